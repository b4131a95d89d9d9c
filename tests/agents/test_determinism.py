"""One seed, one result: every number of a run depends on the seed and the settings alone."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.environments import Counter, Reach
from tests.helpers import assert_same_parameters, small_sac

HINDSIGHT = {"replay_buffer_class": rejeu.HerReplayBuffer}


def counting(n_envs, **settings):
    return small_sac(InProcess([Counter((5, 3)) for _ in range(n_envs)], seed=0), **settings)


def reaching(n_envs, **settings):
    return small_sac(InProcess([Reach() for _ in range(n_envs)], seed=0), **HINDSIGHT, **settings)


MAKERS = {"one environment": (counting, 1), "three": (counting, 3), "hindsight, two": (reaching, 2)}


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


@pytest.mark.parametrize("name", MAKERS)
def test_two_runs_with_one_seed_are_the_same_to_the_last_bit(name):
    make, n_envs = MAKERS[name]
    one, two = make(n_envs).learn(40), make(n_envs).learn(40)
    assert one.n_updates == 32
    assert_same_run(one, two)


def test_functions_compiled_apart_give_the_same_bits():
    """Agents of these tests share compiled functions; those of users do not."""
    alone = rejeu.SAC(
        "MlpPolicy",
        InProcess([Counter((5, 3))], seed=0),
        learning_starts=8,
        batch_size=4,
        buffer_size=300,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    )
    assert_same_run(alone.learn(40), counting(1).learn(40))


@pytest.mark.parametrize(
    ("name", "parts"), [("one environment", (3, 18, 1, 18)), ("three", (9, 30)), ("hindsight, two", (14, 26))]
)
def test_learning_in_parts_is_learning_at_once(name, parts):
    make, n_envs = MAKERS[name]
    whole, pieces = make(n_envs).learn(sum(parts)), make(n_envs)
    for part in parts:
        pieces.learn(part, reset_num_timesteps=False)
    assert pieces.num_timesteps == whole.num_timesteps
    assert_same_run(whole, pieces)


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


def test_what_happens_beside_training_does_not_change_it(tmp_path):
    """Saving, reading statistics and predicting in a callback leave a run as it is."""

    def look(agent, progress):
        agent.save(tmp_path / "model")
        agent.statistics()
        agent.predict(np.zeros((2, 3)))
        agent.get_parameters()

    assert_same_run(counting(1).learn(20), counting(1).learn(20, callback=look))


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
