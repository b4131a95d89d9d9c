"""Records weights and episodes of a few hundred steps, and compares two checkouts: results for a seed must not change.

    PYTHONPATH=../before/src python scripts/signatures.py --out before.json
    python scripts/signatures.py --against before.json

Each configuration is trained from a fixed seed. Its signature is a hash of the final weights and of the returns and lengths
of the episodes. The results of XLA differ between machines and versions, so both checkouts must run on the same one.
Exits with status 1 if a signature differs. ``--only NAME ...`` trains some of the configurations.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

import rejeu

SMALL: dict[str, Any] = {"policy_kwargs": {"net_arch": [16]}, "seed": 5}
OFF_POLICY: dict[str, Any] = {**SMALL, "learning_starts": 50, "batch_size": 16, "buffer_size": 400}
ON_POLICY: dict[str, Any] = {**SMALL, "n_steps": 32, "batch_size": 32, "n_epochs": 2}
HINDSIGHT: dict[str, Any] = {**OFF_POLICY, "replay_buffer_class": rejeu.HerReplayBuffer}


class Doors(gym.Env):
    """Three doors, one of which is locked in each step; the highest open one is right."""

    observation_space = gym.spaces.Box(0, 1, (3,), np.float32)
    action_space = gym.spaces.Discrete(3)

    def reset(self, **options: Any) -> Any:
        super().reset(**options)
        self.steps = 0
        return self.look(), {}

    def look(self) -> np.ndarray:
        self.is_open = np.arange(3) != self.np_random.integers(3)
        return self.is_open.astype(np.float32)

    def action_masks(self) -> np.ndarray:
        return self.is_open

    def step(self, action: Any) -> Any:
        reward, self.steps = float(action == np.flatnonzero(self.is_open)[-1]), self.steps + 1
        return self.look(), reward, self.steps == 10, False, {}


def host(env: str, n_envs: int = 1) -> Any:
    """Returns environments that are stepped in this process."""
    return rejeu.make_vector(env, n_envs, "gymnasium", seed=5)


def device(env: str, n_envs: int = 2) -> Any:
    """Returns environments that are compiled with the agent."""
    return rejeu.make_vector(env, n_envs, seed=5)


def two_seeds() -> Any:
    """Returns two runs that one program trains."""
    settings = {name: value for name, value in ON_POLICY.items() if name != "seed"}
    return rejeu.train_seeds(rejeu.PPO, "MlpPolicy", "jax/CartPole-v1", 256, seeds=2, n_envs=2, **settings)


def on_host(agent: rejeu.OffPolicyAgent) -> rejeu.OffPolicyAgent:
    """Lets an agent train with the loop of the host."""
    agent.on_device = False
    return agent


AGENTS: dict[str, Callable[[], Any]] = {
    "SAC": lambda: rejeu.SAC("MlpPolicy", host("Pendulum-v1"), **OFF_POLICY),
    "SAC, 3 environments, n-step, normalize": lambda: rejeu.SAC(
        "MlpPolicy", host("Pendulum-v1", 3), n_steps=3, normalize=True, **OFF_POLICY
    ),
    "TD3, noise, PER": lambda: rejeu.TD3(
        "MlpPolicy", host("Pendulum-v1"), action_noise=0.1, priorities={}, **OFF_POLICY
    ),
    "DQN, 4 environments, n-step, PER": lambda: rejeu.DQN(
        "MlpPolicy", host("CartPole-v1", 4), n_steps=3, priorities={}, **OFF_POLICY
    ),
    "SAC, HER": lambda: on_host(rejeu.SAC("MultiInputPolicy", device("jax/PointMaze-v0"), **HINDSIGHT)),
    "PPO, 4 environments, normalize": lambda: rejeu.PPO(
        "MlpPolicy", host("Pendulum-v1", 4), normalize=True, **ON_POLICY
    ),
    "RecurrentPPO": lambda: rejeu.RecurrentPPO(
        "MlpPolicy",
        host("CartPole-v1", 2),
        **{**ON_POLICY, "policy_kwargs": {"net_arch": [16], "lstm_hidden_size": 8}},
    ),
    "MaskablePPO": lambda: rejeu.MaskablePPO("MlpPolicy", Doors(), **ON_POLICY),
    "device: SAC, HER, n-step": lambda: rejeu.SAC(
        "MultiInputPolicy", device("jax/PointMaze-v0"), n_steps=2, **HINDSIGHT
    ),
    "device: DQN, PER": lambda: rejeu.DQN("MlpPolicy", device("jax/CartPole-v1"), priorities={}, **OFF_POLICY),
    "device: TD3, noise, normalize": lambda: rejeu.TD3(
        "MlpPolicy", device("jax/Pendulum-v1"), action_noise=0.1, normalize=True, **OFF_POLICY
    ),
    "device: PPO, normalize": lambda: rejeu.PPO("MlpPolicy", device("jax/CartPole-v1", 4), normalize=True, **ON_POLICY),
    "device: PQN": lambda: rejeu.PQN("MlpPolicy", device("jax/CartPole-v1", 4), **SMALL),
    "device: two seeds of PPO": two_seeds,
}
"""The configurations: agents that are trained for 256 steps, or runs that were."""


def signature(trained: Any) -> str:
    """Returns a hash of the weights and episodes of one agent or several."""
    digest = hashlib.sha256()
    for agent in trained if isinstance(trained, list | tuple) else [trained]:
        for name, value in sorted(agent.get_parameters().items()):
            digest.update(f"{name} {value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        for column in ("step", "env", "return", "length"):
            digest.update(agent.history[column].tobytes())
    return digest.hexdigest()[:16]


def record(only: list[str]) -> dict[str, str]:
    """Trains the configurations and returns their signatures."""
    signatures = {}
    for name in only:
        agent = AGENTS[name]()
        signatures[name] = signature(agent.learn(256) if hasattr(agent, "learn") else agent)
        print(f"{signatures[name]}  {name}", flush=True)
    return signatures


def main() -> int:
    """Runs the command and returns its exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, help="write the signatures to this file")
    parser.add_argument("--against", type=Path, help="compare with the signatures in this file")
    parser.add_argument("--only", nargs="*", choices=AGENTS, default=[*AGENTS], metavar="NAME")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    print(rejeu.__file__)
    signatures = record(arguments.only)
    if arguments.out:
        arguments.out.write_text(json.dumps(signatures, indent=1) + "\n", encoding="utf-8")
    if not arguments.against:
        return 0
    before = json.loads(arguments.against.read_text(encoding="utf-8"))
    changed = [name for name in signatures if before.get(name) != signatures[name]]
    print(
        f"{len(signatures) - len(changed)} of {len(signatures)} equal",
        *(f"changed: {name}" for name in changed),
        sep="\n",
    )
    return int(bool(changed))


if __name__ == "__main__":
    sys.exit(main())
