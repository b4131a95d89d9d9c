"""Agents that share compiled functions, because compilation takes most of the time of a test.

A :class:`Learner` contains pure functions of an algorithm's configuration and the spaces, and no state. Agents for
which these are equal can therefore share one.
"""

import contextlib
import copy
import dataclasses
import json
from collections.abc import Hashable, Iterator
from unittest import mock

import gymnasium as gym

from rejeu.agents import Agent, agent as agent_module
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import spaces
from rejeu.training.learner import Learner

READ_ELSEWHERE = ("learning_starts", "buffer_size", "train_freq", "gradient_steps", "n_steps")
"""Settings of off-policy algorithms that only the loop and the replay buffer use."""

_learners: dict[Hashable, Learner] = {}
_build = Agent.build


@contextlib.contextmanager
def shared_learners() -> Iterator[None]:
    """Agents that are created or loaded within the block share the learner of equal agents, also across blocks.

    Not for tests that patch functions of an algorithm other than ``make``: a learner that was compiled earlier does not use
    the patch.
    """
    with mock.patch.object(Agent, "build", _build_or_share):
        yield


def forget_learners() -> None:
    """Lets later agents compile their functions anew."""
    _learners.clear()


def _build_or_share(agent: Agent, observation_space: gym.Space, action_space: gym.Space) -> None:
    key = _key(agent, observation_space, action_space)
    if key not in _learners:
        _build(agent, observation_space, action_space)
        _learners[key] = agent.learner
    with mock.patch.object(agent_module, "Learner", return_value=copy.copy(_learners[key])):
        _build(agent, observation_space, action_space)


def _key(agent: Agent, observation_space: gym.Space, action_space: gym.Space) -> Hashable:
    config = agent.config
    if isinstance(config, OffPolicyConfig):
        defaults = type(config)()
        names = [name for name in READ_ELSEWHERE if hasattr(config, name)]
        if config.normalize is None:
            names.append("gamma")  # otherwise gamma occurs only in the discounts of a batch
        config = dataclasses.replace(config, **{name: getattr(defaults, name) for name in names})
    return (
        type(agent),
        agent.algorithm.make,
        config,
        json.dumps([spaces.describe(observation_space), spaces.describe(action_space)]),
    )
