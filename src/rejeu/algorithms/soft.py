"""The update that SAC and its relatives share, and the state and settings that go with it.

An update takes these steps in this order: critics, actor (against the new critics), temperature, targets. The actor and the
temperature take a step at every ``policy_delay``-th update and share one sample of actions, and the losses use the temperature
``alpha`` from before the update. Its loss is ``-mean log_alpha (log pi(a | s) + target_entropy)``: as in Stable-Baselines3 it
is written in ``log alpha`` rather than ``alpha``.

What the critics learn, and what the actor climbs, are the functions of :class:`SoftCritic`, which each algorithm has of its
own: SAC (:mod:`rejeu.algorithms.sac`), TQC (:mod:`rejeu.algorithms.tqc`), CrossQ (:mod:`rejeu.algorithms.crossq`), FlashSAC
and XQC (:mod:`rejeu.algorithms.flashsac`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core.algorithm import (
    AVERAGED,
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    Optimizer,
    PyTree,
    Scalar,
    Transition,
    copy,
    descend,
    minimize,
    polyak,
    tau_at,
    without_gradient,
)
from rejeu.core.prng import nth
from rejeu.core.schedules import at
from rejeu.core.validation import coerce, is_number, number, whole

ALPHA_OPTIMIZER = optimizers.make("adam")
"""Of the temperature, whatever the optimizer of the networks is."""


@dataclass(frozen=True, kw_only=True)
class EntropyConfig(OffPolicyConfig):
    """The hyperparameters of algorithms with an entropy bonus and several critics. Abstract."""

    ent_coef: float | str = "auto"
    """Temperature of the entropy bonus: ``"auto"`` learns it from 1, ``"auto_0.1"`` from 0.1, a number fixes it. A larger
    value explores more."""
    target_entropy: float | str = "auto"
    """Target entropy in nats for learning the temperature. ``"auto"`` is minus the number of action dimensions; for n
    Discrete actions 0.3 log n (the paper's 0.98 log n keeps the policy nearly uniform). ``"std_0.15"`` is that of normal
    distributions with this standard deviation, the range of an action being [-1, 1]."""
    n_critics: int = 2
    """Number of critics."""
    policy_delay: int = 1
    """Gradient steps of the critics per step of actor and temperature. A larger number computes less."""
    noise_repeat: int = 1
    """Most steps for which the noise of an action stays the same; most spells are short (FlashSAC). A larger number explores
    further from where the policy is. Box actions only, without ``action_noise``. 1: fresh noise in every step."""

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        initial_temperature(self.ent_coef)
        coerce(self, "target_entropy", entropy_target)
        coerce(self, "noise_repeat", whole, least=1)
        for key, is_set in (("action_noise", self.action_noise is not None), ("lstm_hidden_size", self.has_memory)):
            if self.noise_repeat > 1 and is_set:
                raise ValueError(f"noise_repeat={self.noise_repeat} is not available with {key}; leave one of them out")
        coerce(self, ("n_critics", "policy_delay"), whole, least=1)

    def entropy_target(self, automatic: float, action_dim: int = 0) -> float:
        """Returns the target entropy in nats, ``automatic`` for ``"auto"``.

        That of a standard deviation ``std`` is ``n log(2 pi e std^2) / 2`` for ``n`` components of a Box.
        """
        if isinstance(self.target_entropy, str) and self.target_entropy != "auto":
            std = float(self.target_entropy.removeprefix("std_"))
            return 0.5 * action_dim * math.log(2 * math.pi * math.e * std**2)
        return automatic if self.target_entropy == "auto" else float(self.target_entropy)

    @property
    def learns_temperature(self) -> bool:
        """Whether the temperature is learned."""
        return isinstance(self.ent_coef, str)


class State(eqx.Module):
    """Everything that a soft actor-critic learns; every leaf is an array."""

    actor: PyTree
    """The network of the policy, with its running statistics if it has any."""
    critics: PyTree
    """All critics, stacked along a leading axis."""
    target_critics: PyTree = eqx.field(metadata=AVERAGED)
    """None without target networks."""
    log_alpha: Array
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    alpha_optimizer: PyTree
    key: Array
    """Root of the random numbers of the updates, ``uint32[2]``; never changes."""
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""
    actor_loss: Array | None = None
    """Of the actor's last step, ``float32[]``, with ``policy_delay``."""
    entropy: Array | None = None
    """Of the policy at that step, in nats, ``float32[]``, likewise."""


class SoftCritic(NamedTuple):
    """The parts in which algorithms differ: their networks, and their equations for one update.

    Keys are for what is drawn at random, such as actions.
    """

    actor: Callable[[Array], PyTree]
    """``actor(key)``: the network of the policy."""
    critics: Callable[[Array], PyTree]
    """``critics(key)``: all critics, stacked along a leading axis."""
    target: Callable[[PyTree, PyTree, Array, Transition, Array], PyTree]
    """``target(actor, target_critics, alpha, batch, key)``: what the critics learn. It is not differentiated."""
    critics_loss: Callable[[PyTree, Transition, PyTree, Array], tuple[Array, PyTree]]
    """``critics_loss(critics, batch, target, key)``: the loss, and what ``measure`` takes. The key is that of
    ``actor_loss``."""
    actor_loss: Callable[[PyTree, PyTree, Array, Transition, Array], tuple[Array, PyTree]]
    """``actor_loss(actor, critics, alpha, batch, key)``: the loss; the log-probabilities of the policy's actions,
    ``(batch,)``, or ``(batch, n)`` for n temperatures."""
    target_entropy: Callable[[PyTree], Scalar]
    """``target_entropy(obs)``: the entropy that the temperature keeps the policy at, in nats, ``()`` or ``(1, n)``."""
    measure: Callable[[PyTree, PyTree], tuple[Array, Array]] = lambda errors, target: errors
    """``measure(outputs, target)``: the values of the actions taken and the TD errors, ``(n_critics, batch)`` each.
    ``outputs`` came with the loss, and may be they."""
    minimize: Callable[..., tuple[PyTree, PyTree, Array, PyTree]] = minimize
    """How a network takes a step on its loss, as :func:`rejeu.core.algorithm.minimize`."""
    has_targets: bool = True
    """Whether there are target critics."""
    keeps_losses: bool = False
    """Whether the state has ``actor_loss`` and ``entropy`` for any ``policy_delay``; a resumed run may then have another."""
    keys: Callable[[Array], Any] = jax.random.split
    """``keys(key)``: the keys of the target and of the actor in an update."""
    temperatures: tuple[int, ...] = ()
    """``()`` for one temperature, ``(n,)`` for n."""


def soft_actor_critic(
    parts: SoftCritic, config: Any, explore: Callable[..., Array], exploit: Callable[..., Array], optimizer: Optimizer
) -> Algorithm:
    """Returns the algorithm with these networks and equations, which acts by ``explore`` and ``exploit`` of an algorithm."""
    settings = {"parts": parts, "config": config, "optimizer": optimizer}
    init, learn = partial(initial_state, **settings), partial(update, **settings)
    return Algorithm(init, lambda state: state.actor, explore, exploit, learn)


def initial_state(key: Array, parts: SoftCritic, config: Any, optimizer: Optimizer) -> State:
    """Returns the state before the first update."""
    actor_key, critics_key, update_key = jax.random.split(key, 3)
    actor, critics = parts.actor(actor_key), parts.critics(critics_key)
    log_alpha = jnp.full(parts.temperatures, jnp.log(jnp.float32(initial_temperature(config.ent_coef))))
    keeps_losses = parts.keeps_losses or config.policy_delay > 1
    return State(
        actor=actor,
        critics=critics,
        target_critics=copy(critics) if parts.has_targets else None,
        log_alpha=log_alpha,
        actor_optimizer=optimizer.init(actor),
        critics_optimizer=optimizer.init(critics),
        alpha_optimizer=ALPHA_OPTIMIZER.init(log_alpha),
        key=update_key,
        n_updates=jnp.int32(0),
        actor_loss=jnp.float32(0.0) if keeps_losses else None,
        entropy=jnp.zeros(parts.temperatures, jnp.float32) if keeps_losses else None,
    )


def update(
    state: State, batch: Transition, clock: Clock, parts: SoftCritic, config: Any, optimizer: Optimizer
) -> tuple[State, Metrics]:
    """Returns the state after a step of everything that learns, and the metrics; with several temperatures some are arrays."""
    target_key, actor_key = parts.keys(nth(state.key, state.n_updates))
    rate, alpha = at(config.learning_rate, clock.progress), jnp.exp(state.log_alpha)
    target = without_gradient(parts.target)(state.actor, state.target_critics, alpha, batch, target_key)
    critics, critics_optimizer, critic_loss, outputs = parts.minimize(
        parts.critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target, actor_key
    )
    state = after_critics(state, critics, critics_optimizer, config)
    values, error = parts.measure(outputs, target)
    target_entropy = parts.target_entropy(batch.obs)

    def improve(state: State) -> tuple[State, Array, Array]:
        actor, actor_optimizer, loss, log_prob = parts.minimize(
            parts.actor_loss, state.actor, state.actor_optimizer, optimizer, rate, critics, alpha, batch, actor_key
        )
        state = after_actor(state, actor, actor_optimizer, log_prob, target_entropy, config, rate)
        return state, loss, -jnp.mean(log_prob, axis=0)

    state, actor_loss, entropy = every(config.policy_delay, state, improve)
    metrics = {"critic_loss": critic_loss, "actor_loss": actor_loss, "ent_coef": alpha, "entropy": entropy}
    if config.learns_temperature and not parts.temperatures:
        metrics["ent_coef_loss"] = jnp.log(alpha) * (entropy - target_entropy)
    return state, metrics | {"q_value": jnp.mean(values), TD_ERROR: jnp.mean(jnp.abs(error), axis=0)}


def after_critics(state: State, critics: PyTree, optimizer_state: PyTree, config: Any) -> State:
    """Returns the state with new critics, their optimizer's state, and the targets moved by ``config.tau`` if they are due."""
    n_updates, targets = state.n_updates + 1, state.target_critics
    if targets is not None:
        targets = polyak(targets, critics, tau_at(n_updates, config.tau, config.target_update_interval))
    return dataclasses.replace(
        state, critics=critics, critics_optimizer=optimizer_state, target_critics=targets, n_updates=n_updates
    )


def after_actor(
    state: State,
    actor: PyTree,
    optimizer_state: PyTree,
    log_prob: Array,
    target_entropy: Scalar,
    config: Any,
    rate: Scalar,
) -> State:
    """Returns the state with a new actor and its optimizer's state, after a step of the temperature if it is learned.

    ``log_prob`` is that of the actions that the actor sampled, ``(batch,)``; ``target_entropy`` is in nats.
    """
    state = dataclasses.replace(state, actor=actor, actor_optimizer=optimizer_state)
    if not config.learns_temperature:
        return state
    gradient = jax.grad(temperature_loss)(state.log_alpha, log_prob, target_entropy)
    log_alpha, moments = descend(state.log_alpha, gradient, state.alpha_optimizer, ALPHA_OPTIMIZER, rate)
    return dataclasses.replace(state, log_alpha=log_alpha, alpha_optimizer=moments)


def every(
    policy_delay: int, state: State, improve: Callable[[State], tuple[State, Array, Array]]
) -> tuple[State, PyTree, PyTree]:
    """Returns ``improve(state)`` at every ``policy_delay``-th update of the critics, which ``state.n_updates`` counts.

    That is the state after a step of the actor, its loss and the entropy; at other updates those of its latest step.
    """
    if policy_delay == 1:
        return improve(state)

    def step(state: State) -> State:
        state, loss, entropy = improve(state)
        return dataclasses.replace(state, actor_loss=loss, entropy=entropy)

    state = jax.lax.cond(state.n_updates % policy_delay == 0, step, lambda s: s, state)
    return state, state.actor_loss, state.entropy


def temperature_loss(log_alpha: Array, log_prob: Array, target_entropy: Scalar) -> Array:
    """Returns the loss that raises the temperature while the policy's entropy is below its target.

    Of several temperatures ``(n,)``, with ``log_prob (batch, n)`` and targets ``(1, n)``, it is the sum.
    """
    weight = jnp.broadcast_to(log_alpha, log_prob.shape)
    return -jnp.sum(jnp.mean(weight * (jax.lax.stop_gradient(log_prob) + target_entropy), axis=0))


def entropy_target(key: str, value: object) -> float | str:
    """Returns a target entropy: ``"auto"``, ``"std_"`` and a positive number, or a number."""
    if isinstance(value, str) and value != "auto":
        try:
            is_valid = value.startswith("std_") and 0 < float(value.removeprefix("std_")) < math.inf
        except ValueError:
            is_valid = False
        if not is_valid:
            raise ValueError(f"{key}={value!r} must be 'auto', 'std_0.15' or a number")
    return value if isinstance(value, str) else number(key, value)


def initial_temperature(ent_coef: float | str) -> float:
    """Returns the initial temperature: 1 for ``"auto"``, x for ``"auto_x"`` and for x.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(ent_coef, str):
        initial_value = ent_coef.removeprefix("auto").removeprefix("_")
        try:
            value = float(initial_value) if initial_value else 1.0
        except ValueError:
            value = -1.0
        if ent_coef.startswith("auto") and 0 < value < math.inf:
            return value
    elif is_number(ent_coef) and ent_coef > 0:
        return float(ent_coef)
    raise ValueError(f"ent_coef={ent_coef!r} must be 'auto', 'auto_0.1' or a positive number")
