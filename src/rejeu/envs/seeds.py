"""Seeds of vector environments: one number for all environments, or one for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

Seed = int | Sequence[int] | None
"""A number ``seed``, so that environment i is seeded with ``seed + i``; one number for each environment; or None."""
END = 2**31 - 1
"""Exclusive upper bound of the seeds of single environments, because EnvPool uses 31 bits."""
ENVIRONMENTS = 0x454E
"""Added to the seed of a run, so that the seeds of its environments differ from all others."""


def checked(seed: Any, n_envs: int) -> Seed:
    """Validates a seed for ``n_envs`` environments and returns it, a sequence as a tuple of ints.

    Raises:
        ValueError: if a sequence does not contain one integer from 0 to 2**31 - 2 for each environment.
    """
    if seed is None:
        return None
    if isinstance(seed, int | np.integer):
        return int(seed)
    seeds = np.asarray(seed)
    if seeds.shape != (n_envs,):
        raise ValueError(f"seed={seed!r} must be a number, or a sequence of {n_envs} numbers, one for each environment")
    if seeds.dtype.kind not in "iu" or seeds.min() < 0 or seeds.max() >= END:
        raise ValueError(f"seed={seed!r} must have whole numbers from 0 to 2**31 - 2")
    return tuple(seeds.tolist())


def of_run(seed: int) -> int:
    """Returns the seed of a run's environments, from 0 to 2**31 - 1, for the seed of the run.

    Environment i takes the i-th number after it. Without this, runs with the seeds 0 and 1 would share all their
    environments but one.
    """
    return int(np.random.SeedSequence([seed, ENVIRONMENTS]).generate_state(1)[0] >> 1)


def for_each(seed: Seed, n_envs: int) -> list[int | None]:
    """Returns the seed of each environment.

    >>> for_each(5, 3), for_each((7, 7, 1), 3), for_each(None, 2)
    ([5, 6, 7], [7, 7, 1], [None, None])
    """
    if seed is None:
        return [None] * n_envs
    return [seed + i for i in range(n_envs)] if isinstance(seed, int) else list(seed)
