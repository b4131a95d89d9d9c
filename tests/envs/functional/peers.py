"""Transitions of the environments that those in JAX are compared with, and the comparison."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np

from rejeu.envs.functional.protocol import FunctionalEnv


class Recorded(NamedTuple):
    """Steps of another implementation, each from its own state."""

    state: np.ndarray
    """``float64 (n, ...)``."""
    action: np.ndarray
    next_state: np.ndarray
    obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray


def play(
    env: gym.Env,
    states: np.ndarray,
    actions: np.ndarray,
    put: Callable[[Any, np.ndarray], None],
    get: Callable[[Any], np.ndarray],
) -> Recorded:
    """Returns one step of ``env`` from each of ``states``."""
    rows = []
    for state, action in zip(states, actions, strict=True):
        put(env, state)
        obs, reward, terminated, *_ = env.step(action)
        rows.append((get(env), obs, reward, terminated))
    after, obs, reward, terminated = zip(*rows, strict=True)
    return Recorded(
        states, actions, np.array(after), np.array(obs, np.float64), np.array(reward, np.float64), np.array(terminated)
    )


class Difference(NamedTuple):
    """Largest absolute differences over all steps."""

    state: float
    obs: float
    reward: float
    n_terminated: int
    """Steps whose termination differs."""


def compare(
    env: FunctionalEnv,
    recorded: Recorded,
    make_state: Callable[[np.ndarray], Any],
    physics: Callable[[Any], Any],
    x64: bool,
) -> Difference:
    """Returns how far ``env`` is from the recorded steps, computed in 64 or 32 bits.

    ``make_state`` makes states ``(n, ...)`` of recorded ones; ``physics`` reads their numbers ``(n, ...)`` again.
    """
    with jax.enable_x64(x64):
        state = jax.tree.map(jnp.asarray, make_state(recorded.state))
        key = jax.random.key(0)
        step = jax.jit(jax.vmap(env.step, in_axes=(None, 0, 0)))
        after, obs, reward, terminated, _ = step(key, state, jnp.asarray(recorded.action))
        after, obs, reward, terminated = jax.device_get((physics(after), obs, reward, terminated))
    return Difference(
        float(np.abs(after - recorded.next_state).max()),
        float(np.abs(obs - recorded.obs).max()),
        float(np.abs(reward - recorded.reward).max()),
        int((terminated != recorded.terminated).sum()),
    )
