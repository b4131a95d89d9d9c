"""Environments in JAX as Gymnasium environments: checks, resets, pictures, exact resume, training."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs import snapshot
from rejeu.envs.checker import findings
from rejeu.envs.functional import REGISTRY
from rejeu.envs.rendering import display_for_pygame
from tests.tiers import only

IDS = [*REGISTRY]


@pytest.mark.parametrize("env_id", only({"jax/CartPole-v1"}, IDS))
def test_the_check_finds_no_error(env_id):
    assert [finding for finding in findings(gym.make(env_id)) if finding.level == "error"] == []


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
