"""State-dependent noise (gSDE): a policy's noise that is a function of its last hidden layer and is kept for many steps."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms.actor_critic.config import OnPolicyConfig
from rejeu.algorithms.actor_critic.network import ActionKind, ActorCritic
from rejeu.core import Clock, Explorer, PyTree


def sde_explorer(n_steps: int) -> Explorer:
    """Returns exploration by state-dependent noise (gSDE), whose matrix is sampled every ``n_steps``, or -1: in every episode.

    An episode that continues after an update keeps its matrix with -1, which was drawn with the standard deviation from
    before the update, while the update's log-probabilities use the new one.

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
    """Returns exploration by state-dependent noise if the configuration uses it, else None.

    Raises:
        ValueError: for state-dependent noise on actions other than Box.
    """
    if not config.use_sde:
        return None
    if kind.kind != "box":
        raise ValueError("use_sde=True needs Box actions: noise cannot be added to discrete actions; leave it out")
    return sde_explorer(config.sde_sample_freq)
