"""An algorithm's functions as the loops call them: compiled once, over the flat leaves of the state.

A state crosses the border between Python and XLA many times a second. As a list of arrays it does so several times faster
than as a tree of modules, and choosing an action takes only the leaves that the actor needs.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core import TD_ERROR, Algorithm, Clock, Metrics, PyTree, Transition
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise


class Compiled:
    """The pure functions of one algorithm, compiled; holds no state of its own."""

    def __init__(self, algorithm: Algorithm, noise: Noise | None) -> None:
        self.algorithm = algorithm
        shapes = jax.eval_shape(algorithm.init, jax.random.PRNGKey(0))
        n_leaves = len(jax.tree.leaves(shapes))
        self.structure = jax.tree.structure(shapes)
        self.shapes = shapes
        actor = algorithm.actor(jax.tree.unflatten(self.structure, range(n_leaves)))
        actor_structure = jax.tree.structure(actor)
        self._actor_positions: list[int] = jax.tree.leaves(actor)
        self._explorer = explorer = exploration.make(algorithm, noise)

        @jax.jit
        def init(key: Array) -> list[Array]:
            return jax.tree.leaves(algorithm.init(key))

        @jax.jit
        def act(
            actor_leaves: list[Array], carry: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock
        ) -> tuple[Array, PyTree]:
            actor = jax.tree.unflatten(actor_structure, actor_leaves)
            return explorer.act(carry, actor, obs, ended, jax.random.fold_in(key, clock.step), clock)

        @jax.jit
        def exploit(actor_leaves: list[Array], obs: PyTree) -> Array:
            return algorithm.exploit(jax.tree.unflatten(actor_structure, actor_leaves), obs)

        @partial(jax.jit, donate_argnums=0)
        def update(leaves: list[Array], batches: Transition, clock: Clock) -> tuple[list[Array], Metrics, Array | None]:
            state = jax.tree.unflatten(self.structure, leaves)
            state, metrics = jax.lax.scan(lambda s, batch: algorithm.update(s, batch, clock), state, batches)
            td_error = metrics.pop(TD_ERROR, None)
            return (
                jax.tree.leaves(state),
                jax.tree.map(jnp.mean, metrics),
                None if batches.weight is None else td_error,
            )

        self.copy = jax.jit(lambda leaves: jax.tree.map(jnp.copy, leaves))
        """``copy(leaves) -> leaves`` in buffers of their own."""
        self.init = init
        """``init(key) -> leaves``."""
        self.act = act
        """``act(actor_leaves, carry, obs, ended, key, clock) -> (action, carry)``, exploring, noise included."""
        self.exploit = exploit
        """``exploit(actor_leaves, obs) -> action``."""
        self.update = update
        """``update(leaves, batches, clock) -> (leaves, metrics, td_error)``: one gradient step for each entry of the
        leading axis of ``batches``, in one scan. ``leaves`` are donated; metrics are means over the steps; the absolute
        TD errors ``(steps, batch)`` are None unless the batches are weighted."""

    def initial_carry(self, n_envs: int) -> PyTree:
        """Returns the carry of the exploration of ``n_envs`` environments before their first episodes."""
        return self._explorer.init(self.algorithm.actor(self.shapes), n_envs)

    def actor_leaves(self, leaves: list[Array]) -> list[Array]:
        """Returns the leaves of the state that choosing an action needs."""
        return [leaves[i] for i in self._actor_positions]

    def state(self, leaves: list[Any]) -> PyTree:
        """Returns the state as the algorithm's own class."""
        return jax.tree.unflatten(self.structure, leaves)
