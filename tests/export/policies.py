"""Small agents of every algorithm for every kind of observation, whose environments are never stepped."""

from typing import Any
from unittest import mock

import gymnasium as gym
import jax
import numpy as np
from gymnasium import spaces

from rejeu import agents
from rejeu.core import xla
from tests.sharing import shared_learners

LIMITS = np.array([-2.0, -1.0], np.float32), np.array([2.0, 5.0], np.float32)
OBSERVATIONS: dict[str, gym.Space] = {
    "MLP": spaces.Box(-3.0, 3.0, (4,), np.float32),
    "CNN": spaces.Box(0, 255, (2, 16, 16), np.uint8),
    "Dict": spaces.Dict(
        {
            "camera": spaces.Dict({"left": spaces.Box(0, 255, (12, 12, 3), np.uint8)}),
            "bits": spaces.MultiBinary(2),
            "gear": spaces.Discrete(3, start=1),
            "speed": spaces.Box(-np.inf, np.inf, (3,), np.float64),
            "switches": spaces.MultiDiscrete([2, 3]),
        }
    ),
    "small Dict": spaces.Dict(
        {
            "nested": spaces.Tuple([spaces.Box(0, 255, (4, 4, 1), np.uint8), spaces.Discrete(3, start=-1)]),
            "speed": spaces.Box(-np.inf, np.inf, (3,), np.float64),
        }
    ),
    "large CNN": spaces.Box(0, 255, (4, 40, 40), np.uint8),
    "goals Dict": spaces.Dict(
        {name: spaces.Box(-5.0, 5.0, (2,)) for name in ("achieved_goal", "desired_goal", "observation")}
    ),
}
ACTIONS: dict[str, gym.Space] = {
    "Box": spaces.Box(*LIMITS),
    "Discrete": spaces.Discrete(3, start=1),
    "MultiDiscrete": spaces.MultiDiscrete([3, 2]),
    "MultiBinary": spaces.MultiBinary(3),
    "whole numbers": spaces.Box(-4, 4, (2,), np.int32),
    "unbounded": spaces.Box(-np.inf, np.inf, (2,), np.float32),
}
CONTINUOUS = ("SAC", "DDPG", "TD3", "TQC", "CrossQ", "FlashSAC", "XQC", "IQL", "TD3BC", "ReBRAC")
DISCRETE = ("DQN", "QRDQN", "IQN", "PQN", "SAC", "DDPG")
ON_POLICY = ("PPO", "A2C", "TRPO", "ARS", "RecurrentPPO", "MaskablePPO")
KINDS = [
    *((name, "Box") for name in CONTINUOUS),
    *((name, "Discrete") for name in DISCRETE),
    *((name, space) for name in ON_POLICY for space in ("Box", "Discrete") if (name, space) != ("MaskablePPO", "Box")),
]
"""Every algorithm with every kind of action that matters to its policy."""
SMALL: dict[str, dict[str, Any]] = {
    "CrossQ": {"policy_kwargs": {"net_arch": [16]}},
    "DQN": {"policy_kwargs": {"net_arch": [16]}, "dueling": True},
    "RecurrentPPO": {"policy_kwargs": {"lstm_hidden_size": 8}},
}
STATISTICS = ("mean", "variance", "n_seen", "scale", "offset")
"""Last parts of the names of what normalizations hold."""
WEIGHTS = ("weight", "bias", "inputs", "recurrent", "recurrent_bias", "log_std")
"""Last parts of the names of what layers hold."""


class Still(gym.Env[Any, Any]):
    """An environment that has spaces, and nothing else."""

    def __init__(self, observation: str, action: str) -> None:
        self.observation_space, self.action_space = OBSERVATIONS[observation], ACTIONS[action]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def action_masks(self) -> np.ndarray:
        return np.ones(3 if isinstance(self.action_space, spaces.Discrete) else 5, np.int8)


def agent_of(name: str, action: str, observation: str = "MLP", **settings: Any) -> agents.Agent:
    """Returns an agent of spaces alone; see :func:`made`."""
    policy = "MultiInputPolicy" if "Dict" in observation else "MlpPolicy"
    small = SMALL.get(name, {"policy_kwargs": {"net_arch": [16, 16]}})
    return made(name, policy, Still(observation, action), **{**small, **settings})


def made(name: str, policy: str, env: Any, **settings: Any) -> agents.Agent:
    """Returns an agent with random weights, and random statistics and gains of its normalizations.

    They are drawn in NumPy, because the compilation of an initialization would take most of the time of a test.
    """

    def zeros(function: Any) -> Any:
        return lambda *arguments: jax.tree.map(
            lambda leaf: np.zeros(leaf.shape, leaf.dtype), jax.eval_shape(function, *arguments)
        )

    with shared_learners(), mock.patch.object(xla, "run_once", zeros):
        agent = agents.AGENTS[name](policy, env, **{"seed": 0, **settings})
    rng, parameters = np.random.default_rng(0), agent.get_parameters()
    for key, array in parameters.items():
        last, n_inputs = key.rpartition(".")[2], np.prod(array.shape[:-1])
        if last in STATISTICS:
            parameters[key] = rng.uniform(0.5, 2.0, array.shape).astype(array.dtype)
        elif last in WEIGHTS and "optimizer" not in key:
            parameters[key] = rng.normal(0, (0.05 if n_inputs == 1 else 1.2) / n_inputs**0.5, array.shape).astype(
                array.dtype
            )
    agent.set_parameters(parameters)
    return agent


def observations(agent: agents.Agent, n: int, seed: int) -> list[Any]:
    """Returns samples of the observation space."""
    agent.observation_space.seed(seed)
    return [agent.observation_space.sample() for _ in range(n)]
