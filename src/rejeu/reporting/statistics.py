"""Statistics over several seeds, after Agarwal et al. (2021, arXiv:2108.13264): few runs, so intervals instead of points.

The scores of a group are one array per environment (a stratum), ``(n_runs, ...)``, with one score per run; further axes, such
as the points of a curve, are kept. Bootstrap samples are drawn with replacement within each environment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

Scores = Sequence[np.ndarray]
"""Scores of a group: for each environment ``(n_runs, ...)``."""
Draws = Sequence[np.ndarray]
"""Bootstrap samples: for each environment row numbers, ``int (n_samples, n_runs, ...)``."""
Statistic = Callable[[Scores], np.ndarray]


def mean(scores: Scores) -> np.ndarray:
    """Returns the mean over environments of the mean over runs."""
    return np.mean([one.mean(axis=0) for one in scores], axis=0)


def median(scores: Scores) -> np.ndarray:
    """Returns the median over environments of the mean over runs; in one environment the median over runs.

    The first is the convention of the literature. With one environment it would be the mean.
    """
    if len(scores) == 1:
        return np.median(scores[0], axis=0)
    return np.median([one.mean(axis=0) for one in scores], axis=0)


def iqm(scores: Scores) -> np.ndarray:
    """Returns the interquartile mean over all runs: a quarter, rounded down, is left out at each end.

    >>> float(iqm([np.array([0.0, 1.0, 2.0, 3.0, 100.0])]))
    2.0
    """
    values = np.concatenate([*scores])
    cut = len(values) // 4
    if cut:
        values = np.partition(values, [cut, len(values) - cut - 1], axis=0)[cut : len(values) - cut]
    return values.mean(axis=0)


STATISTICS: dict[str, Statistic] = {"iqm": iqm, "mean": mean, "median": median}


def above(scores: Scores, levels: np.ndarray) -> np.ndarray:
    """Returns the performance profile: the share of runs whose score is above each level, ``(n_levels, ...)``."""
    values = np.concatenate([*scores])
    return np.array([(values > level).mean(axis=0) for level in levels])


def improvement(scores: Scores, others: Scores) -> np.ndarray:
    """Returns the probability that a run of a group scores higher than one of another group, averaged over environments.

    Ties count one half, as in the Mann-Whitney U statistic.

    >>> float(improvement([np.array([1.0, 2.0])], [np.array([0.0, 2.0])]))
    0.625
    """
    shares = []
    for one, other in zip(scores, others, strict=True):
        wins, ties = one[:, None] > other[None], one[:, None] == other[None]
        shares.append((wins + 0.5 * ties).mean(axis=(0, 1)))
    return np.mean(shares, axis=0)


def draw(scores: Scores, n_samples: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Returns bootstrap samples of a group: each draws as many runs of each environment as there are."""
    return [rng.integers(len(one), size=(n_samples, len(one))) for one in scores]


def resampled(scores: Scores, draws: Draws) -> list[np.ndarray]:
    """Returns the scores of bootstrap samples, for each environment ``(n_runs, n_samples, ...)``."""
    found = []
    for one, rows in zip(scores, draws, strict=True):
        if rows.ndim == one.ndim + 1 and rows.ndim > 2:  # drawn separately at each further place
            taken = one[(rows, *np.ogrid[tuple(slice(size) for size in one.shape)][1:])]
        else:
            taken = one[rows]
        found.append(np.moveaxis(taken, 1, 0))
    return found


def interval(values: np.ndarray, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bounds of the percentile interval of bootstrap values, ``(n_samples, ...)``."""
    low, high = np.percentile(values, [50 * (1 - level), 50 * (1 + level)], axis=0)
    return low, high
