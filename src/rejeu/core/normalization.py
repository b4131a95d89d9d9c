"""Observations and rewards normalized by running statistics, which are part of the agent's state.

A :func:`normalized` algorithm takes raw observations and rewards, in training and in use. Its statistics are part of its
state and hence of its file; they change only in training. Observations are standardized,
``clip((x - mean) / sqrt(variance + epsilon), -clip_obs, clip_obs)``. Rewards are divided by the standard deviation of the
running discounted sum of rewards of each environment (Engstrom et al. 2020, "Implementation Matters in Deep Policy
Gradients", arXiv 2005.12729), ``clip(r / sqrt(variance + epsilon), -clip_reward, clip_reward)``, and not shifted. With
``max_return`` the divisor is ``max(sqrt(variance + epsilon), largest / max_return)``, where ``largest`` is the largest of
these sums so far in size, so that none exceeds ``max_return`` (SimbaV2, Lee et al. 2025, arXiv 2502.15280).

Moments are merged as in Chan, Golub and LeVeque 1983, "Algorithms for Computing the Sample Variance". Off-policy
algorithms add every observation to the statistics when it is made; batches from the buffer are normalized by the newest
statistics. On-policy algorithms add a rollout's observations after learning from it, so that the policy that is updated
is exactly the one that acted; rewards, and all of the first rollout, whose scale is unknown before, are added first.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import Algorithm, Clock, Explorer, Masked, Metrics, PyTree, Rollout, Sequences, Transition
from rejeu.core.spaces import Leaf, groups
from rejeu.core.validation import coerce, flag, nested, number

MAX_COUNT = 2.0**23
"""Maximum count of the moments; from then on older values are forgotten. float32 cannot count beyond 2^24 by ones."""


@dataclass(frozen=True)
class NormalizationConfig:
    """Settings of normalization (those of Stable-Baselines3's ``VecNormalize``)."""

    norm_obs: bool = True
    """Standardize continuous observations; images, numbers of choices and bits are not changed."""
    norm_reward: bool = True
    """Divide rewards by the standard deviation of the discounted sum of rewards."""
    clip_obs: float = 10.0
    """Maximum magnitude of a normalized observation."""
    clip_reward: float = 10.0
    """Maximum magnitude of a normalized reward."""
    epsilon: float = 1e-8
    """Added to variances."""
    share_goals: bool = True
    """Use the same statistics for the achieved and the desired goal, so that equal goals stay equal. False: statistics of
    their own, as in Stable-Baselines3."""
    max_return: float | None = None
    """Limit on the discounted sums of normalized rewards, for critics with fixed values: rewards are divided by at least the
    largest sum in size over it. None: no limit."""

    def __post_init__(self) -> None:
        coerce(self, ("norm_obs", "norm_reward", "share_goals"), flag)
        coerce(self, ("clip_obs", "clip_reward", "epsilon"), number, above=0)
        coerce(self, "max_return", number, above=0, optional=True)


def parse(name: str, value: object) -> NormalizationConfig | None:
    """Returns the settings that the argument ``normalize`` stands for: None for False, the defaults for True.

    Raises:
        TypeError: for anything else.
    """
    if value is False:
        return None
    if value is True or isinstance(value, NormalizationConfig | Mapping):
        return nested(name, {} if value is True else value, NormalizationConfig)
    raise TypeError(f"{name}={value!r} must be True, False or a dict such as dict(norm_obs=True, norm_reward=False)")


class Moments(NamedTuple):
    """Running mean and variance, by component."""

    mean: Array
    """``float32``, of the shape of one value."""
    variance: Array
    """Divided by the number of values; 1 before the first value."""
    n_seen: Array
    """``float32[]``."""


def no_moments(shape: tuple[int, ...]) -> Moments:
    """Returns the moments of no values."""
    return Moments(jnp.zeros(shape, jnp.float32), jnp.ones(shape, jnp.float32), jnp.float32(0))


def merged(moments: Moments, values: Array, weight: Array) -> Moments:
    """Returns the moments after ``values`` ``(batch, *shape)``; values with ``weight`` 0 do not count.

    Values that are not finite, or whose square is not, do not count either.
    """
    shape = (-1, *[1] * moments.mean.ndim)
    is_finite = jnp.isfinite(values).reshape(values.shape[0], -1).all(axis=1)
    values = jnp.where(is_finite.reshape(shape), values, 0.0)
    weight = jnp.where(is_finite, weight, 0.0)
    n = jnp.sum(weight)
    spread = weight.reshape(shape)
    mean = jnp.sum(values * spread, axis=0) / jnp.maximum(n, 1.0)
    variance = jnp.sum(jnp.square(values - mean[None]) * spread, axis=0) / jnp.maximum(n, 1.0)
    total = moments.n_seen + n
    share = n / jnp.maximum(total, 1.0)
    delta = mean - moments.mean
    first = moments.n_seen == 0
    old = jnp.where(first, 0.0, moments.variance)
    after = (1.0 - share) * old + share * variance + (1.0 - share) * share * jnp.square(delta)
    updated = Moments(moments.mean + share * delta, after, jnp.minimum(total, MAX_COUNT))
    counts = (n > 0) & jnp.isfinite(updated.mean).all() & jnp.isfinite(updated.variance).all()
    return jax.tree.map(lambda new, before: jnp.where(counts, new, before), updated, moments)


class Statistics(NamedTuple):
    """The statistics of observations and rewards."""

    obs: tuple[Moments, ...]
    """By group of leaves; see :func:`groups`."""
    returns: Moments
    """Of the discounted sum of rewards, ``float32[]`` each."""
    largest: Array | None = None
    """The largest discounted sum of rewards in size, ``float32[]``, with ``max_return``."""


class State(eqx.Module):
    """The state of an algorithm, and the statistics by which its observations and rewards are normalized."""

    learner: PyTree
    statistics: Statistics


class Normalizer(NamedTuple):
    """Pure functions that update statistics and normalize by them."""

    groups: list[int | None]
    """See :func:`groups`."""
    shapes: dict[int, tuple[int, ...]]
    """The shape of one value of each group."""
    config: NormalizationConfig
    gamma: float
    """Discount factor of n-step returns."""

    def init(self) -> Statistics:
        """Returns the statistics before the first step."""
        largest = None if self.config.max_return is None else jnp.float32(0.0)
        return Statistics(tuple(no_moments(self.shapes[g]) for g in sorted(self.shapes)), no_moments(()), largest)

    def obs(self, statistics: Statistics, obs: PyTree) -> PyTree:
        """Returns normalized observations ``(..., *shape)``."""
        if not self.config.norm_obs:
            return obs
        if isinstance(obs, Masked | Sequences):
            return obs._replace(obs=self.obs(statistics, obs.obs))
        arrays, tree = jax.tree.flatten(obs)
        pairs = zip(arrays, self.groups, strict=True)
        return jax.tree.unflatten(tree, [x if g is None else self.standardize(statistics.obs[g], x) for x, g in pairs])

    def standardize(self, moments: Moments, x: Array) -> Array:
        """Returns ``x`` ``(..., *shape)`` standardized and clipped; unchanged before the first update of the moments."""
        moments = jax.lax.stop_gradient(moments)  # which are counted, not learned
        axes = x.ndim - moments.mean.ndim
        mean, variance = (m.reshape(*[1] * axes, *m.shape) for m in (moments.mean, moments.variance))
        z = (x.astype(jnp.float32) - mean) * jax.lax.rsqrt(variance + self.config.epsilon)
        clipped = jnp.clip(z, -self.config.clip_obs, self.config.clip_obs)
        return jnp.where(moments.n_seen > 0, clipped, x.astype(jnp.float32))

    def reward(self, statistics: Statistics, reward: Array, scale: float | Array = 1.0) -> Array:
        """Returns rewards divided by the standard deviation of returns, clipped to ``scale * clip_reward``."""
        if not self.config.norm_reward:
            return reward
        limit = self.config.clip_reward * scale
        factor = jax.lax.rsqrt(statistics.returns.variance + self.config.epsilon)
        if statistics.largest is not None:
            assert self.config.max_return is not None
            factor = jnp.minimum(factor, self.config.max_return / jnp.maximum(statistics.largest, 1e-8))
        scaled = reward * factor
        return jnp.where(statistics.returns.n_seen > 0, jnp.clip(scaled, -limit, limit), reward)

    def n_step_reward(self, statistics: Statistics, rewards: Array) -> Array:
        """Returns the sum of ``gamma^i r_i`` ``(batch, n)``, with each ``r_i`` normalized and clipped."""
        scale = self.gamma ** jnp.arange(rewards.shape[1], dtype=jnp.float32)[None]
        return jnp.sum(self.reward(statistics, rewards, scale), axis=1)

    def with_returns(self, statistics: Statistics, returns: Array, weight: Array) -> Statistics:
        """Returns the statistics after discounted sums of rewards ``(n,)`` whose weights are 0 or 1."""
        moments, largest = merged(statistics.returns, returns, weight), statistics.largest
        if largest is not None:
            sizes = jnp.where((weight > 0) & jnp.isfinite(returns), jnp.abs(returns), 0.0)
            largest = jnp.maximum(largest, jnp.max(sizes))
        return statistics._replace(returns=moments, largest=largest)

    def with_obs(self, statistics: Statistics, obs: PyTree, weight: Array) -> Statistics:
        """Returns the statistics after observations whose weights ``(n,)`` are 0 or 1."""
        arrays = jax.tree.leaves(obs.obs if isinstance(obs, Masked) else obs)
        moments = list(statistics.obs)
        for x, g in zip(arrays, self.groups, strict=True):
            if g is not None:
                moments[g] = merged(moments[g], x.reshape(-1, *self.shapes[g]).astype(jnp.float32), weight)
        return statistics._replace(obs=tuple(moments))

    def transition(self, statistics: Statistics, batch: Transition) -> Transition:
        """Returns a normalized batch from the replay buffer."""
        is_sum = batch.rewards is not None
        return batch._replace(
            obs=self.obs(statistics, batch.obs),
            next_obs=self.obs(statistics, batch.next_obs),
            reward=self.n_step_reward(statistics, batch.rewards) if is_sum else self.reward(statistics, batch.reward),
            rewards=None,
        )

    def rollout(self, before: Statistics, rollout: Rollout) -> tuple[Rollout, Statistics]:
        """Returns a normalized rollout, and the statistics after it.

        Its observations are normalized by the statistics from before, except those of the first rollout.
        """
        weight = rollout.valid.reshape(-1).astype(jnp.float32)
        scaled = self.with_returns(before, rollout.running_return.reshape(-1), weight)
        after = self.with_obs(scaled, rollout.obs, weight)
        is_first = before.returns.n_seen == 0
        used = jax.tree.map(lambda old, new: jnp.where(is_first, new, old), scaled, after)
        normalized = rollout._replace(
            obs=self.obs(used, rollout.obs),
            next_obs=self.obs(used, rollout.next_obs),
            reward=self.reward(used, rollout.reward),
        )
        return normalized, after


def normalizer_of(leaves: tuple[Leaf, ...], config: NormalizationConfig, gamma: float = 1.0) -> Normalizer:
    """Returns the functions that normalize observations of these leaves, and rewards."""
    indices = groups(leaves, config.share_goals)
    shapes = {g: leaf.shape for g, leaf in zip(indices, leaves, strict=True) if g is not None}
    return Normalizer(indices, shapes, config, gamma)


def normalized(
    algorithm: Algorithm, explorer: Explorer, leaves: tuple[Leaf, ...], config: NormalizationConfig, gamma: float = 1.0
) -> Algorithm:
    """Returns an algorithm on raw observations and rewards that keeps the statistics in its state.

    Args:
        algorithm: learns from normalized observations and rewards.
        explorer: how it explores, including noise.
        leaves: those of the observations.
        config: what is normalized.
        gamma: the discount factor of n-step returns, each of whose rewards is clipped separately.
    """
    normalizer = normalizer_of(leaves, config, gamma)

    def update(state: State, batch: PyTree, clock: Clock) -> tuple[State, Metrics]:
        if isinstance(batch, Rollout):
            batch, statistics = normalizer.rollout(state.statistics, batch)
        else:
            batch, statistics = normalizer.transition(state.statistics, batch), state.statistics
        learner, metrics = algorithm.update(state.learner, batch, clock)
        return State(learner, statistics), metrics

    def observe(state: State, obs: PyTree, returns: Array) -> State:
        weight = jnp.ones_like(returns)
        statistics = normalizer.with_obs(state.statistics, obs, weight)
        return State(state.learner, normalizer.with_returns(statistics, returns, weight))

    return acting_normalized(algorithm, explorer, normalizer)._replace(
        init=lambda key: State(algorithm.init(key), normalizer.init()), update=update, observe=observe
    )


def acting_normalized(algorithm: Algorithm, explorer: Explorer, normalizer: Normalizer) -> Algorithm:
    """Returns ``algorithm`` with functions that normalize observations before they choose or evaluate actions.

    The actor is the pair of the algorithm's actor and the statistics.
    """

    def by_actor(function: Callable[..., Any] | None, index: int = 0) -> Any:
        """Returns a function whose argument at ``index`` is the actor, followed by observations; None of None."""

        def call(*arguments: Any) -> Any:
            (actor, statistics), obs, *remaining = arguments[index:]
            return function(*arguments[:index], actor, normalizer.obs(statistics, obs), *remaining)  # type: ignore[misc]

        return None if function is None else call

    def action_values(state: State, obs: PyTree, action: Array | None) -> Array:
        assert algorithm.action_values is not None
        return algorithm.action_values(state.learner, normalizer.obs(state.statistics, obs), action)

    return algorithm._replace(
        actor=lambda state: (algorithm.actor(state.learner), state.statistics),
        explore=by_actor(algorithm.explore),
        exploit=by_actor(algorithm.exploit),
        explorer=Explorer(lambda actor, n_envs: explorer.init(actor[0], n_envs), by_actor(explorer.act, 1)),
        recall=by_actor(algorithm.recall, 1),
        action_values=None if algorithm.action_values is None else action_values,
        state_value=by_actor(algorithm.state_value, 1),
        imitation=by_actor(algorithm.imitation),
    )
