"""Noise of a stochastic policy that stays the same for some steps, so that exploration goes somewhere.

Source: FlashSAC (:mod:`rejeu.algorithms.flashsac`), after the repeated actions of Dabney et al. 2021, "Temporally-Extended
epsilon-Greedy Exploration" (arXiv 2006.01782). An action is ``tanh(mean(s) + std(s) e)``, where ``e ~ N(0, 1)`` is drawn anew
after ``n`` steps and where an episode begins. Each ``n`` is drawn with a probability proportional to ``n^-2``, from 1 to
``max_steps``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import Clock, Explorer, PyTree
from rejeu.core.distributions import TanhNormal

SPELL_EXPONENT = 2.0
"""How fast long spells become rare."""


class Held(NamedTuple):
    """The carry of held noise, by environment."""

    noise: Array
    """``(n_envs, action_dim)``."""
    left: Array
    """Steps for which it stays, ``int32 (n_envs,)``."""


def held_explorer(policy: Callable[[PyTree, PyTree], TanhNormal], action_dim: int, max_steps: int) -> Explorer:
    """Returns exploration by the policy with noise that is held for up to ``max_steps`` steps."""

    def init(actor: PyTree, n_envs: int) -> Held:
        return Held(jnp.zeros((n_envs, action_dim), jnp.float32), jnp.zeros((n_envs,), jnp.int32))

    def act(carry: Held, actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock) -> tuple[Array, Held]:
        noise_key, spell_key = jax.random.split(key)
        due = ended | (carry.left <= 0)
        fresh = jax.random.normal(noise_key, carry.noise.shape, carry.noise.dtype)
        noise = jnp.where(due[:, None], fresh, carry.noise)
        steps_left = jnp.where(due, spells(spell_key, due.shape[0], max_steps), carry.left)
        mean, log_std = policy(actor, obs)
        return jnp.tanh(mean + jnp.exp(log_std) * noise), Held(noise, steps_left - 1)

    return Explorer(init, act)


def spells(key: Array, n: int, max_steps: int) -> Array:
    """Returns ``n`` numbers of steps up to ``max_steps``, ``int32 (n,)``, with probabilities proportional to ``steps^-2``."""
    weights = -SPELL_EXPONENT * jnp.log(jnp.arange(1, max_steps + 1, dtype=jnp.float32))
    return 1 + jax.random.categorical(key, weights, shape=(n,)).astype(jnp.int32)
