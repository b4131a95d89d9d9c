"""Run folders as records that reports and comparisons are made from.

Everything in a run folder is untrusted: sizes are bounded, symbolic links are not followed, nothing is imported or
evaluated, and whatever is missing or damaged becomes a note. A folder can be read while it is being written.
"""

from __future__ import annotations

import math
import os
import re
import stat
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import numpy as np
from filelock import Timeout

from rejeu.agents import presets
from rejeu.algorithms.catalog import CATALOG
from rejeu.checkpoints.run_folder import RunFolder, newest_inside, newest_step
from rejeu.core import atomic
from rejeu.core.errors import CheckpointError
from rejeu.core.records import Malformed, convert, json_text, parse_json, shown
from rejeu.core.types import Settings
from rejeu.lab.runs.config import MAX_BYTES, MAX_WORD, RunConfig
from rejeu.logs.formatting import quoted
from rejeu.logs.tables import EMPTY, Table, flat, read_bytes, read_table

MAX_WARNINGS = 100
MAX_WARNINGS_BYTES = 2**16
MAX_VIDEOS = 1000
MAX_NAME = 200
"""Upper limit on the length of a name or an id, in characters."""
MAX_STEP = 2**53
"""Upper limit on environment steps; larger numbers are damage."""
ERROR = re.compile(r"[A-Z]\w*(Error|Exception): ")
"""Beginning of the warning that names the error which ended a run, if it is the last one."""

MAX_NOTE, MAX_TAGS = 10_000, 20
"""Upper limits on the length of a note, in characters, and on the number of tags."""

UNKNOWN = RunConfig(env="", algorithm="")
"""The description of a run of which nothing is known."""
State = Literal["running", "finished", "paused", "interrupted", "crashed", "damaged", "unknown"]


@dataclass(frozen=True)
class Remarks:
    """Note and tags of a person about a run."""

    note: str = ""
    tags: tuple[str, ...] = ()

    def write(self, folder: RunFolder) -> None:
        """Writes them into the folder of a run, shortened to what is read."""
        content = {"note": self.note[:MAX_NOTE], "tags": [tag[:MAX_NAME] for tag in self.tags[:MAX_TAGS]]}
        atomic.write(folder.remarks, json_text(content))


NO_REMARKS = Remarks()


@dataclass(frozen=True, kw_only=True, eq=False)
class RunSummary:
    """Record of one run, as its files show it; see :func:`read_run`."""

    path: Path
    name: str
    format: Literal["rejeu", "agent", "monitor", "tensorboard"] = "rejeu"
    """Whose files they are: ``"monitor"`` are Stable-Baselines3's ``monitor.csv``; an ``"agent"`` in memory has none."""
    config: RunConfig = UNKNOWN
    """The description of the run, as far as it is known; environment and algorithm are empty if they are not."""
    versions: Mapping[str, str] = field(default_factory=dict)
    state: State = "unknown"
    steps: int = 0
    """Environment steps done, by the tables and the newest checkpoint."""
    seconds: float = math.nan
    """Training time so far."""
    episodes: Table = EMPTY
    """Columns ``step``, ``env``, ``return``, ``length``, ``success``, ``seconds``, in the order in which episodes ended."""
    evaluations: Table = EMPTY
    """Columns ``step``, ``seconds``, ``success_rate``, ``mean_return``, ``std_return``, ``mean_length``, ``episodes``,
    ``best``."""
    metrics: Table = EMPTY
    """Columns ``step``, ``rollout/...``, ``time/...``, ``train/...``."""
    goals: Table = EMPTY
    """Columns ``step``, ``success``, ``goal_0`` ...: the newest episodes of evaluations in goal environments."""
    replays: Table = EMPTY
    """Columns ``seed``, ``return``, ``length``, ``success``: episodes of the trained agent, each from its seed."""
    warnings: tuple[str, ...] = ()
    videos: tuple[Path, ...] = ()
    """Paths of mp4 files inside the folder, oldest first; the video of the best model is last."""
    models: tuple[Path, ...] = ()
    """Paths of the model files, the best first."""
    remarks: Remarks = NO_REMARKS
    notes: tuple[str, ...] = ()
    """One line for each thing that was missing or damaged."""

    @property
    def stepping_seconds(self) -> float:
        """Training time so far without compilation."""
        compiling = self.metrics.column("time/compile_seconds")
        return self.seconds - (float(compiling[-1]) if len(compiling) and np.isfinite(compiling[-1]) else 0.0)

    @property
    def steps_per_second(self) -> float:
        """Without compilation, as training measured it last; NaN if unknown."""
        rates = self.metrics.column("time/fps")
        rates, seconds = rates[np.isfinite(rates)], self.stepping_seconds
        return float(rates[-1]) if len(rates) else self.steps / seconds if seconds > 0 else math.nan

    @property
    def error(self) -> str:
        """The error that ended the run; empty if there was none, or the run was resumed since."""
        return next((text for text in self.warnings[-1:] if ERROR.match(text)), "")

    @cached_property
    def changed(self) -> dict[str, tuple[object, object]]:
        """Value and default of each hyperparameter that differs from the algorithm's default, by dotted name.

        Empty if the algorithm is neither rejeu's nor registered.
        """
        defaults = default_hyperparameters(self.config.algorithm)
        if not defaults:
            return {}
        default, value = dict(flat(defaults)), dict(flat(self.config.hyperparameters))
        return {name: (value[name], default.get(name)) for name in value if value[name] != default.get(name)}

    @cached_property
    def command(self) -> str:
        """The command that repeats the run, made from its configuration; empty if that is not known."""
        if self.format != "rejeu" or not self.config.algorithm:
            return ""
        preset = presets.find(self.config.env, self.config.algorithm)
        usual = default_hyperparameters(self.config.algorithm, preset.hyperparameters if preset else {})
        defaults = dict(flat(usual))  # by rejeu train if nothing is set
        values = dict(flat(self.config.hyperparameters))
        same = {
            name
            for name in values
            if usual and name not in self.changed and defaults.get(name, values[name]) == values[name]
        }
        hyperparameters = {name: value for name, value in values.items() if name not in same}
        minutes = self.config.checkpoint_minutes or 0.0
        words = replace(self.config, hyperparameters=hyperparameters, checkpoint_minutes=minutes).words()
        return " ".join(quoted(shown(word, MAX_WORD)) for word in ["rejeu", *words])


def read_run(path: str | Path, columns: Collection[str] | None = None) -> RunSummary:
    """Returns the record of the run in a folder that ``rejeu train`` wrote or is writing.

    Args:
        path: the folder.
        columns: of the table of episodes, for speed; None for all. The others are NaN.

    Raises:
        FileNotFoundError: if there is no such folder, or it holds nothing of a run.
    """
    folder = Path(path)
    if not folder.is_dir():
        is_something = folder.exists()
        text = f"{shown(folder, 300)} is no folder" if is_something else f"there is no run folder {shown(folder, 300)}"
        raise FileNotFoundError(text)
    folder = folder.resolve()
    files = RunFolder(folder)
    if not any(path.is_file() for path in files.marks):
        raise FileNotFoundError(
            f"{shown(folder, 300)} is no run folder: it holds no {files.config.name}{newest_inside(folder)}"
        )
    config, versions, notes = read_config(files.config)
    metrics, evaluations = (ordered(read_table(path)) for path in (files.metrics, files.evaluations))
    metrics = statistics_rows(metrics)
    episodes = ordered(read_table(files.episodes, columns))
    goals, replays = (read_table(path) if is_file(path) else EMPTY for path in (files.goals, files.replays))
    tables: Settings = {"episodes": episodes, "metrics": metrics, "evaluations": evaluations}
    last_steps = [int(table.column("step")[-1]) for table in tables.values() if len(table)]
    tables |= {"goals": goals, "replays": replays}
    times = (episodes.column("seconds"), metrics.column("time/time_elapsed"), evaluations.column("seconds"))
    run = RunSummary(
        path=folder,
        name=shown(folder.name, MAX_NAME),
        config=config,
        versions={shown(name): shown(version) for name, version in versions.items() if version is not None},
        steps=max(0, newest_step(files.checkpoints), *last_steps),
        seconds=max((column[-1] for column in times if len(column) and math.isfinite(column[-1])), default=math.nan),
        **tables,
        warnings=read_warnings(files.warnings),
        videos=tuple(find_videos(files)),
        models=tuple(path for path in (files.best, files.agent) if is_file(path)),
        remarks=read_remarks(files.remarks),
        notes=(*notes, *(note for table in tables.values() for note in table.notes)),
    )
    state = state_of(run)
    if state == "running":  # in its first seconds nothing was written
        lasting = tuple(note for note in run.notes if not re.fullmatch(r"(there is no )?\w+\.csv( is empty)?", note))
        run = replace(run, notes=lasting)
    return replace(run, state=state)


def best_row(evaluations: Table) -> int | None:
    """Returns the row of the best evaluation, by success rate and then by mean return; None if there is none."""
    mean, rate = evaluations.column("mean_return"), evaluations.column("success_rate")
    rows = np.flatnonzero(np.isfinite(mean)).tolist()
    return max(rows, key=lambda row: (np.nan_to_num(rate[row], nan=-1.0), mean[row]), default=None)


def statistics_rows(table: Table) -> Table:
    """Returns a table of metrics without the rows of evaluations, which have no time.

    >>> table = Table({"step": np.arange(2.0), "time/time_elapsed": np.array([0.5, np.nan]), "eval/mean_reward": np.ones(2)})
    >>> statistics_rows(table).columns
    {'step': array([0.]), 'time/time_elapsed': array([0.5])}
    """
    columns = table.columns
    timed = np.isfinite(columns.get("time/time_elapsed", np.zeros(len(table))))
    return Table({name: values[timed] for name, values in columns.items() if not name.startswith("eval/")}, table.notes)


def read_config(path: Path) -> tuple[RunConfig, dict[str, str | None], list[str]]:
    """Returns the description of a run, the versions of what ran, and notes about what is missing or damaged."""
    try:
        content = parse_json(read_bytes(path, MAX_BYTES))
        config, versions = convert(content, RunConfig), convert(content.get("versions", {}), dict[str, str | None])
        env, algorithm = shown(config.env, MAX_NAME), shown(config.algorithm or "", MAX_NAME)
        return replace(config, env=env, algorithm=algorithm), versions, []
    except FileNotFoundError:
        return UNKNOWN, {}, [f"there is no {path.name}, so the configuration is not known"]
    except (OSError, Malformed, CheckpointError) as error:
        return UNKNOWN, {}, [f"{path.name} is damaged: {shown(error)}"]


def read_remarks(path: Path) -> Remarks:
    """Returns the note and the tags of a run; empty ones of a damaged file."""
    try:
        return convert(parse_json(read_bytes(path, MAX_WARNINGS_BYTES)), Remarks)
    except (OSError, Malformed, CheckpointError):
        return NO_REMARKS


def ordered(table: Table) -> Table:
    """Returns a table without the rows whose step is not a valid number, in the order of the steps."""
    if "step" not in table.columns:
        return Table({}, table.notes if not len(table) else (*table.notes, "a table lacks the column step"))
    step = table.columns["step"]
    columns = {name: np.where(np.isfinite(values), values, np.nan) for name, values in table.columns.items()}
    notes = table.notes
    valid = (step >= 0) & (step <= MAX_STEP)
    if not valid.all():
        columns = {name: values[valid] for name, values in columns.items()}
        notes += (f"{np.sum(~valid):,} rows without a valid step were left out",)
    step = columns["step"]
    if (np.diff(step) < 0).any():
        order = np.argsort(step, kind="stable")
        columns = {name: values[order] for name, values in columns.items()}
        notes += ("the steps of a table decreased; its rows were sorted",)
    return Table(columns, notes)


def state_of(run: RunSummary) -> State:
    """Returns the state of a run: running while it is locked, else by what was written."""
    files = RunFolder(run.path)
    has_model = files.agent in run.models
    if is_locked(files.lock):
        return "running"
    reached_steps = run.config.steps is not None and run.steps >= run.config.steps
    reached_minutes = run.config.minutes is not None and run.seconds >= 0.98 * 60 * run.config.minutes
    if has_model and run.steps in run.evaluations.column("step") and (reached_steps or reached_minutes):
        return "finished"
    if any(note.startswith(f"{files.config.name} is damaged") for note in run.notes):
        return "damaged"
    if not has_model or run.error:
        return "crashed"
    return "paused" if is_file(files.paused) else "interrupted"


def is_locked(path: Path) -> bool:
    """Returns whether another process holds the lock on a file; the file is not changed."""
    if not is_file(path):  # on Windows the lock would create it
        return False
    if os.name != "posix":
        try:
            with atomic.lock(path).acquire(timeout=0):
                return False
        except Timeout:
            return True
        except OSError:
            return False
    import fcntl

    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return False
    except OSError:
        return True
    finally:
        os.close(handle)


def read_warnings(path: Path) -> tuple[str, ...]:
    """Returns the lines of a file of warnings."""
    try:
        lines = read_bytes(path, MAX_WARNINGS_BYTES).decode("utf-8", "replace").splitlines()
    except OSError:
        return ()
    first, last = lines[: MAX_WARNINGS - 1], lines[MAX_WARNINGS - 1 :][-1:]
    return tuple(shown(line, 1000) for line in (*first, *last) if line.strip())


def find_videos(folder: RunFolder) -> Iterator[Path]:
    """Yields the mp4 files of a run folder that are not symbolic links and not in linked folders."""
    if folder.videos.is_dir() and not folder.videos.is_symlink():
        yield from sorted(filter(is_file, folder.videos.glob("[!.]*.mp4")))[:MAX_VIDEOS]
    if is_file(folder.video):
        yield folder.video


def is_file(path: Path) -> bool:
    """Returns whether a path inside a run folder is a regular file, and no symbolic link."""
    try:
        return stat.S_ISREG(path.lstat().st_mode) and not path.parent.is_symlink()
    except (OSError, ValueError):
        return False


def default_hyperparameters(algorithm: str | None, tuned: Mapping[str, object] = MappingProxyType({})) -> Settings:
    """Returns ``tuned`` and the defaults of an algorithm as JSON values; empty if it is neither rejeu's nor registered."""
    from rejeu.algorithms import config

    classes = dict(config.registered)
    if algorithm in CATALOG:
        classes[algorithm] = CATALOG[algorithm].load().Config
    return config.to_json(classes[algorithm](**tuned)) if algorithm in classes else {}
