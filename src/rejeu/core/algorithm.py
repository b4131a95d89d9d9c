"""The types and functions that every algorithm, buffer and loop shares.

An algorithm is a NamedTuple of pure functions over one explicit state (:class:`Algorithm`). Experience reaches it as a
:class:`Transition` or a :class:`Rollout`. Nothing here depends on a particular algorithm.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import optax
from jax import Array

from rejeu.core.types import Action, AnyArray, PyTree, Scalar
from rejeu.core.xla import one_kernel, outlined

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
    action: Action
    """Action, ``(batch, action_dim)`` in [-1, 1] for continuous actions, ``(batch,)`` indices for discrete ones."""
    reward: AnyArray
    """Reward, ``(batch,)``, summed and discounted over n steps for n-step returns."""
    next_obs: PyTree
    """The observation that the target bootstraps from, same structure as ``obs``."""
    discount: AnyArray
    """Weight of the bootstrapped value, ``(batch,)`` in [0, 1]."""
    weight: PyTree = None
    """Importance weights of prioritized replay, ``(batch,)`` in (0, 1]; None where all steps are equally likely."""
    rewards: AnyArray = None
    """The discounted rewards that ``reward`` is the sum of, ``(batch, n)``, where normalization clips each; None
    elsewhere. Algorithms do not see them."""
    next_action: Action = None
    """The action that was taken at ``next_obs``, as ``action``, NaN where there was none; None unless the algorithm's
    configuration has ``needs_next_action``."""


class Masked(NamedTuple):
    """An observation together with which actions are allowed."""

    obs: PyTree
    """The observation itself."""
    mask: AnyArray
    """Whether each choice is allowed, ``bool (batch, n)``: n is the number of actions of a Discrete space, the sum of the
    numbers of a MultiDiscrete one, and of MultiBinary the bits that may be 1."""


def unmasked(obs: PyTree) -> tuple[PyTree, AnyArray]:
    """Returns observations and their mask, None where they have none."""
    return (obs.obs, obs.mask) if isinstance(obs, Masked) else (obs, None)


def some_allowed(obs: PyTree) -> PyTree:
    """Returns observations whose masks allow all actions where they allowed none, as after the end of an episode."""
    if not isinstance(obs, Masked):
        return obs
    return Masked(obs.obs, obs.mask | ~obs.mask.any(axis=-1, keepdims=True))


class Remembered(NamedTuple):
    """The memory that networks keep of the observations up to the present one, in place of it."""

    memory: PyTree
    """``(batch, n_numbers)``, of all networks of an algorithm."""


class Sequences(NamedTuple):
    """The observations of a batch of :class:`Transition`, for networks with memory: in successive rows of replay.

    In place of ``(batch, ...)`` the leaves are ``(n, rows, ...)``. Of each of the n sequences some rows are read, and the
    observations of the batch are those, sequence after sequence.
    """

    obs: PyTree
    """Observations in the order in which they were made, ``(n, rows, ...)``; also final ones, without a step."""
    begins: AnyArray
    """Where an episode begins with a row, ``bool (n, rows)``."""
    n_absent: AnyArray
    """How many of the first rows were no longer there and stand for nothing, ``int32 (n,)``."""
    memory: PyTree
    """The memory before the first row that is there, ``(n, n_numbers)``."""
    reads: AnyArray
    """Which rows are read, ``int32 (n, n_reads)``."""


def rows_read(obs: PyTree) -> PyTree:
    """Returns the observations of a batch, ``(batch, ...)``: of :class:`Sequences` the rows that are read."""
    if not isinstance(unmasked(obs)[0], Sequences):
        return obs
    rows, _, _, _, reads = unmasked(obs)[0]

    def read(x: Array) -> Array:
        index = reads.reshape(*reads.shape, *[1] * (x.ndim - 2))
        return jnp.take_along_axis(x, index, axis=1).reshape(-1, *x.shape[2:])

    return jax.tree.map(read, rows)


class Rollout(NamedTuple):
    """The steps that all environments took under one policy; leaves are ``(steps, n_envs, ...)`` where not said."""

    obs: PyTree
    """Observations, as of :class:`Transition`."""
    action: Action
    """Actions as they were drawn: of continuous ones, not clipped."""
    reward: AnyArray
    """Rewards, ``(steps, n_envs)``."""
    next_obs: PyTree
    """True successors of ``obs``, also where an episode ended."""
    discount: AnyArray
    """0 where the MDP terminated, gamma elsewhere, ``(steps, n_envs)``."""
    ended: AnyArray
    """Where an episode ended, by terminal state or time limit, ``bool (steps, n_envs)``: the step after it belongs to
    another."""
    valid: AnyArray
    """Which steps there are, ``bool (steps, n_envs)``; the others are padding. Padding follows what is valid."""
    running_return: AnyArray
    """The discounted sum of the rewards of the episode so far, ``sum_k gamma^k r_{t-k}``, ``(steps, n_envs)``."""
    started: AnyArray
    """Where an episode began with the first step, ``bool (n_envs,)``."""
    carry: PyTree
    """The memory of a policy before the first step, leaves ``(n_envs, ...)``; ``()`` without memory."""


class Clock(NamedTuple):
    """Where a run stands; passed to exploration and update so that schedules are pure functions of it."""

    step: Scalar
    """Environment steps taken so far, over all environments."""
    episode: Scalar
    """Episodes finished so far, over all environments."""
    progress: Scalar
    """How far schedules are, in [0, 1]: the fraction that is done of the present ``learn`` call and those it continues."""
    n_envs: Scalar = 1
    """Environments that step at once, by which ``step`` grows."""


class Explorer(NamedTuple):
    """How training actions are chosen that depend on a *carry*: a small pytree that travels from step to step.

    Its leaves have a leading axis of environments, or are shared by all; it is renewed where an episode begins.
    """

    init: Callable[[PyTree, int], PyTree]
    """``init(actor, n_envs) -> carry``; of ``actor`` only the shapes are used."""
    act: Callable[[PyTree, PyTree, PyTree, Array, Array, Clock], tuple[Array, PyTree]]
    """``act(carry, actor, obs, ended, key, clock) -> (action, carry)``; ``ended``, ``bool (n_envs,)``, is where an
    episode has just begun."""


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
    update: Callable[[PyTree, PyTree, Clock], tuple[PyTree, Metrics]]
    """``update(state, batch, clock) -> (state, metrics)``: one gradient step of everything that learns on a batch of
    :class:`Transition`, or for on-policy algorithms all the steps that one :class:`Rollout` is good for. The metrics are
    scalars, and under ``TD_ERROR`` the absolute TD errors ``(batch,)`` that prioritized replay goes by."""
    explorer: Explorer | None = None
    """How training actions are chosen where that takes more than ``explore``; its carry is the policy's memory if it has
    one. None where ``explore`` is all."""
    recall: Callable[[PyTree, PyTree, PyTree, Array], tuple[Array, PyTree]] | None = None
    """``recall(carry, actor, obs, ended) -> (action, carry)``: the deterministic policy where it has a memory, with the
    carry of ``explorer``. None where the present observation is all that it needs."""
    action_values: Callable[[PyTree, PyTree, Action], Array] | None = None
    """``action_values(state, obs, action)``: the critics' values of actions ``(batch, action_dim)`` in [-1, 1],
    ``(n_critics, batch)``; for Discrete actions the values of all of them, ``(n_critics, batch, n_actions)``, and
    ``action`` is None. None for algorithms without such critics."""
    state_value: Callable[[PyTree, PyTree, PyTree, Array], Array] | None = None
    """``state_value(carry, actor, obs, ended) -> (batch,)``: the critic's values of observations, with the carry of
    ``explorer`` where the policy has a memory and ``()`` elsewhere. None for algorithms without such a critic."""
    imitation: Callable[[PyTree, PyTree, Action], Array] | None = None
    """``imitation(actor, obs, action) -> (batch,)``: the loss of an actor for actions that were demonstrated. None: the
    squared error of ``exploit``, for continuous actions."""
    observe: Callable[[PyTree, PyTree, Array], PyTree] | None = None
    """``observe(state, obs, running_return) -> state``: adds observations ``(batch, ...)`` and discounted sums of
    rewards ``(batch,)`` to running statistics. None where the state needs no more than ``update``."""


TD_ERROR = "td_error"
"""Name among the metrics of an update for the absolute TD error of each transition, ``(batch,)``."""
GRADIENT_STEPS = "gradient_steps"
"""Name among the metrics of an update from a rollout for the number of gradient steps that it took; 1 without it."""
EXPLAINED_VARIANCE = "explained_variance"
"""Name among the metrics for the explained variance of the value. It may be NaN; all other metrics must be finite."""


AVERAGED = {"averaged": True}
"""Metadata of a field of a state that only averages other fields, such as a target network::

    class State(eqx.Module):
        critics: QNetwork
        target_critics: QNetwork = eqx.field(metadata=AVERAGED)

An agent's summary leaves such fields out."""


def value_and_grad(loss: Callable[..., PyTree], has_aux: bool = False) -> Callable[..., tuple[PyTree, PyTree]]:
    """Returns ``jax.value_and_grad(loss, has_aux=has_aux)``, in a form that XLA runs faster on a CPU."""
    return outlined(jax.value_and_grad(loss, has_aux=has_aux))


def without_gradient(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """Returns ``function`` with outputs that are not differentiated, in a form that XLA runs faster on a CPU."""

    @functools.wraps(function)
    def stopped(*arguments: object) -> PyTree:
        return jax.lax.stop_gradient(function(*arguments))

    return outlined(stopped)


class Elementwise(optax.GradientTransformation):
    """An optimizer that treats every number of the gradients by itself, which XLA compiles into one kernel on a CPU."""


class Clipped(NamedTuple):
    """An optimizer whose gradients are limited by :func:`clip` first."""

    optimizer: optax.GradientTransformation
    max_value: float | None
    max_norm: float | None

    def init(self, params: PyTree) -> PyTree:
        """Returns the initial state of the optimizer."""
        return self.optimizer.init(params)


Optimizer: TypeAlias = optax.GradientTransformation | Clipped
"""A transformation from gradients to directions, without a learning rate."""


def descend(
    params: PyTree, gradients: PyTree, optimizer_state: PyTree, optimizer: Optimizer, rate: Scalar
) -> tuple[PyTree, PyTree]:
    """Returns the parameters and the optimizer state after one step of ``rate`` against ``gradients``.

    Args:
        params: what is learned.
        gradients: of a loss with respect to ``params``.
        optimizer_state: of ``optimizer``.
        optimizer: what :func:`rejeu.algorithms.optimizers.make` returned, or another transformation without a learning
            rate, such as ``optax.scale_by_adam()``.
        rate: the learning rate, which may be a traced value of a schedule; or one for each part of ``params``, as a
            pytree that is a prefix of it.
    """
    if isinstance(optimizer, Clipped):
        gradients, optimizer = clip(gradients, optimizer.max_value, optimizer.max_norm), optimizer.optimizer
    step = one_kernel(_descend) if isinstance(optimizer, Elementwise) else _descend
    return step(params, gradients, optimizer_state, optimizer, rate)


def _descend(
    params: PyTree, gradients: PyTree, optimizer_state: PyTree, optimizer: optax.GradientTransformation, rate: Scalar
) -> tuple[PyTree, PyTree]:
    direction, optimizer_state = optimizer.update(gradients, optimizer_state, params)
    step = lambda rate, weights, d: jax.tree.map(lambda p, d: p - rate * d, weights, d)  # noqa: E731
    return jax.tree.map(step, rate, params, direction), optimizer_state


def minimize(
    loss: Callable[..., tuple[Array, PyTree]],
    params: PyTree,
    optimizer_state: PyTree,
    optimizer: Optimizer,
    rate: Scalar,
    *arguments: object,
) -> tuple[PyTree, PyTree, Array, PyTree]:
    """Takes one gradient step on ``loss(params, *arguments)``, which returns a value and something else.

    Returns the parameters and the optimizer state after the step, the loss, and the other value that ``loss`` returned.
    """
    (value, extra), gradients = value_and_grad(loss, has_aux=True)(params, *arguments)
    params, optimizer_state = descend(params, gradients, optimizer_state, optimizer, rate)
    return params, optimizer_state, value, extra


def clip(gradients: PyTree, max_value: float | None, max_norm: float | None) -> PyTree:
    """Returns gradients with every component within ``max_value`` of 0, then scaled to a norm of at most ``max_norm``.

    None stands for no limit.
    """
    if max_value is not None:
        gradients, _ = optax.clip(max_value).update(gradients, optax.EmptyState())
    if max_norm is not None:
        gradients, _ = optax.clip_by_global_norm(max_norm).update(gradients, optax.EmptyState())
    return gradients


def weighted_mean(values: Array, weight: Array | None) -> Array:
    """Returns the mean of ``values`` over their last axis, each multiplied by its importance weight if there are any."""
    return jnp.mean(values if weight is None else values * jnp.broadcast_to(weight, values.shape), axis=-1)


@one_kernel
def polyak(target: PyTree, online: PyTree, tau: Scalar) -> PyTree:
    """Returns ``tau * online + (1 - tau) * target``, leaf by leaf."""
    return optax.incremental_update(online, target, tau)


def tau_at(n_updates: Array, tau: float, interval: int) -> Scalar:
    """Returns ``tau`` at every ``interval``-th update and 0 at the others, at which :func:`polyak` keeps the targets.

    >>> [float(tau_at(jnp.int32(n), 0.5, 3)) for n in (1, 2, 3, 4)]
    [0.0, 0.0, 0.5, 0.0]
    """
    return tau if interval == 1 else jnp.where(n_updates % interval == 0, tau, 0.0)


def averaged_fields(state_class: type) -> set[str]:
    """Returns the names of the fields of a class of states that are declared :data:`AVERAGED`."""
    return {field.name for field in dataclasses.fields(state_class) if field.metadata.get("averaged", False)}


def ensemble(init: Callable[[Array], PyTree], key: Array, size: int) -> PyTree:
    """Returns ``size`` independent initializations stacked along a leading axis."""
    return jax.vmap(init)(jax.random.split(key, size))


def copy(tree: PyTree) -> PyTree:
    """Returns ``tree`` in buffers of its own: a target network must not share what is donated with the online one."""
    return jax.tree.map(jnp.copy, tree)


def renew(ended: Array, fresh: PyTree, carry: PyTree) -> PyTree:
    """Returns ``carry`` with the environments where ``ended`` taken from ``fresh``."""
    return jax.tree.map(lambda f, c: jnp.where(ended.reshape(-1, *[1] * (c.ndim - 1)), f, c), fresh, carry)


def names(tree: PyTree) -> list[str]:
    """Returns the dotted path of each leaf of a tree, such as ``actor.torso.layers.0.weight``."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(tree)]
    return [jax.tree_util.keystr(path, simple=True, separator=".") for path in paths]
