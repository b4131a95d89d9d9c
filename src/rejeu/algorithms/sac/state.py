"""The hyper-parameters and the state of SAC, for Box and for Discrete actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import optax
from jax import Array

from rejeu.algorithms.sac import temperature
from rejeu.algorithms.sac.temperature import EntropyConfig
from rejeu.core import AVERAGED, PyTree, copy, polyak, tau_at
from rejeu.networks import Network
from rejeu.validation import convert, whole

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
        convert(self, "target_update_interval", whole, least=1)


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
    actor: Network, critics: Any, key: Array, config: EntropyConfig, optimizer: optax.GradientTransformation
) -> State:
    """Returns the state before the first update."""
    log_alpha, alpha_optimizer = temperature.initial(config)
    return State(
        actor=actor,
        critics=critics,
        target_critics=copy(critics),
        log_alpha=log_alpha,
        actor_optimizer=optimizer.init(actor),
        critics_optimizer=optimizer.init(critics),
        alpha_optimizer=alpha_optimizer,
        key=key,
        n_updates=jnp.int32(0),
    )


def next_state(state: State, config: Any, actor: Network, critics: Any, log_alpha: Array, *optimizers: PyTree) -> State:
    """Returns the state after an update: what was learned, the optimizer states, and the targets after a soft update."""
    n_updates = state.n_updates + 1
    tau = tau_at(n_updates, config.tau, config.target_update_interval)
    targets = polyak(state.target_critics, critics, tau)
    return State(actor, critics, targets, log_alpha, *optimizers, state.key, n_updates)
