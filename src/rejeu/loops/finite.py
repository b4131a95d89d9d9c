"""Batches whose update left NaN or infinity: explained, saved, loaded and tried again.

:class:`~rejeu.loops.nonfinite.NonFiniteMonitor` finds the update. :func:`reported` saves its batch and returns the error
that users see; :func:`examine` repeats the update of a saved batch. Functions here take an :class:`rejeu.agents.Agent`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from rejeu import spaces
from rejeu.core import Clock, Masked, PyTree, Rollout, Transition
from rejeu.errors import CheckpointError, NonFiniteError
from rejeu.io import checkpoint
from rejeu.loops.learner import Learner
from rejeu.loops.nonfinite import MAX_SKIPPED, NonFiniteUpdate, bad_leaves, checked

PREFIX = "nonfinite_batch_"
"""Beginning of the names of files with such batches."""


class Found(NamedTuple):
    """The parts of an update that are not finite."""

    batch: list[str]
    """Parts of the batch that are not finite, each with the first such number, such as ``reward (nan)``."""
    metrics: list[str]
    """Metrics that are not finite, likewise."""
    leaves: list[str]
    """Leaves of the state after the update that are not finite, likewise."""

    def __bool__(self) -> bool:
        return bool(self.metrics or self.leaves)


def effect(learner: Learner, state: PyTree, batch: Transition | Rollout, clock: Clock) -> tuple[PyTree, Found]:
    """Returns the state after an update on one batch, and the parts of the update that are not finite."""
    after, metrics = jax.jit(learner.algorithm.update)(state, batch, clock)
    return after, Found(bad_leaves(batch._asdict()), bad_leaves(checked(metrics)), bad_leaves(after))


def settle(agent: Any) -> None:
    """Waits for the updates under way and checks them.

    Raises:
        NonFiniteError: if one of them left NaN or infinity.
    """
    try:
        agent.run.monitor.read()
    except NonFiniteUpdate as update:
        raise reported(agent, update) from None


def reported(agent: Any, update: NonFiniteUpdate, of: str = "") -> NonFiniteError:
    """Puts the agent into the state before a bad update, saves its batch, and returns the error that explains it.

    The running episodes end: the actions chosen since are invalid. ``of`` names the run where there are several.
    """
    run, learner, clock = agent.run, agent.learner, update.clock
    run.td_errors, run.obs, run.action = [], None, None
    keep_finite = lambda fresh, leaf: leaf if np.isfinite(leaf).all() else fresh  # noqa: E731
    run.carry = jax.tree.map(keep_finite, learner.initial_carry(agent.n_envs), run.carry)
    run.state = run.state if update.state is None else update.state
    state, found, batch, n_updates = learner.state(run.state), Found([], [], []), update.batches, update.n_updates
    for i, one in enumerate(_one_by_one(update.batches)):
        after, found = effect(learner, state, one, clock)
        if found:
            batch, n_updates = one, n_updates + i
            run.state = learner.pack(state) if i > 0 else run.state
            break
        state = after
    run.n_updates = n_updates + (update.state is None)  # an update that was skipped counts
    names = [text.split(" ")[0] for text in (*found.metrics, *found.leaves)]
    path, saved = _save(agent, batch, clock, names, n_updates + 1)
    what = _describe(found)
    if update.in_a_row >= MAX_SKIPPED:
        what = f"{update.in_a_row} updates in a row were skipped, so nothing is learned any more; in the last of them {what}"
    model = f"; last saved model: {agent.last_saved}" if agent.last_saved is not None else ""
    message = (
        f"{of}{what}, at environment step {int(clock.step)}, update {n_updates + 1}. The agent is as it was before that "
        f"update. {saved}{model}. {_advice(agent, found, batch)}"
    )
    return NonFiniteError(message, names=names, step=int(clock.step), n_updates=n_updates + 1, batch=path)


def _one_by_one(batches: Transition | Rollout) -> list[Any]:
    if isinstance(batches, Rollout) or batches.reward.ndim == 1:
        return [batches]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], batches) for i in range(len(batches.reward))]


def _describe(found: Found) -> str:
    if found.batch:
        return f"the batch held {', '.join(found.batch[:3])}"
    said = [f"{', '.join(found.metrics)}"] if found.metrics else []
    if found.leaves:
        more = len(found.leaves) - 1
        said.append(f"{found.leaves[0]} of the state" + (f" and {more} more of its arrays" if more else ""))
    return " and ".join(said) + " became no finite number" if said else "an update left numbers that are not finite"


def _advice(agent: Any, found: Found, batch: Transition | Rollout) -> str:
    if "reward" in str(found.batch):
        return "Check the environment's reward function; hindsight replay takes rewards from compute_reward"
    config, advice = agent.config, []
    rewards = np.asarray(batch.reward)[np.isfinite(batch.reward)]
    largest = float(np.abs(rewards).max()) if rewards.size else 0.0
    if largest > 1e3:
        advice.append(f"scale the rewards down (the largest of this batch is {largest:.3g})")
    advice.append(f"lower learning_rate (it is {config.learning_rate!r})")
    if "max_grad_norm" in vars(config):
        advice.append(f"set max_grad_norm (it is {config.max_grad_norm!r})")
    if config.normalize is None:
        advice.append("set normalize=True")
    if config.nonfinite == "stop":
        advice.append('or skip such updates with nonfinite="skip"')
    return "Try to " + ", ".join(advice)


def folder_of(agent: Any) -> Path:
    """Returns the folder for bad batches: that of the run, the last saved model or the logs, else the current folder."""
    if agent.report_folder is not None:
        return Path(agent.report_folder)
    if agent.last_saved is not None:
        return agent.last_saved.parent
    return Path.cwd() if agent.tensorboard_log is None else Path(agent.tensorboard_log)


def _save(
    agent: Any, batch: Transition | Rollout, clock: Clock, names: list[str], n_updates: int
) -> tuple[Path | None, str]:
    """Writes the batch; returns its path, None if writing failed, and a sentence that says so."""
    run, step = agent.run, int(clock.step)
    header = {
        "algorithm": agent.name,
        "env_id": None if run.env is None else run.env.env_id,
        "clock": {"step": step, "episode": int(clock.episode), "progress": float(clock.progress)},
        "n_updates": n_updates,
        "names": names,
    }
    try:
        folder = folder_of(agent)
        folder.mkdir(parents=True, exist_ok=True)
        path = _reserved(folder, step)
        checkpoint.write(path, "batch", checkpoint.tree_to_arrays(batch), header)
    except OSError as error:
        return None, f"The batch could not be saved ({' '.join(str(error).split())})"
    return path, f"The batch is saved in {path} (rejeu.loops.finite.examine(agent, path) tries it again)"


def _reserved(folder: Path, step: int) -> Path:
    """Creates an empty file of a new name and returns its path."""
    for i in range(1, 10_000):
        path = folder / f"{PREFIX}{step}{'' if i == 1 else f'_{i}'}{checkpoint.SUFFIX}"
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            continue
        return path
    raise OSError(f"{folder} is full of batches of step {step}")


def load_batch(agent: Any, path: str | Path) -> tuple[Transition | Rollout, Clock]:
    """Returns a saved batch and the clock of its update, as arguments of the update of ``agent``'s algorithm.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it holds no batch, or that of another kind of agent.
    """
    with checkpoint.opened(path, "batch") as file:
        expected = _batch_like(agent, file)
        header, arrays = file.header, file.read()
    try:
        clock = header["clock"]
        clock = Clock(np.uint32(clock["step"]), np.uint32(clock["episode"]), np.float32(clock["progress"]))
    except (KeyError, TypeError, ValueError, OverflowError):
        raise CheckpointError(f"{path}: the header is damaged") from None
    names = checkpoint.names(expected)
    return jax.tree.unflatten(jax.tree.structure(expected), [arrays[name] for name in names]), clock


def _batch_like(agent: Any, file: checkpoint.Contents) -> Transition | Rollout:
    """Returns a batch of the structure of the one in a file, with numbers for arrays.

    Raises:
        CheckpointError: if it is of another kind of agent.
    """
    structure = spaces.structure(agent.observation_space)
    obs: Any = jax.tree.unflatten(structure, [0] * structure.num_leaves)
    expected: Any
    if "ended" in file.specs:
        obs = Masked(obs, 0) if agent.takes_masks else obs
        carry = jax.tree.map(lambda leaf: 0, agent.learner.initial_carry(1))
        expected = Rollout(obs, 0, 0, obs, 0, 0, 0, 0, 0, carry)
    else:
        optional = {name: 0 for name in ("weight", "rewards") if name in file.specs}
        expected = Transition(obs, 0, 0, obs, 0, **optional)
    names = checkpoint.names(expected)
    if file.header.get("algorithm") != agent.name or {*names} != {*file.specs}:
        raise CheckpointError(
            f"{file.path} holds a batch of {str(file.header.get('algorithm'))[:40]} with "
            f"{', '.join(sorted(file.specs))[:200]}; this is {agent.name}, whose batches have {', '.join(sorted(names))}"
        )
    return expected


def examine(agent: Any, path: str | Path) -> Found:
    """Repeats the update of a saved batch and returns the parts that are not finite; the agent is not changed.

    The result is false if everything is finite, for example with other weights or hyperparameters.
    """
    batch, clock = load_batch(agent, path)
    return effect(agent.learner, agent.state, batch, clock)[1]
