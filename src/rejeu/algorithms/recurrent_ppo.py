"""PPO with memory: a recurrent cell between the encoder and the hidden layers.

For partially observable environments. The policy's memory is reset at the start of every episode. Learning
unrolls the cell over the whole rollout of each environment, from its memory at the start, and differentiates
through all of it; a minibatch is a share of the environments with all their steps, so ``n_steps`` is also the length over
which the gradient remembers. Losses and advantages are PPO's (see :mod:`rejeu.algorithms.ppo`); the value of a successor
is read with the memory that the step left.

The cells are those of :mod:`rejeu.networks.memory`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, ppo, search
from rejeu.algorithms.actor_critic.config import ActorCriticConfig
from rejeu.algorithms.actor_critic.network import (
    HIDDEN_GAIN,
    ActionKind,
    ActorCritic,
    Distribution,
    checked,
    orthogonal,
)
from rejeu.algorithms.actor_critic.steps import (
    RolloutState as State,
    Samples,
    flat,
    initial_state,
    shuffled,
    with_advantages,
)
from rejeu.algorithms.ppo import ADAM_EPSILON, Losses, epochs, loss_of, scaled
from rejeu.algorithms.search import Choice, SearchSpace
from rejeu.core.algorithm import Algorithm, Clock, Explorer, Masked, Metrics, PyTree, Rollout, renew, unmasked
from rejeu.core.prng import nth
from rejeu.core.spaces import Leaf
from rejeu.core.validation import choice, coerce, flag, nested, whole
from rejeu.networks import Cell, make_encoder


@dataclass(frozen=True)
class RecurrentConfig(ActorCriticConfig):
    """The settings of policy and value networks with memory."""

    cell: Literal["lstm", "gru"] = "lstm"
    """The recurrent cell."""
    lstm_hidden_size: int = 256
    """Size of its hidden state; an LSTM has a cell state of the same size."""
    shared_lstm: bool = False
    """Policy and value read the same memory, which only the policy's loss trains unless ``share_layers``; otherwise each has
    its own."""

    def __post_init__(self) -> None:
        ActorCriticConfig.__post_init__(self)
        coerce(self, "cell", choice, among=("lstm", "gru"))
        coerce(self, "lstm_hidden_size", whole, least=1)
        coerce(self, "shared_lstm", flag)
        if self.share_layers and not self.shared_lstm:
            raise ValueError("share_layers=True needs shared_lstm=True: shared layers need a shared memory")
        if self.shared_lstm and not self.share_features_extractor:
            raise ValueError(
                "policy_kwargs: shared_lstm=True conflicts with share_features_extractor=False: one memory has "
                "one encoder; leave out one"
            )


@dataclass(frozen=True, kw_only=True)
class Config(ppo.Config):
    """Hyperparameters of recurrent PPO; the defaults are those of Stable-Baselines3's contributions."""

    n_steps: int = 128
    """Steps of each environment between two updates, and the length over which gradients are propagated."""
    batch_size: int = 128
    """Steps per gradient step, rounded to complete environments with all their steps. Larger batches reduce the variance of
    the gradient at a higher cost."""
    policy_kwargs: RecurrentConfig = dataclasses.field(default_factory=RecurrentConfig)
    """Shape of the networks: ``lstm_hidden_size``, ``cell`` (``"lstm"`` or ``"gru"``), ``shared_lstm``, and what PPO
    takes."""

    name: ClassVar[str] = "RecurrentPPO"
    search_space: ClassVar[SearchSpace] = {
        **search.PPO,
        "n_steps": Choice((32, 64, 128, 256)),
        "policy_kwargs.lstm_hidden_size": Choice((16, 32, 64, 128, 256)),
    }

    def __post_init__(self) -> None:
        coerce(self, "policy_kwargs", nested, config_class=RecurrentConfig)
        ppo.Config.__post_init__(self)
        if self.critic_learning_rate is not None:
            raise ValueError("critic_learning_rate: policy and value read through one encoder here; leave it out")
        if self.use_sde:
            raise ValueError("use_sde: state-dependent noise is not available for policies with memory; leave it out")
        if self.n_episodes is not None:
            raise ValueError(
                "n_episodes: a recurrent policy learns from rollouts of equal length; give n_steps and leave it out"
            )

    @property
    def stops_early(self) -> bool:
        """Whether a rollout may be worth fewer gradient steps than :meth:`gradient_steps` says: minibatches are uneven."""
        return True

    def steps_per_gradient(self, n_envs: int) -> int:
        """Returns the number of steps of ``n_envs`` environments per gradient step."""
        return self.n_steps * envs_per_batch(self, self.n_steps, n_envs)


def envs_per_batch(config: Config, n_steps: int, n_envs: int) -> int:
    """Returns how many environments with all their steps make a minibatch."""
    return min(max(config.batch_size // n_steps, 1), n_envs)


Memory = tuple[tuple[Array, ...], ...]
"""Of the policy's cell, and of the value's where it has its own."""


class RecurrentActorCritic(eqx.Module):
    """Observation and memory to a distribution over actions and to a value."""

    encoder: PyTree
    value_encoder: PyTree
    """Of the value's cell; None where the policy's is shared."""
    cells: tuple[Cell, ...]
    """The policy's, and the value's where it has its own."""
    readers: ActorCritic
    """Policy and value, which read what comes out of the cells."""

    def __init__(self, key: Array, leaves: tuple[Leaf, ...], action: ActionKind, shape: RecurrentConfig) -> None:
        """Draws the weights."""
        encoder_key, cell_key, reader_key = jax.random.split(key, 3)
        encoder = make_encoder(encoder_key, leaves, shape)
        value_key = jax.random.fold_in(encoder_key, 1)
        value_encoder = None if shape.share_features_extractor else make_encoder(value_key, leaves, shape)
        if shape.ortho_init:
            encoder = orthogonal(encoder, encoder_key, HIDDEN_GAIN)
            value_encoder = orthogonal(value_encoder, value_key, HIDDEN_GAIN)
        self.encoder, self.value_encoder = encoder, value_encoder
        size = shape.lstm_hidden_size
        n_cells = 1 if shape.shared_lstm else 2
        keys = jax.random.split(cell_key, n_cells)
        self.cells = tuple(Cell(keys[i], self.encoder.n_features, size, shape.cell) for i in range(n_cells))
        remembered = Leaf("", "continuous", (size,), "float32")
        self.readers = ActorCritic(reader_key, (remembered,), action, dataclasses.replace(shape, encoder=None))

    @property
    def log_std(self) -> Array | None:
        """The policy's log standard deviation where it does not depend on the observation."""
        return self.readers.log_std

    def empty(self, n: int) -> Memory:
        """Returns the memory at the start of ``n`` episodes."""
        return tuple(cell.empty(n) for cell in self.cells)

    def remember(self, memory: Memory, obs: PyTree, ended: Array) -> Memory:
        """Returns the memory after observations ``(n, ...)``; reset where ``ended``, ``bool (n,)``."""
        features = self.features(obs)
        memory = renew(ended, self.empty(ended.shape[0]), memory)
        parts = zip(self.cells, memory, features, strict=True)
        return tuple(cell.step(m, cell.project(read)) for cell, m, read in parts)

    def unroll(self, memory: Memory, obs: PyTree, started: Array) -> Memory:
        """Returns the memory after each observation, ``(steps, n, size)`` each.

        Args:
            memory: before the first.
            obs: ``(steps, n, ...)``.
            started: where an episode begins with an observation, ``bool (steps, n)``.
        """
        n_steps, n = started.shape
        features = [read.reshape(n_steps, n, -1) for read in self.features(flat(obs))]
        each = zip(self.cells, memory, features, strict=True)
        return tuple(cell.unroll(before, read, started) for cell, before, read in each)

    def features(self, obs: PyTree) -> tuple[Array, ...]:
        """Returns the features of observations ``(n, ...)`` for each cell, ``(n, n_features)`` each."""
        features = self.encoder(obs)
        if self.value_encoder is None:
            return (features,) * len(self.cells)
        return features, self.value_encoder(obs)

    def policy(self, memory: Memory, mask: Array | None = None) -> Distribution:
        """Returns the distribution of actions with memories ``(n, size)``."""
        read = memory[0][0]
        return self.readers.policy(read if mask is None else Masked(read, mask))

    def value(self, memory: Memory) -> Array:
        """Returns the values with memories ``(n, size)``, ``(n,)``."""
        return self.readers.value(memory[-1][0])


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns recurrent PPO for these spaces.

    Raises:
        ValueError: if no policy can act in the action space.
    """
    obs_leaves, action_kind, shape = checked(config, observation_space, action_space)
    optimizer = optimizers.make(config.optimizer, eps=ADAM_EPSILON)

    def init(key: Array) -> State:
        return initial_state(key, lambda key: RecurrentActorCritic(key, obs_leaves, action_kind, shape), optimizer)

    def act(
        memory: Memory, actor: RecurrentActorCritic, obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, Memory]:
        memory = actor.remember(memory, obs, ended)
        return actor.policy(memory, unmasked(obs)[1]).sample(key), memory

    def recall(memory: Memory, actor: RecurrentActorCritic, obs: PyTree, ended: Array) -> tuple[Array, Memory]:
        memory = actor.remember(memory, obs, ended)
        return actor.policy(memory, unmasked(obs)[1]).mode(), memory

    def explore(actor: RecurrentActorCritic, obs: PyTree, key: Array, clock: Clock) -> Array:
        ended = jnp.ones((jax.tree.leaves(obs)[0].shape[0],), bool)
        return act(actor.empty(ended.shape[0]), actor, obs, ended, key, clock)[0]

    def exploit(actor: RecurrentActorCritic, obs: PyTree) -> Array:
        ended = jnp.ones((jax.tree.leaves(obs)[0].shape[0],), bool)
        return recall(actor.empty(ended.shape[0]), actor, obs, ended)[0]

    def update(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        n_steps, n_envs = rollout.reward.shape
        data, started = unrolled_samples(state.network, rollout, config.gae_lambda)
        size = envs_per_batch(config, n_steps, n_envs)
        n_batches = -(-n_envs // size)
        orders = shuffled(nth(state.key, state.n_rollouts), jnp.ones((n_envs,), bool), config.n_epochs, -n_envs % size)

        def minibatch(i: Array) -> tuple[Samples, Array, Memory]:
            first = (i % n_batches) * size
            index = jax.lax.dynamic_slice(orders, (i // n_batches, first), (1, size))[0]
            exists = first + jnp.arange(size) < n_envs
            sequences = jax.tree.map(lambda x: x[:, index], data)
            memory = jax.tree.map(lambda x: x[index], rollout.carry)
            return sequences._replace(valid=sequences.valid & exists[None]), started[:, index], memory

        network, optimizer_state, n_taken, losses = epochs(
            jax.value_and_grad(loss, has_aux=True),
            state.network,
            state.optimizer,
            minibatch,
            jnp.int32(config.n_epochs * n_batches),
            optimizer,
            config,
            clock,
        )
        state = state.after(network, optimizer_state, n_taken)
        return state, ppo.metrics_of(network, n_taken, losses, data.value, data.target, data.valid, config, clock)

    def value(memory: Memory, actor: RecurrentActorCritic, obs: PyTree, ended: Array) -> Array:
        return actor.value(actor.remember(memory, obs, ended))

    explorer = Explorer(RecurrentActorCritic.empty, act)
    return Algorithm(init, lambda state: state.network, explore, exploit, update, explorer, recall, state_value=value)


def unrolled_samples(network: RecurrentActorCritic, rollout: Rollout, gae_lambda: float) -> tuple[Samples, Array]:
    """Returns the steps of a rollout, leaves ``(steps, n_envs, ...)``, and where an episode starts with a step."""
    shape = rollout.reward.shape
    started = jnp.concatenate([rollout.started[None], rollout.ended[:-1]])
    memory = flat(network.unroll(rollout.carry, rollout.obs, started))
    mask = flat(unmasked(rollout.obs)[1])
    log_prob = network.policy(memory, mask).log_prob(flat(rollout.action))
    never = jnp.zeros((shape[0] * shape[1],), bool)
    next_value = network.value(network.remember(memory, flat(rollout.next_obs), never))
    evaluated = [x.reshape(shape) for x in (log_prob, network.value(memory), next_value)]
    return with_advantages(rollout, gae_lambda, *evaluated), started


def loss(
    network: RecurrentActorCritic, minibatch: tuple[Samples, Array, Memory], config: Config, clock: Clock
) -> tuple[Array, Losses]:
    """Returns PPO's loss of environments with all their steps, and its parts."""
    batch, started, memory = minibatch
    after = flat(network.unroll(memory, batch.obs, started))
    distribution = network.policy(after, flat(unmasked(batch.obs)[1]))
    shape = config.policy_kwargs
    read = jax.lax.stop_gradient(after) if shape.shared_lstm and not shape.share_layers else after
    steps = scaled(flat(batch._replace(obs=())), config)
    return loss_of(distribution, network.value(read), steps, config, clock)
