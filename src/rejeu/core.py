"""The few types and functions that every algorithm, replay and loop shares.

An algorithm is four pure functions over one explicit state, held in an :class:`Algorithm`; data flows between the
environment and the gradient as a :class:`Transition`. Nothing here knows of any particular algorithm.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import Array

PyTree = Any
Metrics = dict[str, Array]
"""Named scalars of one update, still on the device."""


class Transition(NamedTuple):
    """One step of experience, or a batch of them (every leaf then has a leading batch axis).

    ``next_obs`` is the true successor of ``obs``, also where an episode ended. ``discount`` is 0 where the MDP
    terminated and ``gamma`` (to the power n for n-step returns) elsewhere: a time limit is not a termination, and
    learning code never needs to know about it.
    """

    obs: PyTree
    """Observation, any pytree of arrays ``(batch, ...)``."""
    action: Any
    """Action, ``(batch, action_dim)`` in [-1, 1] for continuous actions, ``(batch,)`` indices for discrete ones."""
    reward: Any
    """Reward, ``(batch,)``, summed and discounted over n steps for n-step returns."""
    next_obs: PyTree
    """The observation that the target bootstraps from, same structure as ``obs``."""
    discount: Any
    """Weight of the bootstrapped value, ``(batch,)`` in [0, 1]."""
    weight: Any = None
    """Importance weights of prioritised replay, ``(batch,)`` in (0, 1]; None where all steps are equally likely."""


class Clock(NamedTuple):
    """Where a run stands; passed to exploration and update so that schedules are pure functions of it."""

    step: Any
    """Environment steps taken so far, over all environments."""
    episode: Any
    """Episodes finished so far, over all environments."""
    progress: Any
    """Fraction of the present ``learn`` call that is done, in [0, 1]."""


class Algorithm(NamedTuple):
    """A learning algorithm as pure functions over its state.

    The state is one pytree whose every leaf is an array; nothing learns outside it.
    """

    init: Callable[[Array], PyTree]
    """``init(key) -> state``."""
    actor: Callable[[PyTree], PyTree]
    """``actor(state)``: the part of the state that choosing an action needs. Small, so cheap to hand to a call."""
    explore: Callable[[PyTree, PyTree, Array, Clock], Array]
    """``explore(actor, obs, key, clock) -> action`` for training, ``(batch, ...)``."""
    exploit: Callable[[PyTree, PyTree], Array]
    """``exploit(actor, obs) -> action``, the deterministic policy, ``(batch, ...)``."""
    update: Callable[[PyTree, Transition, Clock], tuple[PyTree, Metrics]]
    """``update(state, batch, clock) -> (state, metrics)``: one gradient step of everything that learns. The metrics are
    scalars, and under ``TD_ERROR`` the absolute TD errors ``(batch,)`` that prioritised replay goes by."""


TD_ERROR = "td_error"
"""Name among the metrics of an update for the absolute TD error of each transition, ``(batch,)``."""


def descend(
    params: PyTree, gradients: PyTree, optimizer_state: PyTree, optimizer: optax.GradientTransformation, rate: Any
) -> tuple[PyTree, PyTree]:
    """Returns the parameters and optimizer state after one step of ``rate`` against ``gradients``.

    ``optimizer`` is a transformation without a learning rate (``optax.scale_by_adam()``); the rate is multiplied here,
    so that it may be a traced value of a schedule.
    """
    direction, optimizer_state = optimizer.update(gradients, optimizer_state, params)
    params = jax.tree.map(lambda p, d: p - rate * d, params, direction)
    return params, optimizer_state


def weighted_mean(values: Array, weight: Array | None) -> Array:
    """Returns the mean of ``values`` over their last axis, each multiplied by its importance weight if there are any."""
    return jnp.mean(values if weight is None else values * jnp.broadcast_to(weight, values.shape), axis=-1)


def polyak(target: PyTree, online: PyTree, tau: Any) -> PyTree:
    """Returns ``(1 - tau) * target + tau * online``, leaf by leaf."""
    return jax.tree.map(lambda t, o: t + tau * (o - t), target, online)


def ensemble(init: Callable[[Array], PyTree], key: Array, size: int) -> PyTree:
    """Returns ``size`` independent initialisations stacked along a leading axis."""
    return jax.vmap(init)(jax.random.split(key, size))


def copy(tree: PyTree) -> PyTree:
    """Returns ``tree`` in buffers of its own: a target network must not share what is donated with the online one."""
    return jax.tree.map(jnp.copy, tree)
