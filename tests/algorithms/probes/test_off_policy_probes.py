"""Every off-policy algorithm solves the probe environments on each kind of action that it takes."""

from __future__ import annotations

import numpy as np
import pytest

import rejeu
from tests.algorithms.probes.environments import ByAction, BySight, BySightAndAction, Constant, Endless, Later
from tests.every_agent import KINDS, env_of, small
from tests.tiers import only

GAMMA = 0.5
every_algorithm = pytest.mark.parametrize("name", KINDS)
some_algorithms = pytest.mark.parametrize("name", only(["SAC", "TD3", "DQN"], KINDS))


def solve(name, probe):
    kind = KINDS[name]
    return small(kind, env_of(kind, probe()), gamma=GAMMA).learn(700)


def tolerances(name):
    """Of values and of actions. Critics that see every batch normalised by itself are never as exact."""
    return (0.15, 0.25) if name in ("CrossQ", "FlashSAC", "XQC") else (0.05, 0.12)


def best_actions(agent, sights):
    """What the agent does without exploring, in the probes' terms: numbers from 0 to 2, ``(n,)``."""
    action, _ = agent.predict(np.float32(sights)[:, None], deterministic=True)
    return action / 2.0 if action.ndim == 1 else action[:, 0]


def values(agent, sights):
    """What the critics say, on average, of those actions, which are what is learnt best; ``(n,)``."""
    obs = np.float32(sights)[:, None]
    return agent.q_values(obs, agent.predict(obs, deterministic=True)[0], critics="mean")


@some_algorithms
def test_the_critic_learns_a_constant(name):
    assert values(solve(name, Constant), [0.0]) == pytest.approx([1.0], abs=tolerances(name)[0])


@some_algorithms
def test_the_critic_bootstraps_through_a_time_limit(name):
    expected = [1.0 / (1.0 - GAMMA)]
    assert values(solve(name, Endless), [0.0]) == pytest.approx(expected, abs=2 * tolerances(name)[0])


@some_algorithms
def test_the_critic_uses_the_observation(name):
    assert values(solve(name, BySight), [-1.0, 1.0]) == pytest.approx([-1.0, 1.0], abs=tolerances(name)[0])


@every_algorithm
def test_the_critic_discounts_what_comes_later(name):
    assert values(solve(name, Later), [0.0, 1.0]) == pytest.approx([GAMMA, 1.0], abs=tolerances(name)[0])


@some_algorithms
def test_the_best_action_is_found(name):
    assert best_actions(solve(name, ByAction), [0.0]) == pytest.approx([1.5], abs=tolerances(name)[1])


@every_algorithm
def test_the_best_action_depends_on_the_observation(name):
    action = best_actions(solve(name, BySightAndAction), [-1.0, 1.0])
    assert action == pytest.approx([0.5, 1.5], abs=tolerances(name)[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"), [("TQC", {"learning_rate": 1e-3}), ("CrossQ", {"policy_delay": 2})], ids=["TQC", "CrossQ"]
)
def test_pendulum_is_learned_in_5_000_steps(name, settings):
    """A random policy gets about -1,200; swinging up and holding about -150."""
    settings = {**settings, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}
    agent = rejeu.AGENTS[name]("MlpPolicy", "Pendulum-v1", seed=0, **settings).learn(5_000)
    assert agent.evaluate(20, seed=1).mean_return > -250
