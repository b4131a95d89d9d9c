"""Checkpoints of whole runs: everything that a run depends on, so that it goes on as if nothing had happened.

A folder of checkpoints holds ::

    run_000000020000.safetensors           the newest and the one before: all but the replay buffer's rows
    run_000000010000.safetensors
    rows_000000010000_5f0c.safetensors     the rows that were new at a checkpoint; those that are still needed
    rows_000000020000_91aa.safetensors
    lock                                   held by the process that trains

Rows are written once, so a checkpoint costs what is new, whatever the size of the buffer. Every file is written beside its
place, synced and renamed, rows before the run that names them, and nothing is deleted before what replaces it is there:
whenever the process dies, the newest complete checkpoint is at most one interval old.
"""

from __future__ import annotations

import re
import secrets
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from filelock import FileLock, Timeout

from rejeu import checkpoint, finite, plain, spaces
from rejeu.agents import files, loading
from rejeu.agents.call import Call
from rejeu.config import number, whole
from rejeu.core import PyTree
from rejeu.envs import state as env_state
from rejeu.envs.vector import BACKENDS, Backend, VectorEnv
from rejeu.errors import CheckpointError, RunInUseError
from rejeu.loops.host import Progress, Run
from rejeu.loops.packing import Readings
from rejeu.replay.ring import Ring
from rejeu.replay.rollout import RolloutBuffer

if TYPE_CHECKING:
    from rejeu.agents.base import Agent

A = TypeVar("A", bound="Agent")

MINUTES = 5.0
"""Between two checkpoints where nothing else is asked for."""
RUN_FILE = re.compile(r"run_(\d{12})\.safetensors")
ROWS_FILE = re.compile(r"rows_\d{12}_[0-9a-f]+\.safetensors")
MOST_ENVS = 4096
"""More environments than so many are not made because a file says so."""
SCALARS = ("learn_from", "owed", "steps_since_update")
"""Counters of a run that are in no model file; whole numbers from 0."""
PER_ENV = ("playing", "ended", "episode_return", "episode_length", "running_return")
"""Fields of a run that are arrays with one entry for each environment."""


class Resumed(NamedTuple):
    """Where a run was taken up again."""

    step: int
    """Environment steps that had been taken."""
    exact: bool
    """Whether the environments go on where they stood too, so that the run is the same as without a break."""
    reason: str
    """Why not, in words; empty where it is exact."""

    def __str__(self) -> str:
        where = "exactly where it stood" if self.exact else f"at the start of new episodes: {self.reason}"
        return f"resumed at step {self.step:,}, {where}"


@dataclass
class RowFiles:
    """Which files hold the rows of a replay buffer. Mutable."""

    files: list[tuple[str, np.ndarray]] = field(default_factory=list)
    """Names, oldest first, and the times of the newest rows in each, by environment."""
    ring: Ring | None = None
    """The ring whose rows they are, while ``version`` is its own."""
    version: int = -1

    def heads(self, ring: Ring) -> np.ndarray:
        """Returns up to which times the rows of ``ring`` are on disk, -1 for nothing."""
        if self.ring is not ring or self.version != ring.version or not self.files:
            self.files, self.ring, self.version = [], ring, ring.version
            return np.full(ring.n_envs, -1, np.int64)
        return self.files[-1][1]

    def add(self, name: str, ring: Ring) -> None:
        """Notes a file that holds the rows up to the newest, and forgets those of which no row is kept any more."""
        self.files.append((name, ring.head.copy()))
        oldest = ring.oldest()
        self.files = [one for one in self.files if (one[1] >= oldest).any()]


class Checkpoint:
    """Saves the whole run every so many environment steps or minutes, and whenever ``learn`` ends, so that it can go on.

    Ctrl-C, SIGTERM and errors of the environment end ``learn`` with a checkpoint as well. ``Agent.resume(folder)`` takes the
    run up again. The folder belongs to one run; the last ``keep`` checkpoints are kept.

    >>> import rejeu, tempfile
    >>> folder = tempfile.mkdtemp()
    >>> agent = rejeu.SAC("MlpPolicy", "rejeu/Ball-v0", seed=0, buffer_size=1000)
    >>> stop = lambda agent, progress: progress.step < 150
    >>> _ = agent.learn(300, [Checkpoint(folder, every=100), stop])
    >>> rejeu.SAC.resume(folder).learn().num_timesteps
    300
    """

    def __init__(
        self, folder: str | Path, every: int | None = None, *, minutes: float | None = None, keep: int = 2
    ) -> None:
        """Saves nothing yet.

        Args:
            folder: of the checkpoints, made with the first; new, or of the same run.
            every: environment steps between two checkpoints.
            minutes: of wall time between two checkpoints; with neither, every five.
            keep: how many checkpoints are kept, at least 1.
        """
        if isinstance(folder, int):
            raise TypeError(f"folder={folder!r} must be a path: Checkpoint(folder, every={folder})")
        self.folder = Path(folder)
        self.every = None if every is None else whole("every", every, least=1)
        given = None if minutes is None else number("minutes", minutes, above=0)
        self.minutes = MINUTES if given is None and every is None else given
        self.keep = whole("keep", keep, least=1)
        self.seconds = 0.0
        """Wall time spent saving."""
        self._saved: tuple[int, int] | None = None
        self._named: dict[Path, list[str]] = {}
        self._last_step = 0
        self._last_time = 0.0

    @contextmanager
    def held(self, agent: Agent) -> Iterator[None]:
        """While entered, the folder is this process's alone.

        Raises:
            RunInUseError: if another process holds it.
            FileExistsError: if it holds the checkpoints of another run.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(self.folder / "lock")
        try:
            lock.acquire(timeout=0)
        except Timeout:
            raise RunInUseError(
                f"another process is training in {self.folder}; wait for it, stop it, or give Checkpoint another folder"
            ) from None
        try:
            self._check_owner(agent)
            for path in self.folder.glob(".*.tmp"):  # of a process that died while it wrote
                path.unlink(missing_ok=True)
            self._last_step, self._last_time = agent._run.step, time.monotonic()
            if not run_files(self.folder):
                self.save(agent)
            if agent.report_folder is None:
                agent.report_folder = self.folder
            yield
        finally:
            lock.release()

    def _check_owner(self, agent: Agent) -> None:
        for path in run_files(self.folder):
            try:
                header = checkpoint.read_header(path, "run")
            except CheckpointError:
                continue
            if header.get("run_id") != agent._run_id:
                raise FileExistsError(
                    f"{self.folder} holds the checkpoints of another run; go on with it by {agent.name}.resume(folder), or "
                    "give Checkpoint another folder"
                )
            return

    def __call__(self, agent: Agent, progress: Progress) -> None:
        """Saves if a checkpoint has fallen due in this step."""
        before, self._last_step = self._last_step, progress.step
        by_steps = self.every is not None and before // self.every < progress.step // self.every
        by_time = self.minutes is not None and time.monotonic() - self._last_time >= 60 * self.minutes
        if by_steps or by_time:
            self.save(agent)

    def save(self, agent: Agent, reason: str = "") -> Path | None:
        """Saves now, unless nothing has happened since the last time; returns the path, or None.

        Args:
            agent: the agent.
            reason: why the environments' state is not to be trusted, in words; empty where it is.

        Raises:
            OSError: if that is impossible; what was saved before stays as it is.
            NonFiniteError: if the last update left numbers that are not finite; nothing is saved then.
        """
        began = time.monotonic()
        finite.settle(agent)
        run = agent._run
        if self._saved == (run.step, run.n_updates) and not reason:
            return None
        row_files = agent._rows.setdefault(self.folder.resolve(), RowFiles())
        try:
            if not isinstance(run.replay, RolloutBuffer):
                self._write_rows(run.replay.ring, row_files, run.step)
            header, arrays = content(agent, reason)
            header["rows"] = [name for name, _ in row_files.files]
            path = checkpoint.write(self.folder / f"run_{run.step:012d}.safetensors", "run", arrays, header)
            self._named[path], agent.last_saved = header["rows"], path
        except OSError as error:
            left = run_files(self.folder)
            raise OSError(
                error.errno,
                f"the checkpoint of step {run.step} could not be written ({error}); "
                + (f"the one before is whole: {left[0]}" if left else "there is none before it"),
            ) from error
        self._tidy()
        self._saved, self._last_step, self._last_time = (run.step, run.n_updates), run.step, time.monotonic()
        self.seconds += self._last_time - began
        return path

    def save_after(self, error: Exception, agent: Agent) -> None:
        """Saves what is whole after an error in the course of a step: the run goes on at the start of new episodes."""
        if any(array.is_deleted() for array in agent._run.state):
            return  # the error came between two states
        try:
            self.save(agent, f"the run ended with {type(error).__name__}")
        except Exception as second:  # the first error is what the user must see
            error.add_note(f"and no checkpoint could be written: {second}")

    def _write_rows(self, ring: Ring, row_files: RowFiles, step: int) -> None:
        rows = ring.rows_since(row_files.heads(ring))
        name = f"rows_{step:012d}_{secrets.token_hex(4)}.safetensors"
        checkpoint.write(self.folder / name, "rows", rows, {})
        row_files.add(name, ring)

    def _tidy(self) -> None:
        """Deletes the checkpoints that are too many, and the rows that no other names."""
        found = run_files(self.folder)
        for path in found[self.keep :]:
            path.unlink(missing_ok=True)
            self._named.pop(path, None)
        needed = {name for path in found[: self.keep] for name in self._rows_of(path)}
        for path in self.folder.iterdir():
            if ROWS_FILE.fullmatch(path.name) and path.name not in needed:
                path.unlink(missing_ok=True)

    def _rows_of(self, path: Path) -> list[str]:
        """Returns the files of rows that a checkpoint names; none, if it is damaged."""
        if path not in self._named:
            try:
                self._named[path] = [str(name) for name in checkpoint.read_header(path, "run")["rows"]]
            except (CheckpointError, KeyError, TypeError):
                self._named[path] = []
        return self._named[path]


def run_files(folder: Path) -> list[Path]:
    """Returns the checkpoints in a folder, newest first."""
    if not folder.is_dir():
        return []
    return sorted((path for path in folder.iterdir() if RUN_FILE.fullmatch(path.name)), reverse=True)


def content(agent: Agent, reason: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Returns header and arrays of a run, the rows of its replay buffer left out."""
    run = agent._run
    states = None if reason or run.obs is None else env_state.carried(run.env)
    if states is None and not reason:
        where = f"{run.env.env_id} ({run.env.backend})"
        reason = "none was under way" if run.obs is None else f"the state of {where} cannot be carried"
    arrays = {f"state.{name}": array for name, array in checkpoint.tree_to_arrays(agent.state).items()}
    best = None
    if agent.best is not None:
        best = {"score": agent.best.score, "by": agent.best.by, "step": agent.best.step}
        whole_state = agent._compiled.state(agent.best.state)
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
        "n_skipped": run.watch.n_skipped,
        "td_errors": leaves(run.td_errors),
        "seconds": {key: float(value) for key, value in run.seconds.items()},
        "buffer": buffer_content(run),
        "history": agent.history.table(),
        "best": best,
        "logger": [dict(agent.logger.name_to_value), dict(agent.logger._counts)],
        "n_predictions": agent._n_predictions,
        "call": None if agent._call is None else agent._call.to_json(),
        "callbacks": [[type(one).__name__, one.state_dict()] for one in agent._callbacks],
        "vec_normalize": None if statistics is None else statistics.statistics(),
    }
    header = {
        **files.header(agent),
        "run_id": agent._run_id,
        "n_envs": run.env.n_envs,
        "backend": run.env.backend,
        "own_env": agent._own_env,
        "run": plain.encode(everything, arrays, "run"),
    }
    return header, arrays


def buffer_content(run: Run) -> dict[str, Any]:
    """Returns what a buffer holds beside the rows of a ring."""
    buffer = run.replay
    if isinstance(buffer, RolloutBuffer):
        return {"rollout": buffer.arrays(), "started": buffer.started, "carry": leaves(buffer.carry)}
    priorities = None if buffer.priorities is None else buffer.priorities.state()
    return {"heads": buffer.ring.head, "priorities": priorities}


def leaves(tree: PyTree) -> list[np.ndarray]:
    """Returns copies of the leaves of a tree, on the host."""
    return [np.array(leaf) for leaf in jax.tree.leaves(tree)]


def resume(cls: type[A], folder: Path, env: Any, changes: dict[str, Any]) -> A:
    """Returns the agent of the newest checkpoint that is whole; see :meth:`Agent.resume`."""
    found = run_files(folder)
    if not found:
        raise FileNotFoundError(f"there is no checkpoint in {folder}")
    for i, path in enumerate(found):
        try:
            return _resume(cls, path, env, dict(changes))
        except CheckpointError as error:
            if i + 1 == len(found):
                raise
            warnings.warn(f"{error}; going on from the checkpoint before it", UserWarning, stacklevel=3)
    raise AssertionError


def _resume(cls: type[A], path: Path, env: Any, changes: dict[str, Any]) -> A:
    header, arrays = checkpoint.read(path, "run")
    state = {name[6:]: array for name, array in arrays.items() if name.startswith("state.")}

    def make_env(agent: Agent) -> VectorEnv:
        if env is None:
            env_id, n_envs, backend = environment(path, header)
            vector = agent._vector(env_id, n_envs, backend, agent.seed)
        else:
            vector = agent._vector(env, seed=agent.seed)
        if vector.n_envs != header.get("n_envs"):
            raise CheckpointError(f"the run had {header.get('n_envs')} environments, and {vector.n_envs} are given")
        return vector

    agent = files.load(cls, path, header, state, make_env, changes)
    try:
        saved = plain.decode(header["run"], arrays)
        rows = [_rows_name(name) for name in header["rows"]]
        parts = [checkpoint.read(path.parent / name, "rows")[1] for name in rows]
        restore(agent, saved, parts, {n[5:]: array for n, array in arrays.items() if n.startswith("best.")}, path)
        agent._run_id, agent._own_env = text(header["run_id"]), env is None
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} needs a file that is missing: {error}") from None
    except CheckpointError:
        raise
    except loading.WRONG as error:
        raise CheckpointError(f"{path}: the checkpoint is damaged or does not fit: {loading.brief(error)}") from error
    if parts:
        ring = agent._run.replay.ring
        heads = [part["head"] for part in parts]
        agent._rows[path.parent.resolve()] = RowFiles(list(zip(rows, heads, strict=True)), ring, ring.version)
    assert agent.resumed is not None
    if not agent.resumed.exact:
        warnings.warn(str(agent.resumed), UserWarning, stacklevel=4)
    return agent


def _rows_name(name: Any) -> str:
    if not isinstance(name, str) or not ROWS_FILE.fullmatch(name):
        raise CheckpointError(f"{str(name)[:40]!r} is no file of rows")
    return name


def environment(path: Path, header: dict[str, Any]) -> tuple[str, int, Backend]:
    """Returns id, number and backend of the environments that a run had.

    Raises:
        CheckpointError: if the checkpoint does not say, or they were not made from an id.
    """
    env_id, n_envs, backend = header.get("env_id"), header.get("n_envs"), header.get("backend")
    if not isinstance(env_id, str) or backend not in BACKENDS or type(n_envs) is not int or not 0 < n_envs <= MOST_ENVS:
        raise CheckpointError(f"{path} does not say which environments the run had; give them: resume(folder, env=...)")
    if not header.get("own_env") or ":" in env_id:  # a colon would let Gymnasium import what stands before it
        raise CheckpointError(
            f"the run was given an environment, {env_id[:60]!r}, that no file can hold; give it again: "
            "resume(folder, env=...)"
        )
    return env_id, n_envs, backend


def restore(
    agent: Agent, saved: dict[str, Any], rows: Sequence[dict[str, np.ndarray]], best: dict[str, np.ndarray], path: Path
) -> None:
    """Puts an agent that was loaded from the same checkpoint where its run stood.

    Raises:
        LookupError, TypeError, ValueError, AttributeError, ArithmeticError: if something is damaged.
    """
    run, compiled = agent._run, agent._compiled
    for key in SCALARS:
        setattr(run, key, whole(key, saved[key], least=0))
    n_envs = run.env.n_envs
    run.rng.bit_generator.state = saved["rng"]
    run.carry = like(compiled.initial_carry(n_envs), saved["carry"], "carry")
    if saved["metrics"] is not None:
        metrics = {key: exactly(value, (), np.float32, f"the metric {key}") for key, value in saved["metrics"].items()}
        run.metrics = Readings.of({key: jnp.asarray(value) for key, value in metrics.items()})
    run.watch.n_skipped = whole("n_skipped", saved["n_skipped"], least=0)
    run.td_errors = [jnp.asarray(exactly(a, np.shape(a), np.float32, "a TD error")) for a in saved["td_errors"]]
    run.seconds = {key: number(key, saved["seconds"][key], least=0) for key in run.seconds}
    for key in PER_ENV:
        setattr(run, key, exactly(saved[key], (len(saved[key]),), getattr(run, key).dtype, key))
    restore_buffer(run, saved["buffer"], rows, compiled.initial_carry(n_envs))
    if saved["envs"] is not None:
        put_envs_back(run, saved)
    elif saved["seed"] is not None:
        run.seed = loading.whole_seed(saved["seed"])
    agent.history.replace(saved["history"])
    agent._fill_windows()
    if saved["best"] is not None:
        packed = compiled.pack(checkpoint.arrays_to_tree(compiled.shapes, best, path))
        agent._put_best(saved["best"]["score"], text(saved["best"]["by"]), int(saved["best"]["step"]), packed)
    values, counts = saved["logger"]
    agent.logger.name_to_value = {key: number(key, value) for key, value in values.items()}
    agent.logger._counts = {key: whole(key, value, least=0) for key, value in counts.items()}
    agent._n_predictions = whole("n_predictions", saved["n_predictions"], least=0)
    agent._call = None if saved["call"] is None else Call.from_json(saved["call"])
    agent._saved_callbacks = [(text(name), state) for name, state in saved["callbacks"]]
    statistics = agent.get_vec_normalize_env()
    if statistics is not None and saved["vec_normalize"] is not None:
        statistics.put_statistics(saved["vec_normalize"])
    agent.resumed = Resumed(run.step, not text(saved["reason"]), saved["reason"])


def put_envs_back(run: Run, saved: dict[str, Any]) -> None:
    """Lets the environments stand where they stood, with the observations and the actions that were chosen there."""
    n_envs = run.env.n_envs
    for key in PER_ENV:
        if len(getattr(run, key)) not in (n_envs, 0):
            raise ValueError(f"{key} is not of {n_envs} environments")
    held = run.replay if isinstance(run.replay, RolloutBuffer) else run.replay.ring
    parts = zip(saved["obs"], held.obs_leaves, strict=True)
    obs = jax.tree.unflatten(
        held.obs_structure, [exactly(part, (n_envs, *leaf.shape), leaf.dtype, "obs") for part, leaf in parts]
    )
    env_state.put_back(run.env, saved["envs"], obs)
    run.obs = obs
    if saved["action"] is not None:
        expected = np.asarray(spaces.random_action(run.env.action_space, n_envs, np.random.default_rng(0)))
        run.action = exactly(saved["action"], expected.shape, expected.dtype, "action")


def restore_buffer(run: Run, saved: dict[str, Any], rows: Sequence[dict[str, np.ndarray]], carry: PyTree) -> None:
    """Puts the experience of a run back; ``carry`` is what exploration remembers, for its form."""
    buffer = run.replay
    if isinstance(buffer, RolloutBuffer):
        buffer.restore(saved["rollout"])
        buffer.started = exactly(saved["started"], (buffer.n_envs,), np.dtype(bool), "started")
        buffer.carry = like(carry, saved["carry"], "carry") if buffer.length or saved["carry"] else ()
        return
    buffer.ring.put_rows(rows)
    if not np.array_equal(buffer.ring.head, saved["heads"]):
        raise ValueError("rows of the replay buffer are missing")
    if buffer.priorities is not None:
        buffer.priorities.restore(saved["priorities"])
        if [error.size for error in run.td_errors] != [len(index) for index, _ in saved["priorities"]["drawn"]]:
            raise ValueError("the TD errors under way are not those of the steps that were drawn")


def text(value: Any) -> str:
    """Returns a text of a file.

    Raises:
        TypeError: if it is none.
    """
    if not isinstance(value, str):
        raise TypeError(f"expected a text, got {type(value).__name__}")
    return value


def like(expected: PyTree, given: list[np.ndarray], name: str) -> PyTree:
    """Returns a tree of the form of ``expected`` with the given leaves.

    Raises:
        ValueError: if shapes or dtypes differ.
    """
    parts = jax.tree.leaves(expected)
    return jax.tree.unflatten(
        jax.tree.structure(expected),
        [jnp.asarray(exactly(g, e.shape, np.dtype(e.dtype), name)) for g, e in zip(given, parts, strict=True)],
    )


def exactly(array: Any, shape: tuple[int, ...], dtype: Any, name: str) -> np.ndarray:
    """Returns an array of a file.

    Raises:
        ValueError: if its shape or dtype is another than expected.
    """
    if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != dtype:
        found = f"{array.dtype}{list(array.shape)}" if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{name} is {found}, expected {np.dtype(dtype)}{list(shape)}")
    return array.copy()


def restore_callbacks(callbacks: Sequence[Any], saved: Sequence[Any]) -> None:
    """Gives callbacks what those of the same kind remembered when the run was saved, in order.

    Those for which nothing was saved begin anew, with a warning, and what was saved for others is passed over likewise.
    """
    left = [(name, state) for name, state in saved]
    for one in callbacks:
        name = type(one).__name__
        match = next((entry for entry in left if entry[0] == name), None)
        if match is None:
            warnings.warn(f"the run was saved without a {name}; it begins anew", UserWarning, stacklevel=4)
            continue
        left.remove(match)
        try:
            one.load_state_dict(match[1])
        except loading.WRONG as error:
            raise CheckpointError(f"what {name} remembered is damaged: {loading.brief(error)}") from error
    if left:
        names = ", ".join(name for name, _ in left)
        warnings.warn(f"the run was saved with {names}, which learn was not given now", UserWarning, stacklevel=4)
