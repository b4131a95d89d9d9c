"""Observations and rewards scaled by what has been seen so far, inside the agent's state.

An algorithm that is :func:`normalised` takes raw observations and rewards, in training as in use: the statistics are part
of its state, hence of its file, and stand still wherever nothing learns. Observations are standardised,
``clip((x - mean) / sqrt(variance + epsilon), -clip_obs, clip_obs)``; rewards are divided by the standard deviation of the
discounted sum of rewards that runs along with each environment (Engstrom et al. 2020, "Implementation Matters in Deep
Policy Gradients", arXiv 2005.12729), ``clip(r / sqrt(variance + epsilon), -clip_reward, clip_reward)``, and not shifted.

Moments are merged as in Chan, Golub and LeVeque 1983, "Algorithms for Computing the Sample Variance". Learners with a
replay buffer take in every observation as it comes; what they draw later is scaled by the newest statistics. On-policy
learners take in a rollout's observations after they have learnt from it, so that the policy that is updated is exactly the one
that acted; its rewards, and all of the first rollout, of whose scale nothing is known before, they take in at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core import Algorithm, Clock, Explorer, Masked, Metrics, PyTree, Rollout, Transition
from rejeu.spaces import Leaf

MOST = 2.0**23
"""Count at which moments stop growing slower: from then on they forget. Beyond it float32 could not count by ones."""


@dataclass(frozen=True)
class NormalizationConfig:
    """What is normalised (the settings of Stable-Baselines3's ``VecNormalize``)."""

    norm_obs: bool = True
    """Standardise continuous observations; images, numbers of choices and bits are left as they are."""
    norm_reward: bool = True
    """Divide rewards by the standard deviation of the discounted sum of rewards."""
    clip_obs: float = 10.0
    """Largest magnitude of a normalised observation. Raising it keeps outliers apart."""
    clip_reward: float = 10.0
    """Largest magnitude of a normalised reward."""
    epsilon: float = 1e-8
    """Added to variances."""

    def __post_init__(self) -> None:
        for key in ("norm_obs", "norm_reward"):
            if not isinstance(getattr(self, key), bool):
                raise TypeError(f"{key}={getattr(self, key)!r} must be True or False")
        for key in ("clip_obs", "clip_reward", "epsilon"):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < float("inf"):
                raise ValueError(f"{key}={value!r} must be a positive number")
            object.__setattr__(self, key, float(value))


def parse(value: Any) -> NormalizationConfig | None:
    """Returns what ``normalize`` asks for: False or None nothing, True all, a dict of settings what it says.

    Raises:
        TypeError: for anything else.
    """
    if value is None or value is False:
        return None
    if value is True:
        return NormalizationConfig()
    if isinstance(value, NormalizationConfig):
        return value
    if isinstance(value, Mapping):
        known = list(NormalizationConfig.__dataclass_fields__)
        if unknown := set(value) - set(known):
            raise TypeError(f"normalize has no setting {sorted(unknown)[0]!r}; known: {', '.join(known)}")
        return NormalizationConfig(**value)
    raise TypeError(f"normalize={value!r} must be True, False or a dict such as dict(norm_obs=True, norm_reward=False)")


class Moments(NamedTuple):
    """Mean and variance of what has been seen, by component."""

    mean: Array
    """``float32``, of the shape of one value."""
    variance: Array
    """Divided by the number of values; 1 before anything was seen."""
    n_seen: Array
    """``float32[]``."""


def nothing(shape: tuple[int, ...]) -> Moments:
    """Returns the moments of no values."""
    return Moments(jnp.zeros(shape, jnp.float32), jnp.ones(shape, jnp.float32), jnp.float32(0))


def merged(moments: Moments, values: Array, weight: Array) -> Moments:
    """Returns the moments after ``values`` ``(batch, *shape)`` have been seen; those with ``weight`` 0 have not.

    Values that are not finite, or whose square is not, are as if they had not been seen either.
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
    seen = Moments(moments.mean + share * delta, after, jnp.minimum(total, MOST))
    counts = (n > 0) & jnp.isfinite(seen.mean).all() & jnp.isfinite(seen.variance).all()
    return jax.tree.map(lambda new, before: jnp.where(counts, new, before), seen, moments)


class Statistics(NamedTuple):
    """What has been seen of an environment."""

    obs: tuple[Moments, ...]
    """By group of leaves; see :func:`groups`."""
    returns: Moments
    """Of the discounted sum of rewards, ``float32[]`` each."""


class State(eqx.Module):
    """A learner's state and the statistics that its observations and rewards are scaled by."""

    learner: Any
    statistics: Statistics


def groups(leaves: tuple[Leaf, ...]) -> list[int | None]:
    """Returns for each leaf which moments it is scaled by, None for those that are not scaled.

    The achieved and the desired goal share theirs: hindsight puts the one in the other's place, and their difference must
    keep its meaning.
    """
    found: dict[str, int] = {}
    result: list[int | None] = []
    for leaf in leaves:
        if leaf.kind != "continuous":
            result.append(None)
            continue
        name = "goal" if leaf.path in ("achieved_goal", "desired_goal") else f"leaf {leaf.path}"
        result.append(found.setdefault(name, len(found)))
    return result


def normalised(
    algorithm: Algorithm,
    explorer: Explorer,
    leaves: tuple[Leaf, ...],
    config: NormalizationConfig,
    gamma: float = 1.0,
) -> Algorithm:
    """Returns an algorithm on raw observations and rewards that keeps the statistics in its state.

    Args:
        algorithm: what learns from the scaled ones.
        explorer: how it explores, noise included.
        leaves: those of the observations.
        config: what is scaled.
        gamma: the discount factor of n-step returns, each of whose rewards is clipped by itself.
    """
    group = groups(leaves)
    members: dict[int, Leaf] = {g: leaf for g, leaf in zip(group, leaves, strict=True) if g is not None}

    def scaled(statistics: Statistics, obs: PyTree) -> PyTree:
        if not config.norm_obs:
            return obs
        if isinstance(obs, Masked):
            return Masked(scaled(statistics, obs.obs), obs.mask)
        arrays, tree = jax.tree.flatten(obs)
        return jax.tree.unflatten(
            tree, [x if g is None else standardise(statistics.obs[g], x) for x, g in zip(arrays, group, strict=True)]
        )

    def standardise(moments: Moments, x: Array) -> Array:
        axes = x.ndim - moments.mean.ndim
        mean, variance = (m.reshape(*[1] * axes, *m.shape) for m in (moments.mean, moments.variance))
        known = moments.n_seen > 0
        z = (x.astype(jnp.float32) - mean) * jax.lax.rsqrt(variance + config.epsilon)
        return jnp.where(known, jnp.clip(z, -config.clip_obs, config.clip_obs), x.astype(jnp.float32))

    def reward(statistics: Statistics, r: Array, most: float | Array = config.clip_reward) -> Array:
        if not config.norm_reward:
            return r
        scale = jax.lax.rsqrt(statistics.returns.variance + config.epsilon)
        return jnp.where(statistics.returns.n_seen > 0, jnp.clip(r * scale, -most, most), r)

    def n_step_reward(statistics: Statistics, rewards: Array) -> Array:
        """Returns the sum of ``gamma^i r_i`` ``(batch, n)``, each ``r_i`` scaled and clipped."""
        most = config.clip_reward * gamma ** jnp.arange(rewards.shape[1], dtype=jnp.float32)[None]
        return jnp.sum(reward(statistics, rewards, most), axis=1)

    def seen(statistics: Statistics, obs: PyTree, weight: Array) -> Statistics:
        arrays = jax.tree.leaves(obs.obs if isinstance(obs, Masked) else obs)
        moments = list(statistics.obs)
        for x, g in zip(arrays, group, strict=True):
            if g is not None:
                values = x.reshape(-1, *members[g].shape).astype(jnp.float32)
                moments[g] = merged(moments[g], values, weight)
        return statistics._replace(obs=tuple(moments))

    def init(key: Array) -> State:
        obs = tuple(nothing(members[g].shape) for g in sorted(members))
        return State(algorithm.init(key), Statistics(obs, nothing(())))

    def actor(state: State) -> tuple[PyTree, Statistics]:
        return algorithm.actor(state.learner), state.statistics

    def explore(actor: tuple[PyTree, Statistics], obs: PyTree, key: Array, clock: Clock) -> Array:
        return algorithm.explore(actor[0], scaled(actor[1], obs), key, clock)

    def exploit(actor: tuple[PyTree, Statistics], obs: PyTree) -> Array:
        return algorithm.exploit(actor[0], scaled(actor[1], obs))

    def observe(state: State, obs: PyTree, returns: Array) -> State:
        statistics = seen(state.statistics, obs, jnp.ones(returns.shape, jnp.float32))
        return State(
            state.learner, statistics._replace(returns=merged(statistics.returns, returns, jnp.ones_like(returns)))
        )

    def update(state: State, batch: Any, clock: Clock) -> tuple[State, Metrics]:
        if isinstance(batch, Rollout):
            return learn(state, batch, clock)
        assert isinstance(batch, Transition)
        statistics = state.statistics
        is_sum = batch.rewards is not None
        batch = batch._replace(
            obs=scaled(statistics, batch.obs),
            next_obs=scaled(statistics, batch.next_obs),
            reward=n_step_reward(statistics, batch.rewards) if is_sum else reward(statistics, batch.reward),
            rewards=None,
        )
        learner, metrics = algorithm.update(state.learner, batch, clock)
        return State(learner, statistics), metrics

    def learn(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        weight = rollout.valid.reshape(-1).astype(jnp.float32)
        known = state.statistics
        returns = merged(known.returns, rollout.running_return.reshape(-1), weight)
        after = seen(known._replace(returns=returns), rollout.obs, weight)
        is_first = known.returns.n_seen == 0
        present = jax.tree.map(lambda old, new: jnp.where(is_first, new, old), known._replace(returns=returns), after)
        batch = rollout._replace(
            obs=scaled(present, rollout.obs),
            next_obs=scaled(present, rollout.next_obs),
            reward=reward(present, rollout.reward),
        )
        learner, metrics = algorithm.update(state.learner, batch, clock)
        return State(learner, after), metrics

    def act(
        carry: PyTree, actor: tuple[PyTree, Statistics], obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, PyTree]:
        return explorer.act(carry, actor[0], scaled(actor[1], obs), ended, key, clock)

    def recall(carry: PyTree, actor: tuple[PyTree, Statistics], obs: PyTree, ended: Array) -> tuple[Array, PyTree]:
        assert algorithm.recall is not None
        return algorithm.recall(carry, actor[0], scaled(actor[1], obs), ended)

    def action_values(state: State, obs: PyTree, action: Array | None) -> Array:
        assert algorithm.action_values is not None
        return algorithm.action_values(state.learner, scaled(state.statistics, obs), action)

    def state_value(carry: PyTree, actor: tuple[PyTree, Statistics], obs: PyTree, ended: Array) -> Array:
        assert algorithm.state_value is not None
        return algorithm.state_value(carry, actor[0], scaled(actor[1], obs), ended)

    outer = Explorer(lambda actor, n_envs: explorer.init(actor[0], n_envs), act)
    return Algorithm(
        init,
        actor,
        explore,
        exploit,
        update,
        outer,
        recall=None if algorithm.recall is None else recall,
        action_values=None if algorithm.action_values is None else action_values,
        state_value=None if algorithm.state_value is None else state_value,
        observe=observe,
    )
