"""Soft actor-critic: an off-policy actor-critic that also maximises the entropy of its policy.

Sources: Haarnoja et al. 2018, "Soft Actor-Critic" (arXiv 1801.01290) and "Soft Actor-Critic Algorithms and
Applications" (arXiv 1812.05905), from which the automatic temperature comes. With policy ``pi``, critics ``Q_i``, their
slowly moving targets ``Q'_i``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    y           = r + d (min_i Q'_i(s', a') - alpha log pi(a' | s')),       a' ~ pi(. | s')
    J_Q         = mean_i mean (Q_i(s, a) - y)^2 / 2
    J_pi        = mean (alpha log pi(a | s) - min_i Q_i(s, a)),             a ~ pi(. | s), reparameterised
    J_alpha     = -mean log_alpha (log pi(a | s) + target_entropy)
    Q'_i       <- Q'_i + tau (Q_i - Q'_i)

As in Stable-Baselines3, one update takes these steps in this order with one draw of actions at ``s``: temperature,
critics, actor (against the new critics), targets; ``J_alpha`` is written in ``log alpha`` rather than ``alpha``; and the
critics' losses are summed over the critics, which gives each the gradient of its own ``J_Q``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import (
    AVERAGED,
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    copy,
    descend,
    ensemble,
    polyak,
    tau_at,
    value_and_grad,
    weighted_mean,
)
from rejeu.distributions import TanhNormal
from rejeu.networks import Actor, Critic, action_values
from rejeu.prng import nth
from rejeu.schedules import at
from rejeu.spaces import action_dimension, check_box_action, leaves
from rejeu.validation import number, whole
from rejeu.xla import outlined

LOG_STD_RANGE = (-20.0, 2.0)
"""Bounds of the policy's log standard deviation, in nats, as in the authors' code."""
HIDDEN_LAYERS = (256, 256)
"""Default widths of actor and critics."""


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of SAC; the defaults are those of the paper and of Stable-Baselines3."""

    ent_coef: float | str = "auto"
    """Temperature of the entropy bonus: ``"auto"`` learns it from 1, ``"auto_0.1"`` from 0.1, a number fixes it.
    Raising it explores more."""
    target_entropy: float | str = "auto"
    """Entropy in nats that the automatic temperature steers to; ``"auto"`` is minus the number of action dimensions, for n
    Discrete actions 0.3 log n (the paper's 0.98 log n keeps the policy nearly uniform)."""
    target_update_interval: int = 1
    """Gradient steps between two moves of the target critics."""
    n_critics: int = 2
    """Number of critics; the least of their values is the target. More are more pessimistic."""

    name: ClassVar[str] = "SAC"

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        initial_temperature(self.ent_coef)
        if self.target_entropy != "auto":
            object.__setattr__(self, "target_entropy", number("target_entropy", self.target_entropy))
        for key in ("target_update_interval", "n_critics"):
            object.__setattr__(self, key, whole(key, getattr(self, key), least=1))


class State(eqx.Module):
    """Everything that SAC learns, every leaf an array."""

    actor: Actor
    critics: Critic
    """All critics, stacked along a leading axis."""
    target_critics: Critic = eqx.field(metadata=AVERAGED)
    log_alpha: Array
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    alpha_optimizer: PyTree
    key: Array
    """Root of the randomness of the updates, ``uint32[2]``; never changes."""
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns SAC for these spaces.

    Raises:
        ValueError: if the action space is neither a finite Box nor Discrete.
        TypeError: if the observation space holds something that is no array.
    """
    if isinstance(action_space, spaces.Discrete):
        from rejeu.algorithms import sac_discrete  # which imports this module

        return sac_discrete.make(config, observation_space, action_space)
    box = check_box_action(action_space, "SAC")
    obs_leaves = leaves(observation_space)
    action_dim = action_dimension(box)
    shape = config.policy_kwargs
    target_entropy = -float(action_dim) if config.target_entropy == "auto" else float(config.target_entropy)
    optimizer = optax.scale_by_adam()

    def init(key: Array) -> State:
        actor_key, critics_key, update_key = jax.random.split(key, 3)
        actor = Actor(actor_key, obs_leaves, 2 * action_dim, shape.actor_widths(HIDDEN_LAYERS), shape)
        critics = ensemble(
            lambda k: Critic(k, obs_leaves, action_dim, shape.critic_widths(HIDDEN_LAYERS), shape),
            critics_key,
            config.n_critics,
        )
        log_alpha = jnp.log(jnp.float32(initial_temperature(config.ent_coef)))
        return State(
            actor=actor,
            critics=critics,
            target_critics=copy(critics),
            log_alpha=log_alpha,
            actor_optimizer=optimizer.init(actor),
            critics_optimizer=optimizer.init(critics),
            alpha_optimizer=optimizer.init(log_alpha),
            key=update_key,
            n_updates=jnp.int32(0),
        )

    def explore(actor: Actor, obs: PyTree, key: Array, clock: Clock) -> Array:
        return policy(actor, obs).sample(key)

    def exploit(actor: Actor, obs: PyTree) -> Array:
        return policy(actor, obs).mode()

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate = at(config.learning_rate, clock.progress)
        alpha = jnp.exp(state.log_alpha)
        target = td_target(state.actor, state.target_critics, alpha, batch, target_key)
        (critic_loss, values), gradients = value_and_grad(critics_loss, has_aux=True)(state.critics, batch, target)
        critics, critics_optimizer = descend(state.critics, gradients, state.critics_optimizer, optimizer, rate)
        (policy_loss, log_prob), gradients = value_and_grad(actor_loss, has_aux=True)(
            state.actor, critics, alpha, batch.obs, actor_key
        )
        actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)

        log_alpha, alpha_optimizer = state.log_alpha, state.alpha_optimizer
        if isinstance(config.ent_coef, str):
            gradient = jax.grad(temperature_loss)(log_alpha, log_prob, target_entropy)
            log_alpha, alpha_optimizer = descend(log_alpha, gradient, alpha_optimizer, optimizer, rate)

        n_updates = state.n_updates + 1
        tau = tau_at(n_updates, config.tau, config.target_update_interval)
        state = State(
            actor=actor,
            critics=critics,
            target_critics=polyak(state.target_critics, critics, tau),
            log_alpha=log_alpha,
            actor_optimizer=actor_optimizer,
            critics_optimizer=critics_optimizer,
            alpha_optimizer=alpha_optimizer,
            key=state.key,
            n_updates=n_updates,
        )
        metrics = {
            "critic_loss": critic_loss,
            "actor_loss": policy_loss,
            "ent_coef": alpha,
            "entropy": -jnp.mean(log_prob),
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.mean(jnp.abs(values - target[None]), axis=0),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        assert action is not None
        return action_values(state.critics, obs, action)

    return Algorithm(init, lambda state: state.actor, explore, exploit, update, action_values=values)


def initial_temperature(ent_coef: float | str) -> float:
    """Returns the temperature that learning starts from: 1 for ``"auto"``, x for ``"auto_x"`` and for x.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(ent_coef, str):
        rest = ent_coef.removeprefix("auto").removeprefix("_")
        try:
            value = float(rest) if rest else 1.0
        except ValueError:
            value = -1.0
        if ent_coef.startswith("auto") and 0 < value < math.inf:
            return value
    elif not isinstance(ent_coef, bool) and isinstance(ent_coef, int | float) and 0 < ent_coef < math.inf:
        return float(ent_coef)
    raise ValueError(f"ent_coef={ent_coef!r} must be 'auto', 'auto_0.1' or a positive number")


def policy(actor: Actor, obs: PyTree) -> TanhNormal:
    """Returns the distribution of actions in [-1, 1] at ``obs``."""
    mean, log_std = jnp.split(actor(obs), 2, axis=-1)
    return TanhNormal(mean, jnp.clip(log_std, *LOG_STD_RANGE))


@outlined
def td_target(actor: Actor, target_critics: Critic, alpha: Array, batch: Transition, key: Array) -> Array:
    """Returns what the critics should say of the batch, ``(batch,)`` (arXiv 1812.05905, equations 2 and 5)."""
    next_action, next_log_prob = policy(actor, batch.next_obs).sample_and_log_prob(key)
    next_value = jnp.min(action_values(target_critics, batch.next_obs, next_action), axis=0)
    return batch.reward + batch.discount * (next_value - alpha * next_log_prob)


def critics_loss(critics: Critic, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns half the squared TD error, averaged over the batch and summed over critics, and the values."""
    values = action_values(critics, batch.obs, batch.action)
    return 0.5 * jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values


def actor_loss(actor: Actor, critics: Critic, alpha: Array, obs: PyTree, key: Array) -> tuple[Array, Array]:
    """Returns the soft policy loss and the log-probabilities of the actions drawn, ``(batch,)`` (equation 7)."""
    action, log_prob = policy(actor, obs).sample_and_log_prob(key)
    value = jnp.min(action_values(critics, obs, action), axis=0)
    return jnp.mean(alpha * log_prob - value), log_prob


def temperature_loss(log_alpha: Array, log_prob: Array, target_entropy: float) -> Array:
    """Returns the loss that raises the temperature while the policy's entropy is below its target."""
    return -jnp.mean(log_alpha * (jax.lax.stop_gradient(log_prob) + target_entropy))
