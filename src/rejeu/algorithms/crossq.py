"""CrossQ: SAC without target networks, steadied by batch renormalisation instead, with wide critics.

Source: Bhatt et al. 2024, "CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and
Simplicity" (arXiv 1902.05605). Batch normalisation fails in a critic that sees ``(s, a)`` in one pass and ``(s', a')``,
which are distributed otherwise, in another. Here they go through together and share their statistics. With policy
``pi``, critics ``Q_i``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    a'                          ~ pi(. | s')
    [Q_i(s, a), Q_i(s', a')]    = one training pass of both halves through Q_i
    y                           = r + d (min_i Q_i(s', a') - alpha log pi(a' | s')),      not differentiated
    J_Q                         = sum_i mean (Q_i(s, a) - y)^2 / 2
    J_pi                        = mean (alpha log pi(a | s) - min_i Q_i(s, a)),           a ~ pi(. | s), reparameterised

and every ``policy_delay``-th time, after the critics, the actor takes a step and with it the temperature, whose loss is
SAC's (:mod:`rejeu.algorithms.sac`). A network goes by the batch's statistics, and its running ones move on, only while
its own loss is taken (:mod:`rejeu.networks.batch_renorm`): the policy acts, draws ``a'`` and is judged by the critics with
running statistics. Adam's first moment forgets faster, ``b_1 = 1/2``, except for the temperature.

As in Stable-Baselines3 Contrib, the critics are 1024 wide by default, where the paper's are 2048.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.sac import LOG_STD_RANGE, initial_temperature, temperature_loss
from rejeu.core import (
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Transition,
    descend,
    ensemble,
    value_and_grad,
    weighted_mean,
)
from rejeu.distributions import TanhNormal
from rejeu.networks import PolicyConfig, Widths
from rejeu.networks.batch_renorm import RenormalisedNetwork, with_statistics
from rejeu.prng import nth
from rejeu.schedules import Schedule, at
from rejeu.spaces import action_dimension, check_box_action, leaves
from rejeu.validation import number, whole

ACTOR_LAYERS = (256, 256)
"""Default widths of the actor."""
CRITIC_LAYERS = (1024, 1024)
"""Default widths of each critic."""
ADAM_B1 = 0.5
"""Decay of the networks' first moments."""


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of CrossQ; the defaults are those of Stable-Baselines3 Contrib."""

    learning_rate: float | Schedule = 1e-3
    """Step size of Adam for every network; a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)`` or
    ``"lin_1e-3"``."""
    policy_delay: int = 3
    """Gradient steps of the critics to one of actor and temperature. Raising it computes less."""
    renorm_warmup_steps: int = 100_000
    """Training passes through each layer that are normalised by the batch alone, before its renormalisation begins; the
    actor's count is ``policy_delay`` times slower."""
    n_critics: int = 2
    """Number of critics; the least of their values is the target."""
    ent_coef: float | str = "auto"
    """Temperature of the entropy bonus: ``"auto"`` learns it from 1, ``"auto_0.1"`` from 0.1, a number fixes it.
    Raising it explores more."""
    target_entropy: float | str = "auto"
    """Entropy in nats that the automatic temperature steers to; ``"auto"`` is minus the number of action dimensions."""
    # A class variable in place of the inherited field takes the field away: CrossQ(tau=...) is then an unknown setting.
    tau: ClassVar[float] = 1.0  # type: ignore[misc]

    name: ClassVar[str] = "CrossQ"
    hidden_layers: ClassVar[Widths] = Widths(ACTOR_LAYERS, CRITIC_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = hidden_layers

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        initial_temperature(self.ent_coef)
        if self.target_entropy != "auto":
            object.__setattr__(self, "target_entropy", number("target_entropy", self.target_entropy))
        for key in ("policy_delay", "n_critics"):
            object.__setattr__(self, key, whole(key, getattr(self, key), least=1))
        object.__setattr__(self, "renorm_warmup_steps", whole("renorm_warmup_steps", self.renorm_warmup_steps, least=0))
        check_shape(self.policy_kwargs)


class State(eqx.Module):
    """Everything that CrossQ learns, every leaf an array; the networks hold their running statistics."""

    actor: RenormalisedNetwork
    critics: RenormalisedNetwork
    """All critics, stacked along a leading axis."""
    log_alpha: Array
    actor_optimizer: PyTree
    critics_optimizer: PyTree
    alpha_optimizer: PyTree
    actor_loss: Array
    """Of the actor's last step, ``float32[]``: there is none in between."""
    entropy: Array
    """Of the policy at the actor's last step, in nats, ``float32[]``."""
    key: Array
    """Root of the randomness of the updates, ``uint32[2]``; never changes."""
    n_updates: Array
    """Gradient steps of the critics taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns CrossQ for these spaces.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is no array.
    """
    box = check_box_action(action_space, "CrossQ")
    obs_leaves, action_dim, shape = leaves(observation_space), action_dimension(box), config.policy_kwargs
    target_entropy = -float(action_dim) if config.target_entropy == "auto" else float(config.target_entropy)
    optimizer, alpha_descent = optax.scale_by_adam(b1=ADAM_B1), optax.scale_by_adam()

    def network(key: Array, n_actions: int | None, n_outputs: int, widths: tuple[int, ...]) -> RenormalisedNetwork:
        warm_up = config.renorm_warmup_steps
        return RenormalisedNetwork(key, obs_leaves, n_actions, n_outputs, widths, shape.activation_fn, warm_up)

    def init(key: Array) -> State:
        actor_key, critics_key, update_key = jax.random.split(key, 3)
        actor = network(actor_key, None, 2 * action_dim, shape.actor_widths(ACTOR_LAYERS))
        widths = shape.critic_widths(CRITIC_LAYERS)
        critics = ensemble(lambda k: network(k, action_dim, 1, widths), critics_key, config.n_critics)
        log_alpha = jnp.log(jnp.float32(initial_temperature(config.ent_coef)))
        return State(
            actor=actor,
            critics=critics,
            log_alpha=log_alpha,
            actor_optimizer=optimizer.init(actor),
            critics_optimizer=optimizer.init(critics),
            alpha_optimizer=alpha_descent.init(log_alpha),
            actor_loss=jnp.float32(0.0),
            entropy=jnp.float32(0.0),
            key=update_key,
            n_updates=jnp.int32(0),
        )

    def explore(actor: RenormalisedNetwork, obs: PyTree, key: Array, clock: Clock) -> Array:
        return distribution(actor(obs)).sample(key)

    def exploit(actor: RenormalisedNetwork, obs: PyTree) -> Array:
        return distribution(actor(obs)).mode()

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate = at(config.learning_rate, clock.progress)
        alpha = jnp.exp(state.log_alpha)
        next_action, next_log_prob = distribution(state.actor(batch.next_obs)).sample_and_log_prob(target_key)
        (critic_loss, (values, target, trained)), gradients = value_and_grad(critics_loss, has_aux=True)(
            state.critics, batch, next_action, alpha * next_log_prob
        )
        critics, critics_optimizer = descend(state.critics, gradients, state.critics_optimizer, optimizer, rate)
        critics, n_updates = with_statistics(critics, trained), state.n_updates + 1

        def delayed(state: State) -> State:
            (policy_loss, (log_prob, trained)), gradients = value_and_grad(actor_loss, has_aux=True)(
                state.actor, critics, alpha, batch.obs, actor_key
            )
            actor, actor_optimizer = descend(state.actor, gradients, state.actor_optimizer, optimizer, rate)
            log_alpha, alpha_optimizer = state.log_alpha, state.alpha_optimizer
            if isinstance(config.ent_coef, str):
                gradient = jax.grad(temperature_loss)(log_alpha, log_prob, target_entropy)
                log_alpha, alpha_optimizer = descend(log_alpha, gradient, alpha_optimizer, alpha_descent, rate)
            return eqx.tree_at(
                lambda s: (s.actor, s.actor_optimizer, s.log_alpha, s.alpha_optimizer, s.actor_loss, s.entropy),
                state,
                (
                    with_statistics(actor, trained),
                    actor_optimizer,
                    log_alpha,
                    alpha_optimizer,
                    policy_loss,
                    -jnp.mean(log_prob),
                ),
            )

        state = eqx.tree_at(
            lambda s: (s.critics, s.critics_optimizer, s.n_updates), state, (critics, critics_optimizer, n_updates)
        )
        state = jax.lax.cond(n_updates % config.policy_delay == 0, delayed, lambda s: s, state)
        metrics = {
            "critic_loss": critic_loss,
            "actor_loss": state.actor_loss,
            "ent_coef": alpha,
            "entropy": state.entropy,
            "q_value": jnp.mean(values),
            TD_ERROR: jnp.mean(jnp.abs(values - target[None]), axis=0),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        return jax.vmap(lambda critic: critic(obs, action)[:, 0])(state.critics)

    return Algorithm(init, lambda state: state.actor, explore, exploit, update, action_values=values)


def check_shape(shape: PolicyConfig) -> None:
    """Raises ``ValueError`` for network shapes other than plain layers: CrossQ puts its normalisation between them."""
    given = {
        "layer_norm": shape.layer_norm,
        "architecture": shape.architecture != "mlp",
        "torso": shape.torso is not None,
        "branches": shape.has_branches,
    }
    if refused := [key for key, present in given.items() if present]:
        raise ValueError(
            f"CrossQ renormalises layers of its own; its policy_kwargs take net_arch and activation_fn, not "
            f"{', '.join(refused)}: leave that out, or use SAC or TQC"
        )


def joint_values(
    critics: RenormalisedNetwork, batch: Transition, next_action: Array
) -> tuple[Array, Array, RenormalisedNetwork]:
    """Returns the values of ``(s, a)`` and of ``(s', a')``, ``(n_critics, batch)`` each, from one pass of both.

    The critics are in training; they are returned as they are after having seen the batch.
    """
    obs = jax.tree.map(lambda now, then: jnp.concatenate([now, then], axis=0), batch.obs, batch.next_obs)
    action = jnp.concatenate([batch.action, next_action], axis=0)
    values, trained = jax.vmap(lambda critic: critic.train(obs, action))(critics)
    now, then = jnp.split(values[..., 0], 2, axis=-1)
    return now, then, trained


def td_target(next_values: Array, next_entropy_cost: Array, batch: Transition) -> Array:
    """Returns what the critics should say of the batch, ``(batch,)``; nothing is differentiated.

    Args:
        next_values: of ``(s', a')`` by each critic, ``(n_critics, batch)``.
        next_entropy_cost: ``alpha log pi(a' | s')``, ``(batch,)``.
        batch: gives rewards and discounts.
    """
    return jax.lax.stop_gradient(batch.reward + batch.discount * (jnp.min(next_values, axis=0) - next_entropy_cost))


def critics_loss(
    critics: RenormalisedNetwork, batch: Transition, next_action: Array, next_entropy_cost: Array
) -> tuple[Array, tuple[Array, Array, RenormalisedNetwork]]:
    """Returns half the squared TD error, averaged over the batch and summed over critics.

    With it come the values ``(n_critics, batch)``, the target ``(batch,)`` and the critics that have seen the batch.
    ``next_entropy_cost`` is that of :func:`td_target`.
    """
    values, next_values, trained = joint_values(critics, batch, next_action)
    target = td_target(next_values, next_entropy_cost, batch)
    loss = 0.5 * jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight))
    return loss, (values, target, trained)


def distribution(outputs: Array) -> TanhNormal:
    """Returns the distribution of actions in [-1, 1] that the actor's outputs, ``(batch, 2 action_dim)``, mean."""
    mean, log_std = jnp.split(outputs, 2, axis=-1)
    return TanhNormal(mean, jnp.clip(log_std, *LOG_STD_RANGE))


def actor_loss(
    actor: RenormalisedNetwork, critics: RenormalisedNetwork, alpha: Array, obs: PyTree, key: Array
) -> tuple[Array, tuple[Array, RenormalisedNetwork]]:
    """Returns the soft policy loss, the critics judging by their running statistics.

    With it come the log-probabilities of the actions drawn, ``(batch,)``, and the actor that has seen the batch.
    """
    outputs, trained = actor.train(obs)
    action, log_prob = distribution(outputs).sample_and_log_prob(key)
    value = jnp.min(jax.vmap(lambda critic: critic(obs, action)[:, 0])(critics), axis=0)
    return jnp.mean(alpha * log_prob - value), (log_prob, trained)
