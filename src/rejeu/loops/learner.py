"""The compiled functions of an algorithm that loops and agents call, such as ``act`` and ``update``."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu import xla
from rejeu.algorithms.contract import check_state
from rejeu.core import TD_ERROR, Algorithm, Clock, Explorer, Metrics, PyTree, Rollout, Transition, copy
from rejeu.exploration import explorer as exploration
from rejeu.exploration.noise import Noise
from rejeu.loops import nonfinite
from rejeu.loops.packing import PackedState, Packing, Readings
from rejeu.prng import nth

NO_TD_ERROR = (
    "prioritized replay needs the absolute TD error of each transition: return it from update among the metrics, as TD_ERROR "
    "of shape (batch,); it returned {}"
)


class Learner:
    """The pure functions of an algorithm, compiled. Holds no state: every function takes it, packed into a few vectors.

    ``act`` is ``_act`` compiled by ``jax.jit``, and so on.
    """

    def __init__(self, algorithm: Algorithm, noise: Noise | None, skips: bool = False) -> None:
        """Takes an algorithm and the action noise of training; ``skips`` undoes updates that leave NaN or infinity."""
        self.algorithm, self.skips = algorithm, skips
        self.explorer = exploration.make(algorithm, noise)
        self.shapes = jax.eval_shape(algorithm.init, jax.ShapeDtypeStruct((2,), jnp.uint32))
        """The unpacked state, with shapes in place of arrays."""
        self.packing = Packing(self.shapes)
        self.init = xla.run_once(self._init)
        self.act = self.sample = jax.jit(partial(self._act, self.explorer))
        if algorithm.recall is None and (noise is not None or algorithm.explorer is not None):
            self.sample = jax.jit(partial(self._act, exploration.plain(algorithm)))
        self.update = jax.jit(self._update, donate_argnums=0)
        self.observe = None if algorithm.observe is None else jax.jit(self._observe, donate_argnums=0)
        self.exploit, self.recall = jax.jit(self._exploit), jax.jit(self._recall)
        self.action_values, self.state_value = jax.jit(self._action_values), jax.jit(self._state_value)
        self.copy = jax.jit(copy)
        self.programs: dict[Any, Any] = {}
        """Compiled programs of training on the device, by what they are compiled for."""

    def _act(
        self, explorer: Explorer, state: PackedState, carry: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, PyTree]:
        """Returns actions drawn for ``obs`` ``(n_envs, ...)``, and the carry of exploration after them.

        ``ended``, ``bool (n_envs,)``, is where an episode has just begun. ``act`` draws with the noise of training, and
        ``sample`` without it.
        """
        actor = self.algorithm.actor(self.packing.unpack(state))
        return explorer.act(carry, actor, obs, ended, nth(key, clock.step), clock)

    def _update(
        self, state: PackedState, batches: Transition | Rollout, clock: Clock
    ) -> tuple[PackedState, Readings, Array | None]:
        """Takes a gradient step on a batch, or one on each of several in a scan, or learns from a rollout.

        Args:
            state: donated.
            batches: leaves ``(batch, ...)`` or ``(steps, batch, ...)``.
            clock: where the run is.

        Returns:
            The new state, the metrics (means over the steps), and the absolute TD errors, shaped like the rewards, if the
            batches have importance weights.
        """

        def step(before: PyTree, batch: Any) -> tuple[PyTree, Metrics]:
            after, metrics = self.algorithm.update(before, batch, clock)
            metrics = {name: jnp.asarray(value) for name, value in metrics.items()}
            return nonfinite.undo(before, after, metrics) if self.skips else (after, metrics)

        before = xla.one_kernel(self.packing.unpack)(state)
        is_one = isinstance(batches, Rollout) or batches.reward.ndim == 1
        after, metrics = step(before, batches) if is_one else jax.lax.scan(step, before, batches)
        # Without the barrier XLA would compute the optimizer's step once more for the check.
        state = jax.lax.optimization_barrier(xla.one_kernel(self.packing.pack, self.packing.longest)(after))
        td_error = td_error_of(metrics, batches)
        metrics.pop(TD_ERROR, None)
        vectors = state[: len(self.packing.groups)]  # large arrays are checked by the monitor
        return state, nonfinite.readings(vectors, metrics), td_error

    def _init(self, key: Array) -> PackedState:
        """Returns the state before learning."""
        state = self.algorithm.init(key)
        check_state(state, self.shapes, "init")
        return self.packing.pack(state)

    def _observe(self, state: PackedState, obs: PyTree, running_return: Array) -> PackedState:
        """Returns the state, which is donated, with observations added to its statistics (see ``Algorithm.observe``)."""
        assert self.algorithm.observe is not None
        return self.packing.pack(self.algorithm.observe(self.packing.unpack(state), obs, running_return))

    def _exploit(self, state: PackedState, obs: PyTree) -> Array:
        """Returns the deterministic actions for ``obs`` ``(batch, ...)``."""
        return self.algorithm.exploit(self.algorithm.actor(self.packing.unpack(state)), obs)

    def _recall(self, state: PackedState, carry: PyTree, obs: PyTree, ended: Array) -> tuple[Array, PyTree]:
        """Returns the deterministic actions of a recurrent policy and its memory after ``obs`` ``(batch, ...)``."""
        assert self.algorithm.recall is not None
        return self.algorithm.recall(carry, self.algorithm.actor(self.packing.unpack(state)), obs, ended)

    def _action_values(self, state: PackedState, obs: PyTree, action: Array | None) -> Array:
        """Returns the critics' values; see ``Algorithm.action_values``."""
        assert self.algorithm.action_values is not None
        return self.algorithm.action_values(self.packing.unpack(state), obs, action)

    def _state_value(self, state: PackedState, carry: PyTree, obs: PyTree, ended: Array) -> Array:
        """Returns the critic's values of states; see ``Algorithm.state_value``."""
        assert self.algorithm.state_value is not None
        return self.algorithm.state_value(carry, self.algorithm.actor(self.packing.unpack(state)), obs, ended)

    def state(self, packed: PackedState) -> PyTree:
        """Returns a packed state as the algorithm's own class, in buffers of its own; waits for the device.

        This and :meth:`pack` run on the host: they are rarely called, and compiling them would take longer.
        """
        return jax.tree.map(jnp.array, self.packing.unpack([np.asarray(array) for array in packed]))

    def pack(self, state: PyTree) -> PackedState:
        """Returns a state packed, in buffers of its own: the inverse of :meth:`state`."""
        return [jnp.array(array) for array in self.packing.pack(jax.tree.map(np.asarray, state), np.concatenate)]

    def bad_leaves(self, state: PackedState) -> list[str]:
        """Returns the names of the leaves of a packed state that are not finite; waits for the device."""
        return [] if is_finite(state) else nonfinite.bad_leaves(self.packing.unpack([np.asarray(a) for a in state]))

    def initial_carry(self, n_envs: int) -> PyTree:
        """Returns the carry of the exploration of ``n_envs`` environments before their first episodes."""
        return self.explorer.init(self.algorithm.actor(self.shapes), n_envs)


def td_error_of(metrics: Metrics, batches: Transition | Rollout) -> Array | None:
    """Returns the absolute TD errors of weighted batches, or raises ``ValueError`` if there are none; None for others."""
    if not isinstance(batches, Transition) or batches.weight is None:
        return None
    td_error = metrics.get(TD_ERROR)
    if td_error is None or td_error.shape != batches.reward.shape:
        raise ValueError(NO_TD_ERROR.format("none" if td_error is None else td_error.shape))
    return td_error


def is_finite(state: PackedState) -> bool:
    """Returns whether all numbers of a packed state are finite; waits for the device."""
    return all(np.isfinite(array).all() for array in map(np.asarray, state) if array.dtype.kind == "f")
