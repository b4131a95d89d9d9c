"""Run folders: their files and their configuration."""

from __future__ import annotations

import json
import platform
import re
import time
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from rejeu.agents.model_files import WRONG
from rejeu.cli import environment
from rejeu.cli.commands import RunOptions, Which
from rejeu.cli.environment import Environment
from rejeu.cli.settings import MAX_EPISODES
from rejeu.errors import CheckpointError
from rejeu.io import atomic, checkpoint
from rejeu.io.records import Duration, EnvCount, Malformed, Positive, Seed, convert, parse_json, shown
from rejeu.reporting.logging import LOGS
from rejeu.reporting.runs import newest_inside

LogName = Annotated[str, Meta(pattern=f"^({'|'.join(LOGS)})$")]
MAX_CONFIG_BYTES = 2**20
"""Upper limit on the size of a ``config.json``."""


@dataclass(frozen=True)
class RunFolder:
    """The files of one run."""

    path: Path
    """The folder."""

    @property
    def config(self) -> Path:
        """Everything needed to repeat the run."""
        return self.path / "config.json"

    @property
    def episodes(self) -> Path:
        """One row an episode of training."""
        return self.path / "episodes.csv"

    @property
    def metrics(self) -> Path:
        """Means, losses and rates while training."""
        return self.path / "metrics.csv"

    @property
    def evaluations(self) -> Path:
        """One row an evaluation."""
        return self.path / "evaluations.csv"

    @property
    def agent(self) -> Path:
        """The last model."""
        return self.path / "agent.safetensors"

    @property
    def best(self) -> Path:
        """The model that evaluated best."""
        return self.path / "best.safetensors"

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints from which the run can be resumed."""
        return self.path / "checkpoints"

    @property
    def arrivals(self) -> Path:
        """In which order the results of environments were taken, of a run with ``wait_for``; see :func:`read_arrivals`."""
        return self.path / "arrivals.npy"

    @property
    def curve(self) -> Path:
        """The learning curve."""
        return self.path / "curve.png"

    @property
    def replays(self) -> Path:
        """Episodes of the trained agent, one row each; read by :mod:`rejeu.reporting.runs`."""
        return self.path / "replays.csv"

    @property
    def report(self) -> Path:
        """The page about the run."""
        return self.path / "report.html"

    @property
    def warnings(self) -> Path:
        """Warnings of the training, and the error that ended it, one a line; read by :mod:`rejeu.reporting.runs`."""
        return self.path / "warnings.txt"

    @property
    def videos(self) -> Path:
        """Folder of videos of the policy during training; earlier versions called it ``films``."""
        videos, films = self.path / "videos", self.path / "films"
        return films if films.is_dir() and not videos.exists() else videos

    @property
    def video(self) -> Path:
        """A few episodes of the best model."""
        return self.path / "video.mp4"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """The configuration of a run."""

    env: str
    """Id of the environment."""
    algorithm: str
    """Name of the algorithm."""
    preset: bool
    """Whether the hyperparameters are those of a preset, except where the command line changed them."""
    hyperparameters: dict[str, Any]
    """All of them, defaults included."""
    policy: str
    seed: Seed
    n_envs: EnvCount
    backend: str
    """The backend that stepped the environments; never ``auto``."""
    steps: Positive | None
    """Environment steps to take, None where ``minutes`` ended the run."""
    minutes: Duration | None
    """Minutes of training, None where ``steps`` ended the run."""
    success_threshold: float | None
    """Return from which on an episode counts as a success where the environment does not say; None for its own."""
    video_every: Positive | None
    """Environment steps between two videos of the policy, None for none; earlier versions called it ``film_every``."""
    evaluate_every: Positive
    evaluate_episodes: Annotated[int, Meta(ge=1, le=MAX_EPISODES)]
    checkpoint_minutes: Duration | None
    """Minutes between two checkpoints, None for none."""
    env_argument: str = ""
    """How the environment was named on the command line; used in messages only, never imported."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment."""
    wrappers: tuple[str, ...] = ()
    """Names of its wrappers, innermost first; used in messages only."""
    imports: tuple[str, ...] = ()
    """What ``--import`` named; used in messages only. Missing in older folders."""
    log: tuple[LogName, ...] = ()
    """Logs beside ``metrics.csv``."""
    wait_for: Positive | None = None
    """How many results are taken at a time, None where all environments step together; missing in older folders."""
    device: Annotated[str, Meta(pattern="^(auto|cpu|gpu)$")] = "auto"
    """The device that was asked for; the run can be resumed and its models loaded on any. Missing in older folders."""


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


def write_config(folder: RunFolder, config: RunConfig) -> None:
    """Writes ``config.json``, with the versions of what ran."""
    content = {**asdict(config), "versions": versions()}
    with atomic.replacing(folder.config) as file:
        file.write((json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def read_config(folder: RunFolder) -> RunConfig:
    """Returns what :func:`write_config` wrote.

    Raises:
        FileNotFoundError: if it is not a run folder.
        CheckpointError: if the file is damaged.
    """
    if not folder.config.is_file():
        raise FileNotFoundError(
            f"{folder.path} is no run folder: it holds no {folder.config.name}{newest_inside(folder.path)}"
        )
    try:
        if folder.config.stat().st_size > MAX_CONFIG_BYTES:
            raise Malformed(f"it has more than {MAX_CONFIG_BYTES:,} bytes")
        content = parse_json(folder.config.read_bytes())
        if isinstance(content, dict) and "film_every" in content:
            content.setdefault("video_every", content.pop("film_every"))
        return convert(content, RunConfig)
    except (Malformed, CheckpointError) as error:
        raise CheckpointError(f"{folder.config} is damaged: {shown(error, 1000)}") from None


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


def versions() -> dict[str, str | None]:
    """Returns the versions of Python and of the packages that matter for a run, None for those that are not installed."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for package in ("rejeu", "jax", "jaxlib", "numpy", "equinox", "optax", "gymnasium", "envpool", "highway-env"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def find_model(run: Path, which: Which) -> Path:
    """Returns the model file of a run folder, or ``run`` itself if it is a file.

    Raises:
        FileNotFoundError: if there is none.
    """
    if run.is_file():
        return run
    folder = RunFolder(run)
    model = folder.best if which == "best" else folder.agent
    if not run.is_dir():
        raise FileNotFoundError(f"there is no run folder or model file {run}")
    if not model.is_file():
        newest = newest_inside(run)
        if newest:
            raise FileNotFoundError(f"{run} is no run folder{newest}")
        other = "last" if which == "best" else "best"
        raise FileNotFoundError(
            f"{run} holds no {model.name}; is it a run folder? --which {other} takes the other model"
        )
    return model


def environment_of(model: Path, given: RunOptions) -> Environment:
    """Returns the environment for a model: what the command line says, else what the file and its run folder say.

    Raises:
        CheckpointError: if they do not say, if it must be typed again, or if the file is not a model.
        ValueError: if there is no such environment.
    """
    if given.env is not None:
        return environment.from_arguments(given.env, given)
    env_id = recorded_id(model)
    folder = RunFolder(model.parent)
    if model in (folder.best, folder.agent) and folder.config.is_file():
        config = read_config(folder)
        if config.env == env_id:
            return of_run(folder, config, given)
    return environment.from_run(env_id, "", {}, (), model, given)


def recorded_id(model: Path) -> Any:
    """Returns the id of the environment of a model file, unchecked; None if it has none.

    Raises:
        CheckpointError: if the file is not a model.
    """
    return checkpoint.read_header(model, "agent").get("env_id")


def of_run(folder: RunFolder, config: RunConfig, given: RunOptions) -> Environment:
    """Returns the environment of a run: what the command line says, else what its configuration says."""
    return environment.from_run(config.env, config.env_argument, config.env_kwargs, config.wrappers, folder.path, given)
