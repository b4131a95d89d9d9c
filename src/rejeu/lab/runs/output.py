"""Output of ``rejeu train`` and ``rejeu resume`` on the terminal."""

from __future__ import annotations

import math
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from rejeu.agents import Agent
from rejeu.callbacks import Evaluate, Evaluated
from rejeu.checkpoints.run_folder import RunFolder, checkpoint_files
from rejeu.core import atomic, xla
from rejeu.core.errors import RunInUseError, one_line
from rejeu.core.interrupt import NAMES
from rejeu.core.types import JsonObject
from rejeu.envs.registry import register
from rejeu.lab.runs.config import DecidedRun
from rejeu.lab.runs.environment import Environment
from rejeu.lab.runs.read import RunSummary, read_warnings
from rejeu.lab.runs.requests import keep_model
from rejeu.logs.formatting import counted, quoted
from rejeu.logs.logging import Sink
from rejeu.logs.tables import MEANS, written

echo = partial(print, flush=True)
MOST_GOALS = 100
"""Newest episodes of evaluations whose goals are kept."""


class Stopwatch:
    """Measures wall time and compilation time since it was made."""

    def __init__(self) -> None:
        self._began, self._clock = time.perf_counter(), xla.clock()

    def seconds(self) -> tuple[float, float]:
        """Returns wall time, and how much of it was compilation."""
        wall = time.perf_counter() - self._began
        return wall, max(wall - (xla.clock() - self._clock), 0.0)  # which rounds below 0 where nothing was compiled


def header(config: DecidedRun, environment: Environment, backend: str, folder: RunFolder) -> str:
    """Returns the first lines of a run; ``backend`` describes the backend."""
    length = f"{config.minutes:g} minutes" if config.steps is None else f"{config.steps:,} steps"
    every = f"evaluated on {counted(config.evaluate_episodes, 'episode')} every {config.evaluate_every:,} steps"
    return (
        f"environment   {environment}, {config.n_envs} at once\n"
        f"backend       {backend}\n"
        f"algorithm     {config.algorithm}, {'preset' if config.preset else 'no preset'}, seed {config.seed}\n"
        f"training      {length}, {every}\n"
        f"run folder    {folder.path}"
    )


def reporter(agent: Agent, table: Sink, folder: RunFolder, label: str = "") -> Callable[[Evaluated, bool], None]:
    """Returns a function that prints an evaluation, after ``label``, adds it to a table, and keeps its model and goals."""
    recent: deque[list[float]] = deque(maxlen=MOST_GOALS)

    def report(result: Evaluated, is_best: bool) -> None:
        evaluation = result.evaluation
        means = {name: getattr(evaluation, name) for name in MEANS}
        row = {"seconds": agent.seconds["total"], **means, "episodes": len(evaluation.returns), "best": int(is_best)}
        table.write(result.step, row)
        keep_model(agent, folder.models, result.step)
        rows = zip(evaluation.successes.tolist(), evaluation.goals.tolist(), strict=False)
        recent.extend([result.step, success, *goal] for success, goal in rows)
        if recent:
            write = partial(atomic.write, folder.goals, written(("step", "success"), recent))
            agent.failed_writes.attempt(f"goals {folder.goals}", write, is_row=True)
        success = "" if math.isnan(evaluation.success_rate) else f"success {evaluation.success_rate:6.1%}  "
        ending = "  (best)" if is_best else ""
        echo(f"{label}step {result.step:>9,}  {success}return {evaluation.mean_return:,.2f}{ending}")

    return report


def as_dict(
    agent: Agent, folder: RunFolder, evaluate: Evaluate, signal: int | None, is_complete: bool, stopwatch: Stopwatch
) -> JsonObject:
    """Returns how a run ended, for :func:`summary` and ``--json``."""
    last = agent.history.summary(agent.stats_window_size).last
    best = evaluate.best
    seconds, compile_seconds = stopwatch.seconds()
    return {
        "run": folder.path,
        "env_id": None if agent.run.env is None else agent.run.env.env_id,
        "algorithm": agent.name,
        "seed": agent.seed,
        "complete": is_complete,
        "signal": signal,
        "steps": agent.num_timesteps,
        "episodes": len(agent.history),
        "seconds": seconds,
        "compile_seconds": compile_seconds,
        "steps_per_second": agent.steps_per_second,
        "training": {"episodes": last.n, **{name: getattr(last, name) for name in MEANS}},
        "best": None if best is None else {"step": best.step, **best.evaluation.to_dict()},
        "files": sorted(path.name for path in folder.path.iterdir()),
        "not_written": [*agent.failed_writes.failures],
    }


def summary(facts: JsonObject, agent: Agent, folder: RunFolder, environment: Environment, evaluate: Evaluate) -> str:
    """Returns the last lines of a run; ``facts`` are those of :func:`as_dict`."""
    options = environment.run.again()
    lines = [""]
    if not facts["complete"]:
        can_resume = checkpoint_files(folder.checkpoints)
        how = f"; rejeu resume {quoted(facts['run'])}{options} continues" if can_resume else ""
        ending = "paused" if facts["signal"] is None else f"stopped by {NAMES[facts['signal']]}"
        saved = "; everything is saved" if agent.failed_writes.complete else ""
        lines.append(f"{ending}{saved}{how}")
    if (last := facts["training"])["episodes"]:
        success = "" if math.isnan(last["success_rate"]) else f"success {last['success_rate']:.1%}, "
        text = f"return {last['mean_return']:.2f} ± {last['std_return']:.2f}, length {last['mean_length']:.1f}"
        lines.append(f"training      last {counted(last['episodes'], 'episode')}: {success}{text}")
    if evaluate.best is not None:
        lines.append(f"best model    step {evaluate.best.step:,}: {evaluate.best.evaluation}")
    backend = " --backend gymnasium" if register(environment.env_id) else ""
    steps = f"; {agent.num_timesteps:,} steps at {agent.steps_per_second:,.0f} steps/s" if agent.num_timesteps else ""
    try_it = f"try it        rejeu evaluate {quoted(facts['run'])}{options}{backend}"
    return "\n".join(
        [
            *lines,
            f"files         {facts['run']}: {', '.join(facts['files'])}",
            f"time          {facts['seconds']:.1f} s in all, {facts['compile_seconds']:.1f} s of them compiling{steps}",
            *([try_it] if {folder.best.name, folder.agent.name} & {*facts["files"]} else ()),
        ]
    )


@contextmanager
def noted_in(path: Path) -> Iterator[None]:
    """Context whose warnings, and the error that ends it, are also written to a file, one a line."""
    show = warnings.showwarning

    def note(text: Warning | str) -> None:
        with suppress(OSError), atomic.open_file(path) as file:
            file.write(f"{one_line(text)}\n".encode())

    def show_and_note(message: Warning | str, *arguments: Any, **options: Any) -> None:
        show(message, *arguments, **options)
        note(message)

    if path.exists() and RunSummary(path=path, name="", warnings=read_warnings(path)).error:
        note("the run was resumed after this error")
    warnings.showwarning = show_and_note
    try:
        yield
    except Exception as error:
        if not isinstance(error, RunInUseError):  # the file is that of the run in the other process
            note(f"{type(error).__name__}: {error}")
        raise
    finally:
        warnings.showwarning = show
