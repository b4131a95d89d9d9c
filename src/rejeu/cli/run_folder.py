"""The folder that a run leaves behind."""

from __future__ import annotations

import json
import platform
import re
import time
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from rejeu import atomic
from rejeu.errors import CheckpointError

Which = Literal["best", "last"]
KINDS: dict[str, Any] = {
    "str": str,
    "bool": bool,
    "int": int,
    "int | None": int | None,
    "float | None": float | int | None,
    "dict[str, Any]": dict,
}
"""What the annotations of :class:`RunConfig` allow."""


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
        """The model as it was at the end."""
        return self.path / "agent.safetensors"

    @property
    def best(self) -> Path:
        """The model that evaluated best."""
        return self.path / "best.safetensors"

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints from which the run can go on."""
        return self.path / "checkpoints"

    @property
    def curve(self) -> Path:
        """The learning curve."""
        return self.path / "curve.png"

    @property
    def films(self) -> Path:
        """Folder of films of the policy while it learnt."""
        return self.path / "films"

    @property
    def video(self) -> Path:
        """A few episodes of the best model."""
        return self.path / "video.mp4"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """What a run was asked to do."""

    env: str
    """Id of the environment."""
    algorithm: str
    """Name of the algorithm."""
    preset: bool
    """Whether the hyper-parameters began from a preset."""
    hyperparameters: dict[str, Any]
    """All of them, defaults included."""
    policy: str
    seed: int
    n_envs: int
    backend: str
    """The backend that stepped the environments; never ``auto``."""
    steps: int | None
    """Environment steps to take, None where ``minutes`` ended the run."""
    minutes: float | None
    """Minutes of training, None where ``steps`` ended the run."""
    success_threshold: float | None
    """Return from which on an episode counts as a success where the environment does not say; None for its own."""
    film_every: int | None
    """Environment steps between two films of the policy, None for none."""
    evaluate_every: int
    evaluate_episodes: int
    checkpoint_minutes: float | None
    """Minutes between two checkpoints, None for none."""


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
        FileNotFoundError: if the folder is of no run.
        CheckpointError: if the file is damaged.
    """
    if not folder.config.is_file():
        raise FileNotFoundError(f"{folder.path} is no run folder: it holds no {folder.config.name}")
    try:
        content = json.loads(folder.config.read_text(encoding="utf-8"))
        config = RunConfig(**{field.name: content[field.name] for field in fields(RunConfig)})
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{folder.config} is damaged: {type(error).__name__} {error}") from None
    for field in fields(RunConfig):
        value = getattr(config, field.name)
        if not isinstance(value, KINDS[str(field.type)]):
            raise CheckpointError(f"{folder.config} is damaged: {field.name} is {str(value)[:40]!r}, not {field.type}")
    return config


def versions() -> dict[str, str | None]:
    """Returns the version of Python and of each package that shapes a run, None where it is not installed."""
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
        other = "last" if which == "best" else "best"
        raise FileNotFoundError(
            f"{run} holds no {model.name}; is it a run folder? --which {other} takes the other model"
        )
    return model


def environment_of(model: Path) -> str:
    """Returns the id of the environment that a model file was trained on: of one that is registered here.

    Gymnasium imports the module before a colon in an id. No id that was saved holds one, and none is taken from a file: what
    is imported must not be a file's choice.

    Raises:
        CheckpointError: if the file does not say, or is no model.
    """
    from rejeu import checkpoint

    env_id = checkpoint.read_header(model, "agent").get("env_id")
    if not isinstance(env_id, str) or not re.fullmatch(r"[\w./-]{1,200}", env_id):
        raise CheckpointError(f"{model} does not say which environment it is for; load it in Python: rejeu.load(path)")
    return env_id
