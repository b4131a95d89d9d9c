"""Environments with the interfaces of gymnax and Brax. Their packages conflict with rejeu's; small stand-ins have the same
functions, and the test of gymnax itself runs where it is installed."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import rejeu
from rejeu.envs.functional import cart_pole
from rejeu.envs.functional.adapters import from_brax, from_gymnax
from rejeu.envs.functional.vector import reset_all, reset_done, step_all


class Params(NamedTuple):
    speed: float = 1.0
    max_steps_in_episode: int = 5


class GymnaxState(NamedTuple):
    place: Any
    time: Any


class Line:
    """A point on a line with the methods of an environment of gymnax 1.0; terminates at 3."""

    default_params = Params()

    def observation_space(self, params):
        return SimpleNamespace(low=-10.0, high=10.0, shape=(1,), dtype=jnp.float32)

    def action_space(self, params):
        return SimpleNamespace(n=2, shape=(), dtype=jnp.int32)

    def reset_env(self, key, params):
        state = GymnaxState(0.0, 0)  # Python numbers, as gymnax has them
        return jnp.zeros(1), state

    def step_env(self, key, state, action, params):
        state = GymnaxState(state.place + params.speed * action, state.time + 1)
        return jnp.array([state.place]), state, -1, state.place >= 3, {"discount": 1.0}

    def is_truncated(self, state, params):
        return state.time >= params.max_steps_in_episode


def episode(env, action, n):
    """Returns observations, rewards, terminations and truncations of the first of two environments in one program."""
    state = reset_all(env, jax.random.key(0), 2)

    def turn(state, _):
        state, obs, reward, terminated, truncated, _ = step_all(env, state, action)
        state, _ = reset_done(env, state, terminated | truncated)
        return state, (jax.tree.leaves(obs)[0][0], reward[0], terminated[0], truncated[0])

    return jax.device_get(jax.jit(lambda state: jax.lax.scan(turn, state, length=n))(state)[1])


def test_gymnax_terminates_and_truncates_apart_and_is_reset_by_the_caller():
    obs, reward, terminated, truncated = episode(from_gymnax(Line()), jnp.array([1, 0]), 4)
    assert obs[:, 0].tolist() == [1.0, 2.0, 3.0, 1.0]  # the successor, then a new episode
    assert reward.tolist() == [-1.0] * 4
    assert terminated.tolist() == [False, False, True, False]
    assert not truncated.any()
    *_, terminated, truncated = episode(from_gymnax(Line()), jnp.array([0, 1]), 6)
    assert not terminated.any()
    assert truncated.tolist() == [False] * 4 + [True, False]


def test_gymnaxs_parameters_and_spaces_are_kept():
    env = from_gymnax(Line(), Params(speed=0.5, max_steps_in_episode=9))
    assert env.observation_space == spaces.Box(-10, 10, (1,))
    assert env.action_space == spaces.Discrete(2)
    vector = rejeu.make_vector(env, 2)
    assert vector.max_episode_steps == 9
    vector.reset(seed=0)
    np.testing.assert_array_equal(vector.step(np.array([0, 1])).obs, [[0.0], [0.5]])


def test_gymnaxs_own_cart_pole_is_ours():
    gymnax = pytest.importorskip("gymnax")
    env = from_gymnax(*gymnax.make("CartPole-v1"))
    vector = rejeu.make_vector(env, 3)
    obs = vector.reset(seed=0)
    own = cart_pole.CartPole()
    for i in range(30):
        state = jnp.asarray(obs)
        action = np.array([i % 2, 0, 1])
        step = vector.step(action)
        ours = jax.vmap(own.step, (None, 0, 0))(
            jax.random.key(0), cart_pole.State(state, jnp.zeros(3, jnp.int32)), jnp.asarray(action)
        )
        np.testing.assert_allclose(step.obs, ours[1], atol=1e-5)
        np.testing.assert_array_equal(step.terminated, ours[3])
        obs = vector.reset_done(step.terminated) if step.terminated.any() else step.obs
    with jax.numpy_rank_promotion("allow"):
        for env_id in set(gymnax.registered_envs) - {"MNISTBandit-bsuite"}:  # which downloads images
            vector = rejeu.make_vector(from_gymnax(*gymnax.make(env_id)), 2, seed=0)
            vector.reset()
            action = np.array([vector.action_space.sample() for _ in range(2)])
            assert vector.step(action).reward.shape == (2,), env_id


class Brax(eqx.Module):
    """What the functions of an environment of Brax return."""

    obs: Any
    reward: Any
    done: Any
    info: dict[str, Any]


class Slide:
    """A point on a line with the methods of an environment of Brax; ``done`` at 3."""

    action_size = 1

    def __init__(self, dict_obs=False, limit=None):
        self.dict_obs, self.limit = dict_obs, limit

    def reset(self, key):
        info = {"rng": key} | ({} if self.limit is None else {"truncation": 0.0, "steps": 0.0})
        return Brax(self.observe(jnp.zeros(1)), 0.0, 0.0, info)

    def step(self, state, action):
        place = (state.obs["state"] if self.dict_obs else state.obs) + action
        done, info = place[0] >= 3, dict(state.info)
        if self.limit is not None:
            info["steps"] = info["steps"] + 1
            info["truncation"] = (info["steps"] >= self.limit).astype(float)
            done = done | (info["truncation"] > 0)
        return Brax(self.observe(place), -1.0, done.astype(float), info)

    def observe(self, place):
        return {"state": place, "privileged_state": jnp.append(place, 0.0)} if self.dict_obs else place


def test_brax_is_reset_by_the_caller_and_gets_a_time_limit():
    obs, reward, terminated, truncated = episode(from_brax(Slide(), 5), jnp.array([[1.0], [0.0]]), 4)
    assert obs[:, 0].tolist() == [1.0, 2.0, 3.0, 1.0]
    assert reward.tolist() == [-1.0] * 4
    assert terminated.tolist() == [False, False, True, False]
    *_, terminated, truncated = episode(from_brax(Slide(), 5), jnp.array([[0.0], [1.0]]), 6)
    assert not terminated.any()
    assert truncated.tolist() == [False] * 4 + [True, False]


def test_a_limit_of_brax_itself_truncates():
    *_, terminated, truncated = episode(from_brax(Slide(limit=2), None), jnp.array([[0.5], [0.0]]), 3)
    assert not terminated.any()
    assert truncated.tolist() == [False, True, False]


def test_observations_of_several_arrays_become_a_dict():
    vector = rejeu.make_vector(from_brax(Slide(dict_obs=True)), 2, seed=0)
    assert vector.observation_space["privileged_state"].shape == (2,)
    assert vector.max_episode_steps == 1000
    assert vector.reset()["state"].shape == (2, 1)
    step = vector.step(np.ones((2, 1)))
    np.testing.assert_array_equal(step.obs["privileged_state"], [[1.0, 0.0]] * 2)
