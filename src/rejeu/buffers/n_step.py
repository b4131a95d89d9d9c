"""Which rows of a ring the returns of several steps sum. One definition for the arrays of NumPy and those of JAX.

``np`` is the module that computes with the arrays, ``numpy`` or ``jax.numpy``. ``ring`` has ``kind``, ``reward`` and ``head``,
and ``index(env, time)`` returns positions in it, as :class:`rejeu.buffers.ring.Ring` does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy

from rejeu.buffers.ring import LAST, TERMINATED


class Window(NamedTuple):
    """The steps that n-step returns sum, ``(batch, n)`` each."""

    position: Any
    """Positions in the ring of the n rows from the sampled one on."""
    valid: Any
    """Which of them belong to the return; the first always does."""
    terminal: Any
    """Which of these entered a terminal state."""


def look_ahead(np: Any, ring: Any, index: Callable[..., Any], rows: Any, n: int) -> Window:
    """Returns the up to ``n`` steps from each of ``rows`` to its episode's end or to the newest step."""
    times = rows.time[:, None] + np.arange(n)[None]
    position = index(rows.env[:, None], times)
    kind = ring.kind[position]
    is_step = (kind != LAST) & (times < ring.head[rows.env][:, None])
    continues = np.cumprod(is_step & (kind != TERMINATED), axis=1).astype(bool)
    valid = np.concatenate([is_step[:, :1], is_step[:, 1:] & continues[:, :-1]], axis=1)
    return Window(position, valid, (kind == TERMINATED) & valid)


def with_new_goals(
    np: Any,
    rewards: Any,
    window: Window,
    which: Any,
    reached: Any,
    goal: Any,
    reward: Callable[[Any, Any], Any],
    terminated: Callable[[Any, Any], Any] | None,
) -> tuple[Any, Window]:
    """Returns rewards ``(batch, n)`` and window of transitions of which those at ``which`` have new goals.

    Args:
        np: the module of the arrays.
        rewards: of the steps; mutated if it is NumPy's.
        window: likewise.
        which: where the new goals are.
        reached: the goals achieved by each of their steps, ``(n_goals, n, ...)``.
        goal: the new goals, ``(n_goals, ...)``.
        reward: the reward of achieved and desired goals.
        terminated: whether they end the episode; None if the steps keep their own flags.
    """
    valid, terminal, n = window.valid, window.terminal, window.valid.shape[1]
    reached, goals = reached.reshape(-1, *goal.shape[1:]), np.repeat(goal, n, axis=0)
    rewards = replaced(rewards, which, reward(reached, goals).reshape(-1, n))
    if terminated is not None:
        ends = terminated(reached, goals).astype(bool).reshape(-1, n) & valid[which]
        goes_on = np.cumsum(ends, axis=1)[:, :-1] == 0
        valid = replaced(valid, (which, slice(1, None)), valid[which][:, 1:] & goes_on)
        terminal = replaced(terminal, which, ends) & valid
    return rewards, Window(window.position, valid, terminal)


def replaced(array: Any, which: Any, values: Any) -> Any:
    """Returns ``array`` with ``values`` at ``which``; an array of NumPy is mutated."""
    if isinstance(array, numpy.ndarray):
        array[which] = values
        return array
    return array.at[which].set(values.astype(array.dtype))
