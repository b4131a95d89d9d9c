"""Batches whose update left NaN or infinity: they are read, and their update is repeated.

:mod:`rejeu.loops.nonfinite` finds such updates and saves their batches. Functions here take an :class:`rejeu.agents.Agent`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rejeu import core, spaces
from rejeu.core import Clock, Masked, Rollout, Sequences, Transition
from rejeu.errors import CheckpointError
from rejeu.io import checkpoint
from rejeu.loops.learner import bad_leaves, checked


class Found(NamedTuple):
    """The parts of an update that are not finite, each with the first such number, such as ``reward (nan)``."""

    batch: list[str]
    metrics: list[str]
    leaves: list[str]
    """Leaves of the state after the update."""

    def __bool__(self) -> bool:
        return bool(self.metrics or self.leaves)


def examine(agent: Any, path: str | Path) -> Found:
    """Repeats the update of a saved batch and returns the parts that are not finite; the agent is not changed.

    The result is false if everything is finite, for example with other weights or hyperparameters.
    """
    batch, clock = load_batch(agent, path)
    after, metrics = jax.jit(agent.learner.algorithm.update)(agent.state, batch, clock)
    return Found(bad_leaves(batch._asdict()), bad_leaves(checked(metrics)), bad_leaves(after))


def load_batch(agent: Any, path: str | Path) -> tuple[Transition | Rollout, Clock]:
    """Returns a saved batch and the clock of its update, as arguments of the update of ``agent``'s algorithm.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it holds no batch, or that of another kind of agent.
    """
    with checkpoint.opened(path, "batch") as file:
        like, header = batch_like(agent, {*file.specs}), file.header
        names = core.names(like)
        if header.get("algorithm") != agent.name or {*names} != {*file.specs}:
            raise CheckpointError(f"{path} holds a batch of another kind of agent than this {agent.name}")
        arrays = file.read()
    try:
        clock = header["clock"]
        clock = Clock(np.uint32(clock["step"]), np.uint32(clock["episode"]), np.float32(clock["progress"]))
    except (KeyError, TypeError, ValueError, OverflowError):
        raise CheckpointError(f"{path}: the header is damaged") from None
    return jax.tree.unflatten(jax.tree.structure(like), [arrays[name] for name in names]), clock


def batch_like(agent: Any, names: set[str]) -> Transition | Rollout:
    """Returns a batch of the structure of an agent's, with numbers for arrays; a file has the arrays of these names."""
    structure = spaces.structure(agent.observation_space)
    obs: Any = jax.tree.unflatten(structure, [0] * structure.num_leaves)
    zero: Any = 0
    if "obs.memory" in names or "obs.obs.memory" in names:
        obs = Sequences(obs, zero, zero, zero, zero)
    obs = Masked(obs, zero) if agent.takes_masks else obs
    if "ended" not in names:
        return Transition(obs, zero, zero, obs, zero, **{name: zero for name in ("weight", "rewards") if name in names})
    carry = jax.tree.map(lambda leaf: zero, agent.learner.initial_carry(1))
    return Rollout(obs, zero, zero, obs, zero, zero, zero, zero, zero, carry)
