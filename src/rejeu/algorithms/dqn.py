"""Deep Q-learning: one network learns the values of all actions, and the action of highest value is taken.

Sources: Mnih et al. 2015, "Human-level control through deep reinforcement learning" (doi 10.1038/nature14236); van
Hasselt et al. 2016, "Deep Reinforcement Learning with Double Q-learning" (arXiv 1509.06461); Wang et al. 2016, "Dueling
Network Architectures for Deep Reinforcement Learning" (arXiv 1511.06581). With network ``Q``, target network ``Q'`` and
discount ``d`` (0 where the MDP terminated, gamma to the power n for n-step returns)::

    y      = r + d max_a' Q'(s', a')                        double_q: r + d Q'(s', argmax_a' Q(s', a'))
    J      = mean h(Q(s, a) - y),                           h(e) = e^2 / 2 where |e| < 1, |e| - 1/2 elsewhere
    Q(s,a) = V(s) + A(s, a) - mean_a' A(s, a')              where dueling
    Q'    <- Q' + tau (Q - Q')                              once every target_update_interval environment steps
    a      = argmax_a Q(s, a), or any with probability epsilon

With masks, every maximum is over the allowed actions, and so are the random ones.

The target moves just before the first gradient step at or after every multiple of ``target_update_interval``: to the
same numbers as in Stable-Baselines3, where it moves between two gradient steps. If several multiples have passed since
the last gradient step, so many soft updates are made at once, of ``1 - (1 - tau)^n`` together. Unlike there, the
interval is counted in environment steps exactly, also where the number of environments does not divide it.

Unlike in the paper on dueling networks, the gradients of both streams enter the shared layers unscaled, without the factor
``1 / sqrt(2)``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.config import OffPolicyConfig, network_inputs
from rejeu.algorithms.memory import remembering
from rejeu.algorithms.search import SearchSpace
from rejeu.core import (
    AVERAGED,
    TD_ERROR,
    Algorithm,
    Clock,
    Metrics,
    Optimizer,
    PyTree,
    Transition,
    copy,
    minimize,
    polyak,
    some_allowed,
    unmasked,
    weighted_mean,
    without_gradient,
)
from rejeu.distributions import forbid
from rejeu.exploration.noise import NoiseProcess
from rejeu.networks import MLP, Network, PolicyConfig, Torso, Widths, make_encoder, make_head, make_torso, with_memory
from rejeu.schedules import Exponential, Linear, Schedule, at
from rejeu.spaces import Leaf, check_discrete_action, nth_allowed
from rejeu.validation import choice, coerce, flag, number, whole

MARGIN = 0.8
"""By how much a demonstrated action should be better than the others; that of arXiv 1704.03732."""
HIDDEN_LAYERS = (64, 64)
"""Default widths of the network but on images, those of Stable-Baselines3."""


@dataclass(frozen=True, kw_only=True)
class QLearningConfig(OffPolicyConfig):
    """The hyperparameters that DQN and QR-DQN share. Abstract."""

    batch_size: int = 32
    """Transitions per gradient step. Larger batches reduce the variance of the gradient at a higher cost."""
    tau: float = 1.0
    """Coefficient of the update of the target network every ``target_update_interval`` steps, in (0, 1]; 1 copies."""
    train_freq: int | tuple[int, Literal["step", "episode"]] = 4
    """Update every ``train_freq`` environment steps, or ``(n, "episode")``: every n finished episodes. Counted over all
    environments together."""
    target_update_interval: int = 10_000
    """Environment steps between two updates of the target network, over all environments. A larger interval is more
    stable and slower."""
    exploration_fraction: float = 0.1
    """Fraction of the run over which epsilon decreases, in (0, 1]."""
    exploration_initial_eps: float = 1.0
    """Initial probability of a random action, in [0, 1]."""
    exploration_final_eps: float = 0.05
    """Probability of a random action from ``exploration_fraction`` of the run on, in [0, 1]."""
    exploration_schedule: Literal["linear", "exponential"] = "linear"
    """How epsilon decreases: linearly, or by the same factor for equal parts of the run. The run is measured in what
    ``learn`` was given: steps, episodes or minutes."""
    max_grad_norm: float | None = 10.0

    can_mask: ClassVar[bool] = True
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
        coerce(self, "target_update_interval", whole, least=1)
        check_epsilon(self)

    @property
    def epsilon(self) -> Schedule:
        """The probability of a random action as a function of the progress."""
        return epsilon_schedule(self)


@dataclass(frozen=True, kw_only=True)
class Config(QLearningConfig):
    """Hyperparameters of DQN; the defaults are those of Stable-Baselines3."""

    learning_rate: float | Schedule = 1e-4
    clip_grad_value: float | None = None
    """Maximum absolute value of each component of the gradient, applied before ``max_grad_norm``. None: no limit."""
    loss: Literal["huber", "squared"] = "huber"
    """Loss of the TD error: ``huber`` grows linearly beyond 1, ``squared`` is the square."""
    double_q: bool = False
    """Choose the next action by the network and evaluate it by the target network, which reduces overestimation."""
    dueling: bool = False
    """Split the last hidden layer into a stream for the state's value and one for the actions' advantages."""

    can_remember: ClassVar[bool] = True
    name: ClassVar[str] = "DQN"

    def __post_init__(self) -> None:
        QLearningConfig.__post_init__(self)
        coerce(self, "loss", choice, among=tuple(LOSSES))
        coerce(self, "clip_grad_value", number, above=0, optional=True)
        coerce(self, ("double_q", "dueling"), flag)


class State(eqx.Module):
    """Everything that DQN or QR-DQN learns; every leaf is an array."""

    network: Any
    """Maps observations to the values of all actions: a :class:`Network`, :class:`Dueling` or ``QuantileNetwork``."""
    target_network: Any = eqx.field(metadata=AVERAGED)
    optimizer: PyTree
    step: Array
    """Environment steps at the newest gradient step, ``uint32[]``: determines the next update of the target."""
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DQN for these spaces.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    n_actions = check_discrete_action(action_space, config.name)
    obs_leaves, shape = network_inputs(config, observation_space)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm, config.clip_grad_value)
    epsilon = config.epsilon

    def init(key: Array) -> State:
        kind = Dueling if config.dueling else Network
        network = with_memory(
            key,
            obs_leaves,
            shape,
            lambda leaves, shape: kind(key, leaves, n_actions, shape.critic_widths(HIDDEN_LAYERS), shape),
        )
        return initial_state(network, optimizer)

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        moves = moves_due(state.step, clock.step, config.target_update_interval)
        target_network = moved_target(state.target_network, state.network, moves, config.tau)
        target = without_gradient(td_target)(state.network, target_network, batch, config.double_q)
        rate = at(config.learning_rate, clock.progress)
        network, optimizer_state, loss, td_error = minimize(
            td_loss, state.network, state.optimizer, optimizer, rate, batch, target, LOSSES[config.loss]
        )
        step = jnp.asarray(clock.step, jnp.uint32)
        metrics = metrics_of(loss, jnp.mean(td_error + target), epsilon, clock) | {TD_ERROR: jnp.abs(td_error)}
        return State(network, target_network, optimizer_state, step, state.n_updates + 1), metrics

    return remembering(epsilon_greedy_algorithm(init, update, epsilon), shape, lambda state: (state.network,))


def initial_state(network: Any, optimizer: Optimizer) -> State:
    """Returns the state before the first update."""
    return State(network, copy(network), optimizer.init(network), jnp.uint32(0), jnp.int32(0))


def epsilon_greedy_algorithm(
    init: Callable[[Array], Any],
    update: Callable[..., Any],
    epsilon: Schedule,
    state_value: Callable[..., Array] | None = None,
) -> Algorithm:
    """Returns the algorithm that explores by :func:`epsilon_greedy` and exploits by :func:`greedy` actions.

    Args:
        init: of :class:`Algorithm`, as are the other functions. The state has a field ``network``, which maps observations
            to the values of all actions.
        update: learns from a batch or a rollout.
        epsilon: the probability of a random action as a function of the progress.
        state_value: the values of observations, or None.
    """

    def explore(network: Any, obs: PyTree, key: Array, clock: Clock) -> Array:
        return epsilon_greedy(network(obs), at(epsilon, clock.progress), key, unmasked(obs)[1])

    def exploit(network: Any, obs: PyTree) -> Array:
        return greedy(network(obs), unmasked(obs)[1])

    def values(state: Any, obs: PyTree, action: None) -> Array:
        return state.network(obs)[None]

    return Algorithm(
        init,
        lambda state: state.network,
        explore,
        exploit,
        update,
        action_values=values,
        state_value=state_value,
        imitation=lambda network, obs, action: margin_loss(forbid(network(obs), unmasked(obs)[1]), action),
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


class Dueling(eqx.Module):
    """Observation to the values of all actions by two streams, which part before the last hidden layer.

    Hidden layers that are not a plain perceptron (branches, SimBa, a user's own) are shared as a whole; each stream is then
    one linear map.
    """

    encoder: Any
    torso: Torso
    value: MLP
    advantage: MLP
    value_head: Any
    advantage_head: Any

    def __init__(
        self, key: Array, leaves: tuple[Leaf, ...], n_actions: int, widths: Sequence[int], shape: PolicyConfig
    ) -> None:
        keys = jax.random.split(key, 6)
        plain = shape.torso is None and shape.architecture == "mlp" and not shape.has_branches
        shared, own = (widths[:-1], widths[-1:]) if plain else (widths, ())
        stream = lambda k, n_inputs: MLP(k, n_inputs, own, shape.activation_fn, shape.layer_norm)  # noqa: E731
        self.encoder = make_encoder(keys[0], leaves, shape)
        self.torso, n_shared = make_torso(keys[1], self.encoder.n_features, None, shared, shape)
        self.value = stream(keys[2], n_shared)
        self.advantage = stream(keys[3], n_shared)
        n_hidden = (n_shared, *own)[-1]
        self.value_head = make_head(keys[4], n_hidden, 1, shape)
        self.advantage_head = make_head(keys[5], n_hidden, n_actions, shape)

    def __call__(self, obs: PyTree) -> Array:
        """Maps observations ``(batch, ...)`` to values ``(batch, n_actions)``."""
        shared = self.torso(self.encoder(obs))
        return joined(self.value_head(self.value(shared)), self.advantage_head(self.advantage(shared)))


def joined(value: Array, advantage: Array) -> Array:
    """Returns ``V + A - mean A``, ``(batch, n_actions)`` (arXiv 1511.06581, equation 9).

    Without the mean, a constant could move between ``value``, ``(batch, 1)``, and ``advantage``,
    ``(batch, n_actions)``, and neither would mean anything.

    >>> joined(jnp.array([[10.0]]), jnp.array([[1.0, 2.0, 6.0]]))
    Array([[ 8.,  9., 13.]], dtype=float32)
    """
    return value + advantage - jnp.mean(advantage, axis=-1, keepdims=True)


def td_target(
    network: Network | Dueling, target_network: Network | Dueling, batch: Transition, double_q: bool
) -> Array:
    """Returns the TD targets, ``(batch,)``."""
    next_values = target_network(batch.next_obs)
    chooser = network(batch.next_obs) if double_q else next_values
    mask = unmasked(some_allowed(batch.next_obs))[1]
    return batch.reward + batch.discount * taken(next_values, greedy(chooser, mask))


def td_loss(
    network: Network | Dueling, batch: Transition, target: Array, penalty: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Returns the mean penalty of the TD errors, and the errors ``Q(s, a) - y``, ``(batch,)``."""
    td_error = taken(network(batch.obs), batch.action) - target
    return weighted_mean(penalty(td_error), batch.weight), td_error


LOSSES: dict[str, Callable[[Array], Array]] = {"huber": optax.huber_loss, "squared": jnp.square}
"""The losses of a TD error by the name of the setting ``loss``."""


def taken(values: Array, action: Array) -> Array:
    """Returns ``values[i, action[i]]`` of values ``(batch, n_actions, ...)``, ``(batch, ...)``."""
    index = action.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.take_along_axis(values, index, axis=1)[:, 0]


def greedy(values: Array, mask: Array | None = None) -> Array:
    """Returns the index of the highest of values ``(batch, n_actions)``, ``int32 (batch,)``; the first of equals.

    With ``mask``, ``bool (batch, n_actions)``, among the allowed ones.
    """
    return jnp.argmax(forbid(values, mask), axis=-1).astype(jnp.int32)


def epsilon_greedy(values: Array, epsilon: Any, key: Array, mask: Array | None = None) -> Array:
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
    kind = {"linear": Linear, "exponential": Exponential}[config.exploration_schedule]
    return kind(config.exploration_initial_eps, config.exploration_final_eps, config.exploration_fraction)


def moves_due(last_step: Array, step: Any, interval: int) -> Array:
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
