"""The hyper-parameters and the state of SAC, for Box and for Discrete actions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import Array

from rejeu.algorithms.sac import temperature
from rejeu.algorithms.sac.temperature import EntropyConfig
from rejeu.core import AVERAGED, PyTree, copy, ensemble, polyak, tau_at
from rejeu.networks import Network
from rejeu.spaces import Leaf
from rejeu.validation import coerce, whole

HIDDEN_LAYERS = (256, 256)
"""Default widths of actor and critics."""


@dataclass(frozen=True, kw_only=True)
class Config(EntropyConfig):
    """Hyper-parameters of SAC; the defaults are those of the paper and of Stable-Baselines3."""

    target_update_interval: int = 1
    """Gradient steps between two updates of the target critics."""

    name: ClassVar[str] = "SAC"

    def __post_init__(self) -> None:
        EntropyConfig.__post_init__(self)
        coerce(self, "target_update_interval", whole, least=1)


class State(eqx.Module):
    """Everything that SAC learns; every leaf is an array."""

    actor: Network
    critics: Any
    """All critics, stacked along a leading axis."""
    target_critics: Any = eqx.field(metadata=AVERAGED)
    log_alpha: Array
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    alpha_optimizer: PyTree
    key: Array
    """Root of the random numbers of the updates, ``uint32[2]``; never changes."""
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def initial_state(
    key: Array,
    obs_leaves: tuple[Leaf, ...],
    n_outputs: int,
    make_critic: Callable[[Array], Any],
    config: EntropyConfig,
    optimizer: optax.GradientTransformation,
) -> State:
    """Returns the state before the first update: an actor of ``n_outputs``, and ``config.n_critics`` critics."""
    actor_key, critics_key, update_key = jax.random.split(key, 3)
    shape = config.policy_kwargs
    actor = Network(actor_key, obs_leaves, n_outputs, shape.actor_widths(HIDDEN_LAYERS), shape)
    critics = ensemble(make_critic, critics_key, config.n_critics)
    log_alpha, alpha_optimizer = temperature.initial(config)
    return State(
        actor=actor,
        critics=critics,
        target_critics=copy(critics),
        log_alpha=log_alpha,
        actor_optimizer=optimizer.init(actor),
        critics_optimizer=optimizer.init(critics),
        alpha_optimizer=alpha_optimizer,
        key=update_key,
        n_updates=jnp.int32(0),
    )


def temperature_and_targets(
    state: State,
    actor: tuple[Network, PyTree],
    critics: tuple[Any, PyTree],
    log_prob: Array,
    target_entropy: float,
    config: Any,
    rate: Any,
) -> State:
    """Returns the state after the last two steps of an update, those of the temperature and the target critics.

    Args:
        state: from before the update.
        actor: the new actor and its optimizer state.
        critics: likewise.
        log_prob: of the actions that the actor sampled, ``(batch,)``.
        target_entropy: in nats.
        config: gives ``tau`` and ``target_update_interval``.
        rate: the learning rate.
    """
    log_alpha, alpha_optimizer = temperature.temperature_step(
        state.log_alpha, state.alpha_optimizer, log_prob, target_entropy, config, rate
    )
    n_updates = state.n_updates + 1
    tau = tau_at(n_updates, config.tau, config.target_update_interval)
    return State(
        actor=actor[0],
        critics=critics[0],
        target_critics=polyak(state.target_critics, critics[0], tau),
        log_alpha=log_alpha,
        actor_optimizer=actor[1],
        critics_optimizer=critics[1],
        alpha_optimizer=alpha_optimizer,
        key=state.key,
        n_updates=n_updates,
    )
