"""Environments in JAX as Gymnasium environments: checks, resets, pictures, exact resume, training."""

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs import snapshot
from rejeu.envs.checker import findings
from rejeu.envs.functional import REGISTRY, make
from rejeu.envs.rendering import display_for_pygame
from tests.tiers import exhaustive, only

IDS = [*REGISTRY]


@pytest.mark.parametrize("env_id", only({"jax/CartPole-v1"}, IDS))
def test_the_check_finds_no_error(env_id):
    assert [finding for finding in findings(gym.make(env_id)) if finding.level == "error"] == []


@pytest.mark.parametrize("env_id", IDS)
def test_the_registered_limit_is_the_environments_own(env_id):
    limit, own = gym.spec(env_id).max_episode_steps, make(env_id).max_episode_steps
    assert own is not None
    assert limit in (own, None)
    assert rejeu.make_vector(env_id, backend="gymnasium").max_episode_steps == own


@pytest.mark.parametrize("env_id", IDS)
def test_it_draws_itself(env_id):
    pytest.importorskip("pygame")
    with gym.make(env_id, render_mode="rgb_array") as env, display_for_pygame():
        env.reset(seed=0)
        env.action_space.seed(0)
        first = env.render()
        for _ in range(20):
            env.step(env.action_space.sample())
        later = env.render()
    assert first.dtype == np.uint8
    assert first.shape == later.shape
    assert first.shape[2] == 3
    assert (first != later).any()


def test_a_seed_gives_the_episode_of_a_vector():
    env, vector = gym.make("jax/Pendulum-v1"), rejeu.make_vector("jax/Pendulum-v1", 1, seed=4)
    obs, info = env.reset(seed=4)
    np.testing.assert_array_equal(vector.reset()[0], obs)
    assert info == {}
    np.testing.assert_array_equal(env.step(np.ones(1))[0], vector.step(np.ones((1, 1))).obs[0])


def test_gymnasium_sets_the_time_limit():
    env = gym.make("jax/CartPole-v1", max_episode_steps=7)
    env.reset(seed=0)
    assert [env.step(i % 2)[3] for i in range(7)] == [False] * 6 + [True]
    assert gym.make("jax/Pendulum-v1", max_episode_steps=300).unwrapped.max_episode_steps is None


def test_a_running_episode_is_saved_and_restored():
    env, other = gym.make("jax/CartPole-v1"), gym.make("jax/CartPole-v1")
    env.reset(seed=0)
    env.step(1)
    snapshot.restore(other, snapshot.state_of(env))
    np.testing.assert_array_equal(other.step(0)[0], env.step(0)[0])
    np.testing.assert_array_equal(other.reset()[0], env.reset()[0])
    assert not snapshot.is_over(other)
    np.testing.assert_array_equal(other.np_random.random(3), env.np_random.random(3))
    while not env.step(1)[2]:
        pass
    snapshot.restore(other, snapshot.state_of(env))
    assert snapshot.is_over(other)
    snapshot.restore(other, snapshot.state_of(gym.make("jax/CartPole-v1")))  # whose first episode has not begun
    assert snapshot.is_over(other)


def test_arguments_reach_the_environment():
    assert gym.make("jax/Pendulum-v1", g=2.5).unwrapped.functional.g == 2.5
    assert rejeu.make_vector("jax/Pendulum-v1", 2, g=2.5).env.g == 2.5


@exhaustive
def test_an_agent_trains_saves_and_resumes(tmp_path):
    env = rejeu.make_vector("jax/CartPole-v1", 2)
    small = {"learning_starts": 20, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
    agent = rejeu.DQN("MlpPolicy", env, **small).learn(60)
    assert agent.env.backend == "jax"
    assert agent.evaluate(2).mean_return > 0
    agent.save(tmp_path / "model")
    loaded = rejeu.load(tmp_path / "model")
    assert loaded.num_timesteps == 60
