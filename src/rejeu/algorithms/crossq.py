"""CrossQ: SAC without target networks, stabilized by batch renormalization instead, with wide critics.

Source: Bhatt et al. 2024, "CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and
Simplicity" (arXiv 1902.05605). Batch normalization fails in a critic that sees ``(s, a)`` in one pass and ``(s', a')``,
which are distributed otherwise, in another. Here they go through together and share their statistics. With policy
``pi``, critics ``Q_i``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    a'                          ~ pi(. | s')
    [Q_i(s, a), Q_i(s', a')]    = one training pass of both halves through Q_i
    y                           = r + d (min_i Q_i(s', a') - alpha log pi(a' | s')),      not differentiated
    J_Q                         = sum_i mean (Q_i(s, a) - y)^2 / 2
    J_pi                        = mean (alpha log pi(a | s) - min_i Q_i(s, a)),           a ~ pi(. | s), reparameterized

and every ``policy_delay``-th time, after the critics, the actor takes a step and with it the temperature, whose loss is
SAC's (:mod:`rejeu.algorithms.sac`). A network goes by the batch's statistics, and its running ones move on, only while
its own loss is taken (:mod:`rejeu.networks.batch_renorm`): the policy acts, draws ``a'`` and is judged by the critics with
running statistics. Adam's first moment forgets faster, ``b_1 = 1/2``, except for the temperature.

As in Stable-Baselines3 Contrib, the critics are 1024 wide by default, where the paper's are 2048.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.sac.continuous import (
    LOG_STD_RANGE,
    EntropyConfig,
    exploit,
    explore,
    initial_alpha,
    metrics_of,
    temperature_step,
)
from rejeu.algorithms.search import Integers, SearchSpace
from rejeu.core.algorithm import (
    Algorithm,
    Clock,
    Metrics,
    Optimizer,
    PyTree,
    Transition,
    ensemble,
    minimize,
    weighted_mean,
)
from rejeu.core.distributions import TanhNormal
from rejeu.core.prng import nth
from rejeu.core.schedules import Schedule, at
from rejeu.core.spaces import Leaf, action_dimension, check_box_action, leaves
from rejeu.core.validation import coerce, whole
from rejeu.exploration.held_noise import held_explorer
from rejeu.networks import PolicyConfig, Widths, action_values, values_by_critics
from rejeu.networks.batch_renorm import RenormalizedMLP, RenormalizedNetwork, with_statistics

ACTOR_LAYERS = (256, 256)
"""Default widths of the actor."""
CRITIC_LAYERS = (1024, 1024)
"""Default widths of each critic."""
ADAM_B1 = 0.5
"""Decay of the networks' first moments."""


@dataclass(frozen=True, kw_only=True)
class Config(EntropyConfig):
    """Hyperparameters of CrossQ; the defaults are those of Stable-Baselines3 Contrib."""

    learning_rate: float | Schedule = 1e-3
    policy_delay: int = 3
    """Gradient steps of the critics per step of actor and temperature. A larger number computes less."""
    renorm_warmup_steps: int = 100_000
    """Training passes through each layer that are normalized by the batch alone, before its renormalization begins; the
    actor's count is ``policy_delay`` times slower."""
    # A class variable in place of the inherited field takes the field away: CrossQ(tau=...) is then an unknown setting.
    tau: ClassVar[float] = 1.0  # type: ignore[misc]

    name: ClassVar[str] = "CrossQ"
    search_space: ClassVar[SearchSpace] = {
        **{name: one for name, one in search.OFF_POLICY.items() if name != "tau"},
        "policy_delay": Integers(1, 4),
    }
    hidden_layers: ClassVar[Widths] = Widths(ACTOR_LAYERS, CRITIC_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = hidden_layers

    def __post_init__(self) -> None:
        EntropyConfig.__post_init__(self)
        coerce(self, "policy_delay", whole, least=1)
        coerce(self, "renorm_warmup_steps", whole, least=0)
        check_shape(self.policy_kwargs, self.name)


class State(eqx.Module):
    """Everything that CrossQ learns, every leaf an array; the networks hold their running statistics."""

    actor: RenormalizedNetwork
    critics: RenormalizedNetwork
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
        TypeError: if the observation space holds something that is not an array.
    """
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, target_entropy = leaves(observation_space), config.entropy_target(-float(action_dim), action_dim)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm, b1=ADAM_B1)

    def init(key: Array) -> State:
        return initial_state(key, obs_leaves, action_dim, config, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate, alpha = at(config.learning_rate, clock.progress), jnp.exp(state.log_alpha)
        next_action, next_log_prob = distribution(state.actor(batch.next_obs)).sample_and_log_prob(target_key)
        critics, critics_optimizer, critic_loss, (values, target, trained) = minimize(
            critics_loss,
            state.critics,
            state.critics_optimizer,
            optimizer,
            rate,
            batch,
            next_action,
            alpha * next_log_prob,
        )
        critics, n_updates = with_statistics(critics, trained), state.n_updates + 1

        def delayed(state: State) -> State:
            actor, actor_optimizer, policy_loss, (log_prob, trained) = minimize(
                actor_loss, state.actor, state.actor_optimizer, optimizer, rate, critics, alpha, batch.obs, actor_key
            )
            log_alpha, alpha_optimizer = temperature_step(
                state.log_alpha, state.alpha_optimizer, log_prob, target_entropy, config, rate
            )
            return dataclasses.replace(
                state,
                actor=with_statistics(actor, trained),
                actor_optimizer=actor_optimizer,
                log_alpha=log_alpha,
                alpha_optimizer=alpha_optimizer,
                actor_loss=policy_loss,
                entropy=-jnp.mean(log_prob),
            )

        state = dataclasses.replace(state, critics=critics, critics_optimizer=critics_optimizer, n_updates=n_updates)
        state = jax.lax.cond(n_updates % config.policy_delay == 0, delayed, lambda s: s, state)
        return state, metrics_of(
            critic_loss, state.actor_loss, alpha, state.entropy, values, target, target_entropy, config
        )

    policy = lambda actor, obs: distribution(actor(obs))  # noqa: E731
    explorer = held_explorer(policy, action_dim, config.noise_repeat) if config.noise_repeat > 1 else None
    return Algorithm(
        init, lambda state: state.actor, explore, exploit, update, explorer, action_values=values_by_critics
    )


def initial_state(
    key: Array,
    obs_leaves: tuple[Leaf, ...],
    action_dim: int,
    config: Config,
    optimizer: Optimizer,
) -> State:
    """Returns the state before the first update."""
    actor_key, critics_key, update_key = jax.random.split(key, 3)
    shape = config.policy_kwargs

    def network(key: Array, n_actions: int | None, n_outputs: int, widths: tuple[int, ...]) -> RenormalizedNetwork:
        settings = widths, shape.activation_fn, config.renorm_warmup_steps
        torso = lambda key, n_inputs: RenormalizedMLP(key, n_inputs, *settings)  # noqa: E731
        return RenormalizedNetwork(key, obs_leaves, n_actions, n_outputs, torso)

    actor = network(actor_key, None, 2 * action_dim, shape.actor_widths(ACTOR_LAYERS))
    widths = shape.critic_widths(CRITIC_LAYERS)
    critics = ensemble(lambda k: network(k, action_dim, 1, widths), critics_key, config.n_critics)
    log_alpha, alpha_optimizer = initial_alpha(config)
    return State(
        actor=actor,
        critics=critics,
        log_alpha=log_alpha,
        actor_optimizer=optimizer.init(actor),
        critics_optimizer=optimizer.init(critics),
        alpha_optimizer=alpha_optimizer,
        actor_loss=jnp.float32(0.0),
        entropy=jnp.float32(0.0),
        key=update_key,
        n_updates=jnp.int32(0),
    )


def check_shape(shape: PolicyConfig, name: str) -> None:
    """Raises ``ValueError`` for network shapes other than widths: the algorithm ``name`` has normalized layers of its own."""
    given = {
        "layer_norm": shape.layer_norm,
        "cnn_layer_norm": shape.cnn_layer_norm,
        "cnn_features": shape.cnn_features is not None,
        "normalize_images": not shape.normalize_images,
        "encoder": shape.encoder is not None,
        "head": shape.head is not None,
        "architecture": shape.architecture != "mlp",
        "torso": shape.torso is not None,
        "branches": shape.has_branches,
    }
    if refused := [key for key, present in given.items() if present]:
        raise ValueError(
            f"{name} normalizes layers of its own; its policy_kwargs take net_arch and activation_fn, not "
            f"{', '.join(refused)}: leave that out, or use SAC or TQC"
        )


def joint_values(
    critics: RenormalizedNetwork, batch: Transition, next_action: Array
) -> tuple[Array, Array, RenormalizedNetwork]:
    """Returns the values of ``(s, a)`` and of ``(s', a')``, ``(n_critics, batch)`` each, from one pass of both.

    The critics are in training; they are returned as they are after having seen the batch.
    """
    obs = jax.tree.map(lambda now, then: jnp.concatenate([now, then], axis=0), batch.obs, batch.next_obs)
    action = jnp.concatenate([batch.action, next_action], axis=0)
    values, trained = jax.vmap(lambda critic: critic.train(obs, action))(critics)
    now, then = jnp.split(values[..., 0], 2, axis=-1)
    return now, then, trained


def td_target(next_values: Array, next_entropy_cost: Array, batch: Transition) -> Array:
    """Returns the TD targets, ``(batch,)``, without gradient.

    Args:
        next_values: of ``(s', a')`` by each critic, ``(n_critics, batch)``.
        next_entropy_cost: ``alpha log pi(a' | s')``, ``(batch,)``.
        batch: gives rewards and discounts.
    """
    return jax.lax.stop_gradient(batch.reward + batch.discount * (jnp.min(next_values, axis=0) - next_entropy_cost))


def critics_loss(
    critics: RenormalizedNetwork, batch: Transition, next_action: Array, next_entropy_cost: Array
) -> tuple[Array, tuple[Array, Array, RenormalizedNetwork]]:
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
    actor: RenormalizedNetwork, critics: RenormalizedNetwork, alpha: Array, obs: PyTree, key: Array
) -> tuple[Array, tuple[Array, RenormalizedNetwork]]:
    """Returns the soft policy loss, the critics judging by their running statistics.

    With it come the log-probabilities of the actions drawn, ``(batch,)``, and the actor that has seen the batch.
    """
    outputs, trained = actor.train(obs)
    action, log_prob = distribution(outputs).sample_and_log_prob(key)
    value = jnp.min(action_values(critics, obs, action), axis=0)
    return jnp.mean(alpha * log_prob - value), (log_prob, trained)
