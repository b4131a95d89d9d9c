"""Compares the environments in JAX with those that they reproduce, step by step from the same states.

    python benchmarks/functional_equality.py [--steps 12000]

Half of the states are random, half are from episodes with random actions; see ``tests/envs/functional``. The largest
absolute differences are written to ``benchmarks/results/functional_equality.json``.
"""

from __future__ import annotations

import argparse
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]

from tests.envs.functional import classic_control, parking  # noqa: E402
from tests.envs.functional.peers import compare  # noqa: E402
from trials.provenance import provenance, write  # noqa: E402

RESULT = Path(__file__).parent / "results" / "functional_equality.json"


def classic(case: classic_control.Case, n: int) -> dict[str, Any]:
    """Returns the differences from an environment of Gymnasium."""
    recorded = classic_control.record(case, n)
    differences = {
        name: compare(case.env, recorded, case.make_state, case.physics, x64)._asdict()
        for name, x64 in (("float64", True), ("float32", False))
    }
    return {
        "env": f"jax/{case.env_id}",
        "peer": f"gymnasium {version('gymnasium')}",
        "steps": n,
        "n_terminated": int(recorded.terminated.sum()),
        **differences,
    }


def lot(n: int) -> dict[str, Any]:
    """Returns the differences from highway-env's parking-v0."""
    recorded, success = parking.record(n)
    crashed = recorded.next_state[:, 4].astype(bool)
    row: dict[str, Any] = {
        "env": "jax/Parking-v0",
        "peer": f"highway-env {version('highway-env')}",
        "steps": n,
        "n_terminated": int(recorded.terminated.sum()),
        "n_successes": int(success.sum()),
        "n_crashes": int(crashed.sum()),
    }
    for name, x64 in (("float64", True), ("float32", False)):
        found = parking.compare(recorded, success, x64)
        far = (found.state > 1e-5) & crashed if x64 else crashed
        row[name] = {
            "state": float(found.state[~far].max()),
            "obs": float(found.obs[~far].max()),
            "reward": float(found.reward[~far].max()),
            "n_terminated": int(found.wrong.sum()),
            "n_left_out": int(far.sum()),
        }
        if x64:
            unstable = [parking.is_unstable(recorded, i, found.after[i]) for i in np.flatnonzero(far)]
            row["unstable"] = {
                "n": sum(unstable),
                "n_unexplained": len(unstable) - sum(unstable),
                "position": float(np.abs(found.after[far, :2] - recorded.next_state[far, :2]).max()),
                "reward": float(found.reward[far].max()),
            }
    return row


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=12_000)
    steps = parser.parse_args().steps
    rows = [classic(case, steps) for case in classic_control.CASES] + [lot(steps)]
    write(RESULT, {**provenance(), "results": rows})
    for row in rows:
        print(row)


if __name__ == "__main__":
    main()
