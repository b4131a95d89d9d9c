"""Many environments in JAX at once: streams of random numbers, ends of episodes, resets, and the vector for the host."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.envs.functional import make, vector
from rejeu.envs.functional.vector import JaxVector, VectorState, reset_all, reset_done, step_all
from tests.tiers import exhaustive

CART_POLE = make("jax/CartPole-v1")
step_cart_poles = jax.jit(partial(step_all, CART_POLE))
reset_cart_poles = jax.jit(partial(reset_done, CART_POLE))


def play(env, key, actions, n):
    """Returns the observations after each of the steps with ``actions`` ``(n_steps, n)``; ended episodes are reset."""
    state = jax.jit(partial(reset_all, env, n=n))(key)

    def turn(state: VectorState, action):
        state, obs, _, terminated, truncated, _ = step_all(env, state, action)
        state, after = reset_done(env, state, terminated | truncated)
        return state, (obs, after, terminated)

    return jax.jit(lambda state: jax.lax.scan(turn, state, actions))(state)[1]


@exhaustive
def test_many_environments_equal_single_ones():
    key, n = jax.random.key(3), 4
    actions = jax.random.randint(jax.random.key(1), (60, n), 0, 2)
    obs, after, terminated = play(CART_POLE, key, actions, n)
    assert terminated.any(axis=0).all()  # each of them was reset
    more = jnp.concatenate([actions, actions], axis=1)
    obs_of_more, after_of_more, _ = play(CART_POLE, key, more, 2 * n)
    np.testing.assert_array_equal(obs_of_more[:, :n], obs)
    np.testing.assert_array_equal(after_of_more[:, :n], after)


def test_an_environment_is_the_single_one_of_its_stream():
    key, actions = jax.random.key(3), jax.random.randint(jax.random.key(1), (40, 3), 0, 2)
    together = reset_all(CART_POLE, key, 3)
    alone = vector.reset_streams(CART_POLE, vector.streams(key, 3)[1:2])
    step, again = step_cart_poles, reset_cart_poles
    for action in actions:
        together, _, _, terminated, *_ = step(together, action)
        alone, obs, _, terminated_alone, *_ = step(alone, action[1:2])
        np.testing.assert_allclose(obs[0], together.obs[1], atol=1e-6)
        together, alone = again(together, terminated)[0], again(alone, terminated_alone)[0]
    assert alone.counts[0] == together.counts[1] > 41  # it was reset at least once


def test_a_step_returns_the_true_successor_and_resets_nothing():
    state = reset_all(CART_POLE, jax.random.key(0), 3)
    falling = state.env._replace(physics=jnp.zeros((3, 4)).at[0].set(jnp.array([0.0, 0.0, 0.2, 3.0])))
    state = VectorState(state.keys, state.counts, falling, falling.physics)
    state, obs, reward, terminated, truncated, success = step_cart_poles(state, jnp.array([1, 1, 1]))
    assert terminated.tolist() == [True, False, False]
    assert not truncated.any()
    assert reward.tolist() == [1.0] * 3
    assert success is None
    np.testing.assert_allclose(obs[0, 2], 0.26, atol=1e-6)
    np.testing.assert_array_equal(state.obs, obs)
    after, first = reset_cart_poles(state, terminated | truncated)
    assert (jnp.abs(first[0]) <= 0.05).all()
    np.testing.assert_array_equal(first[1:], obs[1:])
    assert after.env.time.tolist() == [0, 1, 1]


def test_the_time_limit_truncates_and_does_not_terminate():
    env = make("jax/Pendulum-v1", max_episode_steps=3)
    state = reset_all(env, jax.random.key(0), 1)
    ends = []
    for _ in range(3):
        state, _, _, terminated, truncated, _ = step_all(env, state, jnp.zeros((1, 1)))
        ends.append((bool(terminated[0]), bool(truncated[0])))
    assert ends == [(False, False), (False, False), (False, True)]


def test_a_vector_is_the_pure_functions_for_the_key_of_its_seed():
    env = rejeu.make_vector("jax/CartPole-v1", 3, seed=7)
    assert (env.backend, env.max_episode_steps, env.reward_threshold) == ("jax", 500, 475.0)
    state = reset_all(CART_POLE, jax.random.key(7), 3)
    np.testing.assert_array_equal(env.reset(), state.obs)
    rng = np.random.default_rng(0)
    for _ in range(40):
        action = rng.integers(0, 2, 3)
        step = env.step(action)
        state, obs, reward, terminated, *_ = step_cart_poles(state, jnp.asarray(action, jnp.int32))
        np.testing.assert_allclose(step.obs, obs, atol=1e-6)
        np.testing.assert_array_equal(step.terminated, terminated)
        np.testing.assert_array_equal(step.reward, reward)
        done = step.terminated | step.truncated
        if done.any():
            state, first = reset_cart_poles(state, jnp.asarray(done))
            np.testing.assert_allclose(env.reset_done(done), first, atol=1e-6)
    assert np.isnan(env.success(step, 0))
    assert env.goals() is None


def test_a_sequence_of_seeds_gives_each_environment_the_episodes_of_a_single_one():
    together = rejeu.make_vector("jax/Pendulum-v1", 2, seed=[5, 9]).reset()
    for row, seed in zip(together, (5, 9), strict=True):
        np.testing.assert_array_equal(rejeu.make_vector("jax/Pendulum-v1", 1, seed=seed).reset()[0], row)


def test_seeds_that_differ_beyond_32_bits_give_different_episodes():
    seeds = (5, 2**32 + 5, 2**33 + 5)
    first, *others = (rejeu.make_vector("jax/Pendulum-v1", 2, seed=seed).reset() for seed in seeds)
    assert all((other != first).any() for other in others)
    np.testing.assert_array_equal(rejeu.make_vector("jax/Pendulum-v1", 2, seed=seeds[1]).reset(), others[0])


def test_resetting_without_a_seed_continues_the_streams():
    env = rejeu.make_vector("jax/Pendulum-v1", 2, seed=5)
    first = env.reset().copy()
    assert (env.reset() != first).any(axis=1).all()
    np.testing.assert_array_equal(env.reset(seed=5), first)


def test_inactive_environments_do_not_move():
    env = rejeu.make_vector("jax/Pendulum-v1", 2, seed=0)
    reference = rejeu.make_vector("jax/Pendulum-v1", 2, seed=0)
    obs = env.reset().copy()
    reference.reset()
    step = env.step(np.ones((2, 1)), active=np.array([True, False]))
    np.testing.assert_array_equal(step.obs[1], obs[1])
    assert (step.obs[0] != obs[0]).any()
    assert step.reward[1] == 0.0
    later = env.step(np.ones((2, 1)), active=np.array([False, True]))
    np.testing.assert_allclose(later.obs, reference.step(np.ones((2, 1))).obs, atol=1e-6)


def test_a_snapshot_continues_in_another_vector():
    env = rejeu.make_vector("jax/CartPole-v1", 2, seed=0)
    env.reset()
    obs = env.step(np.array([0, 1])).obs.copy()
    saved = env.snapshot()
    other = JaxVector(CART_POLE, 2)
    assert other.restore(saved, obs) == []
    np.testing.assert_array_equal(other.step(np.array([1, 1])).obs, env.step(np.array([1, 1])).obs)
    done = np.array([True, False])
    np.testing.assert_array_equal(other.reset_done(done), env.reset_done(done))


@pytest.mark.parametrize(
    "damage", [lambda s: s[:-1], lambda s: "state", lambda s: [s[0][:1], *s[1:]], lambda s: [3, *s[1:]]]
)
def test_a_damaged_snapshot_is_refused(damage):
    env = rejeu.make_vector("jax/CartPole-v1", 2, seed=0)
    obs = env.reset()
    with pytest.raises(ValueError, match="not of 2 environments jax/CartPole-v1"):
        env.restore(damage(env.snapshot()), obs)
    env.step(np.array([0, 1]))  # it continues with its own state
