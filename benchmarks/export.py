"""Compares exported policies with ``predict``, and measures their sizes and latencies.

    python benchmarks/export.py

Every algorithm with every kind of action that matters to its policy and every form of observations, with random weights of
small networks; SAC with two layers of 64 units is for the latencies. Each in every format that has it, on 1,000 samples of
the observation space, one at a time, on one thread. Latencies are those of the fastest of five rounds. The results are
written to ``benchmarks/results/export.json``.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from rejeu import load_policy
from rejeu.agents import Agent, exporting
from rejeu.core import spaces
from rejeu.export import FORMATS, check
from rejeu.export.check import Run
from rejeu.export.contract import Exportable
from rejeu.lab.runs.config import versions
from tests.export.policies import KINDS, agent_of
from trials.provenance import machine, provenance, write

OUT = Path(__file__).parent / "results" / "export.json"
FORMS: dict[str, dict[str, Any]] = {
    "MLP": {},
    "MLP, normalized": {"normalize": True},
    "CNN": {"observation": "CNN"},
    "Dict": {"observation": "Dict"},
    "small Dict, normalized": {"observation": "small Dict", "normalize": True},
}
TIMED = "SAC, Box, 64-64"
"""The policy whose latencies are reported."""
SHOWN = ("bytes", "p50", "p99")


def cases() -> Iterator[tuple[str, str, str, dict[str, Any]]]:
    """Yields algorithm, kind of action, form and settings."""
    yield "SAC", "Box", "64-64", {"policy_kwargs": {"net_arch": [64, 64]}}
    for name, action in KINDS:
        for form, settings in FORMS.items():
            yield name, action, form, settings
    for name in ("DQN", "QRDQN", "SAC", "A2C", "TRPO", "RecurrentPPO"):
        yield name, "Discrete", "masks", {"action_masks": True}


def measure(agent: Agent, folder: Path, is_timed: bool) -> dict[str, dict[str, Any]]:
    """Returns the check of each format, with the size of its file."""
    single_policy = exporting.policy_for(agent, False, 1)
    recording, *_ = exporting.record(agent, single_policy, None)
    runs: dict[str, tuple[Run, int]] = {}
    card = exporting.card_of(agent, single_policy, "c", "", None)
    for target in ("onnx", "c", "stablehlo"):
        exported_policy = single_policy if target == "c" else exporting.policy_for(agent, False, None)
        source = Exportable(exported_policy, single_policy, card, agent.observation_space, agent.action_space)
        contents, run = FORMATS[target].files(source)
        if run is not None:
            runs[target] = run, len(contents[0])
    saved = agent.export(folder / "policy.npz").path
    acting: dict[str, Any] = {"predict": agent} if is_timed else {}
    if not single_policy.of("state"):  # which predict passes on by itself
        acting["numpy"] = load_policy(saved)
    structure = spaces.structure(agent.observation_space)
    names = [port.name for port in single_policy.of("observation")]
    for target, policy in acting.items():

        def call(inputs: dict[str, np.ndarray], policy: Any = policy) -> dict[str, Any]:
            obs = jax.tree.unflatten(structure, [inputs[name] for name in names])
            masks = {"action_masks": inputs["action_mask"]} if "action_mask" in inputs else {}
            return {"action": policy.predict(obs, deterministic=True, **masks)[0]}

        runs[target] = check.one_by_one(single_policy, call), saved.stat().st_size
    rounds = 5 if is_timed else 1
    return {
        target: {
            **min(
                (check.compare(single_policy, recording, run) for _ in range(rounds)),
                key=lambda comparison: comparison.p99,
            )._asdict(),
            "bytes": size,
        }
        for target, (run, size) in runs.items()
    }


def summary(rows: list[dict[str, Any]], key: str) -> dict[str, dict[str, Any]]:
    """Returns for each value of a key the number of files, the largest difference and the number of ties."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return {
        value: {
            "files": len(group),
            "largest difference": max(row["difference"] for row in group),
            "ties": sum(row["ties"] for row in group),
        }
        for value, group in groups.items()
    }


def main() -> int:
    """Runs the command and returns its exit status."""
    origin, rows = provenance(), []
    for name, action, form, settings in cases():
        with tempfile.TemporaryDirectory() as folder:
            comparisons = measure(agent_of(name, action, **settings), Path(folder), form == "64-64")
        policy = f"{name}, {action}, {form}"
        rows += [
            {"policy": policy, "algorithm": name, "form": form, "target": target, **comparison}
            for target, comparison in comparisons.items()
        ]
        print(policy, {target: comparison["difference"] for target, comparison in comparisons.items()}, flush=True)
    exported = [row for row in rows if row["target"] != "predict"]
    content = {
        **origin,
        "machine": machine(),
        "versions": versions(),
        "observations": check.OBSERVATIONS,
        "latency": {row["target"]: {key: row[key] for key in SHOWN} for row in rows if row["policy"] == TIMED},
        "formats": summary(exported, "target"),
        "algorithms": summary(exported, "algorithm"),
        "forms": summary(exported, "form"),
        "rows": rows,
    }
    write(OUT, content, rows="rows")
    return int(any(row["difference"] > check.LARGEST_DIFFERENCE for row in exported))


if __name__ == "__main__":
    sys.exit(main())
