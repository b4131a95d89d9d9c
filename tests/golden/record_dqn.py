"""Records three gradient steps of Stable-Baselines3's DQN for ``tests/algorithms/test_recorded_updates.py``.

Run it in an environment with stable-baselines3 (2.9.2 was used)::

    python tests/golden/record_dqn.py

It writes ``dqn_sb3.npz`` to its own folder: initial parameters, parameters and Adam moments after the first and the
third step, batches and losses. Between the second and the third step the target is updated with ``tau``, as
Stable-Baselines3 does after an environment step.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.logger import Logger

OBS_DIM, N_ACTIONS, BATCH, UPDATES = 3, 4, 8, 3


class Empty(gym.Env):
    """An environment with the spaces and no dynamics."""

    observation_space = gym.spaces.Box(-5.0, 5.0, (OBS_DIM,), np.float32)
    action_space = gym.spaces.Discrete(N_ACTIONS)

    def reset(self, *, seed=None, options=None):
        return np.zeros(OBS_DIM, np.float32), {}


def parameters(model: DQN) -> dict[str, np.ndarray]:
    """Returns weights and both moments of Adam by torch's names."""
    found: dict[str, np.ndarray] = {}
    for part in ("q_net", "q_net_target"):
        for name, value in getattr(model, part).named_parameters():
            found[f"{part}.{name}"] = value.detach().numpy().copy()
            if value in model.policy.optimizer.state:
                state = model.policy.optimizer.state[value]
                found[f"exp_avg.{part}.{name}"] = state["exp_avg"].numpy().copy()
                found[f"exp_avg_sq.{part}.{name}"] = state["exp_avg_sq"].numpy().copy()
    return found


def main() -> None:
    """Writes the file."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    model = DQN(
        "MlpPolicy",
        Empty(),
        learning_rate=1e-2,
        gamma=0.9,
        tau=0.25,
        target_update_interval=2,
        max_grad_norm=0.1,
        policy_kwargs={"net_arch": [5, 4]},
        device="cpu",
    )
    model.set_logger(Logger(None, []))
    # Otherwise the target equals the network, which could hide errors.
    with torch.no_grad():
        for value in model.q_net_target.parameters():
            value += 0.3 * torch.tensor(rng.normal(size=value.shape), dtype=torch.float32)
    record = {f"before.{name}": value for name, value in parameters(model).items()}

    for update in range(UPDATES):
        f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
        data = {
            "obs": f32(BATCH, OBS_DIM),
            "action": rng.integers(N_ACTIONS, size=BATCH),
            "reward": 2.0 * f32(BATCH),
            "next_obs": f32(BATCH, OBS_DIM),
            "terminated": np.arange(BATCH) % 3 == 0,
        }
        record |= {f"{update}.{name}": value for name, value in data.items()}
        batch = SimpleNamespace(
            observations=torch.tensor(data["obs"]),
            actions=torch.tensor(data["action"])[:, None],
            rewards=torch.tensor(data["reward"])[:, None],
            next_observations=torch.tensor(data["next_obs"]),
            dones=torch.tensor(data["terminated"], dtype=torch.float32)[:, None],
            discounts=None,
        )
        model.replay_buffer = SimpleNamespace(sample=lambda size, env, batch=batch: batch)
        if update == 2:
            model._n_calls = 1
            model._on_step()
        model.train(1, BATCH)
        gradient = torch.cat([p.grad.flatten() for p in model.q_net.parameters()])
        record[f"{update}.grad_norm"] = np.float64(gradient.norm())
        record[f"{update}.loss"] = np.float64(model.logger.name_to_value["train/loss"])
        if update in (0, UPDATES - 1):
            record |= {f"{update}.after.{name}": value for name, value in parameters(model).items()}
    path = Path(__file__).with_name("dqn_sb3.npz")
    np.savez_compressed(path, **record)
    print(path, path.stat().st_size, "bytes")


if __name__ == "__main__":
    main()
