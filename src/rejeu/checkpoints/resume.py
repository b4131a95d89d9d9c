"""Resumes a run from its newest checkpoint; damaged or hostile files are refused."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from numpy.typing import DTypeLike

from rejeu.checkpoints import model_files
from rejeu.checkpoints.agent_state import AnyAgent, Best, Resumed
from rejeu.checkpoints.run_files import PER_ENV, SCALARS, RowFiles, RunHeader, SavedBest, SavedRun, folder_of, versions
from rejeu.checkpoints.run_folder import checkpoint_files
from rejeu.core import checkpoint, devices, records, spaces, xla
from rejeu.core.algorithm import PyTree
from rejeu.core.errors import CheckpointError, DivergedError
from rejeu.core.records import MAX_ENVS, WRONG, brief, convert
from rejeu.core.types import JsonObject, Settings
from rejeu.core.validation import number, whole_seed
from rejeu.envs.base import seed_of_run
from rejeu.envs.make import BACKENDS, Backend, VectorEnv
from rejeu.replay import ring_io
from rejeu.replay.prioritized import Draw, Priorities
from rejeu.replay.rollout import RolloutBuffer
from rejeu.training.learner import Readings
from rejeu.training.run import Run, TrainingCall

A = TypeVar("A", bound=AnyAgent)


def resume(cls: type[A], folder: Path, env: Any, changes: Settings) -> A:
    """Returns the agent of the newest complete checkpoint, or of the one that is named; see :meth:`Agent.resume`."""
    paths = [folder] if folder.is_file() else checkpoint_files(folder)
    if not paths:
        raise FileNotFoundError(f"there is no checkpoint in {folder}")
    skipped: list[str] = []
    for i, path in enumerate(paths):
        try:
            with checkpoint.opened(path, "run") as file, ExitStack() as stack:
                agent = _resume_within(stack, file, cls, env, dict(changes))
                stack.pop_all()
        except CheckpointError as error:
            settings = changes.keys() - model_files.AGENT_ARGUMENTS
            if settings and is_whole(path):  # an older one might fit, and lose what was trained since
                raise CheckpointError(f"{error}; {', '.join(sorted(settings))} cannot be changed here") from None
            if i + 1 == len(paths):
                raise
            skipped.append(str(error))
            warnings.warn(f"{error}; resuming from the checkpoint before it", UserWarning, stacklevel=3)
        else:
            assert agent.resumed is not None
            agent.resumed = agent.resumed._replace(skipped=tuple(skipped))
            if not agent.resumed.exact:
                warnings.warn(str(agent.resumed), UserWarning, stacklevel=3)
            return agent
    raise AssertionError


def is_whole(path: Path) -> bool:
    """Returns whether a checkpoint and its files of rows can be read."""
    try:
        with checkpoint.opened(path, "run") as file:
            file.read()
        for name in convert(file.header, RunHeader).rows:
            with checkpoint.opened(path.parent / name, "rows") as rows:
                rows.read()
    except (FileNotFoundError, *WRONG):
        return False
    return True


def _resume_within(stack: ExitStack, file: checkpoint.Contents, cls: type[A], env: Any, changes: Settings) -> A:
    """Returns the agent; ``stack`` closes the environments made for it if the checkpoint is refused."""
    path = file.path
    try:
        header = convert(file.header, RunHeader)
    except WRONG as error:
        raise refusal(path, error) from error

    def make_env(agent: AnyAgent) -> VectorEnv:
        if env is not None:
            vector = agent.make_envs(env, seed=seed_of_run(agent.identity.seed))
            if vector.n_envs != header.n_envs:
                raise CheckpointError(f"the run had {header.n_envs} environments, and {vector.n_envs} are given")
            return vector
        env_id, backend = environment(path, header)
        try:
            vector = agent.make_envs(env_id, header.n_envs, backend, seed_of_run(agent.identity.seed))
            stack.callback(vector.close)
            agent.check_spaces(vector, f"{env_id} as it is here")
        except (ValueError, TypeError, gym.error.Error) as error:
            raise CheckpointError(
                f"{path}: the environments of the run cannot be made again ({brief(error)}); give them: "
                "resume(folder, env=...)"
            ) from error
        return vector

    agent = model_files.load(cls, file, make_env, changes, header.threads, "state.")
    try:
        check_specs(agent, file)
        saved = convert(records.decode(header.run, file.read("run.")), SavedRun)
        best = checkpoint.within(file.read("best."), "best.")
        parts = [read_rows(path.parent / name, agent) for name in header.rows]
        with devices.chosen(agent.identity.device):
            reason = restore(agent, saved, parts, best, path)
        agent.resumed = Resumed(agent.run.step, not reason, reason) if reason else compared(agent, header)
        agent.identity.run_id, agent.identity.made_from_id = header.run_id, env is None
    except FileNotFoundError as error:
        raise CheckpointError(f"{path} needs a file that is missing: {error}") from None
    except WRONG as error:
        raise refusal(path, error) from error
    if parts:
        ring = agent.run.replay.ring
        heads = [rows["head"] for rows in parts]
        pairs = list(zip(header.rows, heads, strict=True))
        folder_of(agent, path.parent).row_files = RowFiles(pairs, ring, ring.version)
    return agent


def check_specs(agent: AnyAgent, file: checkpoint.Contents) -> None:
    """Checks the arrays of a run's file before they are read; those of the agent's state were checked before.

    Raises:
        CheckpointError: if the best weights are of other networks, or there are arrays that no run has.
    """
    if best := checkpoint.within(file.specs, "best."):
        checkpoint.match(agent.learner.shapes, best, file.path)
    for name in file.specs:
        if not name.startswith(("state.", "best.", "run.")):
            raise CheckpointError(f"{file.path} has {checkpoint.shown(name)}, which no checkpoint of a run has")


def read_rows(path: Path, agent: AnyAgent) -> dict[str, np.ndarray]:
    """Returns the arrays of a file of rows, after checking that they fit the agent's buffer.

    Raises:
        CheckpointError, ValueError: if they are not.
    """
    with checkpoint.opened(path, "rows") as file:
        ring_io.check_rows(agent.run.replay.ring, file.specs)
        return file.read()


def compared(agent: AnyAgent, header: RunHeader) -> Resumed:
    """Returns how a run resumes whose environments were restored."""
    here = xla.threads()
    if header.versions != versions():
        why = "by another version of rejeu, JAX or Optax, so"
    elif header.n_together > 1:
        why = f"alone: it was one of {header.n_together} runs in one program, whose sums are rounded otherwise, so"
    elif header.threads != here:
        why = (
            f"JAX computes with {here} threads here and had {header.threads}; resume in a new process, with the environment "
            f"variable {xla.THREADS}={header.threads} if JAX is used before, or"
        )
    else:
        return Resumed(agent.run.step, True, "")
    return Resumed(agent.run.step, False, f"as it was saved, but {why} results may differ in their last bits")


def refusal(path: Path, error: BaseException) -> CheckpointError:
    """Returns the error for a checkpoint whose values raised ``error``."""
    if isinstance(error, CheckpointError) and str(path.parent) in str(error):
        return error
    return CheckpointError(f"{path}: the checkpoint is damaged or does not fit: {brief(error)}")


def environment(path: Path, header: RunHeader) -> tuple[str, Backend]:
    """Returns id and backend of the environments of a run.

    Raises:
        CheckpointError: if the checkpoint does not say, or they were not made from an id.
    """
    env_id, backend = header.env_id, header.backend
    if not isinstance(env_id, str) or backend not in BACKENDS or header.n_envs > MAX_ENVS:
        raise CheckpointError(f"{path} does not say which environments the run had; give them: resume(folder, env=...)")
    if not header.own_env or ":" in env_id:  # Gymnasium imports what precedes a colon
        raise CheckpointError(
            f"the run was given an environment, {env_id[:60]!r}, that no file can hold; give it again: "
            "resume(folder, env=...)"
        )
    return env_id, backend


def restore(
    agent: AnyAgent, saved: SavedRun, rows: Sequence[dict[str, np.ndarray]], best: dict[str, np.ndarray], path: Path
) -> str:
    """Restores the run of an agent that was loaded from the same checkpoint.

    Returns why its environments begin new episodes, empty if they continue.

    Raises:
        LookupError, TypeError, ValueError, AttributeError, ArithmeticError: if something is damaged.
    """
    run, n_envs = agent.run, agent.run.env.n_envs
    carry = agent.learner.initial_carry(n_envs)
    restore_counters(agent, saved)
    run.carry = like(carry, saved.carry, "carry")
    if saved.metrics is not None:
        metrics = {key: exactly(value, (), np.float32, f"the metric {key}") for key, value in saved.metrics.items()}
        run.metrics = Readings.of({key: jnp.asarray(value) for key, value in metrics.items()})
    td_errors = [jnp.asarray(exactly(a, np.shape(a), np.float32, "a TD error")) for a in saved.td_errors]
    restore_buffer(run, saved.buffer, rows, carry, begun=saved.envs is not None)
    if saved.buffer.get("priorities") is not None:
        run.td_errors = with_draws(run.replay.priorities, saved.buffer["priorities"]["drawn"], td_errors)
    reason = saved.reason
    if saved.envs is not None:
        reason = reason or put_envs_back(run, saved, getattr(agent.config, "n_episodes", None))
    elif saved.seed is not None:
        run.seed = whole_seed(saved.seed)
    agent.record.restore(saved.history)
    if saved.best is not None:
        restore_best(agent, saved.best, best, path)
    agent.call.training_call = None if saved.call is None else TrainingCall.from_json(saved.call)
    agent.call.saved_callbacks = list(saved.callbacks)
    statistics = agent.get_vec_normalize_env()
    if statistics is not None and saved.vec_normalize is not None:
        statistics.put_statistics(saved.vec_normalize)
    return f"at the start of new episodes: {reason}" if reason else ""


def restore_counters(agent: AnyAgent, saved: SavedRun) -> None:
    """Restores counters, durations, random numbers and the logger of a run."""
    run = agent.run
    if saved.steps_since_update > run.step:
        raise ValueError(f"steps_since_update={saved.steps_since_update}, expected at most {run.step}")
    for key in SCALARS:
        setattr(run, key, getattr(saved, key))
    for key in PER_ENV:
        value = getattr(saved, key)
        setattr(run, key, exactly(value, (len(value),), getattr(run, key).dtype, key))
    run.rng.bit_generator.state = saved.rng
    run.monitor.n_skipped = saved.n_skipped
    run.seconds = {key: saved.seconds[key] for key in run.seconds}
    agent.call.reset_seconds = number("before", saved.seconds["before"], least=0, most=run.seconds["total"])
    values, agent.logger.name_to_count = saved.logger
    agent.logger.values.update({key: number(key, value) for key, value in values.items()})
    agent.n_predictions = saved.n_predictions


def restore_best(agent: AnyAgent, saved: SavedBest, arrays: dict[str, np.ndarray], path: Path) -> None:
    """Restores the best weights.

    Raises:
        CheckpointError: if they are of other networks, or not finite.
    """
    packed = agent.learner.pack(checkpoint.arrays_to_tree(agent.learner.shapes, arrays, path))
    checkpoint.require_finite(arrays, path)
    agent.record.best = Best(saved.score, saved.by, saved.step, packed)


def put_envs_back(run: Run, saved: SavedRun, n_episodes: int | None) -> str:
    """Restores the environments, their observations and the actions chosen for them.

    If rollouts consist of ``n_episodes`` whole episodes, environments that have finished theirs may be at the end of one.
    Returns why new episodes must begin instead, empty if they need not.
    """
    n_envs = run.env.n_envs
    for key in PER_ENV:
        if len(getattr(run, key)) != n_envs and (key != "playing" or n_episodes is not None):
            raise ValueError(f"{key} is not of {n_envs} environments")
    waiting = None if n_episodes is None else run.playing == 0
    held = run.replay if isinstance(run.replay, RolloutBuffer) else run.replay.ring
    parts = zip(saved.obs or (), held.obs_leaves, strict=True)
    obs = jax.tree.unflatten(
        held.obs_structure, [exactly(array, (n_envs, *leaf.shape), leaf.dtype, "obs") for array, leaf in parts]
    )
    try:
        must_reset = run.env.restore(saved.envs, obs)
    except DivergedError as error:
        return str(error)
    if over := [i for i in must_reset if waiting is None or not waiting[i]]:
        raise ValueError(f"the episode of environment {over[0]} is over, and it was not reset")
    run.obs, run.seed = obs, None
    if saved.action is not None:
        expected = np.asarray(spaces.random_action(run.env.action_space, n_envs, np.random.default_rng(0)))
        run.action = exactly(saved.action, expected.shape, expected.dtype, "action")
    return ""


def restore_buffer(
    run: Run, saved: JsonObject, rows: Sequence[dict[str, np.ndarray]], carry: PyTree, begun: bool
) -> None:
    """Restores the experience of a run.

    Args:
        run: mutated.
        saved: what :func:`rejeu.checkpoints.run_files.buffer_content` returned.
        rows: of a ring.
        carry: the state of exploration, for its structure.
        begun: whether a rollout has begun; before the first there is no carry of its beginning.
    """
    buffer = run.replay
    if isinstance(buffer, RolloutBuffer):
        buffer.restore(saved["rollout"])
        buffer.started = exactly(saved["started"], (buffer.n_envs,), np.dtype(bool), "started")
        buffer.carry = like(carry, saved["carry"], "carry") if begun or buffer.length or saved["carry"] else ()
        return
    ring_io.put_rows(buffer.ring, rows)
    if not np.array_equal(buffer.ring.head, saved["heads"]):
        raise ValueError("rows of the replay buffer are missing")
    if buffer.priorities is not None:
        buffer.priorities.restore(saved["priorities"])


def with_draws(priorities: Priorities, drawn: Sequence[Any], td_errors: list[Array]) -> list[tuple[Draw, Array]]:
    """Returns TD errors with the draws that they belong to.

    Raises:
        ValueError: if they do not belong together, or to another replay buffer.
    """
    draws = [priorities.draw_of(index, time) for index, time in drawn]
    if [len(draw.position) for draw in draws] != [td_error.size for td_error in td_errors]:
        raise ValueError("the TD errors under way are not those of the steps that were drawn")
    return list(zip(draws, td_errors, strict=True))


def like(expected: PyTree, arrays: list[np.ndarray], name: str) -> PyTree:
    """Returns a tree with the structure of ``expected`` and the leaves ``arrays``.

    Raises:
        ValueError: if shapes or dtypes differ, or a number is not finite.
    """
    parts = jax.tree.leaves(expected)
    if not all(spaces.is_finite(array) for array in arrays):
        raise ValueError(f"{name} is not finite")
    return jax.tree.unflatten(
        jax.tree.structure(expected),
        [jnp.asarray(exactly(g, e.shape, np.dtype(e.dtype), name)) for g, e in zip(arrays, parts, strict=True)],
    )


def exactly(array: object, shape: tuple[int, ...], dtype: DTypeLike, name: str) -> np.ndarray:
    """Returns a copy of an array of a file.

    Raises:
        ValueError: if its shape or dtype differs from what is expected.
    """
    if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != dtype:
        got = f"{array.dtype}{list(array.shape)}" if isinstance(array, np.ndarray) else type(array).__name__
        raise ValueError(f"{name} is {got}, expected {np.dtype(dtype)}{list(shape)}")
    return array.copy()
