"""Checkpoints of whole runs, from which a run resumes exactly.

A folder of checkpoints holds ::

    run_000000020000.safetensors           the newest checkpoint, without the rows of the replay buffer
    run_000000010000.safetensors           the one before
    rows_000000010000_5f0c.safetensors     rows that were new at a checkpoint, as long as they are needed
    rows_000000020000_91aa.safetensors
    lock                                   held by the process that trains

Rows are written once, so the cost of a checkpoint does not depend on the size of the buffer. Every file is written
atomically, rows before the run that refers to them, and files are deleted only after their replacements exist. Whenever the
process dies, the newest complete checkpoint is at most one interval old.
"""

from __future__ import annotations

import re
import secrets
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import jax
import msgspec
import numpy as np
import optax
from filelock import Timeout
from msgspec import Meta

from rejeu.checkpoints import model_files
from rejeu.checkpoints.agent_state import AnyAgent
from rejeu.checkpoints.run_folder import checkpoint_files, step_of
from rejeu.core import atomic, checkpoint, records, xla
from rejeu.core.algorithm import PyTree
from rejeu.core.errors import CheckpointError, RunInUseError
from rejeu.core.records import Count, Positive, Seconds
from rejeu.core.types import JsonObject
from rejeu.replay import ring_io
from rejeu.replay.ring import Ring
from rejeu.replay.rollout import RolloutBuffer
from rejeu.training import finite
from rejeu.training.run import Run

ROWS_FILE = re.compile(r"rows_\d{12}_[0-9a-f]+\.safetensors")
SCALARS = ("learn_from", "owed", "steps_since_update")
"""Counters of a run that model files do not hold."""
MOMENT = 0.5
"""Seconds to wait for the lock, which a process that asks whether the run is locked holds for a moment."""
PER_ENV = ("playing", "ended", "episode_return", "episode_length", "running_return")
"""Fields of a run that are arrays with one entry per environment."""


@dataclass
class RowFiles:
    """The files that hold the rows of a replay buffer. Mutable."""

    files: list[tuple[str, np.ndarray]] = field(default_factory=list)
    """Names, oldest first, and the times of the newest rows in each, by environment."""
    ring: Ring | None = None
    """The ring whose rows they are, while ``version`` is its own."""
    version: int = -1

    def heads(self, ring: Ring) -> np.ndarray:
        """Returns the times of the newest rows of ``ring`` on disk, -1 for none."""
        if self.ring is not ring or self.version != ring.version or not self.files:
            self.files, self.ring, self.version = [], ring, ring.version
            return np.full(ring.n_envs, -1, np.int64)
        return self.files[-1][1]

    def add(self, name: str, ring: Ring) -> None:
        """Adds a file with the rows up to the newest, and drops files of which the ring keeps no row."""
        self.files.append((name, ring.head.copy()))
        oldest = ring.oldest()
        self.files = [(file, head) for file, head in self.files if (head >= oldest).any()]


def folder_of(agent: AnyAgent, folder: Path) -> CheckpointFolder:
    """Returns the folder of an agent's checkpoints, always the same object for the same path."""
    folders: dict[Path, CheckpointFolder] = agent.files.checkpoint_folders
    if (path := folder.resolve()) not in folders:
        folders[path] = CheckpointFolder(agent, folder.absolute())
    return folders[path]


class CheckpointFolder:
    """A folder with the checkpoints of an agent's run. Mutable; see :meth:`Agent.checkpoint_folder`."""

    def __init__(self, agent: AnyAgent, folder: Path) -> None:
        self.agent = agent
        self.folder = folder
        self.row_files = RowFiles()
        self._lock = atomic.lock(folder / "lock")
        self._named: dict[Path, list[str]] = {}

    def lock(self) -> None:
        """Makes the folder and locks it for this process, until it is closed as often as it was locked and opened.

        Raises:
            RunInUseError: if another process holds the lock.
        """
        atomic.make_folder(self.folder)
        try:
            self._lock.acquire(timeout=MOMENT)
        except Timeout:
            raise RunInUseError(
                f"another process is training in {self.folder}; wait for it, stop it, or give Checkpoint another folder"
            ) from None

    def open(self) -> None:
        """Locks the folder, and removes incomplete files of a process that died.

        Raises:
            RunInUseError: if another process holds the lock.
            FileExistsError: if the folder contains the checkpoints of another run, or newer ones that resume did not skip.
        """
        self.lock()
        try:
            self._check_owner()
            for path in self.folder.glob(".*.tmp"):  # of a process that died while it wrote
                path.unlink(missing_ok=True)
            for path in checkpoint_files(self.folder):
                if step_of(path) > self.agent.run.step:  # one that resume has skipped
                    path.replace(path.with_name(f"{path.name}.damaged"))
        except BaseException:
            self.close()
            raise
        self.agent.run.env.record()
        if self.agent.files.report_folder is None:
            self.agent.files.report_folder = self.folder

    def close(self) -> None:
        """Releases the lock."""
        self._lock.release()

    def is_empty(self) -> bool:
        """Returns whether the folder contains no checkpoint."""
        return not checkpoint_files(self.folder)

    def save(self, keep: int, reason: str = "") -> Path:
        """Writes a checkpoint of the run as it is now, deletes all but the newest ``keep``, and returns its path.

        Args:
            keep: how many checkpoints are kept.
            reason: why the environments' state cannot be trusted; empty if it can.

        Raises:
            OSError: if it cannot be written; earlier checkpoints are unchanged.
            NonFiniteError: if the last update left numbers that are not finite; nothing is written then.
        """
        agent = self.agent
        finite.settle(agent)
        run = agent.run
        try:
            if not isinstance(run.replay, RolloutBuffer):
                self._write_rows(run.replay.ring, run.step)
            header, arrays = content(agent, reason)
            header["rows"] = [name for name, _ in self.row_files.files]
            path = checkpoint.write(self.folder / f"run_{run.step:012d}.safetensors", "run", arrays, header)
            self._named[path], agent.files.last_saved = header["rows"], path
        except OSError as error:
            remaining = checkpoint_files(self.folder)
            raise OSError(
                error.errno,
                f"the checkpoint of step {run.step} could not be written ({error}); "
                + (f"the one before it is complete: {remaining[0]}" if remaining else "there is none before it"),
            ) from error
        self._delete_old(keep)
        return path

    def _check_owner(self) -> None:
        step, resumed = self.agent.run.step, self.agent.resumed
        for path in checkpoint_files(self.folder):
            try:
                header = checkpoint.read_header(path, "run")
            except CheckpointError:
                continue
            is_other = header.get("run_id") != self.agent.identity.run_id
            if is_other or (step_of(path) > step and not (resumed and resumed.skipped)):
                checkpoints = (
                    "the checkpoints of another run" if is_other else f"checkpoints after the agent's step {step}"
                )
                raise FileExistsError(
                    f"{self.folder} contains {checkpoints}; continue it with {self.agent.name}.resume(folder), or give "
                    "Checkpoint another folder"
                )
            return

    def _write_rows(self, ring: Ring, step: int) -> None:
        row_files = self.row_files
        if not all((self.folder / name).exists() for name, _ in row_files.files):
            row_files.files = []  # somebody has cleared the folder: all rows are written again
        rows = ring_io.rows_since(ring, row_files.heads(ring))
        name = f"rows_{step:012d}_{secrets.token_hex(4)}.safetensors"
        checkpoint.write(self.folder / name, "rows", rows, {})
        row_files.add(name, ring)

    def _delete_old(self, keep: int) -> None:
        """Deletes all but the newest ``keep`` checkpoints, and the files of rows that none of these needs."""
        paths = checkpoint_files(self.folder)
        for path in paths[keep:]:
            _remove(path)
            self._named.pop(path, None)
        needed = {name for path in paths[:keep] for name in self._rows_of(path)}
        for path in self.folder.iterdir():
            if ROWS_FILE.fullmatch(path.name) and path.name not in needed:
                _remove(path)

    def _rows_of(self, path: Path) -> list[str]:
        """Returns the files of rows that a checkpoint needs; none, if it is damaged."""
        if path not in self._named:
            try:
                self._named[path] = [str(name) for name in checkpoint.read_header(path, "run")["rows"]]
            except (CheckpointError, KeyError, TypeError):
                self._named[path] = []
        return self._named[path]


def _remove(path: Path) -> None:
    """Removes a file; if that fails, the next checkpoint tries again."""
    with suppress(OSError):
        path.unlink()


UPDATES = 4
"""Number of the arithmetic of updates and batches; a change that rounds anything differently raises it."""


def versions() -> JsonObject:
    """Returns the versions that results depend on in their last bits."""
    return {"updates": UPDATES, "jax": jax.__version__, "optax": optax.__version__}


class RunHeader(msgspec.Struct):
    """The header of a run's checkpoint, in addition to that of a model file; unknown fields are ignored."""

    rows: list[Annotated[str, Meta(pattern=rf"^{ROWS_FILE.pattern}\Z")]]
    """Names of the files with the rows of the replay buffer, oldest first."""
    n_envs: Positive
    run_id: str
    run: Any
    """A :class:`SavedRun`, encoded by :mod:`rejeu.core.records`."""
    threads: Annotated[int, Meta(ge=1, le=1024)]
    """Of JAX's device."""
    env_id: Any = None
    backend: Any = None
    own_env: Any = False
    n_together: Positive = 1
    """Runs in the program that trained it."""
    versions: Any = None
    """:func:`versions` of the process that wrote it."""


class SavedBest(msgspec.Struct):
    """The best weights, which are arrays of their own."""

    score: Any
    by: str
    step: Count


class SavedRun(msgspec.Struct, kw_only=True):
    """The state of a run that is in no model file; what depends on the agent is compared with it when it is resumed."""

    learn_from: Count
    owed: Count
    steps_since_update: Count
    playing: np.ndarray
    ended: np.ndarray
    episode_return: np.ndarray
    episode_length: np.ndarray
    running_return: np.ndarray
    rng: JsonObject
    carry: list[np.ndarray]
    obs: list[np.ndarray] | None
    action: np.ndarray | None
    envs: Any
    seed: Any
    """Used only where new episodes begin."""
    reason: str
    metrics: dict[str, np.ndarray] | None
    n_skipped: Count
    td_errors: list[np.ndarray]
    seconds: dict[str, Seconds]
    buffer: JsonObject
    history: np.ndarray
    best: SavedBest | None
    logger: tuple[JsonObject, dict[str, Count]]
    n_predictions: Count
    call: JsonObject | None
    callbacks: list[tuple[str, Any]]
    vec_normalize: Any


def content(agent: AnyAgent, reason: str) -> tuple[JsonObject, dict[str, np.ndarray]]:
    """Returns header and arrays of a run, without the rows of its replay buffer."""
    run = agent.run
    states = None if reason or run.obs is None else run.env.snapshot()
    if states is None and not reason:
        where = f"{run.env.env_id} ({run.env.backend})"
        reason = "none was under way" if run.obs is None else f"the state of {where} cannot be carried"
    arrays = {f"state.{name}": array for name, array in checkpoint.tree_to_arrays(agent.state).items()}
    best = None
    if agent.record.best is not None:
        best = {"score": agent.record.best.score, "by": agent.record.best.by, "step": agent.record.best.step}
        whole_state = agent.learner.state(agent.record.best.state)
        arrays |= {f"best.{name}": array for name, array in checkpoint.tree_to_arrays(whole_state).items()}
    statistics = agent.get_vec_normalize_env()
    everything = {
        **{key: int(getattr(run, key)) for key in SCALARS},
        **{key: getattr(run, key) for key in PER_ENV},
        "rng": run.rng.bit_generator.state,
        "carry": leaves(run.carry),
        "obs": None if states is None else leaves(run.obs),
        "action": None if states is None or run.action is None else np.asarray(run.action),
        "envs": states,
        "seed": run.seed,
        "reason": "" if run.seed is not None and run.obs is None else reason,
        "metrics": None if run.metrics is None else {key: np.asarray(value) for key, value in run.metrics.items()},
        "n_skipped": run.monitor.n_skipped,
        "td_errors": leaves([td_error for _, td_error in run.td_errors]),
        "seconds": {**{key: float(value) for key, value in run.seconds.items()}, "before": agent.call.reset_seconds},
        "buffer": buffer_content(run),
        "history": agent.record.history.table(),
        "best": best,
        "logger": [dict(agent.logger.values), dict(agent.logger.name_to_count)],
        "n_predictions": agent.n_predictions,
        "call": None if agent.call.training_call is None else agent.call.training_call.to_json(),
        "callbacks": [[type(callback).__name__, callback.state_dict()] for callback in agent.call.callbacks],
        "vec_normalize": None if statistics is None else statistics.statistics(),
    }
    header = {
        **model_files.header(agent),
        "run_id": agent.identity.run_id,
        "n_envs": run.env.n_envs,
        "backend": run.env.backend,
        "own_env": agent.identity.made_from_id,
        "threads": xla.threads(),
        "n_together": agent.call.n_together,
        "versions": versions(),
        "run": records.encode(everything, arrays, "run"),
    }
    return header, arrays


def buffer_content(run: Run) -> JsonObject:
    """Returns the state of a buffer, without the rows of a ring."""
    buffer = run.replay
    if isinstance(buffer, RolloutBuffer):
        return {"rollout": buffer.arrays(), "started": buffer.started, "carry": leaves(buffer.carry)}
    priorities = None
    if buffer.priorities is not None:
        drawn = [[draw.position, draw.time] for draw, _ in run.td_errors]
        priorities = {**buffer.priorities.state(), "drawn": drawn}
    return {"heads": buffer.ring.head, "priorities": priorities}


def leaves(tree: PyTree) -> list[np.ndarray]:
    """Returns copies of the leaves of a tree, on the host."""
    return [np.array(leaf) for leaf in jax.tree.leaves(tree)]
