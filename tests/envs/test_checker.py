"""What is said of an environment of one's own."""

import gymnasium as gym
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.core import spaces
from rejeu.core.errors import BadEnvironmentError
from rejeu.envs import masks
from rejeu.envs.checker import advice_on_observations, check_env, findings
from tests.bad_environments import Line
from tests.environments import Sampled
from tests.golden.vec_env_script import Walk


class Tidy(Walk):
    """Nothing to complain of."""

    observation_space = gym.spaces.Box(-9, 9, (3,), np.float32)


def test_environments_are_checked_and_advised_on():
    check_env(Tidy())
    assert findings(gym.make("Pendulum-v1").unwrapped) == []  # whose range of actions rejeu scales
    with pytest.raises(TypeError, match=r"got str; make it: gymnasium.make\('CartPole-v1'\)"):
        check_env("CartPole-v1")
    with pytest.raises(TypeError, match="got the class Tidy; call it"):
        check_env(Tidy)


@pytest.mark.parametrize("high", [np.inf, np.finfo(np.float32).max, 1e38])
def test_actions_without_bounds_are_advised_on_refused_and_not_scaled(high):
    class Free(Tidy):
        action_space = gym.spaces.Box(np.float32([-1, 0]), np.float32([1, high]))

        def step(self, action):
            return super().step(0)

    assert sum("practically none" in one.text for one in findings(Free())) == 1
    with pytest.raises(ValueError, match="SAC needs finite action bounds"):
        spaces.check_box_action(Free.action_space, "SAC")
    action = np.float32([[0.5, 0.25]])
    np.testing.assert_array_equal(spaces.scale_action(Free.action_space, action), action)
    np.testing.assert_array_equal(spaces.unscale_action(Free.action_space, action), action)
    np.testing.assert_array_equal(spaces.scale_action(Free.action_space, jnp.array(action), jnp), action)


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
    check_env(Line(), warn=False)
    half = gym.spaces.Dict({"observation": Walk.observation_space, "desired_goal": Walk.observation_space})
    with pytest.raises(BadEnvironmentError, match="achieved_goal is missing from a Dict with the keys"):
        check_env(Sampled(half), warn=False)
    place = gym.spaces.Dict({"x": Walk.observation_space})
    parts = gym.spaces.Dict({"observation": Walk.observation_space, "achieved_goal": place, "desired_goal": place})
    with pytest.raises(BadEnvironmentError, match=r"achieved_goal is Dict\(.*FlatGoals"):
        check_env(Sampled(parts), warn=False)


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


class Picky(Sampled):
    """Raises for actions that its mask forbids: those of the parity of the time."""

    def __init__(self, space, in_info):
        super().__init__(gym.spaces.Box(-1.0, 1.0, (2,)), space)
        self.in_info, self.allowed = in_info, np.arange(masks.n_choices(space, "")) % 2

    def info(self):
        return {"action_mask": self.allowed} if self.in_info else {}

    def reward(self, action):
        space = self.action_space
        sizes = np.cumsum([0, *space.nvec[:-1]]) if isinstance(space, gym.spaces.MultiDiscrete) else 0
        chosen = np.flatnonzero(action) if isinstance(space, gym.spaces.MultiBinary) else np.ravel(action) + sizes
        assert self.allowed[chosen].all(), "that is not allowed"
        return 0.0

    def action_masks(self):
        if self.in_info:
            raise AssertionError("the info has it")
        return self.allowed


@pytest.mark.parametrize("in_info", [False, True])
@pytest.mark.parametrize("space", [gym.spaces.Discrete(4), gym.spaces.MultiDiscrete([2, 4]), gym.spaces.MultiBinary(4)])
def test_actions_are_checked_that_the_mask_allows(space, in_info):
    assert not [one for one in findings(Picky(space, in_info)) if "allowed" in one.text or one.level == "error"]


class Clock(Tidy):
    """Shows the time in milliseconds since 1970, which a step moves by ``pace``."""

    def __init__(self, dtype, pace):
        super().__init__()
        self.pace, self.observation_space = pace, gym.spaces.Dict(now=gym.spaces.Box(0, 2**45, (2,), dtype))

    def seen(self, obs):
        now = 1_700_000_000_000 + int(obs[0]) * self.pace
        return {"now": np.array([0, now], self.observation_space["now"].dtype)}

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        return self.seen(obs), info

    def step(self, action):
        obs, *others = super().step(action)
        return self.seen(obs), *others


@pytest.mark.parametrize("dtype", [np.int64, np.uint64, np.float64])
def test_steps_that_float32_does_not_show_are_told(dtype):
    """Near 1.7e12 float32 holds the multiples of 131,072."""
    lost = [one for one in findings(Clock(dtype, 1000)) if "float32, which holds both" in one.text]
    assert [one.level for one in lost] == ["warning"]
    assert "under 'now' went from 1700000001000 to 1700000002000 at index 1" in lost[0].text.replace(".0 ", " ")
    assert not [one for one in findings(Clock(dtype, 2**18)) if "holds both" in one.text]
