"""The memory that training on the device needs, estimated before it is allocated."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from rejeu import devices
from rejeu.buffers.rollout import RolloutBuffer
from rejeu.envs.functional.vector import reset_all
from rejeu.loops.device.trainer import vector_of
from rejeu.loops.learner import Learner
from rejeu.loops.run import Run

GIB = 2**30
COPIES = 3
"""How often networks and optimizers are in memory during an update: before it, after it, and the gradients."""


def check(run: Run, learner: Learner, n_runs: int, batch_size: int, shared_by: Sequence[jax.Device]) -> None:
    """Raises ``MemoryError``, with the numbers and what to lower, if runs need more memory than their devices have free.

    Args:
        run: one of them, before it begins.
        learner: its algorithm.
        n_runs: how many runs are alike.
        batch_size: transitions of a gradient step.
        shared_by: the devices that share the runs.
    """
    free = devices.room(shared_by[0])
    if free is None:
        return
    is_cpu = shared_by[0].platform == "cpu"  # whose devices have one memory, that of the host
    of_one = of_run(run, learner, batch_size) + is_cpu * unwritten(run)
    needed = of_one * (n_runs if is_cpu else -(-n_runs // len(shared_by)))
    if needed > free:
        what, seeds = (f"{n_runs} runs", " or the number of seeds") if n_runs > 1 else ("the run", "")
        raise MemoryError(
            f"{what} would need about {needed / GIB:.1f} GiB on {shared_by[0]}, which has {free / GIB:.1f} GiB free; lower "
            f"{reducible(run)}{seeds}"
        )


def of_run(run: Run, learner: Learner, batch_size: int) -> int:
    """Returns about how many bytes a run takes on the device: networks, an update, and what is not on the host."""
    leaves = jax.tree.leaves(learner.shapes)
    # The state holds each network several times, with the moments of its optimizer. So the outputs of all its layers are
    # about as large as the activations of a network with their gradients.
    outputs = sum(math.prod(leaf.shape[:-2]) * leaf.shape[-1] for leaf in leaves if len(leaf.shape) > 1)
    rows = run.replay.n_steps * run.env.n_envs if isinstance(run.replay, RolloutBuffer) else batch_size
    update = COPIES * total(leaves) + 4 * rows * outputs
    if run.env.backend != "jax":
        return update
    episodes = jax.eval_shape(lambda: reset_all(vector_of(run).env, jax.random.key(0), run.env.n_envs))
    return update + total(jax.tree.leaves(episodes)) + of_experience(run.replay)


def of_experience(buffer: Any) -> int:
    """Returns the bytes of a replay buffer or rollout buffer on the device."""
    if isinstance(buffer, RolloutBuffer):
        return 2 * buffer.nbytes  # before a chunk and after it
    n = len(buffer.ring.kind)
    tables = 3 * 4 * n if buffer.ring.counters else 0  # instead of the counters: the tables of episodes
    return buffer.ring.nbytes + tables + (0 if buffer.priorities is None else 8 * n)  # and their copy before a chunk


def unwritten(run: Run) -> int:
    """Returns the bytes of the buffer on the host that the system will only give when they are written to."""
    if isinstance(run.replay, RolloutBuffer):
        return run.replay.nbytes
    ring = run.replay.ring
    return int(ring.nbytes * (1 - np.mean(np.clip((ring.head + 1) / ring.rows, 0, 1))))


def reducible(run: Run) -> str:
    """Returns the setting on which the memory of a run depends most, with its value."""
    if isinstance(run.replay, RolloutBuffer):
        return f"n_steps (it is {run.replay.n_steps:,}) or the number of environments (it is {run.env.n_envs:,})"
    return f"buffer_size (it is {run.replay.ring.rows * run.replay.ring.n_envs:,})"


def total(leaves: Sequence[Any]) -> int:
    """Returns the bytes of arrays of these shapes and dtypes."""
    return sum(math.prod(leaf.shape) * leaf.dtype.itemsize for leaf in leaves)
