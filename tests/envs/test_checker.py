"""What is said of an environment of one's own."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from rejeu.envs.checker import advice_on_observations, check_env, findings
from rejeu.errors import BadEnvironmentError
from tests.environments import Reach, Sampled
from tests.golden.vec_env_script import Walk


class Tidy(Walk):
    """Nothing to complain of."""

    observation_space = gym.spaces.Box(-9, 9, (3,), np.float32)


def test_environments_are_checked_and_advised_on():
    check_env(Tidy())
    with pytest.warns(UserWarning, match="symmetric and normalized"):
        check_env(gym.make("Pendulum-v1").unwrapped)
    check_env(gym.make("Pendulum-v1").unwrapped, warn=False)
    with pytest.raises(TypeError, match="got str"):
        check_env("CartPole-v1")


@pytest.mark.parametrize(
    ("actions", "is_chosen"),
    [
        (gym.spaces.Dict({"turn": gym.spaces.Discrete(2), "go": gym.spaces.Tuple([Tidy.action_space])}), True),
        (gym.spaces.Tuple([Tidy.action_space, gym.spaces.Text(3)]), False),
        (gym.spaces.Dict({}), False),
    ],
)
def test_nested_actions_are_fine_where_agents_choose_all_parts(actions, is_chosen):
    class Nested(Tidy):
        action_space = actions

        def step(self, action):
            return super().step(0)

    found = [finding.text for finding in findings(Nested()) if finding.level == "error"]
    assert ["agents choose Box, Discrete" in text for text in found] == ([] if is_chosen else [True])


def test_goal_environments_are_checked_for_what_hindsight_needs():
    class Line(Reach):
        def _observe(self):
            return {key: np.array(value) for key, value in super()._observe().items()}

    check_env(Line(), warn=False)
    half = gym.spaces.Dict({"observation": Walk.observation_space, "desired_goal": Walk.observation_space})
    with pytest.raises(BadEnvironmentError, match="achieved_goal is missing from a Dict with the keys"):
        check_env(Sampled(half), warn=False)


BOX = gym.spaces.Box


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (BOX(-1, 1, (3,), np.float32), []),
        (BOX(-1, 1, (3,), np.float64), ["dtype float64; use float32"]),
        (BOX(-1, 1, (3, 2), np.float32), ["two axes are flattened"]),
        (BOX(0, 255, (84, 84, 3), np.uint8), []),
        (BOX(0, 1, (84, 84, 3), np.float32), ["only uint8 images"]),
        (BOX(0, 1, (84, 84, 3), np.uint8), ["other bounds than 0 and 255"]),
        (BOX(0, 255, (20, 20, 3), np.uint8), ["below 36x36"]),
        (gym.spaces.Dict({"a": gym.spaces.Dict({"b": BOX(-1, 1, (1,), np.float32)})}), ["'a' is nested"]),
        (gym.spaces.Discrete(3), []),
    ],
)
def test_advice_on_observations(space, said):
    found = [*advice_on_observations(space)]
    assert len(found) == len(said)
    for line, part in zip(found, said, strict=True):
        assert part in line
