"""Records three gradient steps of Stable-Baselines3's SAC, including noise, for ``tests/algorithms/test_recorded_updates.py``.

Run it in an environment with stable-baselines3 (2.9.2 was used)::

    python tests/golden/record_sac.py

It writes ``sac_sb3.npz`` to its own folder: initial parameters, parameters and Adam moments after the first and the
third step, batches, and the standard normal noise sampled by the policy. Stable-Baselines3 is unchanged except for the
source of its noise.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from torch.distributions import normal

OBS_DIM, ACTION_DIM, BATCH, UPDATES = 3, 2, 8, 3


class Empty(gym.Env):
    """An environment with the spaces and no dynamics."""

    observation_space = gym.spaces.Box(-5.0, 5.0, (OBS_DIM,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)

    def reset(self, *, seed=None, options=None):
        return np.zeros(OBS_DIM, np.float32), {}


def parameters(model: SAC) -> dict[str, np.ndarray]:
    """Returns weights and both moments of Adam by torch's names."""
    found: dict[str, np.ndarray] = {"log_ent_coef": model.log_ent_coef.detach().numpy().copy()}
    optimizers = {"actor": model.actor.optimizer, "critic": model.critic.optimizer}
    for part in ("actor", "critic", "critic_target"):
        for name, value in getattr(model, part).named_parameters():
            found[f"{part}.{name}"] = value.detach().numpy().copy()
            if part in optimizers and value in optimizers[part].state:
                state = optimizers[part].state[value]
                found[f"exp_avg.{part}.{name}"] = state["exp_avg"].numpy().copy()
                found[f"exp_avg_sq.{part}.{name}"] = state["exp_avg_sq"].numpy().copy()
    if model.log_ent_coef in model.ent_coef_optimizer.state:
        state = model.ent_coef_optimizer.state[model.log_ent_coef]
        found["exp_avg.log_ent_coef"] = state["exp_avg"].numpy().copy()
        found["exp_avg_sq.log_ent_coef"] = state["exp_avg_sq"].numpy().copy()
    return found


def main() -> None:
    """Writes the file."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    model = SAC(
        "MlpPolicy",
        Empty(),
        learning_rate=1e-2,
        gamma=0.9,
        tau=0.1,
        ent_coef="auto_0.3",
        policy_kwargs={"net_arch": [5, 4]},
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    # Otherwise targets equal critics and the policy's standard deviation is 1 everywhere, which could hide errors.
    with torch.no_grad():
        for value in model.critic_target.parameters():
            value += 0.3 * torch.tensor(rng.normal(size=value.shape), dtype=torch.float32)
        model.actor.log_std.bias -= 1.5
    record = {f"before.{name}": value for name, value in parameters(model).items()}

    for update in range(UPDATES):
        f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
        data = {
            "obs": 0.5 * f32(BATCH, OBS_DIM),
            "action": np.tanh(f32(BATCH, ACTION_DIM)),
            "reward": f32(BATCH),
            "next_obs": 0.5 * f32(BATCH, OBS_DIM),
            "terminated": np.arange(BATCH) % 3 == 0,
            "actor_noise": f32(BATCH, ACTION_DIM),
            "target_noise": f32(BATCH, ACTION_DIM),
        }
        record |= {f"{update}.{name}": value for name, value in data.items()}
        noises = iter([data["actor_noise"], data["target_noise"]])
        normal._standard_normal = lambda shape, dtype, device, noises=noises: torch.tensor(next(noises))
        batch = SimpleNamespace(
            observations=torch.tensor(data["obs"]),
            actions=torch.tensor(data["action"]),
            rewards=torch.tensor(data["reward"])[:, None],
            next_observations=torch.tensor(data["next_obs"]),
            dones=torch.tensor(data["terminated"], dtype=torch.float32)[:, None],
            discounts=None,
        )
        model.replay_buffer = SimpleNamespace(sample=lambda size, env, batch=batch: batch)
        model.train(1, BATCH)
        assert next(noises, None) is None
        if update in (0, UPDATES - 1):
            record |= {f"{update}.after.{name}": value for name, value in parameters(model).items()}
        for name in ("critic_loss", "actor_loss", "ent_coef"):
            record[f"{update}.{name}"] = np.float64(model.logger.name_to_value[f"train/{name}"])
    path = Path(__file__).with_name("sac_sb3.npz")
    np.savez_compressed(path, **record)
    print(path, path.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
