"""PPO, A2C and PQN solve the probe environments on each kind of action that they take."""

from __future__ import annotations

import numpy as np
import pytest

from tests.algorithms.probes.environments import BySight, BySightAndAction, Constant, Cut, CutByLimit, Endless, Later
from tests.on_policy_agents import KINDS, every_kind
from tests.tiers import crossed, only

GAMMA = 0.5
some_kinds = pytest.mark.parametrize(
    "kind", only([KINDS["PPO, Box"], KINDS["A2C, Discrete"], KINDS["PQN, Discrete"]], KINDS.values()), ids=KINDS
)
every_algorithm = pytest.mark.parametrize(
    "kind", [KINDS["PPO, Discrete"], KINDS["A2C, Box"], KINDS["PQN, Discrete"]], ids=["PPO", "A2C", "PQN"]
)

algorithms_and_numbers = pytest.mark.parametrize(
    ("name", "n_envs"), crossed(["PPO, Discrete", "A2C, Box", "PQN, Discrete"], [1, 3, 8])
)


def solve(kind, probe, steps=800, n_envs=1):
    return kind.small(kind.envs(probe, n_envs)).learn(steps)


def values(agent, sights):
    return agent.value(np.float32(sights)[:, None])


@every_algorithm
def test_the_value_is_a_constant(kind):
    assert values(solve(kind, Constant), [0.0]) == pytest.approx([1.0], abs=0.05)


@some_kinds
def test_the_value_uses_the_observation(kind):
    assert values(solve(kind, BySight), [-1.0, 1.0]) == pytest.approx([-1.0, 1.0], abs=0.08)


@some_kinds
def test_the_value_discounts_what_comes_later(kind):
    assert values(solve(kind, Later), [0.0, 1.0]) == pytest.approx([GAMMA, 1.0], abs=0.05)


@algorithms_and_numbers
def test_a_time_limit_bootstraps_from_the_state_it_was_reached_in(name, n_envs):
    """From what is seen next, in a new episode, it would be 1/3: gamma times the mean of both places' values."""
    agent = solve(KINDS[name], CutByLimit, 800 * n_envs, n_envs)
    assert values(agent, [-1.0, 1.0]) == pytest.approx([GAMMA, 1.0], abs=0.05)


@algorithms_and_numbers
def test_a_terminal_state_is_worth_nothing(name, n_envs):
    assert values(solve(KINDS[name], Cut, 800 * n_envs, n_envs), [-1.0, 1.0]) == pytest.approx([0.0, 1.0], abs=0.05)


@every_algorithm
def test_what_time_limits_cut_is_worth_as_much_as_if_it_went_on(kind):
    assert values(solve(kind, Endless), [0.0]) == pytest.approx([1.0 / (1.0 - GAMMA)], abs=0.05)


@every_kind
def test_the_best_action_depends_on_the_observation(kind):
    agent = solve(kind, BySightAndAction, 2500)
    actions, _ = agent.predict(np.float32([[-1.0], [1.0]]), deterministic=True)
    assert kind.numbers(actions) == pytest.approx([0.5, 1.5], abs=0.15 if kind.wrapper is None else 0.0)
