"""Records three gradient steps of Stable-Baselines3's SAC and DQN for ``tests/algorithms/test_recorded_updates.py``.

Run it in an environment with stable-baselines3 (2.9.2 was used)::

    python tests/golden/record_updates.py

It writes ``sac_sb3.npz`` and ``dqn_sb3.npz`` to its own folder: initial parameters, parameters and Adam moments after the
first and the third step, batches, losses, and the standard normal noise sampled by SAC's policy. Stable-Baselines3 is
unchanged except for the source of this noise. Between the second and the third step DQN's target is updated with ``tau``,
as Stable-Baselines3 does after an environment step.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.logger import Logger
from torch.distributions import normal

OBS_DIM, ACTION_DIM, N_ACTIONS, BATCH, UPDATES = 3, 2, 4, 8, 3
SHARED = {"learning_rate": 1e-2, "gamma": 0.9, "device": "cpu"}
Record = dict[str, np.ndarray]


class Empty(gym.Env):
    """An environment with the spaces and no dynamics."""

    observation_space = gym.spaces.Box(-5.0, 5.0, (OBS_DIM,), np.float32)

    def __init__(self, action_space: gym.Space):
        self.action_space = action_space

    def reset(self, *, seed=None, options=None):
        return np.zeros(OBS_DIM, np.float32), {}


def moments(optimizer: torch.optim.Optimizer, name: str, value: torch.Tensor) -> Record:
    """Returns both moments of Adam for a parameter, nothing before the first step."""
    state = optimizer.state.get(value, {})
    return {f"{kind}.{name}": state[kind].numpy().copy() for kind in ("exp_avg", "exp_avg_sq") if kind in state}


def parameters(model: SAC | DQN) -> Record:
    """Returns weights and both moments of Adam by torch's names."""
    if isinstance(model, SAC):
        optimizers = {"actor": model.actor.optimizer, "critic": model.critic.optimizer, "critic_target": None}
    else:
        optimizers = {"q_net": model.policy.optimizer, "q_net_target": None}
    found: Record = {}
    for part, optimizer in optimizers.items():
        for name, value in getattr(model, part).named_parameters():
            found[f"{part}.{name}"] = value.detach().numpy().copy()
            found |= {} if optimizer is None else moments(optimizer, f"{part}.{name}", value)
    if isinstance(model, SAC):
        found["log_ent_coef"] = model.log_ent_coef.detach().numpy().copy()
        found |= moments(model.ent_coef_optimizer, "log_ent_coef", model.log_ent_coef)
    return found


def sac(rng: np.random.Generator) -> SAC:
    """Returns a model whose targets and standard deviations are none that could hide errors: equal, or 1 everywhere."""
    space = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
    model = SAC("MlpPolicy", Empty(space), tau=0.1, ent_coef="auto_0.3", policy_kwargs={"net_arch": [5, 4]}, **SHARED)
    move(model.critic_target, rng)
    with torch.no_grad():
        model.actor.log_std.bias -= 1.5
    return model


def dqn(rng: np.random.Generator) -> DQN:
    """Returns a model whose target differs from its network."""
    settings = {"tau": 0.25, "target_update_interval": 2, "max_grad_norm": 0.1}
    model = DQN(
        "MlpPolicy", Empty(gym.spaces.Discrete(N_ACTIONS)), **settings, policy_kwargs={"net_arch": [5, 4]}, **SHARED
    )
    move(model.q_net_target, rng)
    return model


def move(target: torch.nn.Module, rng: np.random.Generator) -> None:
    """Moves a target away from its network."""
    with torch.no_grad():
        for value in target.parameters():
            value += 0.3 * torch.tensor(rng.normal(size=value.shape), dtype=torch.float32)


def batch_of(kind: str, rng: np.random.Generator) -> Record:
    """Draws a batch, and the noise of SAC's policy."""
    f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    is_sac = kind == "sac"
    data = {
        "obs": (0.5 if is_sac else 1.0) * f32(BATCH, OBS_DIM),
        "action": np.tanh(f32(BATCH, ACTION_DIM)) if is_sac else rng.integers(N_ACTIONS, size=BATCH),
        "reward": (1.0 if is_sac else 2.0) * f32(BATCH),
        "next_obs": (0.5 if is_sac else 1.0) * f32(BATCH, OBS_DIM),
        "terminated": np.arange(BATCH) % 3 == 0,
    }
    return data | ({name: f32(BATCH, ACTION_DIM) for name in ("actor_noise", "target_noise")} if is_sac else {})


def record(kind: str) -> Record:
    """Returns the record of an algorithm."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    model = {"sac": sac, "dqn": dqn}[kind](rng)
    model.set_logger(Logger(None, []))
    found = {f"before.{name}": value for name, value in parameters(model).items()}
    for update in range(UPDATES):
        data = batch_of(kind, rng)
        found |= {f"{update}.{name}": value for name, value in data.items()}
        noises = iter([data[name] for name in ("actor_noise", "target_noise") if name in data])
        normal._standard_normal = lambda shape, dtype, device, noises=noises: torch.tensor(next(noises))
        batch = SimpleNamespace(
            observations=torch.tensor(data["obs"]),
            actions=torch.tensor(data["action"]).reshape(BATCH, -1),
            rewards=torch.tensor(data["reward"])[:, None],
            next_observations=torch.tensor(data["next_obs"]),
            dones=torch.tensor(data["terminated"], dtype=torch.float32)[:, None],
            discounts=None,
        )
        model.replay_buffer = SimpleNamespace(sample=lambda size, env, batch=batch: batch)
        if kind == "dqn" and update == 2:
            model._n_calls = 1
            model._on_step()
        model.train(1, BATCH)
        assert next(noises, None) is None
        if kind == "dqn":
            gradient = torch.cat([p.grad.flatten() for p in model.q_net.parameters()])
            found[f"{update}.grad_norm"] = np.float64(gradient.norm())
        for name in ("critic_loss", "actor_loss", "ent_coef") if kind == "sac" else ("loss",):
            found[f"{update}.{name}"] = np.float64(model.logger.name_to_value[f"train/{name}"])
        if update in (0, UPDATES - 1):
            found |= {f"{update}.after.{name}": value for name, value in parameters(model).items()}
    return found


if __name__ == "__main__":
    for kind in ("sac", "dqn"):
        path = Path(__file__).with_name(f"{kind}_sb3.npz")
        np.savez_compressed(path, **record(kind))
        print(path, path.stat().st_size, "bytes")
