"""Statistics over several seeds, after Agarwal et al. (2021, arXiv:2108.13264): few runs, so intervals instead of points.

The scores of a group are one array per environment (a stratum), ``(n_runs, ...)``, with one score per run; further axes, such
as the points of a curve, are kept. Bootstrap samples are drawn with replacement within each environment.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

NORMAL = 1.959963984540054
"""Half-width of the central 95 % of a standard normal distribution."""
COVERAGE = {2: 0.50, 3: 0.75, 4: 0.87, 5: 0.90, 6: 0.90, 7: 0.92, 8: 0.93, 9: 0.93}
"""How often a 95 % bootstrap interval of the interquartile mean of ``n`` runs contains the true score, by ``n``: measured by
``benchmarks/interval_coverage.py`` with scores of a normal distribution."""
Scores = Sequence[np.ndarray]
"""Scores of a group: for each environment ``(n_runs, ...)``."""
Draws = Sequence[np.ndarray]
"""Bootstrap samples: for each environment row numbers, ``int (n_samples, n_runs)``."""
Statistic = Callable[[Scores], np.ndarray]


def mean(scores: Scores) -> np.ndarray:
    """Returns the mean over environments of the mean over runs."""
    return np.mean([runs.mean(axis=0) for runs in scores], axis=0)


def median(scores: Scores) -> np.ndarray:
    """Returns the median over environments of the mean over runs; in one environment the median over runs.

    The first is the convention of the literature. With one environment it would be the mean.
    """
    if len(scores) == 1:
        return np.median(scores[0], axis=0)
    return np.median([runs.mean(axis=0) for runs in scores], axis=0)


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
    for first, second in zip(scores, others, strict=True):
        wins, ties = first[:, None] > second[None], first[:, None] == second[None]
        shares.append((wins + 0.5 * ties).mean(axis=(0, 1)))
    return np.mean(shares, axis=0)


def draw(scores: Scores, n_samples: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Returns bootstrap samples of a group: each draws as many runs of each environment as there are."""
    return [rng.integers(len(runs), size=(n_samples, len(runs))) for runs in scores]


def resampled(scores: Scores, draws: Draws) -> list[np.ndarray]:
    """Returns the scores of bootstrap samples, for each environment ``(n_runs, n_samples, ...)``."""
    return [np.moveaxis(runs[rows], 1, 0) for runs, rows in zip(scores, draws, strict=True)]


def student(mean: ArrayLike, std: ArrayLike, n: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bounds of the 95 % confidence interval of a mean (Student's t); NaN below two values.

    Args:
        mean: mean of the values.
        std: their standard deviation, divided by n.
        n: how many there are.
    """
    degrees = np.where(np.asarray(n) >= 2, np.asarray(n, float) - 1, np.nan)
    half = student_quantile(degrees) * np.abs(std) / np.sqrt(degrees)
    return np.asarray(mean) - half, np.asarray(mean) + half


def student_quantile(degrees: np.ndarray) -> np.ndarray:
    """Returns the 97.5 % quantile of Student's t distribution; importing SciPy's takes longer than writing a page.

    ``P(0 < t < sqrt(n) tan(a))`` is the integral of ``cos(x)**(n - 1)`` up to a, times a factor. Newton's method solves for a.
    """
    (nodes, weights), n = np.polynomial.legendre.leggauss(30), degrees[..., None]
    gamma = np.vectorize(math.lgamma, otypes=[float])
    factor, angle = np.exp(gamma((n + 1) / 2) - gamma(n / 2)) / math.sqrt(math.pi), np.arctan(NORMAL / np.sqrt(n))
    for _ in range(8):
        integral = angle / 2 * (weights * np.cos(angle / 2 * (nodes + 1)) ** (n - 1)).sum(-1, keepdims=True)
        angle = angle + (0.475 / factor - integral) / np.cos(angle) ** (n - 1)
    return (np.sqrt(n) * np.tan(angle))[..., 0]


def wilson(rate: ArrayLike, n: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bounds of the 95 % confidence interval of a rate (Wilson's score); NaN where the rate is NaN.

    >>> [round(float(bound), 3) for bound in wilson(1.0, 20)]
    [0.839, 1.0]
    """
    rate, n = np.asarray(rate, float), np.asarray(n, float)
    square = NORMAL**2
    center = (rate + square / (2 * n)) / (1 + square / n)
    half = NORMAL / (1 + square / n) * np.sqrt(rate * (1 - rate) / n + square / (4 * n**2))
    return np.clip(center - half, 0, 1), np.clip(center + half, 0, 1)


def interval(values: np.ndarray, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Returns the bounds of the percentile interval of bootstrap values, ``(n_samples, ...)``."""
    low, high = np.percentile(values, [50 * (1 - level), 50 * (1 + level)], axis=0)
    return low, high
