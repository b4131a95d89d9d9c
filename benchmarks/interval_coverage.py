"""How often the 95 % bootstrap interval of few runs contains the true score.

    python benchmarks/interval_coverage.py

Scores are of a normal distribution with mean 0. Each of 10,000 groups of ``n`` runs gets the interval that ``rejeu compare``
computes, with 1,000 bootstrap samples. ``rejeu.logs.statistics.COVERAGE`` holds the shares.
"""

import numpy as np

from rejeu.logs import statistics

GROUPS, SAMPLES, AT_ONCE = 10_000, 1_000, 500


def coverage(n_runs: int, rng: np.random.Generator) -> float:
    """Returns the share of groups whose interval contains the true score, 0."""
    covered = 0
    for _ in range(GROUPS // AT_ONCE):
        scores = rng.normal(size=(n_runs, AT_ONCE))
        rows = rng.integers(n_runs, size=(SAMPLES, n_runs, AT_ONCE))
        low, high = statistics.interval(statistics.iqm(statistics.resampled([scores], [rows])))
        covered += int(((low <= 0) & (high >= 0)).sum())
    return covered / GROUPS


if __name__ == "__main__":
    for n in (*range(2, 11), 15, 20):
        print(f"{n:3} runs: {coverage(n, np.random.default_rng(n)):.3f}", flush=True)
