"""The contents of a ring as named arrays for files: whole (:func:`arrays`), or the newest rows (:func:`rows_since`).

Restoring checks everything first, because a file may be damaged or of another environment.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rejeu.replay.ring import Ring


def arrays(ring: Ring) -> dict[str, np.ndarray]:
    """Returns the rows in use as named arrays ``(n_envs, rows used, ...)``, and the counters of environments."""
    n_used = int(min(ring.head.max() + 1, ring.rows))
    split = lambda a: a.reshape(ring.n_envs, ring.rows, *a.shape[1:])[:, :n_used]  # noqa: E731
    stored = {name: split(array) for name, array in ring.stored().items()}
    return stored | {"head": ring.head, "n_steps": ring.n_steps}


def restore(ring: Ring, arrays: Mapping[str, np.ndarray]) -> None:
    """Restores the result of :func:`arrays`; everything is checked before anything is changed.

    Raises:
        ValueError: if names, shapes or dtypes are not those of this ring.
    """
    check(ring, arrays)
    head, n_used = arrays["head"], arrays["kind"].shape[1]
    if head.min() < -1 or n_used != min(head.max() + 1, ring.rows):
        raise ValueError("the replay file's counters are damaged")
    for name, array in ring.stored().items():
        array.reshape(ring.n_envs, ring.rows, *array.shape[1:])[:, :n_used] = arrays[name]
    ring.recount(head.copy())
    ring.version += 1


def check(ring: Ring, saved: Mapping[str, Any]) -> None:
    """Checks that arrays, or their specs, can be the result of :func:`arrays` for a ring like this one.

    Raises:
        ValueError: if names, shapes or dtypes are others, or there are more rows than this ring has.
    """
    stored = ring.stored()
    if differing := {*saved} ^ {*stored, "head", "n_steps"}:
        raise ValueError(f"the replay file and this buffer differ in the arrays {', '.join(sorted(differing))[:200]}")
    head, n_steps = saved["head"], saved["n_steps"]
    if head.shape != (ring.n_envs,) or n_steps.shape != (ring.n_envs,):
        raise ValueError(
            f"the replay file is of {head.size} environments and this agent has {ring.n_envs}; make them equal"
        )
    if head.dtype != np.int64 or n_steps.dtype != np.int64:
        raise ValueError("the replay file's counters are damaged")
    n_envs, n_used = ring.n_envs, min((*saved["kind"].shape, 0, 0)[1], ring.rows)
    expected = {name: ((n_envs, n_used, *array.shape[1:]), array.dtype) for name, array in stored.items()}
    check_specs(saved, expected, "the replay file")


def check_specs(saved: Mapping[str, Any], expected: Mapping[str, tuple[Any, Any]], where: str) -> None:
    """Raises ``ValueError`` unless arrays, or their specs, have the shapes and dtypes that a ring has for them."""
    for name, (shape, dtype) in expected.items():
        if saved[name].shape != shape or saved[name].dtype != dtype:
            raise ValueError(
                f"{name} in {where} is {saved[name].dtype}{list(saved[name].shape)} and this buffer expects "
                f"{dtype}{list(shape)}; it was saved with another environment or buffer_size"
            )


def rows_since(ring: Ring, heads: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the rows from the times ``heads`` on, ``(n, ...)``, environment after environment.

    The row at a head is included, since its action and reward came later. With ``-1`` for every head these are all rows.
    """
    first = np.maximum(heads, ring.oldest())
    spans = [np.arange(first[env], ring.head[env] + 1) for env in range(ring.n_envs)]
    index = np.concatenate([ring.index(np.full(len(span), env), span) for env, span in enumerate(spans)])
    rows = {name: array[index] for name, array in ring.stored().items()}
    return rows | {"first": first, "head": ring.head.copy()}


def put_rows(ring: Ring, parts: Sequence[Mapping[str, np.ndarray]]) -> None:
    """Restores successive results of :func:`rows_since`, each beginning where the one before ended, or earlier.

    Raises:
        ValueError: if they are of another ring, or rows are missing; the ring is then empty.
    """
    ring.recount(np.full(ring.n_envs, -1, np.int64))
    ring.version += 1
    stored = ring.stored()
    written = newest = ring.head
    for rows in parts:
        check_rows(ring, rows)
        first, head = rows["first"], rows["head"]
        if len(rows["kind"]) != (n := int((head - first + 1).sum())):  # before anything of that size is made
            raise ValueError(f"rows of the replay buffer are {len(rows['kind'])}, and {n} by their counters")
        spans = [np.arange(first[env], head[env] + 1) for env in range(ring.n_envs)]
        index = np.concatenate([ring.index(np.full(len(span), env), span) for env, span in enumerate(spans)])
        for name, array in stored.items():
            array[index] = rows[name]
        written, newest = np.where(first > newest, first, np.minimum(written, first)), head
    if ((newest >= 0) & (written > np.maximum(newest - ring.rows + 1, 0))).any():
        raise ValueError("rows of the replay buffer are missing")
    ring.recount(newest.copy())


def check_rows(ring: Ring, saved: Mapping[str, Any]) -> None:
    """Checks that arrays, or their specs, can be the result of :func:`rows_since`.

    Raises:
        ValueError: if names, shapes or dtypes are others, or there are more rows than the ring has.
    """
    stored = ring.stored()
    if {*saved} != {*stored, "first", "head"}:
        raise ValueError(
            f"rows of the replay buffer hold {', '.join(sorted(saved))[:200]}, expected "
            f"{', '.join(sorted({*stored, 'first', 'head'}))}"
        )
    n = saved["kind"].shape[0] if saved["kind"].shape else 0
    expected = {name: ((n, *array.shape[1:]), array.dtype) for name, array in stored.items()}
    expected |= dict.fromkeys(("first", "head"), ((ring.n_envs,), np.dtype(np.int64)))
    check_specs(saved, expected, "rows of the replay buffer")
    if n > ring.rows * ring.n_envs:
        raise ValueError(f"there are {n:,} rows, and the replay buffer has {ring.rows * ring.n_envs:,}")
