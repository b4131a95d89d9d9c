"""Arguments of a run, to begin, continue or branch it: those of commands, and of the forms of the studio."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from rejeu.core.records import MAX_ENVS, Duration, Positive, Seed
from rejeu.core.types import Settings
from rejeu.lab.runs.config import MAX_EPISODES, EnvironmentOptions, RunConfig, Shown, Task, Topic

EPISODES = "Episodes of each evaluation; by default the preset's, else 20."
Count = Annotated[Positive | None, Shown("N")]
EnvCount = Annotated[Annotated[int, Meta(ge=1, le=MAX_ENVS)] | None, Shown("N")]
EpisodeCount = Annotated[
    Annotated[int, Meta(ge=1, le=MAX_EPISODES)] | None, Shown("N", help=EPISODES), Topic.EVALUATION
]
Several = Annotated[Annotated[int, Meta(ge=1, le=1000)] | None, Shown("N")]
SeedOrNone = Annotated[Seed | None, Shown("N")]
Minutes = Annotated[Duration | None, Shown("M")]
Rate = Annotated[float | None, Shown("N", help="Steps a second; by default the environment's own.")]
Folder = Annotated[Path | None, Shown("DIR")]
RunPath = Annotated[Path, Shown("RUN", is_positional=True, help="Its folder.")]
NoReport = Annotated[bool, Shown(help="Write no report.html and draw no curve.png at the end."), Topic.OUTPUT]
NoVideo = Annotated[bool, Shown(help="Record no video at the end."), Topic.OUTPUT]
Json = Annotated[
    bool, Shown(help="Print the result as one JSON document, and messages to standard error."), Topic.OUTPUT
]


@dataclass(frozen=True, kw_only=True)
class RunOptions(EnvironmentOptions):
    """How the environment of a run is made, by default as the run says. Abstract."""

    env: Annotated[str | None, Shown("ENV"), Topic.ENVIRONMENT] = None
    """Environment, as for rejeu train; by default the run's. One that is imported must be named again."""


@dataclass(frozen=True, kw_only=True)
class Train(RunConfig):
    """Trains an agent and leaves a run folder: models, tables, learning curve, video.

    Ctrl-C stops cleanly; rejeu resume continues. Example: rejeu train Pendulum-v1 --steps 20000 --set learning_rate=1e-3
    """

    assist: Annotated[bool, Topic.TRAINING] = False
    """Open a window on the environment, in which you act in place of the agent while you hold a key. Your steps are also
    written to a Minari dataset, the folder assisted of the run."""
    fps: Annotated[Rate, Topic.TRAINING] = None
    offline: Annotated[Path | None, Shown("DATASET"), Topic.TRAINING] = None
    """Learn from the Minari dataset in this folder, without stepping the environment, which only evaluates: each step is a
    gradient step. By default with IQL."""
    pause: Annotated[Count, Topic.TRAINING] = None
    """Pause after so many environment steps; rejeu resume continues to the goal."""
    seeds: Annotated[Several, Topic.TRAINING] = None
    """Train this many seeds, from --seed or 0 on, each in a folder of its own, and compare them in the end. In JAX
    environments one program trains all of them; elsewhere, and with --jobs, each has a process of its own."""
    jobs: Annotated[Several, Topic.TRAINING] = None
    """With --seeds: how many are trained at once; by default half as many as there are cores."""
    out: Folder = None
    """Run folder, new or empty; by default one under runs, named after the run and the time."""
    no_report: NoReport = False
    no_video: NoVideo = False
    json: Json = False


@dataclass(frozen=True, kw_only=True)
class Continued(RunOptions):
    """How a run goes on from a checkpoint. Abstract."""

    run: RunPath
    ray: Annotated[str | None, Shown("ADDRESS"), Topic.ENVIRONMENT] = None
    """Of a sweep, or of a run with --backend ray: use this Ray cluster, auto or HOST:PORT."""
    steps: Count = None
    """Pause after so many environment steps; the goal stays. Of a complete run, or beyond the goal: train for so many more."""
    minutes: Minutes = None
    """Pause after so many minutes; the goal stays. Of a complete run: train for so many more."""
    hyperparameters: Annotated[Settings, Shown("NAME=VALUE ...", "set")] = field(default_factory=dict)
    """Hyperparameters to change from here on, as for rejeu train; those that change shapes cannot be changed."""
    device: Annotated[str | None, Shown("NAME"), Topic.TRAINING] = None
    """As for rejeu train; by default cpu if the run was trained there on request, else auto."""
    restart_workers: Annotated[int, Meta(ge=0), Shown("N"), Topic.ENVIRONMENT] = 0
    """As for rejeu train; for this part of the run."""
    env_cpus: Annotated[Annotated[float, Meta(ge=0, le=10_000)] | None, Shown("N"), Topic.ENVIRONMENT] = None
    """With --backend ray: CPUs for each environment, a fraction if it mostly waits; by default 1, or 0 without --ray."""
    no_report: NoReport = False
    no_video: NoVideo = False
    json: Json = False


@dataclass(frozen=True, kw_only=True)
class Resume(Continued):
    """Resumes a run that was stopped, or that crashed, from its newest checkpoint; or a sweep or a study.

    Without --steps or --minutes it trains to the goal that was set when it began. Example: rejeu resume runs/NAME
    """

    finish: bool = False
    """Of a complete run whose process ended before all files were written: write them, rather than report an error."""
    workers: Several = None
    """Of a sweep or a study: runs at once; by default half as many as there are cores."""


@dataclass(frozen=True, kw_only=True)
class Branch(Continued):
    """Begins a new run from a checkpoint of another, with other hyperparameters; the other run is not changed.

    Up to the checkpoint both are the same. Example: rejeu branch runs/NAME --at 50000 --set learning_rate=1e-4
    """

    at: Annotated[Annotated[int, Meta(ge=0)] | None, Shown("STEP")] = None
    """Environment step to begin from: the checkpoint of this step, or the nearest before it; by default the newest."""
    out: Folder = None
    """Run folder, as for rejeu train."""


def of_task(task: Task) -> tuple[str, object]:
    """Returns the command that does what a process is asked to do, and its arguments."""
    run = vars(task.run)
    shared: Settings = {"no_report": task.no_report, "no_video": task.no_video}
    if not task.resume:
        return "train", Train(**run, **shared, out=Path(task.folder))
    again = {name: run[name] for name in ("imports", "restart_workers", "ray", "env_cpus")}
    if task.run.names_code:
        again |= {"env": task.run.typed, "env_kwargs": task.run.env_kwargs, "wrappers": task.run.wrappers}
    return "resume", Resume(run=Path(task.folder), finish=True, **again, **shared)


def check_options(arguments: object) -> None:
    """Raises ``ValueError`` if options exclude each other."""
    options = {key: value for key, value in vars(arguments).items() if value is not None}
    if {"steps", "minutes"} <= options.keys():
        raise ValueError("--steps and --minutes exclude each other; give one of them")
    if options.get("by_hand") and "expert" in options:
        raise ValueError("--by-hand and --expert exclude each other; give one of them")
    if options.get("assist") and "seeds" in options:
        raise ValueError("--assist is for a single run; leave it out, or --seeds")
    if {"pause", "seeds"} <= options.keys():
        raise ValueError("--pause is for a single run; leave it out, or --seeds")
    if "jobs" in options and "seeds" not in options:
        raise ValueError("--jobs is for several seeds; give --seeds N too")
    if "backend" in vars(arguments) and options.get("backend") != "ray" and {"ray", "env_cpus"} & options.keys():
        raise ValueError("--ray and --env-cpus are for --backend ray; give it too, or leave them out")
