"""Deep Q-learning: one network learns the values of all actions, and the action of highest value is taken.

Sources: Mnih et al. 2015, "Human-level control through deep reinforcement learning" (doi 10.1038/nature14236); van
Hasselt et al. 2016, "Deep Reinforcement Learning with Double Q-learning" (arXiv 1509.06461); Wang et al. 2016, "Dueling
Network Architectures for Deep Reinforcement Learning" (arXiv 1511.06581); Fortunato et al. 2018, "Noisy Networks for
Exploration" (arXiv 1706.10295); Vieillard et al. 2020, "Munchausen Reinforcement Learning" (arXiv 2007.14430); for
``distribution="categorical"`` (C51) see :mod:`rejeu.algorithms.categorical`. With network ``Q``, target network ``Q'`` and
discount ``d`` (0 where the MDP terminated, gamma to the power n for n-step returns)::

    y      = r + d max_a' Q'(s', a')                        double_q: r + d Q'(s', argmax_a' Q(s', a'))
    J      = mean h(Q(s, a) - y),                           h(e) = e^2 / 2 where |e| < 1, |e| - 1/2 elsewhere
    Q(s,a) = V(s) + A(s, a) - mean_a' A(s, a')              where dueling
    Q'    <- Q' + tau (Q - Q')                              once every target_update_interval environment steps
    a      = argmax_a Q(s, a), or any with probability epsilon

With masks, every maximum is over the allowed actions, and so are the random ones. With ``noisy``, epsilon is 0 and every
weight is drawn anew (:mod:`rejeu.networks.noisy`): once for each call that chooses actions, and in an update once for each
network and role (Rainbow, Hessel et al. 2018, arXiv 1710.02298). With ``munchausen_alpha`` the target is that of
:func:`munchausen_target`.

What a network predicts of the return, and how it learns it, are the functions of :class:`Returns`: its mean here, or in
place of it probabilities, quantiles (:mod:`rejeu.algorithms.qrdqn`) or a quantile function (:mod:`rejeu.algorithms.iqn`).

The target moves just before the first gradient step at or after every multiple of ``target_update_interval``: to the
same numbers as in Stable-Baselines3, where it moves between two gradient steps. If several multiples have passed since
the last gradient step, so many soft updates are made at once, of ``1 - (1 - tau)^n`` together. As there, several
environments that step at once count as one step for an interval that is shorter. Unlike there, a longer one is counted in
environment steps exactly, also where the number of environments does not divide it.

Unlike in the paper on dueling networks, the gradients of both streams enter the shared layers unscaled, without the factor
``1 / sqrt(2)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import categorical, optimizers, search
from rejeu.algorithms.config import OffPolicyConfig, network_inputs
from rejeu.algorithms.memory import acting_from_memory
from rejeu.algorithms.search import SearchSpace
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
    minimize,
    polyak,
    some_allowed,
    unmasked,
    weighted_mean,
    without_gradient,
)
from rejeu.core.distributions import forbid
from rejeu.core.prng import nth
from rejeu.core.schedules import Exponential, Linear, Schedule, at
from rejeu.core.spaces import Leaf, check_discrete_action, nth_allowed
from rejeu.core.validation import LARGEST_VALUE, choice, coerce, flag, number, whole
from rejeu.exploration.noise import NoiseProcess
from rejeu.networks import MLP, Network, PolicyConfig, Torso, Widths, make_encoder, make_head, make_torso, with_memory
from rejeu.networks.noisy import drawn, noisy

MARGIN = 0.8
"""By how much a demonstrated action should be better than the others; that of arXiv 1704.03732."""
HIDDEN_LAYERS = (64, 64)
"""Default widths of the network but on images, those of Stable-Baselines3."""


@dataclass(frozen=True, kw_only=True)
class QLearningConfig(OffPolicyConfig):
    """The hyperparameters that DQN, QR-DQN and IQN share. Abstract."""

    batch_size: int = 32
    """Transitions per gradient step. Larger batches reduce the variance of the gradient at a higher cost."""
    tau: float = 1.0
    """Coefficient of the update of the target network every ``target_update_interval`` steps, in (0, 1]; 1 copies."""
    train_freq: int | tuple[int, Literal["step", "episode"]] = 4
    """Update every ``train_freq`` environment steps, or ``(n, "episode")``: every n finished episodes. Counted over all
    environments together."""
    target_update_interval: int = 10_000
    """Environment steps between two updates of the target network, over all environments, and at least one step of each. A
    larger interval is more stable and slower."""
    exploration_fraction: float = 0.1
    """Fraction of the run over which epsilon decreases, in (0, 1]."""
    exploration_initial_eps: float = 1.0
    """Initial probability of a random action, in [0, 1]."""
    exploration_final_eps: float = 0.05
    """Probability of a random action from ``exploration_fraction`` of the run on, in [0, 1]."""
    exploration_schedule: Literal["linear", "exponential"] = "linear"
    """How epsilon decreases: linearly, or by the same factor for equal parts of the run. The run is measured in what
    ``learn`` was given: steps, episodes or minutes."""
    double_q: bool = False
    """Choose the next action by the network and evaluate it by the target network, which reduces overestimation."""
    dueling: bool = False
    """Split the last hidden layer into a stream for the state's value and one for the actions' advantages."""
    noisy: bool = False
    """Explore by noise on the weights, whose scale is learned, in place of random actions; ``exploration_...`` then have no
    effect."""
    munchausen_alpha: float | None = None
    """Weight of the scaled log-probability of the action that is added to the reward, in [0, 1]; 0.9 in the paper. The target
    is then that of a softmax policy. None for the usual target."""
    munchausen_temperature: float = 0.03
    """Temperature of that policy, in the unit of the return. A larger value is closer to the uniform policy."""
    munchausen_clip: float = -1.0
    """Lower limit of the scaled log-probability, at most 0."""
    max_grad_norm: float | None = 10.0

    can_mask: ClassVar[bool] = True
    can_remember: ClassVar[bool] = True
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = Widths((), ())
    search_space: ClassVar[SearchSpace] = search.Q_LEARNING

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        if isinstance(self.action_noise, NoiseProcess | str):
            raise ValueError(
                f"action_noise={self.action_noise} does not apply to Discrete actions; explore by exploration_final_eps, "
                "or by action_noise=ParameterNoise()"
            )
        if self.noisy and self.action_noise is not None:
            raise ValueError("noisy=True and action_noise are both noise on the weights; give one of the two")
        coerce(self, "target_update_interval", whole, least=1)
        coerce(self, ("double_q", "dueling", "noisy"), flag)
        coerce(self, "munchausen_alpha", number, least=0, most=1, optional=True)
        coerce(self, "munchausen_temperature", number, above=0)
        coerce(self, "munchausen_clip", number, most=0)
        check_epsilon(self)

    @property
    def epsilon(self) -> Schedule:
        """The probability of a random action as a function of the progress."""
        return Linear(0.0, 0.0) if self.noisy else epsilon_schedule(self)

    @property
    def munchausen(self) -> Munchausen | None:
        """The settings of the target, None for the usual one."""
        alpha = self.munchausen_alpha
        return None if alpha is None else Munchausen(alpha, self.munchausen_temperature, self.munchausen_clip)


@dataclass(frozen=True, kw_only=True)
class Config(QLearningConfig):
    """Hyperparameters of DQN; the defaults are those of Stable-Baselines3."""

    learning_rate: float | Schedule = 1e-4
    clip_grad_value: float | None = None
    """Maximum absolute value of each component of the gradient, applied before ``max_grad_norm``. None: no limit."""
    loss: Literal["huber", "squared"] = "huber"
    """Loss of the TD error: ``huber`` grows linearly beyond 1, ``squared`` is the square."""
    distribution: Literal["expected", "categorical"] = "expected"
    """Prediction of the return: its mean, or the probabilities of ``n_atoms`` values (C51), whose loss is the
    cross-entropy. For quantiles there are QRDQN and IQN."""
    v_min: float = -10.0
    """Lowest return that ``categorical`` can represent, with the discount; lower ones count as this one."""
    v_max: float = 10.0
    """Highest return that ``categorical`` can represent."""
    n_atoms: int = 51
    """Values from ``v_min`` to ``v_max``, at equal distances. A larger number describes the distribution more finely."""

    name: ClassVar[str] = "DQN"

    def __post_init__(self) -> None:
        QLearningConfig.__post_init__(self)
        coerce(self, "loss", choice, among=tuple(LOSSES))
        coerce(self, "clip_grad_value", number, above=0, optional=True)
        coerce(self, "distribution", choice, among=("expected", "categorical"))
        coerce(self, ("v_min", "v_max"), number, least=-LARGEST_VALUE, most=LARGEST_VALUE)
        coerce(self, "n_atoms", whole, least=2)
        if self.v_min >= self.v_max:
            raise ValueError(f"v_min={self.v_min} must be below v_max={self.v_max}")

    @property
    def returns(self) -> Returns:
        """The prediction of the network, and its loss."""
        if self.distribution == "categorical":
            return categorical_returns(categorical.make_atoms(self.v_min, self.v_max, self.n_atoms))
        return LOSSES[self.loss]


class State(eqx.Module):
    """Everything that DQN, QR-DQN or IQN learns; every leaf is an array."""

    network: PyTree
    """Maps observations to the values of all actions, or to what describes the returns of all actions."""
    target_network: PyTree = eqx.field(metadata=AVERAGED)
    optimizer: PyTree
    step: Array
    """Environment steps at the newest gradient step, ``uint32[]``: determines the next update of the target."""
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""
    key: Array | None = None
    """Root of what is drawn at random in updates, ``uint32[2]``; never changes. None where nothing is."""


class Munchausen(NamedTuple):
    """Settings of :func:`munchausen_target`."""

    alpha: float
    temperature: float
    clip: float


class Returns(NamedTuple):
    """A prediction of the return of every action by a network, and its loss.

    Keys are for what is drawn at random: noise on the weights, or the fractions of quantiles. None stands for no noise.
    """

    build: Callable[[Array, tuple[Leaf, ...], PyTree, int, bool], PyTree]
    """``build(key, leaves, shape, n_actions, dueling)``: the network."""
    values: Callable[[PyTree, PyTree, Array | None], Array]
    """``values(network, obs, key)``: the mean of the return of every action, ``(batch, n_actions)``."""
    describe: Callable[[PyTree, PyTree, Any], Array]
    """``describe(network, obs, key)``: values, quantiles or probabilities, of which a mean over actions makes sense,
    ``(batch, n_actions, ...)``."""
    target: Callable[[Array, Array, Array], Array]
    """``target(reward, discount, following)``: what is learned from ``(batch,)`` twice and what describes the return that
    follows, ``(batch, ...)``."""
    loss: Callable[[PyTree, PyTree, Array, Array, Any], tuple[Array, Array, Array]]
    """``loss(network, obs, action, target, key)``: the loss, the error that priorities go by, and the mean of the
    prediction, ``(batch,)`` each."""
    is_random: bool = False
    """Whether updates draw something at random."""
    munchausen: Munchausen | None = None
    """Settings of the target, None for that of the best action."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DQN for these spaces.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm, config.clip_grad_value)
    return q_learning(config, observation_space, action_space, config.returns, optimizer)


def q_learning(
    config: Any, observation_space: spaces.Space, action_space: spaces.Space, returns: Returns, optimizer: Optimizer
) -> Algorithm:
    """Returns the algorithm of these spaces that learns this of the return."""
    n_actions = check_discrete_action(action_space, config.name)
    obs_leaves, shape = network_inputs(config, observation_space)
    returns = (with_noise(returns) if config.noisy else returns)._replace(munchausen=config.munchausen)
    epsilon = config.epsilon

    def init(key: Array) -> State:
        build = lambda leaves, shape: returns.build(key, leaves, shape, n_actions, config.dueling)  # noqa: E731
        network = with_memory(key, obs_leaves, shape, build)
        network = noisy(network) if config.noisy else network
        update_key = jax.random.fold_in(key, 5) if returns.is_random else None
        return State(network, copy(network), optimizer.init(network), jnp.uint32(0), jnp.int32(0), update_key)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        interval = jnp.maximum(jnp.asarray(clock.n_envs, jnp.uint32), config.target_update_interval)
        moves = moves_due(state.step, clock.step, interval)
        target_network = moved_target(state.target_network, state.network, moves, config.tau)
        key, *keys = (None, *NO_KEYS) if state.key is None else jax.random.split(nth(state.key, state.n_updates), 3)
        target = without_gradient(td_target)(state.network, target_network, batch, config.double_q, returns, keys)
        rate = at(config.learning_rate, clock.progress)
        network, optimizer_state, loss, (td_error, value) = minimize(
            td_loss, state.network, state.optimizer, optimizer, rate, batch, target, returns, key
        )
        metrics = metrics_of(loss, jnp.mean(value), epsilon, clock) | {TD_ERROR: jnp.abs(td_error)}
        step = jnp.asarray(clock.step, jnp.uint32)
        return State(network, target_network, optimizer_state, step, state.n_updates + 1, state.key), metrics

    algorithm = epsilon_greedy_algorithm(init, update, epsilon, values=returns.values)
    return acting_from_memory(algorithm, lambda state: (state.network,)) if config.has_memory else algorithm


def epsilon_greedy_algorithm(
    init: Callable[[Array], PyTree],
    update: Callable[..., PyTree],
    epsilon: Schedule,
    state_value: Callable[..., Array] | None = None,
    values: Callable[[PyTree, PyTree, Array | None], Array] = lambda network, obs, key: network(obs),
) -> Algorithm:
    """Returns the algorithm that explores by :func:`epsilon_greedy` actions, of a state with a field ``network``.

    ``values`` is as in :class:`Returns`, ``epsilon`` a function of the progress; the rest is of :class:`Algorithm`.
    """

    def explore(network: PyTree, obs: PyTree, key: Array, clock: Clock) -> Array:
        return epsilon_greedy(values(network, obs, key), at(epsilon, clock.progress), key, unmasked(obs)[1])

    return Algorithm(
        init,
        lambda state: state.network,
        explore,
        lambda network, obs: greedy(values(network, obs, None), unmasked(obs)[1]),
        update,
        action_values=lambda state, obs, action: values(state.network, obs, None)[None],
        state_value=state_value,
        imitation=lambda network, obs, action: margin_loss(
            forbid(values(network, obs, None), unmasked(obs)[1]), action
        ),
    )


def margin_loss(values: Array, action: Array) -> Array:
    """Returns ``max_a (Q(s, a) + m(a)) - Q(s, a*)`` with a margin ``m`` that is 0 at ``a*``, ``(batch,)``.

    So the demonstrated action ``a*`` becomes the best by at least the margin, and no value grows without limit (Hester et
    al. 2018, arXiv 1704.03732, equation 2).

    >>> margin_loss(jnp.array([[1.0, 3.0]]), jnp.array([1])).tolist(), margin_loss(jnp.zeros((1, 2)), jnp.array([0])).tolist()
    ([0.0], [0.800000011920929])
    """
    margin = MARGIN * (jnp.arange(values.shape[1])[None] != action[:, None])
    return jnp.max(values + margin, axis=-1) - taken(values, action)


def metrics_of(loss: Array, q_value: Array, epsilon: Schedule, clock: Clock) -> Metrics:
    """Returns the metrics of an update: loss, mean value of the actions taken, and probability of a random action."""
    exploration_rate = jnp.asarray(at(epsilon, clock.progress), jnp.float32)
    return {"loss": loss, "q_value": q_value, "exploration_rate": exploration_rate}


def value_network(
    key: Array, leaves: tuple[Leaf, ...], shape: PolicyConfig, n_actions: int, dueling: bool, n: int | None = None
) -> PyTree:
    """Returns a network from observations to values ``(batch, n_actions)``, or ``(batch, n_actions, n)`` for a number n."""
    network_class, widths = Dueling if dueling else Network, shape.critic_widths(HIDDEN_LAYERS)
    n_outputs = n_actions * (n or 1)
    outputs = network_class(key, leaves, n_outputs, widths, shape, **({"n_streams": n} if dueling and n else {}))
    return outputs if n is None else DistributionalNetwork(outputs, n)


class DistributionalNetwork(eqx.Module):
    """Observation to what describes the return of every action, such as quantiles."""

    outputs: PyTree
    n: int = eqx.field(static=True)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to ``(batch, n_actions, n)``."""
        outputs = self.outputs(obs)
        return outputs.reshape(outputs.shape[0], -1, self.n)


class Dueling(eqx.Module):
    """Observation to the values of all actions by two streams, which part before the last hidden layer.

    Hidden layers that are not a plain perceptron (branches, SimBa, a user's own) are shared as a whole; each stream is then
    one linear map.
    """

    encoder: PyTree
    torso: Torso
    value: MLP
    advantage: MLP
    value_head: PyTree
    advantage_head: PyTree

    def __init__(
        self,
        key: Array,
        leaves: tuple[Leaf, ...],
        n_outputs: int,
        widths: Sequence[int],
        shape: PolicyConfig,
        n_streams: int = 1,
    ) -> None:
        """Builds the streams of ``n_outputs``, those of the actions one after another, with ``n_streams`` for each."""
        keys = jax.random.split(key, 6)
        shared, stream_widths = parted(widths, shape)
        stream = lambda k, n_inputs: MLP(k, n_inputs, stream_widths, shape.activation_fn, shape.layer_norm)  # noqa: E731
        self.encoder = make_encoder(keys[0], leaves, shape)
        self.torso, n_shared = make_torso(keys[1], self.encoder.n_features, None, shared, shape)
        self.value = stream(keys[2], n_shared)
        self.advantage = stream(keys[3], n_shared)
        n_hidden = (n_shared, *stream_widths)[-1]
        self.value_head = make_head(keys[4], n_hidden, n_streams, shape)
        self.advantage_head = make_head(keys[5], n_hidden, n_outputs, shape)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to ``(batch, n_outputs)``."""
        shared = self.torso(self.encoder(obs))
        value = self.value_head(self.value(shared))[:, None]
        advantage = self.advantage_head(self.advantage(shared))
        return joined(value, advantage.reshape(value.shape[0], -1, value.shape[2])).reshape(advantage.shape)


def parted(widths: Sequence[int], shape: PolicyConfig) -> tuple[Sequence[int], Sequence[int]]:
    """Returns the widths of hidden layers before the last one, and of the last one where it is a layer of its own."""
    plain = shape.torso is None and shape.architecture == "mlp" and not shape.has_branches
    return (widths[:-1], widths[-1:]) if plain else (widths, ())


def joined(value: Array, advantage: Array) -> Array:
    """Returns ``V + A - mean A``, ``(batch, n_actions, ...)`` (arXiv 1511.06581, equation 9).

    Without the mean, a constant could move between ``value``, ``(batch, 1, ...)``, and ``advantage``,
    ``(batch, n_actions, ...)``, and neither would mean anything.

    >>> joined(jnp.array([[10.0]]), jnp.array([[1.0, 2.0, 6.0]]))
    Array([[ 8.,  9., 13.]], dtype=float32)
    """
    return value + advantage - jnp.mean(advantage, axis=1, keepdims=True)


def expected(penalty: Callable[[Array], Array]) -> Returns:
    """Returns the prediction of the mean of the return, with this function of the TD error as the loss."""

    def loss(
        network: PyTree, obs: PyTree, action: Array, target: Array, key: Array | None
    ) -> tuple[Array, Array, Array]:
        value = taken(network(obs), action)
        return penalty(value - target), value - target, value

    values = lambda network, obs, key: network(obs)  # noqa: E731
    return Returns(
        value_network, values, values, lambda reward, discount, following: reward + discount * following, loss
    )


LOSSES: dict[str, Returns] = {"huber": expected(optax.huber_loss), "squared": expected(jnp.square)}
"""Predictions of the mean of the return, by the name of the setting ``loss``."""
MEAN, NO_KEYS = LOSSES["huber"], (None, None)


def categorical_returns(atoms: Array) -> Returns:
    """Returns the prediction of the probabilities of these atoms (C51). Priorities go by the divergence, as in Rainbow."""
    probabilities = lambda network, obs, key: jax.nn.softmax(network(obs), axis=-1)  # noqa: E731

    def target(reward: Array, discount: Array, following: Array) -> Array:
        return categorical.project(reward[:, None] + discount[:, None] * atoms[None], following, atoms)

    def loss(
        network: PyTree, obs: PyTree, action: Array, target: Array, key: Array | None
    ) -> tuple[Array, Array, Array]:
        logits = taken(network(obs), action)
        entropy = -jnp.sum(jax.scipy.special.xlogy(target, target), axis=-1)
        loss = categorical.cross_entropy(logits, target)
        return loss, loss - entropy, categorical.mean_of(logits, atoms)

    values = lambda network, obs, key: categorical.mean_of(network(obs), atoms)  # noqa: E731
    return Returns(partial(value_network, n=atoms.shape[0]), values, probabilities, target, loss)


def with_noise(returns: Returns) -> Returns:
    """Returns a prediction by a network with noise on its weights, unless the key is None."""
    return returns._replace(
        values=lambda network, obs, key: returns.values(drawn(network, key), obs, key),
        describe=lambda network, obs, key: returns.describe(drawn(network, key), obs, key),
        loss=lambda network, obs, action, target, key: returns.loss(drawn(network, key), obs, action, target, key),
        is_random=True,
    )


def td_target(
    network: PyTree,
    target_network: PyTree,
    batch: Transition,
    double_q: bool,
    returns: Returns = MEAN,
    keys: Array | tuple[None, None] = NO_KEYS,
) -> Array:
    """Returns the TD targets, ``(batch,)`` or ``(batch, ...)``; ``keys`` are for the network and the target network."""
    chooser, key = (network, keys[0]) if double_q else (target_network, keys[1])
    values, mask = returns.values(chooser, batch.next_obs, key), unmasked(some_allowed(batch.next_obs))[1]
    following = returns.describe(target_network, batch.next_obs, keys[1])
    if returns.munchausen is not None:
        current_values = returns.values(chooser, batch.obs, key)
        next_values = forbid(values, mask), following
        return returns.target(*munchausen_target(returns.munchausen, batch, current_values, *next_values))
    return returns.target(batch.reward, batch.discount, taken(following, greedy(values, mask)))


def munchausen_target(
    settings: Munchausen, batch: Transition, current_values: Array, values: Array, following: Array
) -> tuple[Array, Array, Array]:
    """Returns the reward, the discount and what follows, of Munchausen Q-learning (arXiv 2007.14430, equation 3 and M-IQN).

    With the policy ``pi = softmax(Q' / tau)`` and a description ``Z'`` of the return that follows::

        r + alpha [tau log pi(a|s)]_clip^0 + d sum_a' pi(a'|s') (Z'(s', a') - tau log pi(a'|s'))

    The entropy does not depend on the description, so that it is a part of the reward here. For n-step returns it is
    discounted with the value that follows, and only the first action has its log-probability added. With double Q-learning,
    which the paper does not have, the policy is that of ``Q`` in both places, and ``Z'`` stays the target's.

    Args:
        settings: ``alpha``, the temperature ``tau`` and ``clip``.
        batch: of transitions.
        current_values: values of all actions in ``obs`` by which the policy chooses, ``(batch, n_actions)``.
        values: those in ``next_obs``, likewise.
        following: ``(batch, n_actions, ...)``.
    """
    tau = settings.temperature
    log_policy = jax.nn.log_softmax(values / tau, axis=-1)
    policy = jnp.exp(log_policy)
    entropy = -tau * jnp.sum(policy * log_policy, axis=-1)
    log_current_policy = jax.nn.log_softmax(forbid(current_values, unmasked(batch.obs)[1]) / tau, axis=-1)
    bonus = settings.alpha * jnp.clip(tau * taken(log_current_policy, batch.action), settings.clip, 0.0)
    mean = jnp.einsum("ba,ba...->b...", policy, following)
    return batch.reward + bonus + batch.discount * entropy, batch.discount, mean


def td_loss(
    network: PyTree,
    batch: Transition,
    target: Array,
    returns: Returns | Callable[[Array], Array],
    key: Array | None = None,
) -> tuple[Array, tuple[Array, Array]]:
    """Returns the mean loss, and of each transition the error and the mean of the prediction, ``(batch,)``.

    For ``returns`` a function of the TD error, such as ``jnp.square``, stands for :func:`expected` of it.
    """
    description = returns if isinstance(returns, Returns) else expected(returns)
    loss, td_error, value = description.loss(network, batch.obs, batch.action, target, key)
    return weighted_mean(loss, batch.weight), (td_error, value)


def taken(values: Array, action: Array) -> Array:
    """Returns ``values[i, action[i]]`` of values ``(batch, n_actions, ...)``, ``(batch, ...)``."""
    index = action.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.take_along_axis(values, index, axis=1)[:, 0]


def greedy(values: Array, mask: Array | None = None) -> Array:
    """Returns the index of the highest of values ``(batch, n_actions)``, ``int32 (batch,)``; the first of equals.

    With ``mask``, ``bool (batch, n_actions)``, among the allowed ones.
    """
    return jnp.argmax(forbid(values, mask), axis=-1).astype(jnp.int32)


def epsilon_greedy(values: Array, epsilon: Scalar, key: Array, mask: Array | None = None) -> Array:
    """Returns the best action by values ``(batch, n_actions)``, or any with probability ``epsilon``; ``(batch,)``.

    With ``mask``, ``bool (batch, n_actions)``, both are among the allowed ones.
    """
    whether_key, which_key = jax.random.split(key)
    batch, n_actions = values.shape
    n_allowed = n_actions if mask is None else jnp.sum(mask, axis=-1, dtype=jnp.int32)
    random = jax.random.randint(which_key, (batch,), 0, n_allowed, jnp.int32)
    random = random if mask is None else nth_allowed(mask, random)
    return jnp.where(jax.random.uniform(whether_key, (batch,)) < epsilon, random, greedy(values, mask))


def check_epsilon(config: Any) -> None:
    """Checks and converts the four settings of a configuration that begin with ``exploration_``.

    Raises:
        ValueError: for one that is not possible.
    """
    coerce(config, "exploration_fraction", number, above=0, most=1)
    coerce(config, "exploration_schedule", choice, among=("linear", "exponential"))
    for key in ("exploration_initial_eps", "exploration_final_eps"):
        coerce(config, key, number, least=0, most=1)
        if getattr(config, key) == 0 and config.exploration_schedule == "exponential":
            raise ValueError(f"{key}=0 is not possible with an exponential schedule; try 0.01, or the linear schedule")


def epsilon_schedule(config: Any) -> Schedule:
    """Returns the probability of a random action that these settings describe, as a function of the progress."""
    schedule_class = {"linear": Linear, "exponential": Exponential}[config.exploration_schedule]
    return schedule_class(config.exploration_initial_eps, config.exploration_final_eps, config.exploration_fraction)


def moves_due(last_step: Array, step: Scalar, interval: Scalar) -> Array:
    """Returns how many multiples of ``interval`` lie above ``last_step`` and not above ``step``, ``int32[]``.

    >>> int(moves_due(jnp.uint32(599), jnp.uint32(608), 600))
    1
    """
    count = lambda steps: (steps // interval).astype(jnp.int32)  # noqa: E731
    return jnp.maximum(count(jnp.asarray(step, jnp.uint32)) - count(last_step), 0)


def moved_target(target: PyTree, online: PyTree, moves: Array, tau: float) -> PyTree:
    """Returns ``target`` after so many soft updates of ``tau`` toward ``online``; exactly ``online`` for ``tau`` 1."""
    if tau == 1.0:
        return jax.tree.map(lambda t, o: jnp.where(moves > 0, o, t), target, online)
    return polyak(target, online, 1.0 - (1.0 - tau) ** moves.astype(jnp.float32))
