"""Deep Q-learning: the values of all actions are learnt by one network, and the best one is taken.

Sources: Mnih et al. 2015, "Human-level control through deep reinforcement learning" (doi 10.1038/nature14236); van
Hasselt et al. 2016, "Deep Reinforcement Learning with Double Q-learning" (arXiv 1509.06461); Wang et al. 2016, "Dueling
Network Architectures for Deep Reinforcement Learning" (arXiv 1511.06581). With network ``Q``, its old copy ``Q'`` and
discount ``d`` (0 where the MDP terminated, gamma to the power n for n-step returns)::

    y      = r + d max_a' Q'(s', a')                        double_q: r + d Q'(s', argmax_a' Q(s', a'))
    J      = mean h(Q(s, a) - y),                           h(e) = e^2 / 2 where |e| < 1, |e| - 1/2 elsewhere
    Q(s,a) = V(s) + A(s, a) - mean_a' A(s, a')              where dueling
    Q'    <- Q' + tau (Q - Q')                              once every target_update_interval environment steps
    a      = argmax_a Q(s, a), or any with probability epsilon

The target moves just before the first gradient step at or after every multiple of ``target_update_interval``: to the
same numbers as in Stable-Baselines3, where it moves between two gradient steps. If several multiples have passed since
the last gradient step, so many soft updates are made at once, of ``1 - (1 - tau)^n`` together. Unlike there, the
interval is counted in environment steps exactly, also where the number of environments does not divide it.
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

from rejeu.algorithms.config import OffPolicyConfig, with_widths
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
    polyak,
    value_and_grad,
    weighted_mean,
)
from rejeu.exploration.noise import ActionNoise
from rejeu.networks import MLP, Actor, Encoder, Linear, PolicyConfig, Torso, Widths, make_torso
from rejeu.schedules import Exponential, Linear as LinearSchedule, Schedule, at
from rejeu.spaces import Leaf, leaves
from rejeu.validation import number, whole
from rejeu.xla import outlined

HIDDEN_LAYERS = (64, 64)
"""Default widths of the network but on images, those of Stable-Baselines3."""


@dataclass(frozen=True, kw_only=True)
class Config(OffPolicyConfig):
    """Hyper-parameters of DQN; the defaults are those of Stable-Baselines3."""

    learning_rate: float | Schedule = 1e-4
    """Step size of Adam; a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)`` or ``"lin_1e-4"``.
    Raising it learns faster until it diverges."""
    batch_size: int = 32
    """Transitions per gradient step. Raising it gives a steadier, dearer step."""
    tau: float = 1.0
    """Share of the network that flows into its target every ``target_update_interval`` steps, in (0, 1]; 1 copies."""
    train_freq: int | tuple[int, Literal["step", "episode"]] = 4
    """Learn every so many environment steps, or ``(n, "episode")``: every n finished episodes. Counted over all
    environments together, whatever their number."""
    target_update_interval: int = 10_000
    """Environment steps between two moves of the target network, over all environments. Raising it is steadier and
    slower."""
    exploration_fraction: float = 0.1
    """Share of the run over which epsilon falls, in (0, 1]."""
    exploration_initial_eps: float = 1.0
    """Probability of a random action at the beginning, in [0, 1]."""
    exploration_final_eps: float = 0.05
    """Probability of a random action from ``exploration_fraction`` of the run on, in [0, 1]."""
    exploration_schedule: Literal["linear", "exponential"] = "linear"
    """How epsilon falls: on a straight line, or by the same factor for every equal stretch of the run. The run is
    measured in what ``learn`` was given: steps, episodes or minutes."""
    max_grad_norm: float | None = 10.0
    """Longest gradient, as a Euclidean norm over all parameters; longer ones are scaled down. None: no limit."""
    clip_grad_value: float | None = None
    """Largest size of each component of the gradient, applied before ``max_grad_norm``. None: no limit."""
    loss: Literal["huber", "squared"] = "huber"
    """What is minimised of the TD error: ``huber`` grows linearly beyond 1, ``squared`` is its plain square."""
    double_q: bool = False
    """Choose the next action by the network and rate it by the target: values are overestimated less."""
    dueling: bool = False
    """Split the last hidden layer into a stream for the state's value and one for the actions' advantages."""

    name: ClassVar[str] = "DQN"
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = Widths((), ())

    def __post_init__(self) -> None:
        OffPolicyConfig.__post_init__(self)
        check_exploration(self)
        check_steps(self)
        if self.loss not in LOSSES:
            raise ValueError(f"loss={self.loss!r} must be one of {', '.join(LOSSES)}")
        if self.clip_grad_value is not None:
            object.__setattr__(self, "clip_grad_value", number("clip_grad_value", self.clip_grad_value, above=0))
        for key in ("double_q", "dueling"):
            if not isinstance(getattr(self, key), bool):
                raise TypeError(f"{key}={getattr(self, key)!r} must be True or False")


class State(eqx.Module):
    """Everything that DQN learns, every leaf an array."""

    network: Actor | Dueling
    target_network: Actor | Dueling = eqx.field(metadata=AVERAGED)
    optimizer: PyTree
    step: Array
    """Environment steps at the newest gradient step, ``uint32[]``: tells when the target is to move next."""
    n_updates: Array
    """Gradient steps taken, ``int32[]``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns DQN for these spaces.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is no array.
    """
    n_actions = check_discrete_action(action_space, "DQN")
    obs_leaves = leaves(observation_space)
    shape = with_widths(config, obs_leaves).policy_kwargs
    widths = shape.critic_widths(HIDDEN_LAYERS)
    optimizer = optax.scale_by_adam()
    epsilon = epsilon_schedule(config)

    def init(key: Array) -> State:
        network = (Dueling if config.dueling else Actor)(key, obs_leaves, n_actions, widths, shape)
        return State(
            network=network,
            target_network=copy(network),
            optimizer=optimizer.init(network),
            step=jnp.uint32(0),
            n_updates=jnp.int32(0),
        )

    def explore(network: Actor | Dueling, obs: PyTree, key: Array, clock: Clock) -> Array:
        return epsilon_greedy(network(obs), at(epsilon, clock.progress), key)

    def exploit(network: Actor | Dueling, obs: PyTree) -> Array:
        return greedy(network(obs))

    def update(state: State, batch: Transition, clock: Clock) -> tuple[State, Metrics]:
        moves = moves_due(state.step, clock.step, config.target_update_interval)
        target_network = moved_target(state.target_network, state.network, moves, config.tau)
        target = td_target(state.network, target_network, batch, config.double_q)
        (loss, td_error), gradients = value_and_grad(td_loss, has_aux=True)(
            state.network, batch, target, LOSSES[config.loss]
        )
        gradients = clipped(gradients, config.clip_grad_value, config.max_grad_norm)
        rate = at(config.learning_rate, clock.progress)
        network, optimizer_state = descend(state.network, gradients, state.optimizer, optimizer, rate)
        state = State(
            network=network,
            target_network=target_network,
            optimizer=optimizer_state,
            step=jnp.asarray(clock.step, jnp.uint32),
            n_updates=state.n_updates + 1,
        )
        metrics = {
            "loss": loss,
            "q_value": jnp.mean(td_error + target),
            "exploration_rate": jnp.asarray(at(epsilon, clock.progress), jnp.float32),
            TD_ERROR: jnp.abs(td_error),
        }
        return state, metrics

    def values(state: State, obs: PyTree, action: Array | None) -> Array:
        return state.network(obs)[None]

    return Algorithm(init, lambda state: state.network, explore, exploit, update, action_values=values)


class Dueling(eqx.Module):
    """Observation to the values of all actions by two streams, which part before the last hidden layer.

    Hidden layers that are no plain perceptron (branches, SimBa, a user's own) are shared as a whole; each stream is then
    one linear map.
    """

    encoder: Encoder
    torso: Torso
    value: MLP
    advantage: MLP
    value_head: Linear
    advantage_head: Linear

    def __init__(
        self, key: Array, leaves: tuple[Leaf, ...], n_actions: int, widths: Sequence[int], shape: PolicyConfig
    ) -> None:
        keys = jax.random.split(key, 6)
        plain = shape.torso is None and shape.architecture == "mlp" and not shape.has_branches
        shared, own = (widths[:-1], widths[-1:]) if plain else (widths, ())
        stream = lambda k, n_inputs: MLP(k, n_inputs, own, shape.activation_fn, shape.layer_norm)  # noqa: E731
        self.encoder = Encoder(leaves, keys[0])
        self.torso, n_shared = make_torso(keys[1], self.encoder.n_features, None, shared, shape)
        self.value = stream(keys[2], n_shared)
        self.advantage = stream(keys[3], n_shared)
        n_hidden = (n_shared, *own)[-1]
        self.value_head = Linear(keys[4], n_hidden, 1)
        self.advantage_head = Linear(keys[5], n_hidden, n_actions)

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


@outlined
def td_target(network: Actor | Dueling, target_network: Actor | Dueling, batch: Transition, double_q: bool) -> Array:
    """Returns what the network should say of the batch, ``(batch,)``."""
    next_values = target_network(batch.next_obs)
    chooser = network(batch.next_obs) if double_q else next_values
    return batch.reward + batch.discount * taken(next_values, greedy(chooser))


def td_loss(
    network: Actor | Dueling, batch: Transition, target: Array, penalty: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """Returns the mean penalty of the TD errors, and the errors ``Q(s, a) - y``, ``(batch,)``."""
    td_error = taken(network(batch.obs), batch.action) - target
    return weighted_mean(penalty(td_error), batch.weight), td_error


def huber(error: Array) -> Array:
    """Returns half the square where an error is below 1, and a line of slope 1 beyond (Huber 1964).

    >>> huber(jnp.array([0.5, -1.0, -3.0]))
    Array([0.125, 0.5  , 2.5  ], dtype=float32)
    """
    size = jnp.abs(error)
    return jnp.where(size < 1.0, 0.5 * jnp.square(error), size - 0.5)


LOSSES: dict[str, Callable[[Array], Array]] = {"huber": huber, "squared": jnp.square}
"""What is minimised of a TD error, by the name of the setting ``loss``."""


def taken(values: Array, action: Array) -> Array:
    """Returns ``values[i, action[i]]`` of values ``(batch, n_actions, ...)``, ``(batch, ...)``."""
    index = action.reshape(-1, *[1] * (values.ndim - 1))
    return jnp.take_along_axis(values, index, axis=1)[:, 0]


def greedy(values: Array) -> Array:
    """Returns the index of the highest of values ``(batch, n_actions)``, ``int32 (batch,)``; the first of equals."""
    return jnp.argmax(values, axis=-1).astype(jnp.int32)


def epsilon_greedy(values: Array, epsilon: Any, key: Array) -> Array:
    """Returns the best action by values ``(batch, n_actions)``, or any with probability ``epsilon``; ``(batch,)``."""
    whether_key, which_key = jax.random.split(key)
    batch, n_actions = values.shape
    random = jax.random.randint(which_key, (batch,), 0, n_actions, jnp.int32)
    return jnp.where(jax.random.uniform(whether_key, (batch,)) < epsilon, random, greedy(values))


def epsilon_schedule(config: Any) -> Schedule:
    """Returns the probability of a random action, a function of progress, from a configuration's ``exploration_*``."""
    kind = {"linear": LinearSchedule, "exponential": Exponential}[config.exploration_schedule]
    return kind(config.exploration_initial_eps, config.exploration_final_eps, config.exploration_fraction)


def moves_due(last_step: Array, step: Any, interval: int) -> Array:
    """Returns how many multiples of ``interval`` lie above ``last_step`` and not above ``step``, ``int32[]``.

    >>> int(moves_due(jnp.uint32(599), jnp.uint32(608), 600))
    1
    """
    count = lambda steps: (steps // interval).astype(jnp.int32)  # noqa: E731
    return jnp.maximum(count(jnp.asarray(step, jnp.uint32)) - count(last_step), 0)


def moved_target(target: PyTree, online: PyTree, moves: Array, tau: float) -> PyTree:
    """Returns ``target`` after so many soft updates of ``tau`` towards ``online``; exactly ``online`` for ``tau`` 1."""
    if tau == 1.0:
        return jax.tree.map(lambda t, o: jnp.where(moves > 0, o, t), target, online)
    return polyak(target, online, 1.0 - (1.0 - tau) ** moves.astype(jnp.float32))


def clipped(gradients: PyTree, max_value: float | None, max_norm: float | None) -> PyTree:
    """Returns gradients with every component within ``max_value`` of 0, then their norm at most ``max_norm``."""
    if max_value is not None:
        gradients = jax.tree.map(lambda g: jnp.clip(g, -max_value, max_value), gradients)
    if max_norm is not None:
        # The small constant is PyTorch's: a gradient of zero must not become NaN.
        norm = jnp.sqrt(sum(jnp.sum(jnp.square(g)) for g in jax.tree.leaves(gradients)))
        scale = jnp.minimum(1.0, max_norm / (norm + 1e-6))
        gradients = jax.tree.map(lambda g: g * scale, gradients)
    return gradients


def check_discrete_action(space: spaces.Space, algorithm: str) -> int:
    """Returns the number of actions of a Discrete space, whatever its ``start``.

    Raises:
        ValueError: for another space, naming what to use instead.
    """
    if not isinstance(space, spaces.Discrete):
        instead = (
            "for this environment use SAC or TD3"
            if isinstance(space, spaces.Box)
            else "wrap the environment in a gymnasium.ActionWrapper with a Discrete action space"
        )
        raise ValueError(f"{algorithm} needs a Discrete action space, got {space}; {instead}")
    return int(space.n)


def check_exploration(config: Any) -> None:
    """Brings a configuration's ``exploration_*`` into their types.

    Raises:
        ValueError: if one is out of its range, or the exponential schedule was given a zero.
    """
    put = lambda key, value: object.__setattr__(config, key, value)  # noqa: E731
    put("exploration_fraction", number("exploration_fraction", config.exploration_fraction, above=0, most=1))
    if config.exploration_schedule not in ("linear", "exponential"):
        raise ValueError(f"exploration_schedule={config.exploration_schedule!r} must be 'linear' or 'exponential'")
    for key in ("exploration_initial_eps", "exploration_final_eps"):
        value = number(key, getattr(config, key), least=0, most=1)
        if value == 0 and config.exploration_schedule == "exponential":
            raise ValueError(f"{key}=0 is out of an exponential schedule's reach; try 0.01, or the linear schedule")
        put(key, value)


def check_steps(config: Any) -> None:
    """Brings ``target_update_interval`` and ``max_grad_norm`` of a configuration into their types.

    Raises:
        ValueError: if one is out of its range, or there is noise to be added to actions, which are indices here.
    """
    if isinstance(config.action_noise, ActionNoise | str):
        raise ValueError(
            f"action_noise={config.action_noise} has no meaning for Discrete actions; explore by exploration_final_eps, "
            "or by action_noise=ParameterNoise()"
        )
    put = lambda key, value: object.__setattr__(config, key, value)  # noqa: E731
    put("target_update_interval", whole("target_update_interval", config.target_update_interval, least=1))
    if config.max_grad_norm is not None:
        put("max_grad_norm", number("max_grad_norm", config.max_grad_norm, above=0))
