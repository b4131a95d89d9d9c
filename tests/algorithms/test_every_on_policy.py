"""What holds for PPO, A2C, TRPO and PQN on every kind of action: counting, repeating, learning in parts, saving, stopping."""

from __future__ import annotations

import os
import signal

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import Probe
from tests.algorithms.test_every_algorithm import OBS, Precise, Wanderer, assert_precise
from tests.environments import Sampled
from tests.helpers import assert_same_parameters, same_parameters
from tests.on_policy_agents import KINDS, every_kind

every_algorithm = pytest.mark.parametrize(
    "kind", [KINDS["PPO, Discrete"], KINDS["A2C, Box"], KINDS["PQN, Discrete"]], ids=["PPO", "A2C", "PQN"]
)
RATE = {"learning_rate": 1e-2}
"""Constant: how far a run in parts has come is told otherwise than that of a whole one."""


def wanderers(kind, n_envs=1):
    return kind.envs(Wanderer, n_envs)


def start(kind, n_envs=1, **settings):
    return kind.small(wanderers(kind, n_envs), **{**RATE, **settings})


def networks(agent):
    """What is learnt by gradient, by name."""
    return {name: array for name, array in agent.get_parameters().items() if name.startswith("network.")}


def moved(before, agent):
    after = networks(agent)
    return {name for name, array in before.items() if (array != after[name]).any()}


CRITIC = {"value_loss", "entropy_loss", "explained_variance"}
METRICS = {
    "PPO": {"loss", "policy_gradient_loss", "approx_kl", "clip_fraction", "clip_range"} | CRITIC,
    "A2C": {"policy_loss"} | CRITIC,
    "TRPO": {"policy_objective", "kl_divergence_loss", "is_line_search_success", "value_loss", "explained_variance"},
    "PQN": {"loss", "q_value"},
}


@every_kind
def test_everything_moves_and_stays_finite(kind):
    """What a policy gradient of a narrow policy and a value's gradient reach, biases and standard deviation too."""
    agent = start(kind)
    before = networks(agent)
    agent.learn(96)
    assert moved(before, agent) == set(before)
    assert ("network.log_std" in before) == (kind.wrapper is None)
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())
    row = agent.statistics()
    assert all(np.isfinite(value) for value in row.values()), row
    keys = METRICS[kind.name] | {"n_updates", "learning_rate"} | ({"std"} if kind.wrapper is None else set())
    assert {f"train/{key}" for key in keys} <= set(row)
    assert row["rollout/ep_len_mean"] == 5.0


@pytest.mark.parametrize(("n_envs", "total"), [(1, 45), (3, 50), (3, 67)])
@every_algorithm
def test_the_steps_asked_for_are_taken_and_as_many_updates_as_they_owe(kind, n_envs, total):
    """16 steps a gradient step, each learned from 4 times; a last rollout of fewer than 16, or of A2C's, has to wait."""
    agent = start(kind, n_envs).learn(total)
    assert agent.num_timesteps == total
    size = agent.config.n_steps * n_envs
    rest = total % size
    sizes = [size] * (total // size) + [rest] * (kind.name != "A2C" and rest >= 16)
    expected = len(sizes) if kind.name == "A2C" else sum(4 * -(-n // 16) for n in sizes)
    assert agent.n_updates == int(agent.state.n_updates) == expected
    assert sum(agent.history["length"]) <= total
    agent.learn(5)
    assert agent.num_timesteps == 5


@every_kind
def test_two_runs_with_one_seed_are_the_same_to_the_last_bit_and_another_seed_differs(kind):
    def run(seed):
        return start(kind, seed=seed).learn(60)

    one, again, other = run(3), run(3), run(4)
    assert_same_parameters(one, again)
    np.testing.assert_array_equal(one.history["return"], again.history["return"])
    assert not same_parameters(one, other)
    assert (one.history["return"] != other.history["return"]).any()


@every_algorithm
def test_functions_compiled_apart_give_the_same_bits(kind):
    """Agents of these tests share compiled functions; those of users do not."""
    shared = start(kind).learn(40)
    alone = kind.agent("MlpPolicy", wanderers(kind), gamma=0.5, seed=0, **{**PLAIN, **kind.settings, **RATE}).learn(40)
    assert_same_parameters(shared, alone)


PLAIN = {"policy_kwargs": {"net_arch": [16]}}


@pytest.mark.parametrize("n_envs", [1, 3])
@every_algorithm
def test_learning_in_parts_of_whole_rollouts_is_learning_at_once(kind, n_envs):
    size = kind.settings["n_steps"] * n_envs
    whole, parts = start(kind, n_envs).learn(5 * size), start(kind, n_envs)
    for n in (1, 3, 1):
        parts.learn(n * size, reset_num_timesteps=False)
    assert parts.num_timesteps == whole.num_timesteps == 5 * size
    assert_same_parameters(whole, parts)
    np.testing.assert_array_equal(whole.history["return"], parts.history["return"])


@every_algorithm
def test_a_run_stopped_within_a_rollout_goes_on_with_it(kind):
    """A callback's False leaves what was collected for later, however much it is."""
    size = kind.settings["n_steps"]
    whole, parts = start(kind).learn(3 * size), start(kind)
    parts.learn(3 * size, callback=lambda agent, progress: progress.step < size + 2)
    assert parts.num_timesteps == size + 2
    parts.learn(2 * size - 2, reset_num_timesteps=False)
    assert_same_parameters(whole, parts)


@every_algorithm
def test_a_last_rollout_smaller_than_a_minibatch_waits_for_the_next_learn(kind):
    size = kind.settings["n_steps"]
    whole, parts = start(kind).learn(3 * size), start(kind)
    before = parts.get_parameters()
    parts.learn(size - 1)
    assert parts.n_updates == 0
    for name, array in parts.get_parameters().items():
        np.testing.assert_array_equal(array, before[name])
    for n in (1, size, size - 1, 1):
        parts.learn(n, reset_num_timesteps=False)
    assert_same_parameters(whole, parts)
    np.testing.assert_array_equal(whole.history["return"], parts.history["return"])


@every_algorithm
@pytest.mark.parametrize("change", ["set_parameters", "restore_best", "set_env"])
def test_a_rollout_that_another_policy_or_environment_collected_is_not_learned_from(kind, change):
    """The log-probabilities of its actions are computed later, by the policy that learns from it."""
    size = kind.settings["n_steps"]
    agent = start(kind).learn(size)
    agent.remember_best(1.0)
    agent.learn(size - 1, reset_num_timesteps=False)
    assert agent.run.replay.size() == size - 1
    if change == "set_parameters":
        agent.set_parameters(agent.get_parameters())
    elif change == "restore_best":
        agent.restore_best()
    else:
        agent.set_env(wanderers(kind))
    n_updates = agent.n_updates
    agent.learn(size - 1, reset_num_timesteps=False)
    assert (agent.n_updates, agent.run.replay.size()) == (n_updates, size - 1)
    agent.learn(1, reset_num_timesteps=False)
    assert agent.n_updates > n_updates


@every_algorithm
def test_what_happens_beside_training_does_not_change_it(kind, tmp_path):
    def look(agent, progress):
        agent.save(tmp_path / "model")
        agent.statistics()
        agent.predict(OBS)
        agent.evaluate(1, env=wanderers(kind))

    assert_same_parameters(start(kind).learn(20), start(kind).learn(20, callback=look))


@every_kind
def test_a_loaded_agent_predicts_the_same_bits_and_goes_on_learning_all_its_parts(kind, tmp_path):
    agent = start(kind).learn(32)
    path = agent.save(tmp_path / "model")
    loaded = kind.load(path, env=wanderers(kind))
    assert type(loaded) is kind.agent
    assert loaded.config == agent.config
    assert_same_parameters(agent, loaded)
    for deterministic in (True, False):
        np.testing.assert_array_equal(
            loaded.predict(OBS, deterministic=deterministic)[0], agent.predict(OBS, deterministic=deterministic)[0]
        )
    assert (loaded.n_updates, loaded.num_timesteps) == (agent.n_updates, 32)
    before, updates = networks(loaded), loaded.n_updates
    loaded.learn(64)
    assert loaded.n_updates > updates
    assert int(loaded.state.n_updates) == loaded.n_updates
    assert moved(before, loaded) == set(before)


@every_algorithm
def test_ctrl_c_ends_training_after_a_step_with_everything_consistent(kind):
    def press(agent, progress):
        if progress.step == 21:
            os.kill(os.getpid(), signal.SIGINT)

    agent = start(kind).learn(60, callback=press)
    assert agent.interrupted
    assert agent.num_timesteps == 21
    agent.learn(39, reset_num_timesteps=False)
    assert not agent.interrupted
    assert_same_parameters(agent, start(kind).learn(60))


@every_algorithm
def test_another_number_of_environments_may_follow(kind):
    agent = start(kind).learn(21)
    agent.set_env(wanderers(kind, 3))
    agent.learn(50)
    assert agent.num_timesteps == 50
    assert agent.n_updates == int(agent.state.n_updates)
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())


@every_algorithm
def test_one_step_at_a_time_is_learnt_from(kind):
    """Stable-Baselines3 1.1.0 and 1.6.1 mended batches of one."""
    settings = {"n_steps": 1, **({} if kind.name == "A2C" else {"batch_size": 1})}
    agent = start(kind, **settings)
    before = networks(agent)
    agent.learn(12)
    assert agent.n_updates == int(agent.state.n_updates) == (12 if kind.name == "A2C" else 48)
    assert moved(before, agent) == set(before)
    assert all(np.isfinite(array).all() for array in agent.get_parameters().values())


@pytest.mark.parametrize("name", ["PPO, Box", "A2C, Box"])
def test_float64_actions_reach_the_environment_as_such_within_their_bounds(name):
    agent = KINDS[name].small(Precise()).learn(40)
    assert agent.n_updates > 0
    assert_precise(agent)


NESTED = gym.spaces.Dict(
    {
        "camera": gym.spaces.Box(0, 255, (4, 4, 3), np.uint8),
        "place": gym.spaces.Tuple([gym.spaces.Discrete(3, start=5), gym.spaces.Box(-1.0, 1.0, (2,), np.float64)]),
        "bits": gym.spaces.MultiBinary(4),
    }
)


@pytest.mark.parametrize("agent", [rejeu.PPO, rejeu.A2C, rejeu.PQN])
def test_observations_of_any_structure_are_learnt_from_and_saved(agent, tmp_path):
    envs = InProcess([Sampled(NESTED, gym.spaces.Discrete(2)) for _ in range(2)], seed=0)
    one = agent("MultiInputPolicy", envs, n_steps=4, policy_kwargs={"net_arch": [4]}, seed=0)
    before = networks(one)
    one.learn(19)
    assert "network.torso.layers.0.weight" in moved(before, one)
    obs = NESTED.sample()
    two = rejeu.load(one.save(tmp_path / "model"))
    assert one.predict(obs, deterministic=True)[0] == two.predict(obs, deterministic=True)[0]


class Broken(Probe):
    """Its fifth reward is no number."""

    length = 9

    def earn(self, action):
        return float("nan") if self.time == 4 else 1.0


@every_algorithm
def test_a_reward_that_is_no_number_ends_training_before_anything_is_learnt_from_it(kind):
    agent = kind.small(kind.envs(Broken), n_steps=50)
    before = networks(agent)
    with pytest.raises(rejeu.errors.BadEnvironmentError, match=r"returned the reward nan .* after 4 steps"):
        agent.learn(20)
    assert moved(before, agent) == set()
