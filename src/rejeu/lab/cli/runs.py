"""``rejeu runs`` and ``status``: lists of runs, and how far one is."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from rejeu.core.records import shown
from rejeu.lab.cli.commands import Runs, Status
from rejeu.lab.reporting import run_list
from rejeu.lab.reporting.runs import RunSummary, best_row
from rejeu.logs import formatting
from rejeu.logs.formatting import counted

WINDOW = 100
"""Training episodes in the mean that is shown."""
EXIT = {"running": 0, "finished": 0, "unknown": 0, "interrupted": 3, "crashed": 4}
"""Exit status of ``rejeu status`` by the state of a run."""
WIDE = 10_000
"""Columns of a table that is not written to a terminal, so that no cell is folded."""


def run_runs(arguments: Runs) -> tuple[int, dict[str, Any]]:
    """Prints a table of the runs in a folder."""
    rows, unreadable = [], []
    if not arguments.folder.exists():
        raise FileNotFoundError(f"there is no folder {arguments.folder}; rejeu train ENV makes runs in the folder runs")
    for path in run_list.find(arguments.folder):
        try:
            rows.append({"run": str(path), **describe(run_list.read(path))})
        except (OSError, ValueError, ImportError) as error:
            unreadable.append(shown(f"{path}: {error}", 300))
    if not arguments.json:
        if rows:
            show_runs(rows)
        else:
            print(f"there are no runs in {arguments.folder}; rejeu train ENV makes one")
        for one in unreadable:
            print(f"note: {one}")
    return 0, {"runs": rows, "unreadable": unreadable}


def show_runs(rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints the table."""
    head = ["run", "environment", "algorithm", "state", "steps", "best result"]
    names = ("env", "algorithm", "state")
    cells = ([shown(row["run"], 300), *(row[name] for name in names), steps_of(row), best_of(row)] for row in rows)
    show_table(head, cells, 3)


def steps_of(row: Mapping[str, Any]) -> str:
    """Returns the steps done, with their share of those asked for, unless all are done."""
    done, asked = row["steps"], row["steps_asked"]
    return f"{done:,} ({done / asked:.0%})" if asked and done < asked else f"{done:,}"


def best_of(row: Mapping[str, Any]) -> str:
    """Returns the best evaluation; of a run without one the mean return of the last training episodes."""
    if row["best"] is None and math.isfinite(row["mean_return"]):
        return f"{row['mean_return']:,.2f} in training"
    return best_text(row["best"]).partition(" (")[0]


def run_status(arguments: Status) -> tuple[int, dict[str, Any]]:
    """Prints the state of a run; the exit status is 3 if it was interrupted, 4 if it crashed."""
    summary = run_list.read(arguments.run)
    facts = describe(summary)
    if not arguments.json:
        print("\n".join(lines(facts)))
    return EXIT[summary.state], facts


def describe(run: RunSummary) -> dict[str, Any]:
    """Returns what is worth knowing of a run, as plain values."""
    compiling = run.metrics.column("time/compile_seconds")
    seconds = run.seconds - (float(compiling[-1]) if len(compiling) and np.isfinite(compiling[-1]) else 0.0)
    rate = run.steps / seconds if seconds > 0 else math.nan
    left = max(run.steps_asked - run.steps, 0) / rate if run.steps_asked and rate else math.nan
    if run.minutes_asked is not None:
        left = max(60 * run.minutes_asked - seconds, 0.0)
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


def best_evaluation(run: RunSummary) -> dict[str, float] | None:
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
    success = "" if math.isnan(best["success_rate"]) else f", {best['success_rate']:.0%} success"
    return f"{best['mean_return']:,.2f}{success} (step {best['step']:,})"


def steps_text(facts: dict[str, Any]) -> str:
    """Returns the steps done, and of how many where that is known."""
    asked = facts["steps_asked"]
    share = f" of {asked:,} ({min(facts['steps'] / asked, 1):.0%})" if asked else ""
    return f"{facts['steps']:,}{share}"


def lines(facts: dict[str, Any]) -> list[str]:
    """Returns the state of a run as lines of text."""
    seed = "" if facts["seed"] is None else f", seed {facts['seed']}"
    texts = [
        f"run           {facts['name']}: {facts['env'] or 'unknown environment'}, {facts['algorithm'] or 'unknown'}{seed}",
        f"state         {facts['state']}",
        f"steps         {steps_text(facts)}",
    ]
    if math.isfinite(facts["seconds"]):
        left = facts["seconds_left"]
        rest = f", about {left:,.0f} s left" if left is not None and math.isfinite(left) else ""
        texts.append(f"time          {facts['seconds']:,.1f} s, {facts['steps_per_second']:,.0f} steps/s{rest}")
    if math.isfinite(facts["mean_return"]):
        n = min(facts["episodes"], WINDOW)
        latest = f"over the last {counted(n, 'episode')}" if n else "in the latest row of metrics.csv"
        texts.append(f"training      return {facts['mean_return']:,.2f} {latest}")
    texts.append(f"best          {best_text(facts['best'])}")
    texts += [f"warning       {one}" for one in facts["warnings"]]
    return [*texts, *(f"note          {one}" for one in facts["notes"])]


def show_table(head: Sequence[str], rows: Iterable[Sequence[str]], n_text: int) -> None:
    """Prints a table. A narrow terminal folds the first ``n_text`` columns, which are text; numbers are never folded."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(box=box.SIMPLE, collapse_padding=True, pad_edge=False)
    for i, name in enumerate(head):
        is_text = i < n_text
        table.add_column(name, justify="left" if is_text else "right", overflow="fold", no_wrap=not is_text)
    for row in rows:
        table.add_row(*map(escape, row))
    console = formatting.console(highlight=False)
    if not console.is_terminal:
        console = formatting.console(highlight=False, width=WIDE)
    console.print(table)
