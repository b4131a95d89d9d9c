"""State-dependent noise (gSDE): a policy's noise that is a function of its last hidden layer and stays for many steps."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core import Clock, Explorer, PyTree

if TYPE_CHECKING:
    from rejeu.algorithms.actor_critic import ActionKind, ActorCritic, OnPolicyConfig

SDE_EPSILON = 1e-6
"""Added to the variance of state-dependent noise, which is 0 where the hidden layer is."""


def sde_log_std(log_std: Array, hidden: Array) -> Array:
    """Returns the log standard deviation of state-dependent noise at hidden layers ``(batch, width)``.

    The noise is ``hidden @ E`` with a matrix ``E`` of independent normals of standard deviations ``exp(log_std)`` (Raffin et
    al. 2020, "Smooth Exploration for Robotic Reinforcement Learning", arXiv 2005.05719, equation 8). No gradient reaches
    the hidden layer this way.
    """
    variance = jnp.square(jax.lax.stop_gradient(hidden)) @ jnp.exp(2.0 * log_std)
    return 0.5 * jnp.log(variance + SDE_EPSILON)


def sde_explorer(n_steps: int) -> Explorer:
    """Returns exploration by state-dependent noise (gSDE), whose matrix is drawn anew every ``n_steps``, or -1: episode.

    The carry is each environment's matrix ``(n_envs, width, action_dim)`` and its age in steps ``int32 (n_envs,)``.
    """

    def init(actor: ActorCritic, n_envs: int) -> tuple[Array, Array]:
        assert actor.log_std is not None
        return jnp.zeros((n_envs, *actor.log_std.shape), jnp.float32), jnp.zeros((n_envs,), jnp.int32)

    def act(
        carry: tuple[Array, Array], actor: ActorCritic, obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, tuple[Array, Array]]:
        matrix, age = carry
        assert actor.log_std is not None
        due = ended if n_steps == -1 else ended | (age % n_steps == 0)
        fresh = jnp.exp(actor.log_std)[None] * jax.random.normal(key, matrix.shape, matrix.dtype)
        matrix = jnp.where(due[:, None, None], fresh, matrix)
        hidden = actor.hidden(obs)
        mean = actor.distribution(hidden, None).mean  # type: ignore[union-attr]
        action = mean + jnp.einsum("nh,nhd->nd", hidden, matrix)
        age = jnp.where(ended, 0, age) + 1
        return jnp.tanh(action) if actor.shape.squash_output else action, (matrix, age)

    return Explorer(init, act)


def explorer_of(config: OnPolicyConfig, kind: ActionKind) -> Explorer | None:
    """Returns how the policy explores where that takes more than drawing from its distribution, else None.

    Raises:
        ValueError: for state-dependent noise on actions that are no numbers.
    """
    if not config.use_sde:
        return None
    if kind.kind != "box":
        raise ValueError("use_sde=True needs Box actions: there is no noise to add to choices; leave it out")
    return sde_explorer(config.sde_sample_freq)
