"""An algorithm's functions as the loops call them: compiled once, over a packed state.

A state crosses the border between Python and XLA many times a second. Packed into a few vectors (see
:mod:`rejeu.loops.packing`) it does so several times faster than as a tree of modules, and so do batches.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu import xla
from rejeu.core import TD_ERROR, Algorithm, Clock, Explorer, Metrics, PyTree, Rollout, Transition, copy as copied
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise
from rejeu.io.checkpoint import names
from rejeu.loops import finite
from rejeu.loops.packing import HostPacker, Message, Packing, Readings
from rejeu.prng import nth

PackedState = list[Array]
"""The state of an algorithm as the vectors of its :class:`Packing`."""


class Learner:
    """The pure functions of one algorithm, compiled; holds no state of its own."""

    def __init__(self, algorithm: Algorithm, noise: Noise | None, skips: bool = False) -> None:
        self.algorithm = algorithm
        self.skips = skips
        """Whether an update that leaves numbers that are not finite is undone."""
        self.shapes = jax.eval_shape(algorithm.init, jax.ShapeDtypeStruct((2,), jnp.uint32))
        """The state, of shapes in place of arrays."""
        self._packing = packing = Packing(self.shapes)
        averaged = {i for i, name in enumerate(names(self.shapes)) if finite.is_averaged(name)}
        passed_over = averaged if skips else {*packing.large}
        """Large leaves that no update looks at; where none is skipped, the next one finds what broke there by its loss."""
        self._act_packer, self._exploit_packer, self._update_packer = HostPacker(), HostPacker(), HostPacker()
        self._recall_packer, self._observe_packer = HostPacker(), HostPacker()
        self._explorer = explorer = exploration.make(algorithm, noise)
        pack, unpack = xla.one_kernel(packing.pack), xla.one_kernel(packing.unpack)

        @xla.run_once
        def init(key: Array) -> PackedState:
            return packing.pack(algorithm.init(key))

        def acting(explorer: Explorer) -> Any:
            @partial(jax.jit, static_argnums=4)
            def act(
                state: PackedState, carry: PyTree, key: Array, vectors: list[Array], plan: Message
            ) -> tuple[Array, PyTree]:
                obs, ended, clock = plan.unpack(vectors)
                actor = algorithm.actor(packing.unpack(state))
                return explorer.act(carry, actor, obs, ended, nth(key, clock.step), clock)

            return act

        @partial(jax.jit, static_argnums=2)
        def exploit(state: PackedState, vectors: list[Array], plan: Message) -> Array:
            return algorithm.exploit(algorithm.actor(packing.unpack(state)), plan.unpack(vectors))

        @partial(jax.jit, static_argnums=3)
        def recall(state: PackedState, carry: PyTree, vectors: list[Array], plan: Message) -> tuple[Array, PyTree]:
            assert algorithm.recall is not None
            obs, ended = plan.unpack(vectors)
            return algorithm.recall(carry, algorithm.actor(packing.unpack(state)), obs, ended)

        @partial(jax.jit, donate_argnums=0, static_argnums=2)
        def observe(state: PackedState, vectors: list[Array], plan: Message) -> PackedState:
            assert algorithm.observe is not None
            return packing.pack(algorithm.observe(packing.unpack(state), *plan.unpack(vectors)))

        @jax.jit
        def action_values(state: PackedState, obs: PyTree, action: Array | None) -> Array:
            assert algorithm.action_values is not None
            return algorithm.action_values(packing.unpack(state), obs, action)

        @jax.jit
        def state_value(state: PackedState, carry: PyTree, obs: PyTree, ended: Array) -> Array:
            assert algorithm.state_value is not None
            return algorithm.state_value(carry, algorithm.actor(packing.unpack(state)), obs, ended)

        def is_sound(after: PackedState, metrics: Metrics) -> Array:
            return finite.all_finite(packing.without(after, passed_over), metrics)

        def learnt(state: PackedState, batch: Transition | Rollout, clock: Clock) -> tuple[PackedState, Metrics, Array]:
            after, metrics = algorithm.update(unpack(state), batch, clock)
            # Without the barrier XLA would compute the whole step of the optimizer once more for the check.
            packed = jax.lax.optimization_barrier(pack(after))
            sound = is_sound(packed, metrics)
            return packed, metrics, sound

        def learnt_or_skipped(state: PackedState, batch: Transition | Rollout, clock: Clock) -> tuple[Any, Any]:
            after, metrics, sound = learnt(state, batch, clock)
            if TD_ERROR in metrics:  # NaN leaves the priorities as they are
                metrics[TD_ERROR] = jnp.where(sound, metrics[TD_ERROR], jnp.nan)
            return [jnp.where(sound, new, old) for new, old in zip(after, state, strict=True)], (metrics, sound)

        @partial(jax.jit, donate_argnums=0, static_argnums=2)
        def update(
            state: PackedState, vectors: list[Array], plan: Message
        ) -> tuple[PackedState, Readings, Array | None]:
            batches, clock = xla.one_kernel(plan.unpack)(vectors)
            is_one = isinstance(batches, Rollout) or batches.reward.ndim == 1
            if skips and is_one:
                packed, (metrics, sound) = learnt_or_skipped(state, batches, clock)
            elif skips:
                packed, (metrics, sound) = jax.lax.scan(lambda s, one: learnt_or_skipped(s, one, clock), state, batches)
            elif is_one:
                packed, metrics, sound = learnt(state, batches, clock)
            else:
                after, metrics = jax.lax.scan(
                    lambda s, batch: algorithm.update(s, batch, clock), packing.unpack(state), batches
                )
                packed = jax.lax.optimization_barrier(packing.pack(after))
                sound = is_sound(packed, metrics)  # what is broken stays so
            td_error = metrics.pop(TD_ERROR, None)
            wanted = isinstance(batches, Transition) and batches.weight is not None
            if skips and not is_one:
                means = {name: jnp.mean(value, where=sound) for name, value in metrics.items()}
            else:
                means = jax.tree.map(jnp.mean, metrics)
            return packed, Readings.of(means, jnp.sum(~sound)), td_error if wanted else None

        self.init = init
        """``init(key) -> state``, packed."""
        self.copy = jax.jit(copied)
        """``copy(packed) -> packed`` in buffers of its own."""
        self.observe = None if algorithm.observe is None else self._observe_packed
        """``observe(state, obs, running_return) -> state``, packed, whose predecessor is donated; None where the algorithm
        has no use for it (see :class:`rejeu.core.Algorithm`)."""
        self.action_values, self.state_value = action_values, state_value
        """``action_values(state, obs, action)`` and ``state_value(state, carry, obs, ended)`` over a packed state; see
        :class:`rejeu.core.Algorithm`."""
        self._exploit, self._recall, self._observe, self._update = exploit, recall, observe, update
        self._act = self._sample = acting(explorer)
        if algorithm.recall is None and (noise is not None or algorithm.explorer is not None):
            self._sample = acting(exploration.plain(algorithm))

    def act(
        self, state: PackedState, carry: PyTree, obs: PyTree, ended: Any, key: Array, clock: Clock
    ) -> tuple[Array, PyTree]:
        """Returns actions for ``obs`` ``(n_envs, ...)``, exploring, noise included, and the carry of exploration.

        ``ended``, ``bool (n_envs,)``, is where an episode has just begun.
        """
        return self._act(state, carry, key, *self._act_packer((obs, ended, clock), len(ended)))

    def sample(
        self, state: PackedState, memory: PyTree, obs: PyTree, ended: Any, key: Array, clock: Clock
    ) -> tuple[Array, PyTree]:
        """Returns actions drawn from the policy for ``obs`` ``(batch, ...)``, without any noise, and its memory after them.

        ``memory`` is ``()`` for a policy without one; ``ended`` is as for :meth:`act`.
        """
        return self._sample(state, memory, key, *self._act_packer((obs, ended, clock), len(ended)))

    def recall(self, state: PackedState, carry: PyTree, obs: PyTree, ended: Any) -> tuple[Array, PyTree]:
        """Returns the deterministic actions of a policy with a memory, and the memory after ``obs`` ``(batch, ...)``."""
        return self._recall(state, carry, *self._recall_packer((obs, ended), len(ended)))

    def _observe_packed(self, state: PackedState, obs: PyTree, running_return: Any) -> PackedState:
        return self._observe(state, *self._observe_packer((obs, running_return), len(running_return)))

    def exploit(self, state: PackedState, obs: PyTree) -> Array:
        """Returns the deterministic actions for ``obs`` ``(batch, ...)``."""
        return self._exploit(state, *self._exploit_packer(obs, len(jax.tree.leaves(obs)[0])))

    def update(
        self, state: PackedState, batches: Transition | Rollout, clock: Clock
    ) -> tuple[PackedState, Readings, Array | None]:
        """Takes a gradient step on a batch, or one on each of several in one scan, or learns a rollout.

        ``batches`` has leaves ``(batch, ...)`` or ``(steps, batch, ...)``. Returns the packed state, whose predecessor is
        donated, the metrics, means over the steps, and the absolute TD errors, shaped as the rewards are, which are None
        unless the batches are weighted.
        """
        weighted = isinstance(batches, Transition) and batches.weight is not None
        return self._update(state, *self._update_packer((batches, clock), (batches.reward.shape, weighted)))

    def state(self, packed: PackedState) -> PyTree:
        """Returns a packed state as the algorithm's own class, in buffers of its own; waits for it.

        This and :meth:`pack` are done on the host: they are called seldom, and compiling them took longer.
        """
        return jax.tree.map(jnp.array, self._packing.unpack([np.asarray(array) for array in packed]))

    def pack(self, state: PyTree) -> PackedState:
        """Returns a state packed, in buffers of its own: the inverse of :meth:`state`."""
        return [jnp.array(a) for a in self._packing.pack_leaves([np.asarray(leaf) for leaf in jax.tree.leaves(state)])]

    def bad_leaves(self, state: PackedState) -> list[str]:
        """Returns the names of the leaves of a state that hold a number that is not finite; waits for it."""
        arrays = [np.asarray(array) for array in state]
        if all(array.dtype.kind != "f" or np.isfinite(array).all() for array in arrays):
            return []
        return finite.bad_leaves(self._packing.unpack(arrays))

    def initial_carry(self, n_envs: int) -> PyTree:
        """Returns the carry of the exploration of ``n_envs`` environments before their first episodes."""
        return self._explorer.init(self.algorithm.actor(self.shapes), n_envs)
