"""The plain replay buffer: every step is as likely as any other; n-step returns by option."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rejeu.core import Transition
from rejeu.replay.ring import LAST, TERMINATED, Ring, Rows


class ReplayBuffer:
    """Draws transitions uniformly from a :class:`Ring`."""

    def __init__(self, ring: Ring, gamma: float, n_steps: int = 1) -> None:
        self.ring = ring
        self.gamma = gamma
        self.n_steps = n_steps

    def size(self) -> int:
        """Returns the number of transitions kept."""
        return len(self.ring)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Transition:
        """Returns transitions, every leaf ``(*shape, ...)``; ``rng`` advances."""
        ring = self.ring
        rows = ring.draw(rng, int(np.prod(shape)))
        index = ring.index(*rows)
        if self.n_steps == 1:
            reward, terminated = ring.reward[index], ring.kind[index] == TERMINATED
            steps = np.ones(1, np.int64)
        else:
            window = look_ahead(ring, rows, self.n_steps)
            rewards = ring.reward[window.index]
            reward = discounted_sum(rewards, window.valid, self.gamma)
            steps, terminated = window.steps, window.terminated
        following = ring.index(rows.env, rows.time + steps)
        return Transition(
            ring.tree([leaf.reshape(*shape, *leaf.shape[1:]) for leaf in ring.observation(index)]),
            ring.action[index].reshape(*shape, *ring.action.shape[1:]),
            reward.reshape(shape),
            ring.tree([leaf.reshape(*shape, *leaf.shape[1:]) for leaf in ring.observation(following)]),
            bootstrap_discount(self.gamma, steps, terminated).reshape(shape),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns everything kept, as named arrays."""
        return self.ring.arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Puts back what :meth:`arrays` returned; see :meth:`Ring.restore`."""
        self.ring.restore(arrays)


class Window(NamedTuple):
    """The steps that an n-step return sums, by sampled row."""

    index: np.ndarray
    """Positions in the ring of the n rows from the sampled one on, ``(batch, n)``."""
    valid: np.ndarray
    """Which of them belong to the return, ``bool (batch, n)``; the first always does."""
    steps: np.ndarray
    """How many do, ``(batch,)``."""
    terminated: np.ndarray
    """Whether the last of them entered a terminal state, ``bool (batch,)``."""


def look_ahead(ring: Ring, rows: Rows, n: int) -> Window:
    """Returns the up to ``n`` steps from each row to its episode's end or to the newest step."""
    times = rows.time[:, None] + np.arange(n)
    index = ring.index(rows.env[:, None], times)
    kind = ring.kind[index]
    is_step = (kind != LAST) & (times < ring.head[rows.env][:, None])
    goes_on = is_step & (kind != TERMINATED)
    valid = is_step.copy()
    valid[:, 1:] &= np.logical_and.accumulate(goes_on, axis=1)[:, :-1]
    return Window(index, valid, valid.sum(axis=1), ((kind == TERMINATED) & valid).any(axis=1))


def discounted_sum(rewards: np.ndarray, valid: np.ndarray, gamma: float) -> np.ndarray:
    """Returns ``sum_i gamma^i r_i`` over the valid steps, ``float32 (batch,)``."""
    weights = gamma ** np.arange(rewards.shape[1])
    return ((rewards * valid) @ weights).astype(np.float32)


def bootstrap_discount(gamma: float, steps: np.ndarray, terminated: np.ndarray) -> np.ndarray:
    """Returns ``gamma^steps``, and 0 where the MDP terminated, ``float32``."""
    return (gamma**steps * ~terminated).astype(np.float32)
