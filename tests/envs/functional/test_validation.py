"""Errors of environments in JAX are reported in one line, with the fix."""

import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import gymnasium as gym
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import rejeu
from rejeu.core.errors import BadEnvironmentError
from rejeu.envs.checker import findings
from rejeu.envs.functional import REGISTRY, FunctionalEnv, GoalEnv, make
from rejeu.envs.functional.gym_env import GymnasiumEnv
from rejeu.envs.functional.validation import check
from rejeu.lab.cli import main

ZERO, NO = jnp.float32(0.0), jnp.bool_(False)


class Walk(FunctionalEnv):
    """Moves by the action; ``begin`` and ``wrong`` return other values from a reset and a step."""

    wrong: Any = eqx.field(static=True, default=None)
    begin: Any = eqx.field(static=True, default=None)
    mask: Any = eqx.field(static=True, default=None)
    max_episode_steps: int | None = eqx.field(static=True, default=None)

    @property
    def observation_space(self):
        return spaces.Box(-9, 9, (1,), np.float32)

    @property
    def action_space(self):
        return spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, key):
        return (jnp.zeros(1), jnp.zeros(1)) if self.begin is None else self.begin()

    def step(self, key, state, action):
        after = state + action
        return (after, after, -after[0], NO, NO) if self.wrong is None else self.wrong(after)

    def action_mask(self, state):
        return None if self.mask is None else self.mask(state)


def if_on_a_value(x):
    return x, x, ZERO if x[0] > 0 else -ZERO, NO, NO


def write_in_place(x):
    x[0] = 0.0
    return x, x, ZERO, NO, NO


def counts_itself(x, env=Walk()):  # noqa: B008 - never changed
    env.time = 1
    return x, x, ZERO, NO, NO


WRONG: dict[str, list[tuple[Any, str]]] = {
    "wrong": [
        (if_on_a_value, r"step cannot be compiled \(TracerBoolConversionError.*jnp.where instead of if"),
        (lambda x: (x, x, float(x[0]), NO, NO), "step cannot be compiled"),
        (lambda x: (x, np.clip(np.asarray(x), 0, 1), ZERO, NO, NO), "step cannot be compiled .TracerArrayConversion"),
        (lambda x: (x, x[x > 0], ZERO, NO, NO), "step cannot be compiled .NonConcreteBooleanIndex"),
        (write_in_place, "step cannot be compiled .*immutable.*: return new arrays"),
        (counts_itself, "step cannot be compiled .*FrozenInstance.*: return new arrays"),
        (lambda x: ("far", x, ZERO, NO, NO), "cannot be compiled .TypeError"),
        (lambda x: (x, x, ZERO, NO), r"4 values, expected \(state, obs, reward"),
        (lambda x: x, "step returned one array, expected"),
        (lambda x: [x, x, ZERO, NO, NO], "step returned one list, expected"),
        (lambda x: (x, jnp.append(x, x), ZERO, NO, NO), r"observation as float32\[2\], expected float32\[1\]"),
        (lambda x: (x, (x,), ZERO, NO, NO), "observation .*, expected one array"),
        (lambda x: (x, x.astype(int), ZERO, NO, NO), r"as int32\[1\], expected float32\[1\] .*\.astype"),
        (lambda x: (jnp.append(x, x), x, ZERO, NO, NO), r"state as float32\[2\], expected float32\[1\]"),
        (lambda x: (x.astype(int), x, ZERO, NO, NO), r"state as int32\[1\], expected float32\[1\]"),
        (lambda x: ((x, x), x, ZERO, NO, NO), "state .*, expected one array"),
        (lambda x: (x, x, x, NO, NO), r"reward as float32\[1\], expected a float"),
        (lambda x: (x, x, jnp.int32(1), NO, NO), r"reward as int32\[\], expected a float"),
        (lambda x: (x, x, None, NO, NO), "reward as None, expected a float"),
        (lambda x: (x, x, ZERO, ZERO, NO), r"terminated as float32\[\], expected a bool"),
        (lambda x: (x, x, ZERO, NO, None), "truncated as None, expected a bool"),
    ],
    "begin": [
        (lambda: jnp.zeros(1), r"reset returned one array, expected \(state, obs\)"),
        (lambda: (jnp.zeros(1), jnp.zeros(1), {}), "reset returned 3 values"),
        (lambda: (jnp.zeros(1), {}), r"observation \{\}, expected one array"),
        (lambda: (jnp.zeros(1), jnp.zeros(())), r"observation as float32\[\], expected float32\[1\]"),
        (lambda: (jnp.zeros(1), jnp.zeros(1, bool)), r"as bool\[1\], expected float32\[1\]"),
        (lambda: (jnp.zeros(1), np.random.default_rng(None)), "reset cannot be compiled .TypeError"),
    ],
    "mask": [
        (lambda x: jnp.ones(3) if x[0] > 0 else None, "action_mask cannot be compiled"),
        (lambda x: jnp.ones((2, 1), bool), r"mask as bool\[2, 1\], expected a bool for each"),
        (lambda x: jnp.ones(3), r"mask as float32\[3\], expected a bool for each"),
    ],
}


@pytest.mark.parametrize(("part", "function", "said"), [(part, *case) for part in WRONG for case in WRONG[part]])
def test_a_wrong_step_reset_or_mask_is_named(part, function, said):
    with pytest.raises(BadEnvironmentError, match=f"Walk.*{said}") as raised:
        rejeu.make_vector(Walk(**{part: function}))
    assert "\n" not in str(raised.value)


class Reach(GoalEnv):
    """An environment whose goal is the origin."""

    rewarded: Any = eqx.field(static=True, default=None)
    judged: Any = eqx.field(static=True, default=None)
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
        if self.rewarded is not None:
            return self.rewarded(achieved_goal, desired_goal)
        return -jnp.abs(achieved_goal - desired_goal).sum(axis=-1)

    def compute_terminated(self, achieved_goal, desired_goal, info=None):
        return None if self.judged is None else self.judged(achieved_goal, desired_goal)


FUNCTIONS = [
    (lambda a, d: np.linalg.norm(a - d), "cannot be compiled .TracerArrayConversion.*jnp instead of np"),
    (lambda a, d: np.float32(0) if (a == d).all() else np.float32(-1), "cannot be compiled.*jnp.where instead of if"),
    (lambda a, d: float(a[0, 0]), r"cannot be compiled .*no float\(\)"),
    (lambda a, d: jnp.linalg.norm(a - d), r"of 3 goals returned the shape \(\), expected the shape \(3,\)"),
    (lambda a, d: a - d, r"of 3 goals returned the shape \(3, 2\), expected"),
    (lambda a, d: (a, d), r"of 3 goals returned \(ShapeDtypeStruct.*, expected"),
]
NAMES = {"rewarded": "compute_reward", "judged": "compute_terminated"}


@pytest.mark.parametrize(("field", "function", "said"), [
    *(("rewarded", *case) for case in [*FUNCTIONS, (lambda a, d: None, "of 3 goals returned None, expected")]),
    *(("judged", *case) for case in FUNCTIONS[3:]),
])  # fmt: skip
def test_a_wrong_function_of_goals_is_named(field, function, said):
    with pytest.raises(BadEnvironmentError, match=f"Reach.{NAMES[field]} {said}") as raised:
        rejeu.make_vector(Reach(**{field: function}))
    assert "\n" not in str(raised.value)


def distance(achieved_goal, desired_goal):
    return -jnp.abs(achieved_goal - desired_goal).sum(axis=-1)


SIGNATURES = [
    lambda self, achieved_goal, desired_goal, info: distance(achieved_goal, desired_goal) * info.get("scale", 1.0),
    lambda self, achieved_goal, desired_goal, info=None: distance(achieved_goal, desired_goal),
    lambda self, achieved_goal, desired_goal, *, info: distance(achieved_goal, desired_goal),
    lambda self, achieved_goal, desired_goal, _info: distance(achieved_goal, desired_goal),
    lambda self, achieved_goal, desired_goal: distance(achieved_goal, desired_goal),
    lambda self, *goals, **infos: distance(*goals),
    staticmethod(lambda achieved_goal, desired_goal, info: distance(achieved_goal, desired_goal)),
]


@pytest.mark.parametrize("function", SIGNATURES)
def test_functions_of_goals_get_an_empty_info_if_they_take_one(function):
    kind = type("Signed", (Reach,), {"compute_reward": function, "compute_terminated": function})
    goals = rejeu.make_vector(kind()).goals()
    achieved = np.float32([[0, 0], [1, 2]])
    np.testing.assert_array_equal(goals.reward(achieved, 0 * achieved), [0.0, -3.0])
    np.testing.assert_array_equal(goals.terminated(achieved, 0 * achieved), [False, True])
    np.testing.assert_array_equal(GymnasiumEnv(kind()).compute_reward(achieved, 0 * achieved, {}), [0.0, -3.0])


def test_an_error_of_a_function_of_goals_is_shown_without_advice_on_something_else():
    def rewarded(achieved, desired):
        return {}["scale"]

    with pytest.raises(BadEnvironmentError, match="compute_reward found no key 'scale': environments in JAX have no"):
        rejeu.make_vector(Reach(rewarded=rewarded))
    with pytest.raises(
        BadEnvironmentError, match=r"compute_reward cannot be compiled \(TypeError: object of type 'int' .*\)$"
    ):
        rejeu.make_vector(Reach(rewarded=lambda achieved, desired: len(0)))
    with pytest.raises(AttributeError, match="has no attribute"):
        rejeu.make_vector(Reach(rewarded=lambda achieved, desired: achieved.nothing))


class NearlyReach(Walk):
    """Has a reward function, but is not a :class:`GoalEnv`."""

    def compute_reward(self, achieved_goal, desired_goal, info=None):
        return ZERO


def test_a_reward_function_of_an_environment_without_goals_is_named():
    with pytest.raises(
        BadEnvironmentError, match=r"NearlyReach has compute_reward, but does not derive from .*GoalEnv"
    ):
        rejeu.make_vector(NearlyReach())


def test_right_environments_pass():
    check(Walk())
    check(Walk(mask=lambda state: jnp.ones(3, bool)))
    check(Walk(begin=lambda: (np.zeros(1, np.float32), np.zeros(1, np.float32))))
    check(Walk(begin=lambda: (0.0, jnp.zeros(1)), wrong=lambda x: (x.sum(), x.reshape(1), ZERO, NO, NO)))
    check(Reach())
    check(Reach(judged=lambda a, d: (a == d).all(axis=-1)))
    for env_id in REGISTRY:
        check(make(env_id))


@pytest.mark.exhaustive
@pytest.mark.parametrize("begin", [lambda: (0.0, jnp.zeros(1)), lambda: (np.float32(0), np.zeros(1, np.float32))])
def test_numbers_of_python_and_numpy_may_begin_a_state_that_trains_on_the_device(begin):
    agent = rejeu.PPO(
        "MlpPolicy",
        rejeu.make_vector(Walk(begin=begin, wrong=lambda x: (x.sum(), x.reshape(1), ZERO, NO, NO)), 2),
        n_steps=4,
        batch_size=4,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    )
    agent.on_device = True
    assert agent.learn(16).num_timesteps == 16


@pytest.mark.exhaustive
def test_observations_far_outside_of_their_bounds_are_reported_on_the_device():
    env = Walk(wrong=lambda x: (x, x + 1e6, ZERO, NO, NO))
    agent = rejeu.SAC("MlpPolicy", rejeu.make_vector(env), policy_kwargs={"net_arch": [8]}, seed=0)
    agent.on_device = True
    with pytest.warns(UserWarning, match="Walk returned .*Networks learn badly from large numbers"):
        agent.learn(8)


SOURCE = """
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from rejeu.envs.functional import FunctionalEnv, register


class Walk(FunctionalEnv):
    max_episode_steps: int | None = None
    observation_space = spaces.Box(-9, 9, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, key):
        return jnp.zeros(1), jnp.zeros(1)

    def step(self, key, state, action):
        reward = 1.0 if state[0] > 0 else 0.0
        return state, state, reward, jnp.bool_(False), jnp.bool_(False)


register("jax/BadWalk-v0", Walk)
"""


@pytest.mark.parametrize("options", [["train", "--steps", "8"], ["train", "--seeds", "2", "--steps", "8"], ["check"]])
def test_the_command_line_says_it_in_one_line(options, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "bad_walk.py").write_text(SOURCE)
    try:
        command, *options = options
        assert main([command, "bad_walk.py", *options]) == 2
    finally:
        gym.registry.pop("jax/BadWalk-v0", None)
        REGISTRY.pop("jax/BadWalk-v0", None)
        sys.modules.pop("bad_walk", None)
    error = capsys.readouterr().err.strip()
    assert "Walk.step cannot be compiled (TracerBoolConversionError" in error.splitlines()[-1]
    assert len(error.splitlines()) == 1


def test_the_checker_of_all_environments_takes_those_in_jax():
    outside, endless = (one.text for one in findings(Walk()))
    assert "outside of the declared bounds [-9.0, 9.0]" in outside
    assert "no episode ended in 2,000 steps" in endless
    with pytest.raises(BadEnvironmentError, match=r"Walk: Walk\.step cannot be compiled"):
        rejeu.check_env(Walk(wrong=if_on_a_value))


@pytest.mark.parametrize("limit", [0, -1, 2.5, "5", True])
def test_a_time_limit_that_is_no_positive_whole_number_is_refused(limit: Any) -> None:
    with pytest.raises(ValueError, match=r"max_episode_steps=.* must be a whole number of at least 1"):
        rejeu.make_vector("jax/CartPole-v1", max_episode_steps=limit)
