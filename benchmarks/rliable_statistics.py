"""Compares the statistics of ``rejeu.compare`` with rliable's on the same bootstrap draws.

    python benchmarks/rliable_statistics.py --peer PYTHON

PYTHON is an interpreter with rliable, arch below 8 and pandas below 3; it runs this file with ``--as-peer``. Both sides make
the same scores, and the same draws from NumPy's legacy generator, which rliable uses. The differences are written to
``benchmarks/results/rliable_statistics.json``.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from trials.provenance import write

RESULTS = Path(__file__).parent / "results" / "rliable_statistics.json"
N_SAMPLES = 2000
SHAPES = {"5 runs, 1 environment": (5, 1), "10 runs, 4 environments": (10, 4), "7 runs, 26 environments": (7, 26)}
CURVE = (5, 3, 20)
"""Runs, environments and points of the curves."""
LEVELS = np.linspace(-1, 2, 13)
SEED = 7


def scores(shape: tuple[int, ...], which: int) -> np.ndarray:
    """Returns scores with some ties, ``(n_runs, n_environments, ...)``."""
    rng = np.random.default_rng([SEED, which, *shape])
    return np.round(rng.normal(0.3 * which, 1.0, shape), 1)


def peer() -> dict[str, Any]:
    """Returns rliable's results."""
    from rliable import library, metrics

    found: dict[str, Any] = {
        "versions": {name: metadata.version(name) for name in ("rliable", "arch", "numpy", "scipy")}
    }

    def estimate(name: str, data: Any, function: Any) -> None:
        np.random.seed(SEED)  # noqa: NPY002 - as rliable
        points, bounds = library.get_interval_estimates({"a": data}, function, reps=N_SAMPLES)
        found[name] = np.concatenate([np.atleast_2d(points["a"]), bounds["a"]]).tolist()

    for name, shape in SHAPES.items():
        one, other = scores(shape, 0), scores(shape, 1)
        estimate(f"iqm, {name}", one, lambda x: np.array([metrics.aggregate_iqm(x)]))
        estimate(f"mean, {name}", one, lambda x: np.array([metrics.aggregate_mean(x)]))
        estimate(f"profile, {name}", one, lambda x: library.score_distributions(x, LEVELS))
        if shape[1] > 1:
            estimate(f"median, {name}", one, lambda x: np.array([metrics.aggregate_median(x)]))
        estimate(
            f"improvement, {name}", [one, other], lambda x, y: np.array([metrics.probability_of_improvement(x, y)])
        )
    curves = scores(CURVE, 0)
    estimate("iqm of curves", curves, lambda x: np.array([metrics.aggregate_iqm(x[..., i]) for i in range(CURVE[2])]))
    return found


def draws(*shapes: tuple[int, ...]) -> list[list[np.ndarray]]:
    """Returns the draws that rliable makes for arrays of these shapes, by array and environment."""
    np.random.seed(SEED)  # noqa: NPY002 - as rliable
    choice = np.random.choice
    samples = [[choice(shape[0], shape) for shape in shapes] for _ in range(N_SAMPLES)]
    stacked = [np.stack(one) for one in zip(*samples, strict=True)]
    return [[one[:, :, task] for task in range(one.shape[2])] for one in stacked]


def ours() -> dict[str, Any]:
    """Returns rejeu's results."""
    from rejeu.reporting import statistics

    found = {}

    def estimate(name: str, data: tuple[np.ndarray, ...], function: Any) -> None:
        strata = [[one[:, task] for task in range(one.shape[1])] for one in data]
        samples = zip(strata, draws(*(one.shape for one in data)), strict=True)
        values = np.asarray(function(*(statistics.resampled(one, rows) for one, rows in samples)))
        values = np.moveaxis(values, 1, 0) if name.startswith("profile") else values
        found[name] = np.stack([np.asarray(function(*strata)), *statistics.interval(values)]).reshape(3, -1).tolist()

    for name, shape in SHAPES.items():
        one, other = scores(shape, 0), scores(shape, 1)
        estimate(f"iqm, {name}", (one,), statistics.iqm)
        estimate(f"mean, {name}", (one,), statistics.mean)
        estimate(f"profile, {name}", (one,), lambda x: statistics.above(x, LEVELS))
        if shape[1] > 1:
            estimate(f"median, {name}", (one,), statistics.median)
        estimate(f"improvement, {name}", (one, other), statistics.improvement)
    estimate("iqm of curves", (scores(CURVE, 0),), statistics.iqm)
    return found


def main() -> None:
    """Runs both sides and writes the table of differences."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", help="interpreter with rliable")
    parser.add_argument("--as-peer", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.as_peer:
        print(json.dumps(peer()))
        return
    text = subprocess.run([arguments.peer, __file__, "--as-peer"], check=True, stdout=subprocess.PIPE, text=True).stdout
    theirs, own = json.loads(text.splitlines()[-1]), ours()
    versions = theirs.pop("versions")
    assert theirs.keys() == own.keys()
    rows = [
        {
            "statistic": name,
            "rliable": theirs[name],
            "rejeu": own[name],
            "largest_difference": float(np.abs(np.array(theirs[name]) - np.array(own[name])).max()),
        }
        for name in theirs
    ]
    command = "python benchmarks/rliable_statistics.py --peer PYTHON"
    content = {"command": command, "versions": versions, "samples": N_SAMPLES, "seed": SEED, "rows": rows}
    write(RESULTS, content)
    for row in rows:
        print(f"{row['statistic']:40} {row['largest_difference']:.1e}")
    sys.exit(max(row["largest_difference"] for row in rows) > 1e-6)


if __name__ == "__main__":
    main()
