"""Soft actor-critic for Box actions: an off-policy actor-critic that also maximizes the entropy of its policy.

Sources: Haarnoja et al. 2018, "Soft Actor-Critic" (arXiv 1801.01290) and "Soft Actor-Critic Algorithms and
Applications" (arXiv 1812.05905), which introduces the automatic temperature. With policy ``pi``, critics ``Q_i``, target
critics ``Q'_i``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    y           = r + d (min_i Q'_i(s', a') - alpha log pi(a' | s')),       a' ~ pi(. | s')
    J_Q         = mean_i mean (Q_i(s, a) - y)^2 / 2
    J_pi        = mean (alpha log pi(a | s) - min_i Q_i(s, a)),             a ~ pi(. | s), reparameterized
    J_alpha     = -mean log_alpha (log pi(a | s) + target_entropy)      unless the temperature is fixed
    Q'_i       <- Q'_i + tau (Q_i - Q'_i)

One update takes these steps in this order: critics, actor (against the new critics), temperature, targets. The actor and
the temperature share one sample of actions, and the losses use the temperature from before the update, as in
Stable-Baselines3. The critics' losses are summed over the critics, which gives each the gradient of its own ``J_Q``. As in
Stable-Baselines3, the temperature's loss is written in ``log alpha`` rather than ``alpha``. TQC and CrossQ share the
temperature.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.actor_critic.network import sde_explorer, sde_log_std
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.memory import remembering
from rejeu.core import (
    AVERAGED,
    TD_ERROR,
    Algorithm,
    Clock,
    Explorer,
    Metrics,
    Optimizer,
    PyTree,
    Transition,
    copy,
    descend,
    ensemble,
    minimize,
    polyak,
    tau_at,
    weighted_mean,
    without_gradient,
)
from rejeu.distributions import TanhNormal
from rejeu.networks import (
    Network,
    QNetwork,
    action_values,
    make_encoder,
    make_head,
    make_torso,
    values_by_critics,
    with_memory,
)
from rejeu.prng import nth
from rejeu.schedules import at
from rejeu.spaces import Leaf, action_dimension, check_box_action, leaves
from rejeu.validation import coerce, flag, number, whole

LOG_STD_RANGE = (-20.0, 2.0)
"""Bounds of the policy's log standard deviation, in nats, as in the authors' code."""


SDE_MEAN = 2.0
"""Largest mean of a policy with gSDE before squashing."""
HIDDEN_LAYERS = (256, 256)
"""Default widths of actor and critics."""
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
    Discrete actions 0.3 log n (the paper's 0.98 log n keeps the policy nearly uniform)."""
    n_critics: int = 2
    """Number of critics."""

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        initial_temperature(self.ent_coef)
        coerce(self, "target_entropy", lambda key, value: value if value == "auto" else number(key, value))
        coerce(self, "n_critics", whole, least=1)

    def entropy_target(self, automatic: float) -> float:
        """Returns the target entropy in nats, ``automatic`` for ``"auto"``."""
        return automatic if self.target_entropy == "auto" else float(self.target_entropy)

    @property
    def learns_temperature(self) -> bool:
        """Whether the temperature is learned."""
        return isinstance(self.ent_coef, str)


@dataclass(frozen=True, kw_only=True)
class Config(EntropyConfig):
    """Hyperparameters of SAC; the defaults are those of the paper and of Stable-Baselines3."""

    target_update_interval: int = 1
    """Gradient steps between two updates of the target critics."""
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

    def __post_init__(self) -> None:
        EntropyConfig.__post_init__(self)
        coerce(self, "target_update_interval", whole, least=1)
        coerce(self, "use_sde", flag)
        coerce(self, "sde_sample_freq", whole, least=-1)
        coerce(self, "sde_log_std_init", number)
        if self.sde_sample_freq == 0:
            raise ValueError("sde_sample_freq=0 would sample no noise; use 1 or more, or -1 for once per episode")
        if self.use_sde and self.action_noise is not None:
            raise ValueError("use_sde=True explores by itself; leave action_noise out")
        if self.use_sde and self.has_memory:
            raise ValueError("use_sde=True is not available for policies with memory; leave it or lstm_hidden_size out")


class SdeActor(eqx.Module):
    """Maps an observation to a mean action, and to noise that its last hidden layer scales (gSDE)."""

    encoder: Any
    torso: Any
    head: Any
    log_std: Array
    """``(width, action_dim)``."""
    use_expln: bool = eqx.field(static=True, default=False)

    def __init__(self, key: Array, obs_leaves: tuple[Leaf, ...], action_dim: int, config: Config) -> None:
        shape = config.policy_kwargs
        encoder_key, torso_key, head_key = jax.random.split(key, 3)
        self.encoder = make_encoder(encoder_key, obs_leaves, shape)
        widths = shape.actor_widths(HIDDEN_LAYERS)
        self.torso, width = make_torso(torso_key, self.encoder.n_features, None, widths, shape)
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


class State(eqx.Module):
    """Everything that SAC learns; every leaf is an array."""

    actor: Network | SdeActor
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


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns SAC for Box actions."""
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, shape = leaves(observation_space), config.policy_kwargs
    target_entropy = config.entropy_target(-float(action_dim))
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)

    def critic(key: Array, leaves: tuple[Leaf, ...], shape: Any) -> QNetwork:
        return QNetwork(key, leaves, action_dim, shape.critic_widths(HIDDEN_LAYERS), shape)

    def init(key: Array) -> State:
        return initial_state(key, obs_leaves, 2 * action_dim, critic, config, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate, alpha = at(config.learning_rate, clock.progress), jnp.exp(state.log_alpha)
        target = without_gradient(td_target)(state.actor, state.target_critics, alpha, batch, target_key)
        critics, critics_optimizer, critic_loss, values = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target
        )
        actor, actor_optimizer, policy_loss, log_prob = minimize(
            actor_loss, state.actor, state.actor_optimizer, optimizer, rate, critics, alpha, batch.obs, actor_key
        )
        state = temperature_and_targets(
            state, (actor, actor_optimizer), (critics, critics_optimizer), log_prob, target_entropy, config, rate
        )
        return state, metrics_of(
            critic_loss, policy_loss, alpha, -jnp.mean(log_prob), values, target, target_entropy, config
        )

    actor = lambda state: state.actor  # noqa: E731
    algorithm = Algorithm(init, actor, explore, exploit, update, explorer_of(config), action_values=values_by_critics)
    return remembering(algorithm, shape, networks)


def networks(state: State) -> tuple[Any, ...]:
    """Returns the networks that may have a memory."""
    return state.actor, state.critics


def explorer_of(config: Config) -> Explorer | None:
    """Returns exploration by state-dependent noise if the configuration uses it, else None."""
    return sde_explorer(config.sde_sample_freq) if config.use_sde else None


def initial_state(
    key: Array,
    obs_leaves: tuple[Leaf, ...],
    n_outputs: int,
    make_critic: Callable[[Array, tuple[Leaf, ...], Any], Any],
    config: Config,
    optimizer: Optimizer,
) -> State:
    """Returns the state before the first update: an actor of ``n_outputs``, and ``config.n_critics`` critics.

    ``make_critic(key, leaves, shape)`` returns one critic of such observations. With gSDE the actor has half as many
    outputs, the means.
    """
    actor_key, critics_key, update_key = jax.random.split(key, 3)
    shape = config.policy_kwargs
    actor: Network | SdeActor
    if config.use_sde:
        actor = SdeActor(actor_key, obs_leaves, n_outputs // 2, config)
    else:
        actor = with_memory(
            actor_key,
            obs_leaves,
            shape,
            lambda leaves, shape: Network(actor_key, leaves, n_outputs, shape.actor_widths(HIDDEN_LAYERS), shape),
        )
    critics = with_memory(
        critics_key,
        obs_leaves,
        shape,
        lambda leaves, shape: ensemble(lambda key: make_critic(key, leaves, shape), critics_key, config.n_critics),
        slot=1,
    )
    log_alpha, alpha_optimizer = initial_alpha(config)
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
    actor: tuple[Network | SdeActor, PyTree],
    critics: tuple[Any, PyTree],
    log_prob: Array,
    target_entropy: Any,
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
    log_alpha, alpha_optimizer = temperature_step(
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
    mean, log_std = jnp.split(actor(obs), 2, axis=-1)
    return TanhNormal(mean, jnp.clip(log_std, *LOG_STD_RANGE))


def td_target(
    actor: Network | SdeActor, target_critics: QNetwork, alpha: Array, batch: Transition, key: Array
) -> Array:
    """Returns the TD targets, ``(batch,)`` (arXiv 1812.05905, equations 2 and 5)."""
    next_action, next_log_prob = policy(actor, batch.next_obs).sample_and_log_prob(key)
    next_value = jnp.min(action_values(target_critics, batch.next_obs, next_action), axis=0)
    return batch.reward + batch.discount * (next_value - alpha * next_log_prob)


def critics_loss(critics: QNetwork, batch: Transition, target: Array) -> tuple[Array, Array]:
    """Returns half the squared TD error, averaged over the batch and summed over critics, and the values."""
    values = action_values(critics, batch.obs, batch.action)
    return 0.5 * jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values


def actor_loss(
    actor: Network | SdeActor, critics: QNetwork, alpha: Array, obs: PyTree, key: Array
) -> tuple[Array, Array]:
    """Returns the soft policy loss and the log-probabilities of the actions drawn, ``(batch,)`` (equation 7)."""
    action, log_prob = policy(actor, obs).sample_and_log_prob(key)
    value = jnp.min(action_values(critics, obs, action), axis=0)
    return jnp.mean(alpha * log_prob - value), log_prob


def initial_temperature(ent_coef: float | str) -> float:
    """Returns the initial temperature: 1 for ``"auto"``, x for ``"auto_x"`` and for x.

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


def initial_alpha(config: EntropyConfig) -> tuple[Array, PyTree]:
    """Returns the initial logarithm of the temperature, and the state of its optimizer."""
    log_alpha = jnp.log(jnp.float32(initial_temperature(config.ent_coef)))
    return log_alpha, ALPHA_OPTIMIZER.init(log_alpha)


def temperature_loss(log_alpha: Array, log_prob: Array, target_entropy: Any) -> Array:
    """Returns the loss that raises the temperature while the policy's entropy is below its target.

    Of several temperatures ``(n,)``, with ``log_prob (batch, n)`` and targets ``(1, n)``, it is the sum.
    """
    weight = jnp.broadcast_to(log_alpha, log_prob.shape)
    return -jnp.sum(jnp.mean(weight * (jax.lax.stop_gradient(log_prob) + target_entropy), axis=0))


def temperature_step(
    log_alpha: Array, optimizer_state: PyTree, log_prob: Array, target_entropy: Any, config: EntropyConfig, rate: Any
) -> tuple[Array, PyTree]:
    """Returns the temperature's logarithm and optimizer state after one step, unchanged if the temperature is fixed."""
    if not config.learns_temperature:
        return log_alpha, optimizer_state
    gradient = jax.grad(temperature_loss)(log_alpha, log_prob, target_entropy)
    return descend(log_alpha, gradient, optimizer_state, ALPHA_OPTIMIZER, rate)


def metrics_of(
    critic_loss: Array,
    actor_loss: Array,
    alpha: Array,
    entropy: Array,
    values: Array,
    target: Array,
    target_entropy: float,
    config: EntropyConfig,
) -> Metrics:
    """Returns the metrics of an update, from the values ``(n_critics, batch)`` and their targets ``(batch,)``."""
    loss = {"ent_coef_loss": jnp.log(alpha) * (entropy - target_entropy)} if config.learns_temperature else {}
    return loss | {
        "critic_loss": critic_loss,
        "actor_loss": actor_loss,
        "ent_coef": alpha,
        "entropy": entropy,
        "q_value": jnp.mean(values),
        TD_ERROR: jnp.mean(jnp.abs(values - target[None]), axis=0),
    }
