"""The guard around updates: none may leave NaN or infinity. The batches of a turn whose updates did are saved.

Every compiled update reports, with its metrics, whether what it left is finite. :class:`NonFiniteMonitor` reads this one
turn later, when the loop waits for the device anyway. Large arrays are checked only where somebody uses the state, and after
each rollout: until then NaN in one of them shows in the loss of the next update. No state is copied, so after a bad update
the agent holds what it left. With ``nonfinite="skip"`` a bad update is undone on the device at once
(:func:`rejeu.training.learner.undo`), and the monitor only counts. :func:`reported` saves the batches and returns the error
that users see.
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

from rejeu.core import checkpoint
from rejeu.core.algorithm import Clock, PyTree, Rollout, Transition
from rejeu.core.errors import NonFiniteError
from rejeu.training.learner import PackedState, Readings, bad_leaves, checked, is_finite

MAX_SKIPPED = 100
"""Number of successive skipped updates after which training stops, because nothing is learned."""
PREFIX = "nonfinite_batch_"
"""Beginning of the names of files with the batches of bad updates."""


class Update(NamedTuple):
    """A call of the compiled update."""

    batches: Transition | Rollout
    clock: Clock
    readings: Readings
    """Its metrics, and whether what it left is finite."""
    n_updates: int
    """Total number of gradient steps before it."""

    @property
    def steps(self) -> range:
        """The environment steps of its turn."""
        first, last = np.ravel(self.clock.step)[[0, -1]].tolist()
        return range(first + 1 - int(np.max(self.clock.n_envs)), last + 1)


class NonFiniteUpdate(Exception):
    """An update left NaN or infinity; :func:`reported` explains it."""

    def __init__(self, turn: list[Update], in_a_row: int) -> None:
        super().__init__("an update left numbers that are not finite")
        self.turn, self.in_a_row = turn, in_a_row


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


class NonFiniteMonitor:
    """Checks the updates of a run. Mutable."""

    def __init__(self, skips: bool) -> None:
        """``skips`` says whether bad updates undo themselves."""
        self.n_skipped = 0
        """Total number of skipped updates."""
        self.failure: tuple[PackedState, NonFiniteError] | None = None
        """The state that a bad update left, and its error, which is raised again as long as the agent has this state."""
        self._skips, self._in_a_row = skips, 0
        self._unread: deque[Update] = deque()
        self._turn: list[Update] = []
        """The last updates that were read, of one turn, until the whole state is checked."""

    def __len__(self) -> int:
        """Returns the number of updates that have not been checked."""
        return len(self._unread)

    def update(
        self, function: Callable[..., PyTree], state: PackedState, batches: PyTree, clock: Clock, n_updates: int
    ) -> tuple[PackedState, Readings, Array | None]:
        """Returns ``function(state, batches, clock)``, an update before which ``n_updates`` gradient steps were taken."""
        after, readings, td_error = function(state, batches, clock)
        self._unread.append(Update(batches, clock, readings, n_updates))
        return after, readings, td_error

    def read(self, n: int) -> None:
        """Checks what the oldest ``n`` updates report; waits for them.

        Raises:
            NonFiniteUpdate: if one of them left NaN or infinity, or if too many in a row were skipped.
        """
        for _ in range(n):
            update = self._unread.popleft()
            self._turn = [*(earlier for earlier in self._turn if earlier.clock is update.clock), update]
            n_bad = update.readings.n_bad
            self._in_a_row = self._in_a_row + n_bad if n_bad else 0
            self.n_skipped += n_bad if self._skips else 0
            if n_bad and (not self._skips or self._in_a_row >= MAX_SKIPPED):
                raise self._error()

    def check(self, state: PackedState) -> None:
        """Checks all updates and the state that they left; waits for them.

        Raises:
            NonFiniteUpdate: as :meth:`read`.
        """
        self.read(len(self))
        if self._turn and not self._skips and not is_finite(state):
            raise self._error()
        self._turn = []

    def _error(self) -> NonFiniteUpdate:
        error = NonFiniteUpdate(self._turn, self._in_a_row)
        self._unread.clear()
        self._turn, self._in_a_row = [], 0
        return error


def settle(agent: Any) -> None:
    """Waits for the updates under way and checks them.

    Raises:
        NonFiniteError: if one of them left NaN or infinity, which the agent still has.
    """
    run = agent.run
    if run.monitor.failure is not None and run.monitor.failure[0] is run.state:
        raise run.monitor.failure[1]
    try:
        run.monitor.check(run.state)
    except NonFiniteUpdate as broken:
        raise reported(agent, broken) from None


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
        "(agent.on_device = False) names the turn and saves its batches"
    )
    names = [text.split(" ")[0] for text in bad.names]
    return NonFiniteError(message, names=names, step=bad.steps[-1], n_updates=agent.n_updates)


def reported(agent: Any, broken: NonFiniteUpdate) -> NonFiniteError:
    """Saves the batches of a turn with a bad update and the state after it, and returns the error that explains it."""
    run, turn, skips = agent.run, broken.turn, agent.learner.skips
    end_episodes(agent)
    bad: list[str] = []
    if not skips:
        leaves = agent.learner.bad_leaves(run.state)
        bad = [*bad_leaves(checked(dict(turn[-1].readings))), *(f"{leaf} of the state" for leaf in leaves)]
    names = [text.split(" ")[0] for text in bad]
    path, saved = _save(agent, turn, names)
    spoiled = [text for update in turn for text in bad_parts(update.batches)]
    first, last = turn[-1].steps[0], turn[-1].steps[-1]
    steps = f"step {last:,}" if first == last else f"steps {first:,} to {last:,}"
    cause = f"the batch held {', '.join(spoiled[:3])}" if spoiled else ""
    remains = "The agent has the state after it: load a saved model or call restore_best() to go on"
    if skips:
        remains = "The bad updates were undone"
    message = (
        f"{_what(bad, broken.in_a_row, cause)}, in the update after environment {steps}. {remains}. {saved}"
        f"{_last_model(agent)}. {_advice(agent.config, spoiled, turn[-1].batches)}"
    )
    error = NonFiniteError(message, names=names, step=last, n_updates=turn[0].n_updates, batch=path)
    run.monitor.failure = None if skips else (run.state, error)
    return error


def _what(names: list[str], in_a_row: int, cause: str = "") -> str:
    """Returns a clause about the event: the names that are not finite, or its ``cause``."""
    more = len(names) - 3
    event = f"{', '.join(names[:3]) or 'an update'}{f' and {more} more' * (more > 0)} became NaN or infinite"
    event = cause or event
    if in_a_row < MAX_SKIPPED:
        return event
    return f"{in_a_row} updates in a row were skipped, so nothing is learned any more; in the last of them {event}"


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


def _save(agent: Any, turn: list[Update], names: list[str]) -> tuple[Path | None, str]:
    """Writes the batches of a turn and the agent's state; returns the path, None on failure, and a sentence that says so."""
    run, last = agent.run, turn[-1]
    header = {
        "algorithm": agent.name,
        "env_id": None if run.env is None else run.env.env_id,
        "clock": {name: np.asarray(value).tolist() for name, value in last.clock._asdict().items()},
        "n_updates": turn[0].n_updates,
        "names": names,
    }
    content = {"batches": [update.batches for update in turn], "state": agent.learner.state(run.state)}
    try:
        folder = folder_of(agent)
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"{PREFIX}{last.steps[-1]}"
        numbered = (f"{stem}{f'_{i}' if i > 1 else ''}{checkpoint.SUFFIX}" for i in itertools.count(1))
        path = next(folder / name for name in numbered if not (folder / name).exists())
        checkpoint.write(path, "batch", checkpoint.tree_to_arrays(content), header)
    except OSError as error:
        return None, f"The batches could not be saved ({' '.join(str(error).split())})"
    return path, f"Its batches and the state after it are saved in {path}"


def bad_parts(batch: Transition | Rollout) -> list[str]:
    """Returns the parts of a batch that are not finite, as :func:`bad_leaves`; a next action of NaN is one not taken."""
    return bad_leaves({name: leaf for name, leaf in batch._asdict().items() if name != "next_action"})
