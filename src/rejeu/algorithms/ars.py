"""Augmented random search: a policy that moves along random directions, by the returns of whole episodes.

Source: Mania et al. 2018, "Simple random search provides a competitive approach to reinforcement learning" (arXiv
1803.07055, algorithms 1 and 2). For the parameters ``theta``, random directions ``delta_k`` of independent standard normals,
and the returns ``r(.)`` of episodes under the deterministic policy::

    r+_k, r-_k  = r(theta + delta_std delta_k), r(theta - delta_std delta_k),           k = 1 ... n_delta
    theta      <- theta + learning_rate / (n_top sigma) sum_k (r+_k - r-_k) delta_k

The sum is over the ``n_top`` directions with the largest ``max(r+_k, r-_k)``, and ``sigma`` is the standard deviation of
their returns. A rollout is one iteration: every environment plays an equal share of the ``2 n_delta n_eval_episodes``
episodes, each under its own parameters. The paper's V2, which scales observations by running statistics, is
``normalize=dict(norm_obs=True, norm_reward=False)``.

The policy is linear, and begins at 0, unless ``policy_kwargs`` gives hidden layers; then actions of Box spaces are squashed by
tanh. As in Stable-Baselines3 Contrib, whose defaults these are; its linear policy has no bias, ours has.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.config import network_inputs
from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.algorithms.search import LogUniform, SearchSpace
from rejeu.core import schedules
from rejeu.core.algorithm import Algorithm, Clock, Explorer, Metrics, PyTree, Rollout, Scalar, renew
from rejeu.core.prng import nth
from rejeu.core.schedules import Schedule, at
from rejeu.core.spaces import action_dimension, check_action
from rejeu.core.validation import coerce, flag, number, whole
from rejeu.networks import Network, Widths

SMALLEST_DEVIATION = 1e-6
"""Added to the standard deviation of returns, which is 0 where all are equal."""


@dataclass(frozen=True, kw_only=True)
class Config(RolloutConfig):
    """Hyperparameters of ARS; the defaults are those of Stable-Baselines3 Contrib."""

    learning_rate: float | Schedule = 0.02
    """Step size of the parameters."""
    n_delta: int = 8
    """Random directions per iteration. A larger number estimates the ascent better and plays more episodes for it."""
    n_top: int | None = None
    """Best directions that count. None: all."""
    delta_std: float | Schedule = 0.05
    """Standard deviation of the perturbations of each parameter."""
    zero_policy: bool = True
    """Start with all parameters at 0, as the paper does. Without effect where there are hidden layers."""
    alive_bonus_offset: float = 0.0
    """Added to each reward for the search: -1 cancels a reward of 1 for every step that an episode goes on."""
    n_eval_episodes: int = 1
    """Episodes for each perturbation."""
    # Class variables in place of inherited fields take the fields away: they have no meaning here.
    n_episodes: ClassVar[int] = 1  # type: ignore[misc]
    optimizer: ClassVar[str] = "sgd"  # type: ignore[misc]
    max_grad_norm: ClassVar[None] = None  # type: ignore[misc]

    name: ClassVar[str] = "ARS"
    hidden_layers: ClassVar[Widths] = Widths((), ())
    search_space: ClassVar[SearchSpace] = {
        "learning_rate": LogUniform(1e-3, 1e-1),
        "delta_std": LogUniform(1e-2, 3e-1),
    }

    def __post_init__(self) -> None:
        RolloutConfig.__post_init__(self)
        coerce(self, "delta_std", schedules.parse, least=0)
        coerce(self, ("n_delta", "n_eval_episodes"), whole, least=1)
        coerce(self, "n_top", whole, least=1, most=self.n_delta, optional=True)
        coerce(self, "alive_bonus_offset", number)
        coerce(self, "zero_policy", flag)

    def episodes(self, n_envs: int) -> int:
        """Returns the complete episodes of each of ``n_envs`` environments between two updates.

        Raises:
            ValueError: if the environments cannot share the episodes of an iteration evenly.
        """
        total = 2 * self.n_delta * self.n_eval_episodes
        if total % n_envs:
            raise ValueError(
                f"an iteration of ARS has 2 * n_delta * n_eval_episodes = {total} episodes, which {n_envs} environments "
                "cannot share evenly; choose a number of environments that divides it"
            )
        return total // n_envs


class Perturbation(eqx.Module):
    """The policy of a rollout: its parameters, and the key from which their perturbations are drawn."""

    network: Network
    key: Array
    """Root of the directions, ``uint32[2]``; never changes."""
    n_rollouts: Array
    """Iterations so far, ``int32[]``."""


class State(eqx.Module):
    """Everything that ARS learns; every leaf is an array."""

    actor: Perturbation
    n_updates: Array
    """Iterations so far, ``int32[]``."""


class Playing(NamedTuple):
    """The carry of the explorer: what each environment plays at present."""

    network: Network
    """The perturbed parameters, leaves ``(n_envs, ...)``."""
    n_rollouts: Array
    """The iteration that they belong to, ``int32 (n_envs,)``."""
    episode: Array
    """Episodes that the environment has begun in this iteration, ``int32 (n_envs,)``."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns ARS for these spaces.

    Raises:
        ValueError: if the actions are neither Box nor Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    check_action(action_space, config.name)
    if not isinstance(action_space, spaces.Box | spaces.Discrete):
        raise ValueError(f"ARS needs Box or Discrete actions, got {action_space}; use PPO")
    n_outputs = action_dimension(action_space) if isinstance(action_space, spaces.Box) else int(action_space.n)
    obs_leaves, shape = network_inputs(config, observation_space)
    widths = shape.actor_widths(())

    def init(key: Array) -> State:
        network_key, search_key = jax.random.split(key)
        network = Network(network_key, obs_leaves, n_outputs, widths, shape)
        if config.zero_policy and not widths:
            network = jax.tree.map(jnp.zeros_like, network)
        return State(Perturbation(network, search_key, jnp.int32(0)), jnp.int32(0))

    def act(network: Network, obs: PyTree) -> Array:
        outputs = network(obs)
        if not isinstance(action_space, spaces.Box):
            return jnp.argmax(outputs, axis=-1).astype(jnp.int32)
        return jnp.tanh(outputs) if widths else jnp.clip(outputs, -1.0, 1.0)

    def choose(actor: Perturbation, obs: PyTree, *_: object) -> Array:
        return act(actor.network, obs)

    def begin(actor: Perturbation, n_envs: int) -> Playing:
        networks = jax.tree.map(lambda leaf: jnp.zeros((n_envs, *leaf.shape), leaf.dtype), actor.network)
        none = jnp.full((n_envs,), -1, jnp.int32)
        return Playing(networks, none, jnp.zeros_like(none))

    def play(
        playing: Playing, actor: Perturbation, obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, Playing]:
        n_envs = ended.shape[0]
        is_new = playing.n_rollouts != actor.n_rollouts
        begun = jnp.where(is_new, 0, playing.episode)
        std = at(config.delta_std, clock.progress)
        candidate = begun * n_envs + jnp.arange(n_envs, dtype=jnp.int32)
        fresh = jax.vmap(lambda i: perturbed(actor, i, std, config.n_delta))(candidate)
        starts = ended | is_new
        networks = renew(starts, fresh, playing.network)
        each = jax.tree.map(lambda leaf: leaf[:, None], obs)
        action = jax.vmap(act)(networks, each)[:, 0]
        number = jnp.broadcast_to(actor.n_rollouts, (n_envs,))
        return action, Playing(networks, number, begun + starts.astype(jnp.int32))

    def update(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        actor = state.actor
        n_episodes = config.episodes(rollout.reward.shape[1])
        returns = episode_returns(rollout, n_episodes, config.alive_bonus_offset)
        plus, minus = jnp.mean(returns.reshape(config.n_eval_episodes, 2, config.n_delta), axis=0)
        weight, deviation = weights(plus, minus, config.n_top or config.n_delta)
        rate = at(config.learning_rate, clock.progress)

        def ascend(network: Network, k: Array) -> tuple[Network, None]:
            return jax.tree.map(lambda p, d: p + rate * weight[k] * d, network, direction(actor, k)), None

        network, _ = jax.lax.scan(ascend, actor.network, jnp.arange(config.n_delta))
        metrics = {
            "return_mean": jnp.mean(returns),
            "return_std": deviation,
            "step_size": jnp.asarray(rate, jnp.float32) / deviation,
            "delta_std": jnp.asarray(at(config.delta_std, clock.progress), jnp.float32),
            "learning_rate": jnp.asarray(rate, jnp.float32),
        }
        actor = dataclasses.replace(actor, network=network, n_rollouts=actor.n_rollouts + 1)
        return State(actor, state.n_updates + 1), metrics

    return Algorithm(init, lambda state: state.actor, choose, choose, update, Explorer(begin, play))


def direction(actor: Perturbation, k: Array) -> Network:
    """Returns the k-th direction of the present iteration: a tree like the network of independent standard normals."""
    key = jax.random.fold_in(nth(actor.key, actor.n_rollouts), k)
    leaves, structure = jax.tree.flatten(actor.network)
    keys = jax.random.split(key, len(leaves))
    drawn = [jax.random.normal(k, leaf.shape, leaf.dtype) for k, leaf in zip(keys, leaves, strict=True)]
    return jax.tree.unflatten(structure, drawn)


def perturbed(actor: Perturbation, candidate: Array, std: Scalar, n_delta: int) -> Network:
    """Returns the parameters of an episode of an iteration.

    Episodes are numbered from 0: first all directions forward, then all backward, and so on for each of the evaluations.
    """
    sign = jnp.where((candidate // n_delta) % 2 == 0, 1.0, -1.0)
    return jax.tree.map(lambda p, d: p + sign * std * d, actor.network, direction(actor, candidate % n_delta))


def episode_returns(rollout: Rollout, n_episodes: int, offset: float) -> Array:
    """Returns the sums of rewards plus ``offset``, in the order in which :func:`perturbed` numbers episodes."""
    before = jnp.cumsum(rollout.ended, axis=0) - rollout.ended
    counted = jnp.where(rollout.valid, rollout.reward + offset, 0.0)
    of_episode = lambda number: jnp.sum(jnp.where(before == number, counted, 0.0), axis=0)  # noqa: E731
    return jax.vmap(of_episode)(jnp.arange(n_episodes)).ravel()


def weights(plus: Array, minus: Array, n_top: int) -> tuple[Array, Array]:
    """Returns the weight of each direction in a step of length 1, ``(n_delta,)``, and the deviation of the returns used.

    Args:
        plus: returns of the episodes forward, ``(n_delta,)``.
        minus: likewise backward.
        n_top: directions that count.
    """
    best = jnp.argsort(-jnp.maximum(plus, minus))[:n_top]
    deviation = jnp.std(jnp.concatenate([plus[best], minus[best]])) + SMALLEST_DEVIATION
    is_best = jnp.zeros_like(plus).at[best].set(1.0)
    return is_best * (plus - minus) / (n_top * deviation), deviation
