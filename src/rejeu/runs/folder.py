"""The folder of a run: its files, and its models."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from rejeu.errors import CheckpointError
from rejeu.io import atomic, checkpoint
from rejeu.io.records import WRONG
from rejeu.runs import config
from rejeu.runs.config import DecidedRun, quoted

RUN_FILE = re.compile(r"run_(\d{12})\.safetensors")
"""Name of a checkpoint, with its environment step."""


@dataclass(frozen=True)
class File:
    """The path of a file or folder in a folder, as an attribute of the class of that folder."""

    name: str

    def __get__(self, folder: Any, kind: type) -> Path:
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
    arrivals = File("arrivals.npy")
    """In which order the results of environments were taken, of a run with ``wait_for``; see :func:`read_arrivals`."""
    curve = File("curve.png")
    """The learning curve."""
    replays = File("replays.csv")
    """Episodes of the trained agent, one row each; read by :mod:`rejeu.reporting.runs`."""
    report = File("report.html")
    """The page about the run."""
    warnings = File("warnings.txt")
    """Warnings of the training, and the error that ended it, one a line; read by :mod:`rejeu.reporting.runs`."""
    video = File("video.mp4")
    """A few episodes of the best model."""

    @property
    def videos(self) -> Path:
        """Folder of videos of the policy during training; earlier versions called it ``films``."""
        videos, films = self.path / "videos", self.path / "films"
        return films if films.is_dir() and not videos.exists() else videos


def read_config(folder: RunFolder) -> DecidedRun:
    """Returns what the ``config.json`` of a run says.

    Raises:
        FileNotFoundError: if it is not a run folder.
        CheckpointError: if the file is damaged.
    """
    if not folder.config.is_file():
        raise FileNotFoundError(
            f"{folder.path} is no run folder: it holds no {folder.config.name}{newest_inside(folder.path)}"
        )
    return config.read(folder.config)


def newest_inside(folder: Path) -> str:
    """Returns the part of a message that names the newest run in a folder of runs; empty if there is none."""
    configs = [*folder.glob("*/config.json")] if folder.is_dir() else []
    if not configs:
        return ""
    newest = max(configs, key=lambda path: path.stat().st_mtime)
    return f"; the newest of the {len(configs)} in it is {quoted(newest.parent)}"


def create(out: Path | None, env_id: str, algorithm: str, seed: int) -> RunFolder:
    """Makes an empty folder: ``out``, or a new one under ``runs`` named after the run and the time.

    Raises:
        FileExistsError: if ``out`` is a file or holds something.
    """
    if out is not None:
        check_free(out)
        out.mkdir(parents=True, exist_ok=True)
        return RunFolder(out)
    stem = re.sub(r"[^\w.-]+", "-", f"{env_id}-{algorithm}-seed{seed}-{time.strftime('%Y%m%d-%H%M%S')}")
    n = 1
    while True:
        path = Path("runs") / (stem if n == 1 else f"{stem}-{n}")
        try:
            path.mkdir(parents=True)
            return RunFolder(path)
        except FileExistsError:
            n += 1


def check_free(out: Path | None) -> None:
    """Raises ``FileExistsError`` if a run may not be written there: nothing is ever overwritten."""
    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise FileExistsError(f"--out {out} exists and is not an empty folder; name another, or remove it first")


def write_arrivals(folder: RunFolder, arrivals: np.ndarray) -> None:
    """Writes the order in which the results of environments were taken."""
    with atomic.replacing(folder.arrivals) as file:
        np.save(file, arrivals, allow_pickle=False)


def read_arrivals(path: Path) -> np.ndarray:
    """Returns what :func:`write_arrivals` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is not a NumPy array without pickles.
    """
    try:
        with path.open("rb") as file:  # np.load also opens zip files, which cannot be a record
            return np.lib.format.read_array(file, allow_pickle=False)
    except (*WRONG, EOFError) as error:
        raise CheckpointError(
            f"{path} is not the arrivals.npy of a run: {' '.join(str(error).split())[:100]}"
        ) from None


def find_model(run: str | Path, which: Literal["best", "last"] = "best") -> Path:
    """Returns the model of a run folder, or a model file, whose suffix may be left out. All that takes a model takes these.

    The best model of a run that was not evaluated is the last one.

    Raises:
        FileNotFoundError: if there is none.
    """
    path = Path(run)
    if path.is_file():
        return path
    if not path.is_dir() or (path.name not in ("", "..") and checkpoint.resolve(path).is_file()):
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


def run_files(folder: Path) -> list[Path]:
    """Returns the checkpoints in a folder, newest first."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if RUN_FILE.fullmatch(path.name)), reverse=True)


def step_of(path: Path) -> int:
    """Returns the environment step of a checkpoint."""
    found = RUN_FILE.fullmatch(path.name)
    assert found is not None
    return int(found[1])


def newest_step(folder: Path) -> int:
    """Returns the environment step of the newest checkpoint in a folder, -1 if there is none."""
    found = run_files(folder)
    return step_of(found[0]) if found else -1
