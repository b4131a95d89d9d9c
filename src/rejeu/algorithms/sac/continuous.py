"""Soft actor-critic for Box actions: an off-policy actor-critic that also maximizes the entropy of its policy.

Sources: Haarnoja et al. 2018, "Soft Actor-Critic" (arXiv 1801.01290) and "Soft Actor-Critic Algorithms and
Applications" (arXiv 1812.05905), which introduces the automatic temperature. With policy ``pi``, critics ``Q_i``, target
critics ``Q'_i``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    y           = r + d (min_i Q'_i(s', a') - alpha log pi(a' | s')),       a' ~ pi(. | s')
    J_Q         = mean_i mean (Q_i(s, a) - y)^2 / 2
    J_pi        = mean (alpha log pi(a | s) - min_i Q_i(s, a)),             a ~ pi(. | s), reparameterized
    J_alpha     = -mean log_alpha (log pi(a | s) + target_entropy)      unless the temperature is fixed
    Q'_i       <- Q'_i + tau (Q_i - Q'_i)

The order of the steps, temperature and targets are those of :mod:`rejeu.algorithms.soft`, as in Stable-Baselines3. The
critics' losses are summed over the critics, which gives each the gradient of its own ``J_Q``.

With ``target_subset`` M, ``min`` in ``y`` is over M critics that are drawn anew for each update, and ``J_pi`` has the mean
of all critics in place of ``min``: REDQ (Chen et al. 2021, arXiv 2101.05982, algorithm 1), which has 10 critics, M = 2, and
one step of the actor for 20 of the critics (``policy_delay``). With dropout in the critics, in every pass of an update, it is
DroQ (Hiraoka et al. 2022, arXiv 2110.02034, algorithm 2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.actor_critic.network import sde_explorer, sde_log_std
from rejeu.algorithms.config import network_inputs
from rejeu.algorithms.memory import acting_from_memory
from rejeu.algorithms.soft import EntropyConfig, SoftCritic, soft_actor_critic
from rejeu.core.algorithm import Algorithm, Clock, Explorer, PyTree, Transition, weighted_mean
from rejeu.core.distributions import TanhNormal
from rejeu.core.spaces import Leaf, action_dimension, check_box_action
from rejeu.core.types import Settings
from rejeu.core.validation import LARGEST_VALUE, coerce, flag, number, whole
from rejeu.exploration.held_noise import held_explorer
from rejeu.networks import (
    Network,
    QNetwork,
    action_values,
    actor_and_critics,
    make_encoder,
    make_head,
    make_torso,
    some,
    with_dropout,
)
from rejeu.networks.shape import PolicyConfig

LOG_STD_RANGE = (-20.0, 2.0)
"""Bounds of the policy's log standard deviation, in nats, as in the authors' code."""
SDE_MEAN = 2.0
"""Largest mean of a policy with gSDE before squashing."""


@dataclass(frozen=True, kw_only=True)
class Config(EntropyConfig):
    """Hyperparameters of SAC; the defaults are those of the paper and of Stable-Baselines3."""

    target_update_interval: int = 1
    """Gradient steps between two updates of the target critics."""
    target_subset: int | None = None
    """Number of critics, drawn anew for each update, of which the target takes the smallest value; the actor then follows
    the mean of all (REDQ, arXiv 2101.05982). A larger number is more pessimistic. None: the smallest of all, for both."""
    v_min: float | None = None
    """Least return, to which the targets of the critics are clipped: with a reward of -1 in every step until the goal it is
    ``-1 / (1 - gamma)`` (the clipped targets of hindsight experience replay). None for no bound."""
    v_max: float | None = None
    """Largest return, likewise: 0 with such rewards. With ``norm_reward`` both bound the returns of normalized rewards."""
    use_sde: bool = False
    """Explore by state-dependent noise (gSDE, arXiv 2005.05719), which is kept for many steps and gives smooth motion. Box
    actions only, without ``action_noise``."""
    sde_sample_freq: int = -1
    """Steps after which that noise is resampled; -1: in every episode."""
    sde_log_std_init: float = -3.0
    """Logarithm of the standard deviations of that noise at the start."""

    name: ClassVar[str] = "SAC"
    can_mask: ClassVar[bool] = True
    can_remember: ClassVar[bool] = True
    can_drop: ClassVar[bool] = True

    def __post_init__(self) -> None:
        EntropyConfig.__post_init__(self)
        coerce(self, "target_update_interval", whole, least=1)
        coerce(self, "target_subset", whole, least=1, optional=True)
        if (self.target_subset or 0) > self.n_critics:
            raise ValueError(f"target_subset={self.target_subset} is more than n_critics={self.n_critics}")
        coerce(self, ("v_min", "v_max"), number, least=-LARGEST_VALUE, most=LARGEST_VALUE, optional=True)
        if self.v_min is not None and self.v_max is not None and self.v_min >= self.v_max:
            raise ValueError(f"v_min={self.v_min} must be below v_max={self.v_max}")
        coerce(self, "use_sde", flag)
        coerce(self, "sde_sample_freq", whole, least=-1)
        coerce(self, "sde_log_std_init", number)
        if self.sde_sample_freq == 0:
            raise ValueError("sde_sample_freq=0 would sample no noise; use 1 or more, or -1 for once per episode")
        if self.use_sde and (self.action_noise is not None or self.noise_repeat > 1):
            raise ValueError("use_sde=True explores by itself; leave action_noise and noise_repeat out")
        if self.use_sde and self.has_memory:
            raise ValueError("use_sde=True is not available for policies with memory; leave it or lstm_hidden_size out")

    @property
    def judged_by(self) -> Callable[..., Array]:
        """The function by which the actor's loss reduces the values of all critics to one."""
        return jnp.min if self.target_subset is None else jnp.mean

    def dropout_keys(self, key: Array) -> PyTree:
        """Returns keys for the dropout of critics that learn and that are learned from; None for both without dropout."""
        return jax.random.split(jax.random.fold_in(key, 1)) if self.policy_kwargs.dropout else (None, None)

    def for_target(self, critics: PyTree, key: Array) -> PyTree:
        """Returns the target critics of an update: all of them or ``target_subset``, with dropout if they have it."""
        if self.target_subset is not None:
            index = jax.random.choice(jax.random.fold_in(key, 2), self.n_critics, (self.target_subset,), replace=False)
            critics = some(critics, index)
        return with_dropout(critics, self.dropout_keys(key)[1])


class SdeActor(eqx.Module):
    """Maps an observation to a mean action, and to noise that its last hidden layer scales (gSDE)."""

    encoder: PyTree
    torso: PyTree
    head: PyTree
    log_std: Array
    """``(width, action_dim)``."""
    use_expln: bool = eqx.field(static=True, default=False)

    def __init__(
        self, key: Array, inputs: tuple[tuple[Leaf, ...], PolicyConfig], action_dim: int, config: Config
    ) -> None:
        obs_leaves, shape = inputs
        encoder_key, torso_key, head_key = jax.random.split(key, 3)
        self.encoder = make_encoder(encoder_key, obs_leaves, shape)
        self.torso, width = make_torso(torso_key, self.encoder.n_features, None, shape.actor_widths(), shape)
        self.head = make_head(head_key, width, action_dim, shape)
        self.log_std = jnp.full((width, action_dim), config.sde_log_std_init, jnp.float32)

    def hidden(self, obs: PyTree) -> Array:
        """Returns the last hidden layer at observations ``(batch, ...)``."""
        return self.torso(self.encoder(obs))

    def distribution(self, hidden: Array, mask: Array | None = None) -> TanhNormal:
        """Returns the distribution of actions that the last hidden layer ``(batch, width)`` asks for.

        As in Stable-Baselines3, the mean before squashing stays within :data:`SDE_MEAN`.
        """
        mean = jnp.clip(self.head(hidden), -SDE_MEAN, SDE_MEAN)
        return TanhNormal(mean, sde_log_std(self.log_std, hidden, self.use_expln))


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns SAC for Box actions."""
    judge = partial(value, judged_by=config.judged_by)
    return make_with(config, observation_space, action_space, td_target, critics_loss, action_values, judge)


def make_with(
    config: Config,
    observation_space: spaces.Space,
    action_space: spaces.Space,
    td_target: Callable[[PyTree, PyTree, Array, Transition, Array], Array],
    critics_loss: Callable[[PyTree, Transition, Array], tuple[Array, PyTree]],
    values: Callable[[PyTree, PyTree, Array], Array],
    judge: Callable[[PyTree, PyTree, Array], Array],
    n_outputs: int = 1,
    measure: Callable[[PyTree, PyTree], tuple[Array, Array]] = lambda errors, target: errors,
) -> Algorithm:
    """Returns SAC for Box actions with critics of ``n_outputs`` and functions of its own, as those of this module.

    ``values`` is as :func:`rejeu.networks.action_values`, ``judge`` as :func:`value`, ``measure`` as of :class:`SoftCritic`.
    """
    action_dim = action_dimension(check_box_action(action_space, config.name))
    target_entropy = config.entropy_target(-float(action_dim), action_dim)
    parts = SoftCritic(
        *networks(config, observation_space, 2 * action_dim, QNetwork, action_dim, n_outputs),
        target=td_target,
        critics_loss=lambda critics, batch, target, key: critics_loss(critics, batch, target),
        actor_loss=lambda actor, critics, alpha, batch, key: actor_loss(actor, critics, alpha, batch.obs, key, judge),
        target_entropy=lambda obs: target_entropy,
        measure=measure,
    )
    queries = {"action_values": lambda state, obs, action: values(state.critics, obs, action)}
    return algorithm_of(parts, config, explore, exploit, {**queries, "explorer": explorer_of(config, action_dim)})


def algorithm_of(
    parts: SoftCritic, config: Config, explore: Callable[..., Array], exploit: Callable[..., Array], others: Settings
) -> Algorithm:
    """Returns the algorithm of these parts and parts of :class:`Algorithm`, with REDQ, dropout and memory if they are set."""
    parts = parts if config.target_subset is None and not config.policy_kwargs.dropout else drawn(parts, config)
    bounds, target = (config.v_min, config.v_max), parts.target
    if bounds != (None, None):
        parts = parts._replace(target=lambda *arguments: jnp.clip(target(*arguments), *bounds))
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)
    algorithm = soft_actor_critic(parts, config, explore, exploit, optimizer)._replace(**others)
    networks = lambda state: (state.actor, state.critics)  # noqa: E731
    return acting_from_memory(algorithm, networks) if config.has_memory else algorithm


def drawn(parts: SoftCritic, config: Config) -> SoftCritic:
    """Returns the equations with ``target_subset`` (REDQ) and with dropout in the critics in every pass (DroQ)."""

    def target(actor: PyTree, target_critics: PyTree, alpha: Array, batch: Transition, key: Array) -> PyTree:
        return parts.target(actor, config.for_target(target_critics, key), alpha, batch, key)

    def critics_loss(critics: PyTree, batch: Transition, target: PyTree, key: Array) -> tuple[Array, PyTree]:
        return parts.critics_loss(with_dropout(critics, config.dropout_keys(key)[0]), batch, target, key)

    def actor_loss(actor: PyTree, critics: PyTree, alpha: Array, batch: Transition, key: Array) -> tuple[Array, PyTree]:
        return parts.actor_loss(actor, with_dropout(critics, config.dropout_keys(key)[1]), alpha, batch, key)

    return parts._replace(target=target, critics_loss=critics_loss, actor_loss=actor_loss)


def networks(
    config: Config, observation_space: spaces.Space, n_outputs: int, critic_class: type[PyTree], *sizes: int
) -> tuple[Callable[[Array], PyTree], Callable[[Array], PyTree]]:
    """Returns functions of a key that build an actor of ``n_outputs``, and ``config.n_critics`` critics.

    A critic is a ``critic_class``, with ``sizes`` where it takes numbers of actions and outputs. With gSDE the actor has half
    as many outputs, the means.
    """
    inputs = network_inputs(config, observation_space)
    actor, critics = actor_and_critics(inputs, n_outputs, config.n_critics, critic_class, *sizes)
    return (
        partial(SdeActor, inputs=inputs, action_dim=n_outputs // 2, config=config) if config.use_sde else actor
    ), critics


def explorer_of(config: Config, action_dim: int) -> Explorer | None:
    """Returns exploration by state-dependent or held noise if the configuration uses it, else None."""
    if config.noise_repeat > 1:
        return held_explorer(policy, action_dim, config.noise_repeat)
    return sde_explorer(config.sde_sample_freq) if config.use_sde else None


def check_discrete(config: Config) -> None:
    """Raises ``ValueError`` for exploration and entropies that only Box actions have."""
    settings = {
        "use_sde=True": config.use_sde,
        f"noise_repeat={config.noise_repeat}": config.noise_repeat > 1,
        f"target_entropy={config.target_entropy!r}": str(config.target_entropy).startswith("std_"),
    }
    if wrong := [setting for setting, is_given in settings.items() if is_given]:
        raise ValueError(f"{wrong[0]} needs Box actions: noise cannot be added to discrete actions; leave it out")


def explore(actor: Network | SdeActor, obs: PyTree, key: Array, clock: Clock) -> Array:
    """Returns actions sampled from the policy, ``(batch, action_dim)``."""
    return policy(actor, obs).sample(key)


def exploit(actor: Network | SdeActor, obs: PyTree) -> Array:
    """Returns the squashed means of the policy, ``(batch, action_dim)``."""
    return policy(actor, obs).mode()


def policy(actor: Network | SdeActor, obs: PyTree) -> TanhNormal:
    """Returns the distribution of actions in [-1, 1] at ``obs``."""
    if isinstance(actor, SdeActor):
        return actor.distribution(actor.hidden(obs))
    return squashed(actor(obs))


def clipped(outputs: Array) -> Array:
    """Returns the log standard deviations of the policy, within :data:`LOG_STD_RANGE`, from outputs of the actor."""
    return jnp.clip(outputs, *LOG_STD_RANGE)


def squashed(outputs: Array, log_std: Callable[[Array], Array] = clipped) -> TanhNormal:
    """Returns the distribution of actions in [-1, 1] that the actor's outputs, ``(batch, 2 action_dim)``, mean."""
    mean, raw = jnp.split(outputs, 2, axis=-1)
    return TanhNormal(mean, log_std(raw))


def td_target(
    actor: Network | SdeActor, target_critics: QNetwork, alpha: Array, batch: Transition, key: Array
) -> Array:
    """Returns the TD targets, ``(batch,)`` (arXiv 1812.05905, equations 2 and 5)."""
    next_action, next_log_prob = policy(actor, batch.next_obs).sample_and_log_prob(key)
    next_value = jnp.min(action_values(target_critics, batch.next_obs, next_action), axis=0)
    return batch.reward + batch.discount * (next_value - alpha * next_log_prob)


def critics_loss(critics: QNetwork, batch: Transition, target: Array) -> tuple[Array, tuple[Array, Array]]:
    """Returns half the squared TD error, averaged over the batch and summed over critics; the values and the TD errors."""
    values = action_values(critics, batch.obs, batch.action)
    return squared_error(values, target, batch)


def squared_error(values: Array, target: Array, batch: Transition) -> tuple[Array, tuple[Array, Array]]:
    """Returns half the squared TD error of values ``(n_critics, batch)``, the values and the TD errors."""
    error = values - target[None]
    return 0.5 * jnp.sum(weighted_mean(jnp.square(error), batch.weight)), (values, error)


def value(critics: QNetwork, obs: PyTree, action: Array, judged_by: Callable[..., Array] = jnp.min) -> Array:
    """Returns the values of actions by all critics, ``(batch,)``, combined by ``jnp.min`` or ``jnp.mean``."""
    return judged_by(action_values(critics, obs, action), axis=0)


def actor_loss(
    actor: Network | SdeActor,
    critics: PyTree,
    alpha: Array,
    obs: PyTree,
    key: Array,
    judge: Callable[[PyTree, PyTree, Array], Array] = value,
) -> tuple[Array, Array]:
    """Returns the soft policy loss and the log-probabilities of the actions drawn, ``(batch,)`` (equation 7).

    ``judge(critics, obs, action)`` returns the values of actions, ``(batch,)``.
    """
    action, log_prob = policy(actor, obs).sample_and_log_prob(key)
    return jnp.mean(alpha * log_prob - judge(critics, obs, action)), log_prob
