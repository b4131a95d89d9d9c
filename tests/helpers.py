"""Small agents that are fast to create, and functions to inspect them."""

import re
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.agents import Agent
from rejeu.lab.cli import main
from rejeu.training.learner import Readings
from tests.sharing import shared_learners


def small_sac(env: Any, **settings: Any) -> rejeu.SAC:
    """Returns a SAC agent with one small layer and a batch size of 4 that learns from step 8 on.

    Agents with equal settings and spaces share their compiled functions.
    """
    space = env.observation_space if isinstance(env, gym.Env) else getattr(env, "observation_space", None)
    nested = isinstance(space, gym.spaces.Dict | gym.spaces.Tuple)
    settings = {
        "learning_starts": 8,
        "batch_size": 4,
        "buffer_size": 300,
        "policy_kwargs": {"net_arch": [8]},
        "seed": 0,
        **settings,
    }
    with shared_learners():
        return rejeu.SAC("MultiInputPolicy" if nested else "MlpPolicy", env, **settings)


def count_updates(agent: rejeu.SAC) -> list[int]:
    """Replaces the update by a function that does nothing; returns a list of the number of batches of each call."""
    calls: list[int] = []

    def update(leaves: Any, batches: Any, clock: Any) -> tuple[Any, dict, None]:
        calls.append(1 if batches.reward.ndim == 1 else len(batches.reward))
        return leaves, Readings((), np.zeros(1)), None

    agent.learner.update = update
    return calls


def assert_same_parameters(agent: rejeu.SAC, other_agent: rejeu.SAC) -> None:
    """Asserts that all parameters are equal, bit for bit."""
    first, second = Agent.get_parameters(agent), Agent.get_parameters(other_agent)  # those of rejeu.sb3 are nested
    assert list(first) == list(second)
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)


def same_parameters(agent: rejeu.SAC, other_agent: rejeu.SAC) -> bool:
    """Returns whether all parameters are equal, bit for bit."""
    first, second = Agent.get_parameters(agent), Agent.get_parameters(other_agent)  # those of rejeu.sb3 are nested
    return all(np.array_equal(value, second[name]) for name, value in first.items())


def error_of(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """Returns the line that a command prints when it fails."""
    assert main([*argv]) == 2
    text = capsys.readouterr().err
    assert re.fullmatch(r"rejeu: error: [^\n]+\n", text)
    return text
