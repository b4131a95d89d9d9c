"""``rejeu status``: how far a run is, also while it trains."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rejeu.cli.commands import Status
from rejeu.cli.jsonout import emit
from rejeu.reporting import run_list
from rejeu.reporting.formatting import counted
from rejeu.reporting.runs import Run, best_row

WINDOW = 100
"""Last episodes that are averaged."""
EXIT = {"running": 0, "finished": 0, "unknown": 0, "interrupted": 3, "crashed": 4}
"""Exit status by the state of the run."""


def run(arguments: Status) -> int:
    """Prints the state of a run and returns the exit status: 0, 3 if it was interrupted, 4 if it crashed."""
    found = run_list.read(arguments.run)
    facts = describe(found)
    if arguments.json:
        emit(facts)
    else:
        print("\n".join(lines(facts)))
    return EXIT[found.state]


def describe(run: Run) -> dict[str, Any]:
    """Returns what is worth knowing of a run, as plain values."""
    rate = run.steps / run.seconds if run.seconds and run.seconds > 0 else math.nan
    left = max(run.steps_asked - run.steps, 0) / rate if run.steps_asked and rate else math.nan
    if run.minutes_asked is not None:
        left = max(60 * run.minutes_asked - run.seconds, 0.0)
    returns = run.episodes.returns[-WINDOW:]
    means = run.metrics.column("rollout/ep_rew_mean")
    known = returns if len(returns) else means[np.isfinite(means)][-1:]
    return {
        "path": run.path,
        "name": run.name,
        "format": run.format,
        "env": run.env_id,
        "algorithm": run.algorithm,
        "seed": run.seed,
        "state": run.state,
        "steps": run.steps,
        "steps_asked": run.steps_asked,
        "seconds": run.seconds,
        "steps_per_second": rate,
        "seconds_left": left if run.state == "running" else None,
        "episodes": len(run.episodes),
        "mean_return": float(np.mean(known[np.isfinite(known)])) if np.isfinite(known).any() else math.nan,
        "best": best_evaluation(run),
        "evaluations": len(run.evaluations),
        "warnings": run.warnings,
        "notes": run.notes,
    }


def best_evaluation(run: Run) -> dict[str, float] | None:
    """Returns the best evaluation; None if there is none."""
    row = best_row(run.evaluations)
    if row is None:
        return None
    step, value, success = (run.evaluations.column(name)[row] for name in ("step", "mean_return", "success_rate"))
    return {"step": int(step), "mean_return": float(value), "success_rate": float(success)}


def best_text(best: dict[str, float] | None) -> str:
    """Returns the best evaluation as text, ``-`` for none."""
    if best is None:
        return "-"
    success = "" if math.isnan(best["success_rate"]) else f", success {best['success_rate']:.0%}"
    return f"{best['mean_return']:,.2f}{success} (step {best['step']:,})"


def steps_text(facts: dict[str, Any]) -> str:
    """Returns the steps done, and of how many where that is known."""
    asked = facts["steps_asked"]
    share = f" of {asked:,} ({min(facts['steps'] / asked, 1):.0%})" if asked else ""
    return f"{facts['steps']:,}{share}"


def lines(facts: dict[str, Any]) -> list[str]:
    """Returns the state of a run as lines of text."""
    seed = "" if facts["seed"] is None else f", seed {facts['seed']}"
    found = [
        f"run           {facts['name']}: {facts['env'] or 'unknown environment'}, {facts['algorithm'] or 'unknown'}{seed}",
        f"state         {facts['state']}",
        f"steps         {steps_text(facts)}",
    ]
    if math.isfinite(facts["seconds"]):
        left = facts["seconds_left"]
        rest = f", about {left:,.0f} s left" if left is not None and math.isfinite(left) else ""
        found.append(f"time          {facts['seconds']:,.1f} s, {facts['steps_per_second']:,.0f} steps/s{rest}")
    if math.isfinite(facts["mean_return"]):
        n = min(facts["episodes"], WINDOW)
        latest = f"over the last {counted(n, 'episode')}" if n else "in the latest row of metrics.csv"
        found.append(f"training      return {facts['mean_return']:,.2f} {latest}")
    found.append(f"best          {best_text(facts['best'])}")
    found += [f"warning       {one}" for one in facts["warnings"]]
    return [*found, *(f"note          {one}" for one in facts["notes"])]
