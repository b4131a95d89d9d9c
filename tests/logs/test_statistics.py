"""Statistics over seeds, against plain loops and against rliable's recorded results."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import special

from rejeu.logs import statistics

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results" / "rliable_statistics.json"
RECORDED = json.loads(RESULTS.read_text(encoding="utf-8"))


def trimmed_mean(values):
    values = sorted(values)
    cut = int(0.25 * len(values))
    kept = values[cut : len(values) - cut]
    return sum(kept) / len(kept)


def wins(one, other):
    return sum((a > b) + 0.5 * (a == b) for a in one for b in other) / (len(one) * len(other))


@pytest.fixture
def groups():
    rng = np.random.default_rng(3)
    return [[np.round(rng.normal(size=n), 1) for n in sizes] for sizes in ((5, 7, 1), (4, 6, 3))]


def test_statistics_equal_plain_loops(groups):
    one, other = groups
    pooled = [value for scores in one for value in scores.tolist()]
    means = [sum(scores.tolist()) / len(scores) for scores in one]
    assert statistics.iqm(one) == pytest.approx(trimmed_mean(pooled), abs=1e-12)
    assert statistics.mean(one) == pytest.approx(sum(means) / 3, abs=1e-12)
    assert statistics.median(one) == pytest.approx(sorted(means)[1], abs=1e-12)
    assert statistics.median(one[:1]) == sorted(one[0])[2]
    expected = sum(wins(a.tolist(), b.tolist()) for a, b in zip(one, other, strict=True)) / 3
    assert statistics.improvement(one, other) == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(statistics.above(one, np.array([0.0])), [np.mean(np.array(pooled) > 0)])


def test_interval_equals_a_bootstrap_in_a_plain_loop(groups):
    scores = groups[0]
    draws = statistics.draw(scores, 200, np.random.default_rng(0))
    values = [
        trimmed_mean([value for one, rows in zip(scores, draws, strict=True) for value in one[rows[i]].tolist()])
        for i in range(200)
    ]
    low, high = statistics.interval(statistics.iqm(statistics.resampled(scores, draws)))
    ordered = np.sort(values)  # linear interpolation between order statistics
    assert low == pytest.approx(np.interp(0.025 * 199, np.arange(200), ordered), abs=1e-12)
    assert high == pytest.approx(np.interp(0.975 * 199, np.arange(200), ordered), abs=1e-12)


@pytest.mark.parametrize("row", RECORDED["rows"], ids=lambda row: row["statistic"])
def test_recorded_differences_from_rliable_are_below_a_millionth(row):
    assert row["largest_difference"] <= 1e-6
    np.testing.assert_allclose(row["rejeu"], row["rliable"], rtol=0, atol=1e-6)


def test_equal_to_rliable_on_the_same_draws():
    """Five runs: scores with ties, and the draws of NumPy's legacy generator, which rliable uses."""
    scores = np.round(np.random.default_rng([RECORDED["seed"], 0, 5, 1]).normal(0.0, 1.0, (5, 1)), 1)[:, 0]
    np.random.seed(RECORDED["seed"])  # noqa: NPY002 - as rliable
    draws = np.stack([np.random.choice(5, (5, 1))[:, 0] for _ in range(RECORDED["samples"])])  # noqa: NPY002
    found = [statistics.iqm([scores]), *statistics.interval(statistics.iqm(statistics.resampled([scores], [draws])))]
    recorded = next(row["rliable"] for row in RECORDED["rows"] if row["statistic"] == "iqm, 5 runs, 1 environment")
    np.testing.assert_allclose(found, np.ravel(recorded), rtol=0, atol=1e-6)


def test_students_quantile_equals_scipys():
    degrees = np.array([1, 2, 3, 4, 7, 19, 99, 1e3, 1e5, np.nan])
    np.testing.assert_allclose(statistics.student_quantile(degrees), special.stdtrit(degrees, 0.975), rtol=1e-8)
    assert statistics.student_quantile(np.zeros(0)).shape == (0,)
