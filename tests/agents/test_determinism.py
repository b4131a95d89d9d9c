"""One seed, one result: every number of a run depends on the seed and the settings alone."""

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.environments import Counter, Reach
from tests.helpers import assert_same_parameters, small_sac

pytestmark = pytest.mark.usefixtures("learners_are_shared")

HINDSIGHT = {"replay_buffer_class": rejeu.HerReplayBuffer}


def counting(n_envs, **settings):
    return small_sac(InProcess([Counter((5, 3)) for _ in range(n_envs)], seed=0), **settings)


def reaching(n_envs, **settings):
    return small_sac(InProcess([Reach() for _ in range(n_envs)], seed=0), **HINDSIGHT, **settings)


def assert_same_run(one, two):
    """Fails unless networks, buffers, episodes and the next action are the same, bit for bit."""
    assert_same_parameters(one, two)
    first, second = one.replay_buffer.arrays(), two.replay_buffer.arrays()
    assert list(first) == list(second)
    for name, array in first.items():
        np.testing.assert_array_equal(array, second[name], err_msg=name)
    for column in ("step", "env", "return", "length", "success"):
        np.testing.assert_array_equal(one.history[column], two.history[column])
    np.testing.assert_array_equal(one.run.action, two.run.action)
    assert (one.n_updates, one.run.step) == (two.n_updates, two.run.step)


def test_two_runs_with_hindsight_are_the_same_to_the_last_bit_and_so_is_one_in_parts():
    one, two, parts = (reaching(2) for _ in range(3))
    for part in (14, 26):
        parts.learn(part, reset_num_timesteps=False)
    assert one.learn(40).n_updates == 32
    assert_same_run(one, two.learn(40))
    assert_same_run(one, parts)


def test_learning_in_parts_is_learning_at_once_with_delayed_updates_and_noise():
    settings = {
        "train_freq": (1, "episode"),
        "gradient_steps": -1,
        "action_noise": rejeu.OrnsteinUhlenbeckActionNoise([0.0], [0.3]),
    }
    whole, pieces = counting(1, **settings).learn(40), counting(1, **settings)
    for part in (13, 20, 7):
        pieces.learn(part, reset_num_timesteps=False)
    assert whole.n_updates > 20
    assert_same_run(whole, pieces)


def test_evaluating_in_other_environments_does_not_change_training():
    one, two = counting(1), counting(1)
    one.learn(20)
    two.learn(10)
    two.evaluate(2, env=Counter((4,)))
    two.learn(10, reset_num_timesteps=False)
    assert_same_run(one, two)


def test_a_seed_decides_the_environments_too():
    """Given by a function, an environment gets its seed from the agent alone."""
    firsts = [
        small_sac(lambda: Counter((5,)), seed=seed, learning_starts=99).learn(1).run.obs[0, 2] for seed in (4, 4, 5)
    ]
    assert firsts[0] == firsts[1] != firsts[2]


@pytest.mark.parametrize("backend", ["gymnasium", "envpool"])
def test_a_seed_decides_a_run_on_every_backend(backend):
    runs = [
        small_sac(rejeu.make_vector("Pendulum-v1", 2, backend), seed=3, learning_starts=99).learn(30) for _ in range(2)
    ]
    assert_same_run(*runs)


def test_without_a_seed_one_is_drawn_and_kept():
    one, two = small_sac(Counter(), seed=None), small_sac(Counter(), seed=None)
    assert one.seed != two.seed
    assert_same_parameters(one, small_sac(Counter(), seed=one.seed))


@pytest.mark.parametrize("overlap", [True, False])
def test_actions_follow_the_newest_update_unless_they_overlap_with_it(overlap):
    agent = rejeu.DDPG(
        "MlpPolicy",
        gym.make("Pendulum-v1"),
        overlap=overlap,
        learning_starts=8,
        batch_size=4,
        learning_rate=1e-2,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    ).learn(30)
    newest = np.asarray(agent.learner.exploit(agent.run.state, agent.run.obs))
    assert (newest == agent.run.action).all() == (not overlap)
