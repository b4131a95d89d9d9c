"""The folder of a run: its files, and its models."""

from __future__ import annotations

import os
import re
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from rejeu.core import checkpoint
from rejeu.core.validation import as_path
from rejeu.logs.formatting import quoted

RUN_FILE = re.compile(r"run_(\d{12})\.safetensors")
"""Name of a checkpoint, with its environment step."""


@dataclass(frozen=True)
class File:
    """The path of a file or folder in a folder, as an attribute of the class of that folder."""

    name: str

    def __get__(self, folder: Any, owner: type) -> Path:
        path: Path = folder.path
        return path / self.name


@dataclass(frozen=True)
class RunFolder:
    """The files of one run."""

    path: Path
    """The folder."""

    config = File("config.json")
    """Everything needed to repeat the run."""
    episodes = File("episodes.csv")
    """One row an episode of training."""
    metrics = File("metrics.csv")
    """Means, losses and rates while training."""
    evaluations = File("evaluations.csv")
    """One row an evaluation."""
    agent = File("agent.safetensors")
    """The last model."""
    best = File("best.safetensors")
    """The model that evaluated best."""
    checkpoints = File("checkpoints")
    """Folder of the checkpoints from which the run can be resumed."""
    lock = File("checkpoints/lock")
    """Held by the process that trains."""
    curve = File("curve.png")
    """The learning curve."""
    replays = File("replays.csv")
    """Episodes of the trained agent, one row each; read by :mod:`rejeu.lab.runs.read`."""
    goals = File("goals.csv")
    """Goals of the newest episodes of evaluations, one row each, and whether they were reached."""
    report = File("report.html")
    """The page about the run."""
    remarks = File("remarks.json")
    """Note and tags of a person; read by :mod:`rejeu.lab.runs.read`."""
    warnings = File("warnings.txt")
    """Warnings of the training, and the error that ended it, one a line; read by :mod:`rejeu.lab.runs.read`."""
    video = File("video.mp4")
    """A few episodes of the best model."""

    models = File("models")
    """Folder of the models of some evaluations, in the course of training."""
    watch = File("watch")
    """Request to show the current policy; see :mod:`rejeu.lab.runs.requests`."""
    stop = File("stop")
    """Request to stop."""
    paused = File("paused")
    """Says of a run that is not complete that it ended as ``--pause``, ``--steps`` or ``--minutes`` had asked."""
    live = File("live.safetensors")
    """The current model, while it is watched."""
    videos = File("videos")
    """Folder of videos of the policy during training."""

    @property
    def marks(self) -> tuple[Path, ...]:
        """The files any of which makes a folder that of a run: its configuration and its tables."""
        return self.config, self.episodes, self.metrics


def newest_inside(folder: Path) -> str:
    """Returns the part of a message that names the newest run in a folder of runs; empty if there is none."""
    configs = [*folder.glob("*/config.json")] if folder.is_dir() else []
    if not configs:
        return ""
    newest = max(configs, key=lambda path: path.stat().st_mtime)
    return f"; the newest of the {len(configs)} in it is {quoted(newest.parent)}"


def dated(*names: str | None) -> Path:
    """Returns the path of a folder under ``runs``, of these names, those that are None left out, and the time."""
    stem = "-".join([*filter(None, names), time.strftime("%Y%m%d-%H%M%S")])
    return Path("runs") / re.sub(r"[^\w.-]+", "-", stem)


def create(out: Path | None, env_id: str, algorithm: str, seed: int) -> RunFolder:
    """Makes an empty folder: ``out``, or a new one under ``runs`` named after the run and the time.

    Raises:
        FileExistsError: if ``out`` is a file or holds something.
    """
    while out is not None:
        check_free(out)
        out.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):  # another process was faster; what it holds is named by the check
            RunFolder(out).config.touch(exist_ok=False)
            return RunFolder(out)
    first, n = dated(env_id, algorithm, f"seed{seed}"), 1
    while True:
        path = first if n == 1 else first.with_name(f"{first.name}-{n}")
        try:
            path.mkdir(parents=True)
            return RunFolder(path)
        except FileExistsError:
            n += 1


def check_free(out: Path | None) -> None:
    """Raises ``FileExistsError`` unless a folder is new or empty: nothing is ever overwritten."""
    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"{out} exists and is not an empty folder; name another, or remove it first")


def find_model(run: str | Path, which: Literal["best", "last"] = "best") -> Path:
    """Returns the model of a run folder, or a model file, whose suffix may be left out. All that takes a model takes these.

    The best model of a run that was not evaluated is the last one.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = as_path(run)
    if os.path.isfile(path):  # unlike Path.is_file, False for a name that is too long
        return path
    if not os.path.isdir(path) or (path.name not in ("", "..") and os.path.isfile(checkpoint.resolve(path))):
        try:
            return checkpoint.existing(path)
        except FileNotFoundError:
            raise FileNotFoundError(f"there is no run folder or model file {path}") from None
    folder = RunFolder(path)
    for model in (folder.best, folder.agent) if which == "best" else (folder.agent,):
        if model.is_file():
            return model
    newest = newest_inside(path) or "; a run folder holds best.safetensors or agent.safetensors"
    raise FileNotFoundError(f"{str(path)!r} is a folder without a model{newest}")


def checkpoint_files(folder: Path) -> list[Path]:
    """Returns the checkpoints in a folder, newest first."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if RUN_FILE.fullmatch(path.name)), reverse=True)


def step_of(path: Path) -> int:
    """Returns the environment step of a checkpoint."""
    match = RUN_FILE.fullmatch(path.name)
    assert match is not None
    return int(match[1])


def newest_step(folder: Path) -> int:
    """Returns the environment step of the newest checkpoint in a folder, -1 if there is none."""
    paths = checkpoint_files(folder)
    return step_of(paths[0]) if paths else -1
