"""The hyperparameters and the state of DDPG, for Box and for Discrete actions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import optax
from jax import Array

from rejeu.algorithms import search
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.search import SearchSpace
from rejeu.core import AVERAGED, TD_ERROR, Metrics, PyTree, copy, polyak, tau_at
from rejeu.networks import Network, Widths
from rejeu.schedules import Schedule
from rejeu.validation import coerce, whole

HIDDEN_LAYERS = (400, 300)
"""Default widths of actor and critic but on images, those of the paper."""


@dataclass(frozen=True, kw_only=True)
class DeterministicPolicyConfig(OffPolicyConfig):
    """The hyperparameters that DDPG and TD3 share. Abstract."""

    learning_rate: float | Schedule = 1e-3
    """Step size of every optimizer: a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)``,
    ``"lin_1e-3"`` or a function of the progress from 0 to 1."""

    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = OffPolicyConfig.hidden_layers
    search_space: ClassVar[SearchSpace] = {**search.OFF_POLICY, **search.ACTION_NOISE}


@dataclass(frozen=True, kw_only=True)
class Config(DeterministicPolicyConfig):
    """Hyperparameters of DDPG; the defaults are those of Stable-Baselines3."""

    target_update_interval: int = 1
    """Gradient steps between two updates of both target networks. A larger interval is more stable and slower."""

    name: ClassVar[str] = "DDPG"

    def __post_init__(self) -> None:
        DeterministicPolicyConfig.__post_init__(self)
        coerce(self, "target_update_interval", whole, least=1)


class State(eqx.Module):
    """Everything that DDPG learns; every leaf is an array."""

    actor: Network
    critic: Any
    """A :class:`QNetwork`; for Discrete actions a :class:`Network` that gives the values of all actions."""
    target_actor: Network = eqx.field(metadata=AVERAGED)
    target_critic: Any = eqx.field(metadata=AVERAGED)
    actor_optimizer: PyTree
    critic_optimizer: PyTree
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def initial_state(actor: Network, critic: Any, optimizer: optax.GradientTransformation) -> State:
    """Returns the state before the first update."""
    targets = copy(actor), copy(critic)
    return State(actor, critic, *targets, optimizer.init(actor), optimizer.init(critic), jnp.int32(0))


def next_state(state: State, config: Config, actor: tuple[Network, PyTree], critic: tuple[Any, PyTree]) -> State:
    """Returns the state after an update, from the new networks with their optimizer states; both targets are updated."""
    n_updates = state.n_updates + 1
    tau = tau_at(n_updates, config.tau, config.target_update_interval)
    return State(
        actor=actor[0],
        critic=critic[0],
        target_actor=polyak(state.target_actor, actor[0], tau),
        target_critic=polyak(state.target_critic, critic[0], tau),
        actor_optimizer=actor[1],
        critic_optimizer=critic[1],
        n_updates=n_updates,
    )


def metrics_of(critic_loss: Array, actor_loss: Array, values: Array, td_error: Array) -> Metrics:
    """Returns the metrics of an update."""
    return {"critic_loss": critic_loss, "actor_loss": actor_loss, "q_value": jnp.mean(values), TD_ERROR: td_error}
