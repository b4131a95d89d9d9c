"""Numbers stay finite: how an update is looked at, and what is said of one that broke something.

Every compiled update says whether what it left is finite (:func:`all_finite`), beside its metrics; the loop's
:class:`~rejeu.loops.nonfinite.NonFiniteMonitor` looks one turn later, when it waits for the device anyway, and finds the
batch to blame. :func:`reported` saves it and makes the error of it; :func:`examine` tries a saved one again.

With ``nonfinite="skip"`` an update that breaks something is undone on the device at once, and counted.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu import spaces
from rejeu.core import Clock, Masked, Metrics, PyTree, Rollout, Transition
from rejeu.errors import CheckpointError, NonFiniteError
from rejeu.io import checkpoint

if TYPE_CHECKING:
    from rejeu.agents import Agent
    from rejeu.loops.learner import Learner

Nonfinite = Literal["stop", "skip"]
CHOICES: tuple[Nonfinite, ...] = ("stop", "skip")
"""What can be done about an update that breaks something."""
MOST_SKIPPED = 100
"""Skipped updates in a row after which it is an error all the same: nothing is being learnt."""
PREFIX = "nonfinite_batch_"
"""Of the files with offending batches."""
WIDTH, FEW = 16, 256


def parse(value: Any) -> Nonfinite:
    """Returns what ``nonfinite`` asks for.

    Raises:
        ValueError: unless it is ``"stop"`` or ``"skip"``.

    >>> parse("skip")
    'skip'
    """
    if value not in CHOICES:
        raise ValueError(f"nonfinite={value!r} must be 'stop' or 'skip'")
    return value


def is_averaged(name: str) -> bool:
    """Returns whether a leaf of a state averages what other leaves hold, so that it is finite as long as they are.

    Those are target networks, and Adam's first moments: of gradients whose squares are in the second.

    >>> [is_averaged(name) for name in ("target_critics.head.bias", "optimizer.mu.head.bias", "optimizer.nu.head.bias")]
    [True, True, False]
    """
    parts = name.split(".")
    return "mu" in parts or any(part.startswith("target") for part in parts)


def is_loss(name: str) -> bool:
    """Returns whether a metric must be finite; others may be NaN, as ``explained_variance`` where all returns are equal."""
    return name.endswith("loss")


def all_finite(vectors: list[Array], metrics: Metrics) -> Array:
    """Returns whether every number of every vector, and every loss among the metrics, is finite, ``bool[]``.

    Inside compiled code. ``0 x`` is NaN where x is not finite. Sixteen stretches of a vector are summed side by side, since
    XLA on a CPU adds up a single one number by number, and what is left of all vectors is looked at together: the fewer
    kernels the better.
    """
    floats = [vector.reshape(-1) for vector in vectors if jnp.issubdtype(vector.dtype, jnp.floating)]
    left = [_folded(vector).astype(jnp.float32) for vector in floats]
    left += [value.reshape(-1) for name, value in metrics.items() if is_loss(name)]
    if not left:
        return jnp.bool(True)
    return jnp.isfinite(jnp.sum(_folded(jnp.concatenate(left)) * jnp.float32(0)))


def _folded(x: Array) -> Array:
    """Returns a sixteenth as many numbers, one of which is NaN if ``x`` holds a number that is not finite, else all 0.

    A vector of few numbers comes back as it is.
    """
    if x.size <= FEW:
        return x
    n, zero = -(-x.size // WIDTH), jnp.zeros((), x.dtype)
    total = x[:n] * zero
    for i in range(1, WIDTH):
        begin = min(i * n, x.size - n)  # the last stretches overlap
        total = total + x[begin : begin + n] * zero
    return total


def bad_leaves(tree: PyTree) -> list[str]:
    """Returns the dotted names of the leaves that hold a number that is not finite, each with the first such number."""
    found = []
    for name, leaf in zip(checkpoint.names(tree), jax.tree.leaves(tree), strict=True):
        array = np.asarray(leaf)
        if array.dtype.kind == "f" and not (ok := np.isfinite(array)).all():
            found.append(f"{name} ({array[~ok].ravel()[0]})")
    return found


class Broken(Exception):
    """An update left numbers that are not finite; :func:`reported` makes of it what users see."""

    def __init__(self, batches: Transition | Rollout, clock: Clock, in_a_row: int = 1) -> None:
        super().__init__("an update left numbers that are not finite")
        self.batches, self.clock, self.in_a_row = batches, clock, in_a_row


class Found(NamedTuple):
    """What one batch does to a state."""

    batch: list[str]
    """Its own parts that are not finite, each with a number, such as ``reward (nan)``."""
    losses: list[str]
    """Losses that are not, likewise."""
    leaves: list[str]
    """Leaves of the state after the update that are not, likewise."""

    def __bool__(self) -> bool:
        return bool(self.losses or self.leaves)


def effect(learner: Learner, state: PyTree, batch: Transition | Rollout, clock: Clock) -> tuple[PyTree, Found]:
    """Returns the state after an update on one batch, and what of it is not finite."""
    after, metrics = jax.jit(learner.algorithm.update)(state, batch, clock)
    losses = bad_leaves({name: value for name, value in metrics.items() if is_loss(name)})
    return after, Found(bad_leaves(batch._asdict()), losses, bad_leaves(after))


def settle(agent: Agent) -> None:
    """Waits for the updates under way and looks at them.

    Raises:
        NonFiniteError: if one of them left numbers that are not finite.
    """
    try:
        agent.run.watch.read(agent.run, agent.learner)
    except Broken as broken:
        raise reported(agent, broken) from None


def reported(agent: Agent, broken: Broken) -> NonFiniteError:
    """Saves the batch that broke something and returns the error that says what, where and why."""
    run, learner, clock = agent.run, agent.learner, broken.clock
    state, found, batch = agent.learner.state(run.state), Found([], [], []), broken.batches
    for i, one in enumerate(_one_by_one(broken.batches)):
        after, found = effect(learner, state, one, clock)
        if found:
            batch = one
            run.state = learner.pack(state) if i > 0 else run.state
            break
        state = after
    names = [text.split(" ")[0] for text in (*found.losses, *found.leaves)]
    saved = _save(agent, batch, clock, names)
    what = _said(found)
    if broken.in_a_row >= MOST_SKIPPED:
        what = f"{broken.in_a_row} updates in a row were skipped, so nothing is learnt any more; in the last of them {what}"
    checkpoint_text = f"; last saved model: {agent.last_saved}" if agent.last_saved is not None else ""
    message = (
        f"{what}, at environment step {int(clock.step)}, update {run.n_updates}. The agent is as it was before that update. "
        f"{saved[1]}{checkpoint_text}. {_advice(agent, found, batch)}"
    )
    return NonFiniteError(message, names=names, step=int(clock.step), n_updates=run.n_updates, batch=saved[0])


def _one_by_one(batches: Transition | Rollout) -> list[Any]:
    if isinstance(batches, Rollout) or batches.reward.ndim == 1:
        return [batches]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], batches) for i in range(len(batches.reward))]


def _said(found: Found) -> str:
    if found.batch:
        return f"the batch held {', '.join(found.batch[:3])}"
    said = [f"{', '.join(found.losses)}"] if found.losses else []
    if found.leaves:
        more = len(found.leaves) - 1
        said.append(f"{found.leaves[0]} of the state" + (f" and {more} more of its arrays" if more else ""))
    return " and ".join(said) + " became no finite number" if said else "an update left numbers that are not finite"


def _advice(agent: Agent, found: Found, batch: Transition | Rollout) -> str:
    if "reward" in str(found.batch):
        return "Look into the environment's reward function; of hindsight's goals rewards are compute_reward's"
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
        advice.append('or pass over such updates with nonfinite="skip"')
    return "Try to " + ", ".join(advice)


def folder_of(agent: Agent) -> Path:
    """Returns where an offending batch is put: beside the run, the newest model or the logs, else where Python runs."""
    if agent.report_folder is not None:
        return Path(agent.report_folder)
    if agent.last_saved is not None:
        return agent.last_saved.parent
    return Path.cwd() if agent.tensorboard_log is None else Path(agent.tensorboard_log)


def _save(agent: Agent, batch: Transition | Rollout, clock: Clock, names: list[str]) -> tuple[Path | None, str]:
    """Returns where the batch was written and a sentence about it; None where it could not be."""
    run, step = agent.run, int(clock.step)
    header = {
        "algorithm": agent.name,
        "env_id": None if run.env is None else run.env.env_id,
        "clock": {"step": step, "episode": int(clock.episode), "progress": float(clock.progress)},
        "n_updates": run.n_updates,
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
    """Returns the path of a new, empty file, of a name that no file had."""
    for i in range(1, 10_000):
        path = folder / f"{PREFIX}{step}{'' if i == 1 else f'_{i}'}{checkpoint.SUFFIX}"
        try:
            path.touch(exist_ok=False)
        except FileExistsError:
            continue
        return path
    raise OSError(f"{folder} is full of batches of step {step}")


def load_batch(agent: Agent, path: str | Path) -> tuple[Transition | Rollout, Clock]:
    """Returns a saved batch and where the run stood, as ``agent``'s algorithm takes them.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it holds no batch, or none of such an agent.
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


def _batch_like(agent: Agent, file: checkpoint.Contents) -> Transition | Rollout:
    """Returns a batch of the form of the one in a file, with numbers for arrays.

    Raises:
        CheckpointError: if it holds none of such an agent.
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


def examine(agent: Agent, path: str | Path) -> Found:
    """Returns what a saved batch breaks in an agent, which is not changed.

    Empty, and false, where everything stays finite: with other weights or other hyper-parameters, say.
    """
    batch, clock = load_batch(agent, path)
    return effect(agent.learner, agent.state, batch, clock)[1]
