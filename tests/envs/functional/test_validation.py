"""Errors of environments in JAX are reported in one line, with the fix."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import rejeu
from rejeu.envs.functional import FunctionalEnv, GoalEnv, make
from rejeu.envs.functional.registry import REGISTRY
from rejeu.envs.functional.validation import check
from rejeu.errors import BadEnvironmentError

ZERO, NO = jnp.float32(0.0), jnp.bool_(False)


class Walk(FunctionalEnv):
    """Moves by the action; ``wrong`` returns other values from a step."""

    wrong: Any = eqx.field(static=True, default=None)
    max_episode_steps: int | None = eqx.field(static=True, default=None)

    @property
    def observation_space(self):
        return spaces.Box(-9, 9, (1,), np.float32)

    @property
    def action_space(self):
        return spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, key):
        return jnp.zeros(1), jnp.zeros(1)

    def step(self, key, state, action):
        after = state + action
        return (after, after, -after[0], NO, NO) if self.wrong is None else self.wrong(after)


def if_on_a_value(x):
    return x, x, ZERO if x[0] > 0 else -ZERO, NO, NO


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (if_on_a_value, r"Walk.step cannot be compiled \(TracerBoolConversionError.*jnp.where instead of if"),
        (lambda x: (x, x, float(x[0]), NO, NO), "Walk.step cannot be compiled"),
        (lambda x: (x, x, x[np.nonzero(x)[0]].sum(), NO, NO), "Walk.step cannot be compiled"),
        (lambda x: (x, x, ZERO, NO), r"returned 4 values, expected \(state, obs, reward"),
        (lambda x: (x, jnp.append(x, x), ZERO, NO, NO), r"an observation of shape \(2,\), expected \(1,\)"),
        (lambda x: (x, (x,), ZERO, NO, NO), "returned the observation PyTreeDef"),
        (lambda x: (x, x.astype(int), ZERO, NO, NO), "dtype int32, expected float32: use .astype"),
        (lambda x: (jnp.append(x, x), x, ZERO, NO, NO), r"changed state from float32\[1\] in reset to float32\[2\]"),
        (lambda x: ((x, x), x, ZERO, NO, NO), "a state of another structure than reset"),
        (lambda x: (x, x, x, NO, NO), r"returned reward as float32\[1\], expected a float"),
        (lambda x: (x, x, ZERO, ZERO, NO), r"returned terminated as float32\[\], expected a bool"),
        (lambda x: (x, x, ZERO, NO, None), "returned truncated as None, expected a bool"),
    ],
)
def test_a_wrong_step_is_named(wrong, said):
    with pytest.raises(BadEnvironmentError, match=said) as raised:
        rejeu.make_vector(Walk(wrong=wrong))
    assert "\n" not in str(raised.value)


class Reach(GoalEnv):
    """An environment whose goal is the origin."""

    rewarded: Any = eqx.field(static=True, default=None)
    max_episode_steps: int | None = eqx.field(static=True, default=None)

    @property
    def observation_space(self):
        return spaces.Dict({k: spaces.Box(-1, 1, (2,)) for k in ("observation", "achieved_goal", "desired_goal")})

    @property
    def action_space(self):
        return spaces.Discrete(2)

    def reset(self, key):
        return jnp.zeros(2), dict.fromkeys(self.observation_space, jnp.zeros(2))

    def step(self, key, state, action):
        return state, dict.fromkeys(self.observation_space, state), ZERO, NO, NO

    def compute_reward(self, achieved_goal, desired_goal, info=None):
        return self.rewarded(achieved_goal, desired_goal)


@pytest.mark.parametrize(
    ("rewarded", "said"),
    [
        (lambda a, d: np.linalg.norm(a - d), "Reach.compute_reward cannot be compiled"),
        (lambda a, d: jnp.linalg.norm(a - d), r"of 3 goals returned the shape \(\), expected \(3,\)"),
        (lambda a, d: a - d, r"of 3 goals returned the shape \(3, 2\), expected \(3,\)"),
    ],
)
def test_a_wrong_reward_function_is_named(rewarded, said):
    with pytest.raises(BadEnvironmentError, match=said):
        rejeu.make_vector(Reach(rewarded=rewarded))


def test_right_environments_pass():
    check(Walk())
    check(Reach(rewarded=lambda a, d: -jnp.abs(a - d).sum(axis=-1)))
    for env_id in REGISTRY:
        check(make(env_id))
