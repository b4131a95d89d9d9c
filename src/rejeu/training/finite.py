"""The guard around updates: none may leave NaN or infinity. Batches of updates that did are saved, and examined.

Every compiled update reports, with its metrics, whether what it left is finite. :class:`NonFiniteMonitor` reads this one
turn later, when the loop waits for the device anyway. It keeps a copy of a state and the updates since, from which it
recomputes the state before the first bad update. Large arrays are checked only in these copies, on the host: until then NaN
in one of them shows in the loss of the next update. With ``nonfinite="skip"`` a bad update is undone on the device at once
(:func:`rejeu.training.learner.undo`), and the monitor only counts. :func:`reported` saves the batch and returns the error that
users see; :func:`examine` repeats its update.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from rejeu.core import algorithm as core, checkpoint, spaces
from rejeu.core.algorithm import Clock, Masked, Rollout, Sequences, Transition
from rejeu.core.errors import CheckpointError, NonFiniteError
from rejeu.training.learner import PackedState, Readings, bad_leaves, checked

MAX_CALLS = 64
"""Largest number of calls after which the state is copied again."""
MAX_BYTES = 32 * 2**20
"""Number of bytes of batches after which the state is copied again."""
MAX_SKIPPED = 100
"""Number of successive skipped updates after which training stops, because nothing is learned."""
PREFIX = "nonfinite_batch_"
"""Beginning of the names of files with batches of bad updates."""


class NonFiniteUpdate(Exception):
    """An update left NaN or infinity; :func:`reported` explains it."""

    def __init__(
        self, state: PackedState | None, batches: Transition | Rollout, clock: Clock, in_a_row: int, n_updates: int
    ) -> None:
        super().__init__("an update left numbers that are not finite")
        self.state = state
        """The state before it; None if the update was undone."""
        self.n_updates = n_updates
        """Total number of gradient steps before it."""
        self.batches, self.clock, self.in_a_row = batches, clock, in_a_row


class NonFiniteSteps(Exception):
    """An update of the program on the device left NaN or infinity; :func:`steps_reported` explains it."""

    def __init__(self, which: int, steps: range, names: list[str], in_a_row: int) -> None:
        super().__init__("an update left numbers that are not finite")
        self.which = which
        """Its run, where several are trained together, which has the state before ``steps``."""
        self.steps = steps
        """The environment steps of the chunk."""
        self.names = names
        """Of what is not finite, each with the first such number."""
        self.in_a_row = in_a_row


def gradient_steps(reward: Array | np.ndarray) -> int:
    """Returns the number of gradient steps on samples, by their rewards: 1 on a batch, or one on each of several."""
    return 1 if reward.ndim == 1 else len(reward)


class Call(NamedTuple):
    """A function that changed the state."""

    function: Callable[..., Any]
    """Takes the state and the arguments; returns the new state, alone or first in a tuple."""
    arguments: tuple[Any, ...]
    """Of an update, the batches and the clock."""
    readings: Readings | None
    """What an update reported; None for other functions."""
    n_updates: int
    """Total number of gradient steps before it."""


class NonFiniteMonitor:
    """Observes the updates of a run. Mutable."""

    def __init__(
        self, copy: Callable[[PackedState], PackedState], is_finite: Callable[[PackedState], bool], skips: bool
    ) -> None:
        """Takes functions that copy and check a state, and whether bad updates undo themselves, so that neither is needed."""
        self.n_skipped = 0
        """Total number of skipped updates."""
        self._copy, self._is_finite, self._skips = copy, is_finite, skips
        self._in_a_row = 0
        self._begin(None)

    def _begin(self, state: PackedState | None) -> None:
        """Forgets all calls and copies the state that they led to."""
        self._newest = state
        """The state after the calls."""
        self._copied = None if state is None or self._skips else self._copy(state)
        """A copy of a state whose updates were all checked."""
        self._calls: list[Call] = []
        """What has changed the state since the copy."""
        self._unread: deque[Call] = deque()
        """The updates among them whose readings have not been checked."""
        self._next: tuple[int, PackedState] | None = None
        """The number of calls before a newer copy, and that copy, until these calls were checked."""
        self._most: int | None = None
        """Number of calls after which the state is copied again; None until a batch is known."""

    def __len__(self) -> int:
        """Returns the number of updates whose readings have not been checked."""
        return len(self._unread)

    def follow(self, function: Callable[..., Any], state: PackedState, *arguments: Any) -> PackedState:
        """Returns ``function(state, *arguments)``, another state, to which the updates belong that follow.

        Raises:
            NonFiniteUpdate: as :meth:`read`, if the state was replaced while updates were still to be looked at.
        """
        self._begin_if_replaced(state)
        self._newest = function(state, *arguments)
        self._calls.append(Call(function, arguments, None, 0))
        return self._newest

    def update(
        self, function: Callable[..., Any], state: PackedState, batches: Any, clock: Clock, n_updates: int
    ) -> tuple[PackedState, Readings, Array | None]:
        """Returns ``function(state, batches, clock)``, an update before which ``n_updates`` gradient steps were taken.

        Raises:
            NonFiniteUpdate: as :meth:`follow`.
        """
        self._begin_if_replaced(state)
        if self._next is None and self._most is not None and len(self._calls) >= self._most and not self._skips:
            self._next = len(self._calls), self._copy(state)
        if self._most is None:
            n_bytes = sum(leaf.nbytes for leaf in jax.tree.leaves(batches))
            self._most = min(max(MAX_BYTES // max(n_bytes, 1), 1), MAX_CALLS)
        self._newest, readings, td_error = function(state, batches, clock)
        self._calls.append(Call(function, (batches, clock), readings, n_updates))
        self._unread.append(self._calls[-1])
        return self._newest, readings, td_error

    def _begin_if_replaced(self, state: PackedState) -> None:
        """Begins at ``state`` unless it is the one that the calls led to."""
        if state is not self._newest and not self._skips:
            self.read()
            self._begin(state)

    def read(self, n: int | None = None) -> None:
        """Checks the oldest ``n`` updates (None: all); waits for them.

        Raises:
            NonFiniteUpdate: if one of them left NaN or infinity, or if too many in a row were skipped.
        """
        for _ in range(len(self._unread) if n is None else n):
            call = self._unread.popleft()
            assert call.readings is not None
            n_bad = call.readings.n_bad
            self._in_a_row = self._in_a_row + n_bad if n_bad else 0
            self.n_skipped += n_bad if self._skips else 0
            if n_bad and (not self._skips or self._in_a_row >= MAX_SKIPPED):
                raise self._error(call)
        if self._skips:
            self._calls = [*self._unread]
        elif self._next is not None and len(self._unread) <= len(self._calls) - self._next[0]:  # all are newer
            n_calls, copied = self._next
            self._check(copied, self._calls[:n_calls])
            self._copied, self._calls, self._next, self._most = copied, self._calls[n_calls:], None, None
        if n is None and self._calls:
            self._check(self._newest, self._calls)
            if isinstance(self._calls[-1].arguments[0], Rollout):  # a view of a buffer that is soon overwritten
                self._begin(self._newest)

    def _check(self, state: PackedState | None, calls: list[Call]) -> None:
        """Raises the error of the first bad update unless the state after some calls is finite."""
        updates = [call for call in calls if call.readings is not None]
        if updates and state is not None and not self._skips and not self._is_finite(state):
            raise self._error(updates[-1])

    def _error(self, bad: Call) -> NonFiniteUpdate:
        """Returns the error of the first bad update, which is ``bad`` or one before it; forgets all calls."""
        state = self._copied
        for call in self._calls:
            if state is None or call is bad:
                break
            before = self._copy(state)
            after = call.function(state, *call.arguments)
            state = after[0] if isinstance(after, tuple) else after
            if call.readings is not None and not self._is_finite(state):
                state, bad = before, call
                break
        (batches, clock), in_a_row, self._in_a_row = bad.arguments, self._in_a_row, 0
        self._begin(None)
        return NonFiniteUpdate(state, batches, clock, in_a_row, bad.n_updates)


def settle(agent: Any) -> None:
    """Waits for the updates under way and checks them.

    Raises:
        NonFiniteError: if one of them left NaN or infinity.
    """
    try:
        agent.run.monitor.read()
    except NonFiniteUpdate as update:
        raise reported(agent, update) from None


def end_episodes(agent: Any) -> None:
    """Ends the running episodes of an agent: the actions chosen since a bad update are invalid."""
    run = agent.run
    run.td_errors, run.obs, run.action = [], None, None
    keep_finite = lambda fresh, leaf: leaf if np.isfinite(leaf).all() else fresh  # noqa: E731
    run.carry = jax.tree.map(keep_finite, agent.learner.initial_carry(agent.n_envs), run.carry)


def steps_reported(agent: Any, bad: NonFiniteSteps, of: str = "") -> NonFiniteError:
    """Returns the error that explains a bad update on the device; ``of`` names the run where there are several."""
    end_episodes(agent)
    message = (
        f"{of}{_what(bad.names, bad.in_a_row)}, in the environment steps {bad.steps[0]:,} to {bad.steps[-1]:,}. The agent is "
        f"as it was before them, apart from its experience{_last_model(agent)}. {_advice(agent.config)}. The loop of the host "
        "(agent.on_device = False) names the update and saves its batch"
    )
    names = [text.split(" ")[0] for text in bad.names]
    return NonFiniteError(message, names=names, step=bad.steps[-1], n_updates=agent.n_updates)


def reported(agent: Any, update: NonFiniteUpdate) -> NonFiniteError:
    """Puts the agent into the state before a bad update, saves its batch, and returns the error that explains it."""
    run, learner = agent.run, agent.learner
    end_episodes(agent)
    run.state = run.state if update.state is None else update.state
    state, n_updates, compiled = learner.state(run.state), update.n_updates, jax.jit(learner.algorithm.update)
    for i, batch in enumerate(one_by_one(update.batches)):
        clock = jax.tree.map(lambda leaf: leaf[i] if np.ndim(leaf) else leaf, update.clock)  # noqa: B023
        after, metrics = compiled(state, batch, clock)
        found = [*bad_leaves(checked(metrics)), *(f"{leaf} of the state" for leaf in bad_leaves(after))]
        if found:
            run.state, n_updates = learner.pack(state) if i > 0 else run.state, n_updates + i
            break
        state = after
    run.n_updates = n_updates + (update.state is None)  # an update that was skipped counts
    names = [text.split(" ")[0] for text in found]
    path, saved = _save(agent, batch, clock, names, n_updates + 1)
    spoiled = bad_parts(batch)
    what = f"the batch held {', '.join(spoiled[:3])}" if spoiled else ""
    message = (
        f"{_what(found, update.in_a_row, what)}, at environment step {int(clock.step)}, update {n_updates + 1}. The agent is "
        f"as it was before that update. {saved}{_last_model(agent)}. {_advice(agent.config, spoiled, batch)}"
    )
    return NonFiniteError(message, names=names, step=int(clock.step), n_updates=n_updates + 1, batch=path)


def one_by_one(batches: Transition | Rollout) -> list[Any]:
    """Returns the batches of gradient steps, or a rollout, one after another."""
    if isinstance(batches, Rollout) or batches.reward.ndim == 1:
        return [batches]
    return [jax.tree.map(lambda leaf, i=i: leaf[i], batches) for i in range(len(batches.reward))]


def _what(names: list[str], in_a_row: int, cause: str = "") -> str:
    """Returns what happened: what is not finite, or its ``cause``."""
    more = len(names) - 3
    what = f"{', '.join(names[:3]) or 'an update'}{f' and {more} more' * (more > 0)} became NaN or infinite"
    what = cause or what
    if in_a_row < MAX_SKIPPED:
        return what
    return f"{in_a_row} updates in a row were skipped, so nothing is learned any more; in the last of them {what}"


def _last_model(agent: Any) -> str:
    return f"; last saved model: {agent.last_saved}" if agent.last_saved is not None else ""


def _advice(config: Any, spoiled: Sequence[str] = (), batch: Transition | Rollout | None = None) -> str:
    if "reward" in str(spoiled):
        return "Check the environment's reward function; hindsight replay takes rewards from compute_reward"
    largest = ""
    if batch is not None:
        size = np.shape(batch.reward)
        rewards = np.abs(batch.reward, where=np.isfinite(batch.reward), out=np.zeros(size, np.float32))
        largest = f" (the largest of this batch is {rewards.max():.3g})"
    return (
        f"Try to scale the rewards down{largest}, lower learning_rate (it is {config.learning_rate!r}), set normalize=True, "
        'or skip such updates with nonfinite="skip"'
    )


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
        "clock": {name: np.asarray(value).item() for name, value in clock._asdict().items()},
        "n_updates": n_updates,
        "names": names,
    }
    try:
        folder = folder_of(agent)
        folder.mkdir(parents=True, exist_ok=True)
        names_of = (f"{PREFIX}{step}{f'_{i}' if i > 1 else ''}{checkpoint.SUFFIX}" for i in itertools.count(1))
        path = next(folder / name for name in names_of if not (folder / name).exists())
        checkpoint.write(path, "batch", checkpoint.tree_to_arrays(batch), header)
    except OSError as error:
        return None, f"The batch could not be saved ({' '.join(str(error).split())})"
    return path, f"The batch is saved in {path}"


class Found(NamedTuple):
    """The parts of an update that are not finite, each with the first such number, such as ``reward (nan)``."""

    batch: list[str]
    metrics: list[str]
    leaves: list[str]
    """Leaves of the state after the update."""

    def __bool__(self) -> bool:
        return bool(self.metrics or self.leaves)


def examine(agent: Any, path: str | Path) -> Found:
    """Repeats the update of a saved batch and returns the parts that are not finite; the agent is not changed.

    The result is false if everything is finite, for example with other weights or hyperparameters.
    """
    batch, clock = load_batch(agent, path)
    after, metrics = jax.jit(agent.learner.algorithm.update)(agent.state, batch, clock)
    return Found(bad_parts(batch), bad_leaves(checked(metrics)), bad_leaves(after))


def bad_parts(batch: Transition | Rollout) -> list[str]:
    """Returns what of a batch is not finite, as :func:`bad_leaves`; a next action of NaN is one that was not taken."""
    return bad_leaves({name: part for name, part in batch._asdict().items() if name != "next_action"})


def load_batch(agent: Any, path: str | Path) -> tuple[Transition | Rollout, Clock]:
    """Returns a saved batch and the clock of its update, as arguments of the update of ``agent``'s algorithm.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it holds no batch, or that of another kind of agent.
    """
    with checkpoint.opened(path, "batch") as file:
        like, header = batch_like(agent, {*file.specs}), file.header
        names = core.names(like)
        if header.get("algorithm") != agent.name or {*names} != {*file.specs}:
            raise CheckpointError(f"{path} holds a batch of another kind of agent than this {agent.name}")
        arrays = file.read()
    try:
        clock = header["clock"]
        step, episode, n_envs = (np.uint32(clock[name]) for name in ("step", "episode", "n_envs"))
        clock = Clock(step, episode, np.float32(clock["progress"]), n_envs)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise CheckpointError(f"{path}: the header is damaged") from None
    return jax.tree.unflatten(jax.tree.structure(like), [arrays[name] for name in names]), clock


def batch_like(agent: Any, names: set[str]) -> Transition | Rollout:
    """Returns a batch of the structure of an agent's, with numbers for arrays; a file has the arrays of these names."""
    structure = spaces.structure(agent.observation_space)
    obs: Any = jax.tree.unflatten(structure, [0] * structure.num_leaves)
    zero: Any = 0
    if "obs.memory" in names or "obs.obs.memory" in names:
        obs = Sequences(obs, zero, zero, zero, zero)
    obs = Masked(obs, zero) if agent.takes_masks else obs
    if "ended" not in names:
        optional = names & {"weight", "rewards", "next_action"}
        return Transition(obs, zero, zero, obs, zero, **dict.fromkeys(optional, zero))
    carry = jax.tree.map(lambda leaf: zero, agent.learner.initial_carry(1))
    return Rollout(obs, zero, zero, obs, zero, zero, zero, zero, zero, carry)
