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

With ``target_subset`` M, ``min`` in ``y`` is over M critics that are drawn anew for each update, and ``J_pi`` has the mean
of all critics in place of ``min``: REDQ (Chen et al. 2021, arXiv 2101.05982, algorithm 1), which has 10 critics, M = 2, and
one step of the actor for 20 of the critics (``policy_delay``). With dropout in the critics, in every pass of an update, it is
DroQ (Hiraoka et al. 2022, arXiv 2110.02034, algorithm 2).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.actor_critic.network import sde_explorer, sde_log_std
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.memory import remembering
from rejeu.core.algorithm import (
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
from rejeu.core.distributions import TanhNormal
from rejeu.core.prng import nth
from rejeu.core.schedules import at
from rejeu.core.spaces import Leaf, action_dimension, check_box_action, leaves
from rejeu.core.validation import coerce, flag, number, whole
from rejeu.exploration.held_noise import held_explorer
from rejeu.networks import (
    Network,
    QNetwork,
    action_values,
    make_encoder,
    make_head,
    make_torso,
    some,
    values_by_critics,
    with_dropout,
    with_memory,
)

S = TypeVar("S", bound=Any)
"""The state of an algorithm with an entropy bonus."""
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
    Discrete actions 0.3 log n (the paper's 0.98 log n keeps the policy nearly uniform). ``"std_0.15"`` is that of normal
    distributions with this standard deviation, the range of an action being [-1, 1]."""
    n_critics: int = 2
    """Number of critics."""
    noise_repeat: int = 1
    """Most steps for which the noise of an action stays the same; most spells are short (FlashSAC). A larger number explores
    further from where the policy is. Box actions only, without ``action_noise``. 1: fresh noise in every step."""

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        initial_temperature(self.ent_coef)
        coerce(self, "target_entropy", entropy_target)
        coerce(self, "noise_repeat", whole, least=1)
        for key, given in (("action_noise", self.action_noise is not None), ("lstm_hidden_size", self.has_memory)):
            if self.noise_repeat > 1 and given:
                raise ValueError(f"noise_repeat={self.noise_repeat} is not available with {key}; leave one of them out")
        coerce(self, "n_critics", whole, least=1)

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


@dataclass(frozen=True, kw_only=True)
class Config(EntropyConfig):
    """Hyperparameters of SAC; the defaults are those of the paper and of Stable-Baselines3."""

    target_update_interval: int = 1
    """Gradient steps between two updates of the target critics."""
    target_subset: int | None = None
    """Number of critics, drawn anew for each update, of which the target takes the smallest value; the actor then follows
    the mean of all (REDQ, arXiv 2101.05982). A larger number is more pessimistic. None: the smallest of all, for both."""
    policy_delay: int = 1
    """Gradient steps of the critics per step of actor and temperature. A larger number computes less."""
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
        coerce(self, ("target_update_interval", "policy_delay"), whole, least=1)
        coerce(self, "target_subset", whole, least=1, optional=True)
        if (self.target_subset or 0) > self.n_critics:
            raise ValueError(f"target_subset={self.target_subset} is more than n_critics={self.n_critics}")
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
        """What the actor's loss makes of the values of all critics."""
        return jnp.min if self.target_subset is None else jnp.mean

    def dropout_keys(self, key: Array) -> Any:
        """Returns keys for the dropout of critics that learn and that are learned from; None for both without dropout."""
        return jax.random.split(jax.random.fold_in(key, 1)) if self.policy_kwargs.dropout else (None, None)

    def for_target(self, critics: Any, key: Array) -> Any:
        """Returns the target critics of an update: all of them or ``target_subset``, with dropout if they have it."""
        if self.target_subset is not None:
            index = jax.random.choice(jax.random.fold_in(key, 2), self.n_critics, (self.target_subset,), replace=False)
            critics = some(critics, index)
        return with_dropout(critics, self.dropout_keys(key)[1])


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

    actor: Any
    """A :class:`Network`, with gSDE an :class:`SdeActor`."""
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
    actor_loss: Array | None = None
    """Of the actor's last step, ``float32[]``, with ``policy_delay``."""
    entropy: Array | None = None
    """Of the policy at that step, in nats, ``float32[]``, likewise."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns SAC for Box actions."""
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, shape = leaves(observation_space), config.policy_kwargs
    target_entropy = config.entropy_target(-float(action_dim), action_dim)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)

    def critic(key: Array, leaves: tuple[Leaf, ...], shape: Any) -> QNetwork:
        return QNetwork(key, leaves, action_dim, shape.critic_widths(HIDDEN_LAYERS), shape)

    def init(key: Array) -> State:
        return initial_state(key, obs_leaves, 2 * action_dim, critic, config, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        target_key, actor_key = jax.random.split(nth(state.key, state.n_updates))
        rate, alpha = at(config.learning_rate, clock.progress), jnp.exp(state.log_alpha)
        target_critics = config.for_target(state.target_critics, target_key)
        target = without_gradient(td_target)(state.actor, target_critics, alpha, batch, target_key)
        drop, judge_drop = config.dropout_keys(actor_key)
        critics, critics_optimizer, critic_loss, values = minimize(
            critics_loss, state.critics, state.critics_optimizer, optimizer, rate, batch, target, drop
        )
        state = after_critics(state, critics, critics_optimizer, config)

        def improve(state: State) -> tuple[State, Array, Array]:
            judges = with_dropout(critics, judge_drop), alpha, batch.obs, actor_key, config.judged_by
            actor, actor_optimizer, loss, log_prob = minimize(
                actor_loss, state.actor, state.actor_optimizer, optimizer, rate, *judges
            )
            state = after_actor(state, actor, actor_optimizer, log_prob, target_entropy, config, rate)
            return state, loss, -jnp.mean(log_prob)

        state, policy_loss, entropy = every(config.policy_delay, state, improve)
        return state, metrics_of(critic_loss, policy_loss, alpha, entropy, values, target, target_entropy, config)

    actor = lambda state: state.actor  # noqa: E731
    explorer = explorer_of(config, action_dim)
    algorithm = Algorithm(init, actor, explore, exploit, update, explorer, action_values=values_by_critics)
    return remembering(algorithm, shape, networks)


def networks(state: State) -> tuple[Any, ...]:
    """Returns the networks that may have a memory."""
    return state.actor, state.critics


def explorer_of(config: Config, action_dim: int) -> Explorer | None:
    """Returns exploration by state-dependent or held noise if the configuration uses it, else None."""
    if config.noise_repeat > 1:
        return held_explorer(policy, action_dim, config.noise_repeat)
    return sde_explorer(config.sde_sample_freq) if config.use_sde else None


def check_discrete(config: Config) -> None:
    """Raises ``ValueError`` for exploration and entropies that only Box actions have."""
    given = {
        "use_sde=True": config.use_sde,
        f"noise_repeat={config.noise_repeat}": config.noise_repeat > 1,
        f"target_entropy={config.target_entropy!r}": str(config.target_entropy).startswith("std_"),
    }
    if wrong := [setting for setting, is_given in given.items() if is_given]:
        raise ValueError(f"{wrong[0]} needs Box actions: noise cannot be added to discrete actions; leave it out")


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
        actor_loss=None if config.policy_delay == 1 else jnp.float32(0.0),
        entropy=None if config.policy_delay == 1 else jnp.float32(0.0),
    )


def after_critics(state: State, critics: Any, optimizer_state: PyTree, config: Any) -> State:
    """Returns the state with new critics, their optimizer's state, and the targets moved by ``config.tau`` if they are due."""
    n_updates = state.n_updates + 1
    tau = tau_at(n_updates, config.tau, config.target_update_interval)
    targets = polyak(state.target_critics, critics, tau)
    return dataclasses.replace(
        state, critics=critics, critics_optimizer=optimizer_state, target_critics=targets, n_updates=n_updates
    )


def after_actor(
    state: S, actor: Any, optimizer_state: PyTree, log_prob: Array, target_entropy: Any, config: Any, rate: Any
) -> S:
    """Returns the state with a new actor and its optimizer's state, after a step of the temperature.

    ``log_prob`` is that of the actions that the actor sampled, ``(batch,)``; ``target_entropy`` is in nats.
    """
    log_alpha, alpha_optimizer = temperature_step(
        state.log_alpha, state.alpha_optimizer, log_prob, target_entropy, config, rate
    )
    return dataclasses.replace(
        state, actor=actor, actor_optimizer=optimizer_state, log_alpha=log_alpha, alpha_optimizer=alpha_optimizer
    )


def every(policy_delay: int, state: S, improve: Callable[[S], tuple[S, Array, Array]]) -> tuple[S, Array, Array]:
    """Returns ``improve(state)`` at every ``policy_delay``-th update of the critics, which ``state.n_updates`` counts.

    That is the state after a step of the actor, its loss and the entropy; at other updates those of its latest step.
    """
    if policy_delay == 1:
        return improve(state)

    def step(state: S) -> S:
        state, loss, entropy = improve(state)
        return dataclasses.replace(state, actor_loss=loss, entropy=entropy)

    state = jax.lax.cond(state.n_updates % policy_delay == 0, step, lambda s: s, state)
    return state, state.actor_loss, state.entropy


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


def critics_loss(critics: QNetwork, batch: Transition, target: Array, drop: Array | None = None) -> tuple[Array, Array]:
    """Returns half the squared TD error, averaged over the batch and summed over critics, and the values.

    ``drop`` is the key of the critics' dropout, None for none.
    """
    values = action_values(with_dropout(critics, drop), batch.obs, batch.action)
    return 0.5 * jnp.sum(weighted_mean(jnp.square(values - target[None]), batch.weight)), values


def actor_loss(
    actor: Network | SdeActor,
    critics: QNetwork,
    alpha: Array,
    obs: PyTree,
    key: Array,
    judged_by: Callable[..., Array] = jnp.min,
) -> tuple[Array, Array]:
    """Returns the soft policy loss and the log-probabilities of the actions drawn, ``(batch,)`` (equation 7).

    The critics are combined by ``judged_by``, ``jnp.min`` or ``jnp.mean``.
    """
    action, log_prob = policy(actor, obs).sample_and_log_prob(key)
    value = judged_by(action_values(critics, obs, action), axis=0)
    return jnp.mean(alpha * log_prob - value), log_prob


def entropy_target(key: str, value: Any) -> float | str:
    """Returns a target entropy: ``"auto"``, ``"std_"`` and a positive number, or a number."""
    if isinstance(value, str) and value != "auto":
        try:
            good = value.startswith("std_") and 0 < float(value.removeprefix("std_")) < math.inf
        except ValueError:
            good = False
        if not good:
            raise ValueError(f"{key}={value!r} must be 'auto', 'std_0.15' or a number")
    return value if isinstance(value, str) else number(key, value)


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
