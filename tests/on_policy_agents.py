"""Small agents that learn from rollouts, with every kind of action space that they support; they share compiled functions."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu import agents
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import Bitwise, Discretely, Doubly, Probe
from tests.sharing import shared_learners
from tests.tiers import only


class Kind(NamedTuple):
    """An algorithm with one kind of action space."""

    name: str
    wrapper: type[gym.ActionWrapper] | None
    """Wrapper that gives a probe such actions; None keeps its Box."""
    settings: dict[str, Any]

    @property
    def agent(self) -> type[agents.Agent]:
        return agents.AGENTS[self.name]

    def envs(self, probe: type[Probe], n_envs: int = 1) -> InProcess:
        """Returns a vector environment of ``n_envs`` probes with such actions."""
        probes = [probe() for _ in range(n_envs)]
        return InProcess([probe if self.wrapper is None else self.wrapper(probe) for probe in probes])

    def small(self, env: Any, **settings: Any) -> agents.Agent:
        """Returns a small agent of this kind."""
        with shared_learners():
            return self.agent("MlpPolicy", env, **{**LEARNING, **self.settings, **settings})

    def numbers(self, actions: np.ndarray) -> np.ndarray:
        """Converts a batch of actions to the probe's numbers, from 0 to 2."""
        if self.wrapper is None:
            return actions[:, 0]
        wrapped = self.wrapper(Probe())
        return np.array([wrapped.action(action)[0] for action in actions])


LEARNING = {"learning_rate": rejeu.Linear(2e-2, 1e-3), "gamma": 0.5, "policy_kwargs": {"net_arch": [16]}, "seed": 0}
ALGORITHMS = {
    "PPO": {"n_steps": 16, "batch_size": 16, "n_epochs": 4},
    "A2C": {"n_steps": 4, "learning_rate": rejeu.Linear(5e-2, 1e-2)},
    "TRPO": {"n_steps": 16, "batch_size": 16, "n_critic_updates": 4, "target_kl": 0.03},
    "PQN": {
        "n_steps": 16,
        "batch_size": 16,
        "n_epochs": 4,
        "exploration_initial_eps": 0.5,
        "exploration_final_eps": 0.5,
    },
}
ACTIONS = {"Box": None, "Discrete": Discretely, "MultiDiscrete": Doubly, "MultiBinary": Bitwise}
NARROW = {"policy_kwargs": {"net_arch": [16], "log_std_init": -1.0}}
"""A Box policy with a smaller initial standard deviation converges sooner."""
CALM = {"learning_rate": rejeu.Linear(1e-2, 1e-3)}
"""At A2C's rate for other actions, the mean of a Box policy leaves the bounds on some seeds and does not come back."""
SAMPLE = ("PPO, MultiDiscrete", "A2C, Box", "PQN, Discrete")
"""Algorithms with networks of their own, which run by default; the other kinds are exhaustive."""

KINDS = {
    f"{name}, {actions}": Kind(
        name,
        wrapper,
        settings | (NARROW if wrapper is None else {}) | (CALM if (name, actions) == ("A2C", "Box") else {}),
    )
    for name, settings in ALGORITHMS.items()
    for actions, wrapper in ACTIONS.items()
    if name != "PQN" or actions == "Discrete"
}
every_kind = pytest.mark.parametrize("kind", only([KINDS[name] for name in SAMPLE], KINDS.values()), ids=KINDS)
