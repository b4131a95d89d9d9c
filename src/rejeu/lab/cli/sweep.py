"""``rejeu sweep`` and ``rejeu train ENV --seeds N``: many runs, in processes or in one program, and their comparison."""

from __future__ import annotations

import dataclasses
import os
from contextlib import ExitStack, closing
from pathlib import Path

from rejeu.agents import find_agent, training
from rejeu.agents.device import reason_against, require_memory
from rejeu.agents.together import learn_together, sibling
from rejeu.checkpoints.run_folder import RunFolder, check_free, dated
from rejeu.core import devices
from rejeu.core.errors import MissingExtra
from rejeu.core.interrupt import NAMES, Interrupt
from rejeu.core.types import JsonObject
from rejeu.core.validation import choice
from rejeu.envs.functional import is_functional
from rejeu.envs.make import BACKENDS
from rejeu.lab.cli.commands import Sweep
from rejeu.lab.experiments.folder import Plan, SweepFolder, open_folder, read_folder
from rejeu.lab.experiments.sweep import SweepResult, imports_of, make_launcher, prepare, states_text, train
from rejeu.lab.experiments.work import FILES, Job, Work, again
from rejeu.lab.reporting.comparison import By, Comparison, compare
from rejeu.lab.reporting.report import write_report
from rejeu.lab.runs.arguments import Resume, Train
from rejeu.lab.runs.begin import begin
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.environment import find_id
from rejeu.lab.runs.output import Stopwatch, echo, header
from rejeu.lab.runs.process import default_workers, hold, threads_of
from rejeu.lab.runs.session import Session, installed_logs, make_evaluation_env
from rejeu.logs.formatting import counted, quoted


def run_sweep(arguments: Sweep) -> tuple[int, JsonObject]:
    """Begins or joins a sweep; the exit status is 0, 2 if a run failed, 1 if one was left, 130 or 143 after a signal."""
    typed = RunConfig(env="", imports=arguments.imports)
    folder = prepare(arguments.plan, arguments.out, arguments.workers, typed, arguments.ray)
    return complete(folder, typed, arguments.workers, arguments.ray, retry=False)


def resume(arguments: Resume) -> tuple[int, JsonObject]:
    """Completes the sweep in a folder, failed runs included; returns the exit status and the result."""
    options = {key: getattr(arguments, key) for key in ("env_kwargs", "wrappers", "imports")}
    typed = RunConfig(env=arguments.env or "", **options)
    folder = read_folder(arguments.run, typed)
    return complete(folder, typed, arguments.workers, arguments.ray, retry=True)


def complete(
    folder: SweepFolder, typed: RunConfig, workers: int | None, ray: str | None, retry: bool
) -> tuple[int, JsonObject]:
    """Trains what is missing in a folder, compares the runs, and returns the exit status and the result."""
    launcher = make_launcher(folder, workers, ray)
    echo(f"run folders   {folder.path}, {counted(len(folder.plan.jobs), 'run')}, {launcher.capacity} at once")
    typed = dataclasses.replace(typed, imports=imports_of(folder, typed))
    with Interrupt() as stop:
        scheduler = train(folder, launcher, stop, typed.imports, retry)
    return finish(folder, scheduler.works, typed, stop)


def finish(folder: SweepFolder, works: list[Work], typed: RunConfig, stop: Interrupt) -> tuple[int, JsonObject]:
    """Says what has become of the jobs and compares the runs; returns the exit status and the result."""
    result = SweepResult(folder.path, tuple(works))
    states = {outcome.state for outcome in result.outcomes}
    resume = f"rejeu resume {quoted(folder.path)}{again(folder.plan.jobs, typed)}"
    echo(f"{counted(len(works), 'run')}: {states_text(result.outcomes)}")
    if "failed" in states:
        echo(f"{resume} tries failed runs again")
    comparison = summarize(folder.path, "setting" if len({job.setting for job in folder.plan.jobs}) > 1 else None)
    status = 2 if "failed" in states else 1 if states & {"waiting", "stopped"} else 0
    if stop.signal is not None:
        echo(f"stopped by {NAMES[stop.signal]}; {resume} continues")
        status = 128 + stop.signal
    rows = None if comparison is None else comparison.table()
    return status, {"folder": folder.path, **result.counts(), "runs": result.table(), "comparison": rows}


def summarize(folder: Path, by: By | None = None) -> Comparison | None:
    """Writes ``compare.html`` and prints the scores with their intervals, or why there are none; returns the comparison."""
    try:
        comparison = compare(folder, by)
    except (ValueError, FileNotFoundError) as error:
        echo(f"no comparison: {error}")
        return None
    echo(comparison)
    try:
        echo(f"comparison    {comparison.save(folder / 'compare.html')[0]}")
    except (MissingExtra, OSError) as error:
        echo(f"no compare.html: {error}; rejeu compare {quoted(folder)} --out compare.md writes the tables")
    return comparison


def train_all(arguments: Train) -> tuple[int, JsonObject]:
    """Trains all seeds and compares them; returns the exit status and the result."""
    jobs = make_jobs(arguments)
    threads = threads_of(min(arguments.jobs or default_workers(), len(jobs)))
    folder = open_folder(choose_folder(arguments), Plan(jobs=jobs, threads=threads), None, arguments)
    return complete(folder, arguments, arguments.jobs, None, retry=False)


def make_jobs(arguments: Train) -> tuple[Job, ...]:
    """Returns one job for each seed.

    Raises:
        ValueError: for an unknown algorithm, backend, device or log.
        MissingExtra: if what ``--log`` or ``--video-every`` need is not installed.
    """
    assert arguments.seeds is not None
    first = arguments.seed or 0
    values = {field.name: getattr(arguments, field.name) for field in dataclasses.fields(RunConfig)}
    installed_logs(arguments)
    devices.named(arguments.device, "--device")
    choice("--backend", arguments.backend or "auto", BACKENDS)
    if arguments.algorithm is not None:
        values["algorithm"] = find_agent(arguments.algorithm).algorithm.Config.name
    if arguments.ray not in (None, "auto"):
        os.environ["RAY_ADDRESS"] = arguments.ray  # no file may name an address
    run = RunConfig(**{**values, "ray": None if arguments.ray is None else "auto", "imports": ()})
    seeds = range(first, first + arguments.seeds)
    outputs = {name: getattr(arguments, name) for name in FILES}
    return tuple(Job(name=f"seed_{seed}", run=dataclasses.replace(run, seed=seed), **outputs) for seed in seeds)


def choose_folder(arguments: Train) -> Path:
    """Returns a new or empty folder for the run folders: ``--out``, or one under ``runs``."""
    check_free(arguments.out)
    return arguments.out or dated(arguments.env, arguments.algorithm, "seeds")


def fit_together(arguments: Train) -> bool:
    """Returns whether seeds are trained in one program: in a JAX environment without wrappers, and without ``--jobs``.

    Imports the environment if it is one of the user's own.
    """
    return arguments.jobs is None and not arguments.wrappers and is_functional(find_id(arguments.env))


def train_together(arguments: Train) -> tuple[int, JsonObject]:
    """Trains all seeds and compares them; returns the exit status and the result.

    Settings that cannot be trained on the device are trained in processes.
    """
    stopwatch, jobs = Stopwatch(), make_jobs(arguments)
    path = choose_folder(arguments)
    with ExitStack() as stack:
        first = begin(dataclasses.replace(arguments, seed=jobs[0].seed), stack, write_report)
        if reason := reason_against(first.agent, ()):
            echo(f"the seeds are trained in processes of their own, not in one program: {reason}")
            return train_all(arguments)
        require_memory(first.agent, len(jobs))
        folder = open_folder(path, Plan(jobs=jobs, threads=threads_of(1)), None, arguments)
        sessions = [first, *(with_seed(first, job.seed, stack) for job in jobs[1:])]
        works = folder.works()
        pairs = zip(sessions, works, strict=True)
        sessions = [session.in_folder(work.files, f"seed {work.job.seed}: ") for session, work in pairs]
        backend = f"{first.backend}, {len(jobs)} seeds in one program"
        echo(header(first.config, first.environment, backend, RunFolder(path)))
        for work in works:
            claim = hold(work.claim)
            assert claim is not None, "another process uses a new folder"
            stack.callback(claim.release)
        with Interrupt() as stop:
            statuses = train_sessions(sessions, stop, stopwatch)
        if stop.signal is None:
            for work, status in zip(works, statuses, strict=True):
                work.write_exit(status)
    return finish(folder, works, arguments, stop)


def with_seed(first: Session, seed: int, stack: ExitStack) -> Session:
    """Returns the session of another seed, whose agent shares the compiled functions of the first; ``stack`` closes it."""
    config = dataclasses.replace(first.config, seed=seed)
    env = stack.enter_context(closing(first.environment.vector(config.n_envs, config.backend, seed)))
    evaluation_env = stack.enter_context(closing(make_evaluation_env(config, first.environment)))
    return first._replace(agent=sibling(first.agent, env, seed), config=config, evaluation_env=evaluation_env)


def train_sessions(sessions: list[Session], stop: Interrupt, stopwatch: Stopwatch) -> list[int]:
    """Trains the runs together and finishes each; returns their exit statuses."""
    agents = [session.agent for session in sessions]
    with ExitStack() as stack:
        learnings = [stack.enter_context(session.training(stop)) for session in sessions]
        calls = [
            training.start_call(agent, session.limits.steps, None, session.limits.minutes, session.log_interval, True)
            for agent, session in zip(agents, sessions, strict=True)
        ]
        callbacks, sinks = zip(*((learning.callbacks, learning.sinks) for learning in learnings), strict=True)
        learn_together(agents, calls, callbacks, sinks, progress_bar=True)
    finished = zip(sessions, learnings, strict=True)
    return [session.finish(learning, stop, stopwatch)[0] for session, learning in finished]
