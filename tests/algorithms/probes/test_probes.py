"""Every algorithm solves the probe environments on each kind of action that it takes.

A value that differs between two places that follow each other needs what is seen, the reward and the discount; an action that
differs between two places needs all of these and the policy. So these are the probes of all algorithms.
"""

import numpy as np
import pytest

import rejeu
from tests import every_agent, on_policy_agents
from tests.algorithms.probes.environments import ByAction, BySightAndAction, Cut, CutByLimit, Endless, Later
from tests.every_agent import env_of, small
from tests.helpers import small_sac
from tests.tiers import exhaustive, only, only_tuples

GAMMA = 0.5
ON_POLICY = on_policy_agents.KINDS
off_policy = pytest.mark.parametrize("name", only(every_agent.SAMPLE, every_agent.KINDS))
on_policy = pytest.mark.parametrize(
    ("name", "n_envs"),
    only_tuples(
        [("PPO, Box", 1), ("A2C, Discrete", 3), ("PQN, Discrete", 1)],
        [(name, n_envs) for name in ON_POLICY for n_envs in (1, 3, 8)],
    ),
)


def solve(name, probe):
    kind = every_agent.KINDS[name]
    return small(kind, env_of(kind, probe()), gamma=GAMMA).learn(700)


def tolerances(name):
    """Of values and of actions. Critics that see every batch normalised by itself are never as exact."""
    return (0.15, 0.25) if name in ("CrossQ", "FlashSAC", "XQC") else (0.05, 0.12)


def values(agent, sights):
    """What the critics say, on average, of the best actions, which are what is learnt best; ``(n,)``."""
    obs = np.float32(sights)[:, None]
    return agent.q_values(obs, agent.predict(obs, deterministic=True)[0], critics="mean")


@pytest.mark.parametrize("name", only(["SAC", "DQN"], every_agent.KINDS))
def test_a_critic_discounts_what_comes_later(name):
    assert values(solve(name, Later), [0.0, 1.0]) == pytest.approx([GAMMA, 1.0], abs=tolerances(name)[0])


@pytest.mark.parametrize("name", only(["SAC"], every_agent.KINDS))
def test_a_critic_bootstraps_through_a_time_limit(name):
    expected = [1.0 / (1.0 - GAMMA)]
    assert values(solve(name, Endless), [0.0]) == pytest.approx(expected, abs=2 * tolerances(name)[0])


@off_policy
def test_the_best_action_depends_on_the_observation(name):
    action, _ = solve(name, BySightAndAction).predict(np.float32([[-1.0], [1.0]]), deterministic=True)
    numbers = action / 2.0 if action.ndim == 1 else action[:, 0]
    assert numbers == pytest.approx([0.5, 1.5], abs=tolerances(name)[1])


@on_policy
@pytest.mark.parametrize(("probe", "first"), [(CutByLimit, GAMMA), (Cut, 0.0)])
def test_a_time_limit_bootstraps_and_a_terminal_state_is_worth_nothing(name, n_envs, probe, first):
    """From what is seen next, in a new episode, it would be 1/3: gamma times the mean of both places' values."""
    kind = ON_POLICY[name]
    agent = kind.small(kind.envs(probe, n_envs)).learn(800 * n_envs)
    assert agent.value(np.float32([[-1.0], [1.0]])) == pytest.approx([first, 1.0], abs=0.05)


@on_policy_agents.every_kind
def test_the_best_action_of_a_policy_gradient_depends_on_the_observation(kind):
    agent = kind.small(kind.envs(BySightAndAction)).learn(2500)
    actions, _ = agent.predict(np.float32([[-1.0], [1.0]]), deterministic=True)
    assert kind.numbers(actions) == pytest.approx([0.5, 1.5], abs=0.15 if kind.wrapper is None else 0.0)


# What SAC alone does.


@exhaustive
def test_the_automatic_temperature_reaches_the_target_entropy():
    """The policy starts with 0.5 nats and the best action alone would have none left; the target is -2."""
    entropies = []
    small_sac(
        ByAction(), target_entropy=-2.0, learning_rate=3e-3, batch_size=32, learning_starts=64, ent_coef="auto_0.1"
    ).learn(1000, callback=lambda _, p: entropies.append(p.metrics["entropy"]) if p.step > 700 else None)
    assert np.mean(entropies) == pytest.approx(-2.0, abs=0.4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings"), [("TQC", {"learning_rate": 1e-3}), ("CrossQ", {"policy_delay": 2})], ids=["TQC", "CrossQ"]
)
def test_pendulum_is_learned_in_5_000_steps(name, settings):
    """A random policy gets about -1,200; swinging up and holding about -150."""
    settings = {**settings, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}}
    agent = rejeu.AGENTS[name]("MlpPolicy", "Pendulum-v1", seed=0, **settings).learn(5_000)
    assert agent.evaluate(20, seed=1).mean_return > -250
