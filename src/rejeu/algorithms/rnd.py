"""Random network distillation: a bonus for observations that are unlike those seen before, for any algorithm.

Source: Burda et al. 2018, "Exploration by Random Network Distillation" (arXiv 1810.12894). A predictor ``f`` learns the
outputs of a network ``g`` whose random weights never change; its error is large where it has learned little::

    e(s') = mean_k (f_k(x) - g_k(x))^2,        x = clip((s' - mean) / std, -5, 5)
    r    <- r + coefficient e(s') / sigma_e,   sigma_e: running standard deviation of e; at most 10 of these
    J_f   = mean e(s')

:func:`with_rnd` transforms an algorithm: it adds the bonus to the rewards of each batch or rollout, which the algorithm then
learns from, and trains the predictor on the same observations, in minibatches, after the bonus is computed. Unlike in the
paper, the bonus is scaled by its own deviation instead of that of its discounted sum, there is one value for both rewards,
and the bonus ends with the episode as rewards do. Images are not standardized. The bonus of n-step returns is that of the
last observation.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.actor_critic.steps import flat, masked_mean, minibatches
from rejeu.algorithms.config import RndConfig
from rejeu.core.algorithm import Algorithm, Clock, Metrics, PyTree, Rollout, minimize, rows_read
from rejeu.core.normalization import NormalizationConfig, Statistics, merged, normalizer_of
from rejeu.core.prng import nth
from rejeu.core.spaces import Leaf
from rejeu.networks import Network, PolicyConfig

HIDDEN_LAYERS = (128, 128)
"""Widths of both networks."""
SCALES = NormalizationConfig(clip_obs=5.0)
"""How observations and errors are scaled."""
OPTIMIZER = optimizers.make("adam")


class State(eqx.Module):
    """The state of an algorithm, and that of its bonus."""

    learner: PyTree
    predictor: Network
    target: Network
    """Its weights never change."""
    optimizer: PyTree
    moments: Statistics
    """Of the observations, and of the errors in the place of returns."""
    key: Array
    """Root of the orders of the minibatches, ``uint32[2]``; never changes."""
    n_updates: Array
    """Batches learned from, ``int32[]``."""


class Seen(NamedTuple):
    """Observations that the predictor learns from, leaves ``(batch, ...)``."""

    obs: PyTree
    valid: Array
    """Whether they exist, ``bool``."""


def with_rnd(algorithm: Algorithm, obs_leaves: tuple[Leaf, ...], config: RndConfig) -> Algorithm:
    """Returns an algorithm that learns from its rewards and the bonus."""
    normalizer = normalizer_of(obs_leaves, SCALES)

    def init(key: Array) -> State:
        keys = [jax.random.fold_in(key, i) for i in (1, 2, 3)]
        settings = obs_leaves, config.n_features, HIDDEN_LAYERS, PolicyConfig()
        predictor, target = (Network(key, *settings) for key in keys[:2])
        optimizer = OPTIMIZER.init(predictor)
        return State(algorithm.init(key), predictor, target, optimizer, normalizer.init(), keys[2], jnp.int32(0))

    def update(state: State, batch: PyTree, clock: Clock) -> tuple[State, Metrics]:
        next_obs, valid = rows_read(batch.next_obs), jnp.ones_like(batch.reward, bool)
        if isinstance(batch, Rollout):
            next_obs, valid = flat(next_obs), batch.valid.reshape(-1)
        weight = valid.astype(jnp.float32)
        moments = normalizer.with_obs(state.moments, next_obs, weight)
        observed = Seen(normalizer.obs(moments, next_obs), valid)
        error = errors(state.predictor, state.target, observed.obs)
        moments = moments._replace(returns=merged(moments.returns, error, weight))
        bonus = config.coefficient * normalizer.reward(moments, error)
        reward = batch.reward + jnp.where(valid, bonus, 0.0).reshape(batch.reward.shape)
        learner, metrics = algorithm.update(state.learner, batch._replace(reward=reward), clock)
        order_key = nth(state.key, state.n_updates)
        predictor, optimizer = trained(state.predictor, state.target, state.optimizer, observed, order_key, config)
        state = State(learner, predictor, state.target, optimizer, moments, state.key, state.n_updates + 1)
        mean = {"rnd_bonus": masked_mean(bonus, valid), "rnd_loss": masked_mean(error, valid)}
        return state, {**metrics, **mean}

    observe, action_values = algorithm.observe, algorithm.action_values
    return algorithm._replace(
        init=init,
        actor=lambda state: algorithm.actor(state.learner),
        update=update,
        action_values=action_values and (lambda state, obs, action: action_values(state.learner, obs, action)),
        observe=observe
        and (
            lambda state, *observations: eqx.tree_at(lambda s: s.learner, state, observe(state.learner, *observations))
        ),
    )


def errors(predictor: Network, target: Network, obs: PyTree) -> Array:
    """Returns the mean squared error of each prediction, ``(batch,)``."""
    return jnp.mean(jnp.square(predictor(obs) - jax.lax.stop_gradient(target(obs))), axis=-1)


def loss(predictor: Network, target: Network, observed: Seen) -> tuple[Array, None]:
    """Returns the mean error of a minibatch."""
    return masked_mean(errors(predictor, target, observed.obs), observed.valid), None


def trained(
    predictor: Network, target: Network, optimizer_state: PyTree, observed: Seen, key: Array, config: RndConfig
) -> tuple[Network, PyTree]:
    """Returns predictor and optimizer state after a gradient step on each minibatch."""
    minibatch, n = minibatches(observed, key, 1, config.batch_size)

    def step(i: Array, learned: tuple[Network, PyTree]) -> tuple[Network, PyTree]:
        return minimize(loss, *learned, OPTIMIZER, config.learning_rate, target, minibatch(i))[:2]

    return jax.lax.fori_loop(0, n, step, (predictor, optimizer_state))
