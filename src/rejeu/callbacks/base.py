"""Callbacks: functions of ``(agent, progress)``, objects that are also told when training starts and ends, and their calls."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, ClassVar, Protocol, runtime_checkable

from rejeu.core.errors import CheckpointError
from rejeu.core.interrupt import Stopped
from rejeu.core.records import WRONG, brief, shown
from rejeu.core.types import JsonObject
from rejeu.training.run import Progress

Callback = Callable[[Any, Progress], bool | None]
"""Called after every step of the environments as ``callback(agent, progress)``. Only ``False`` stops training."""
HIDDEN = (
    "rejeu: progress.action, progress.result and progress.last_obs are None, because callbacks are called between chunks of "
    "turns here; to be called after every step, set agent.on_device = False, or derive the callback from "
    "rejeu.callbacks.TrainingCallback with every_step = True"
)
"""Advice in the error of a callback that needs what a chunk hides."""


class TrainingCallback(ABC):
    """A callback that is also told when training starts and ends. Abstract: subclasses define ``__call__``."""

    runs_last: ClassVar[bool] = False
    """Whether it is called after all others. A checkpoint is, so that it contains what they did."""
    every_step: ClassVar[bool] = False
    """Whether it must be called after every step, so that an agent in a JAX environment trains with the loop of the host."""

    def before_training(self, agent: Any) -> None:  # noqa: B027 - optional
        """Called by ``learn`` before the first step; ``agent.call.training_call`` has its limits."""

    @abstractmethod
    def __call__(self, agent: Any, progress: Progress) -> bool | None:
        """Called after every step of the environments; ``False`` stops training."""

    def resumed(self, agent: Any) -> None:  # noqa: B027 - optional
        """Called by ``learn`` in a resumed run before the first step, when the state of all callbacks was restored."""

    def after_training(self, agent: Any, error: BaseException | None) -> None:  # noqa: B027 - optional
        """Called by ``learn`` at its end; ``error`` is the exception that ended it, None if there is none."""


@runtime_checkable
class Stateful(Protocol):
    """A callback whose state a checkpoint contains."""

    def state_dict(self) -> JsonObject:
        """Returns its state: numbers, strings, lists, dicts and arrays."""

    def load_state_dict(self, state: Mapping[str, object]) -> None:
        """Restores what :meth:`state_dict` returned."""


@runtime_checkable
class Periodic(Protocol):
    """A callback that does something at an interval of environment steps."""

    every: int | None
    """The interval; None for another one."""


def crossed(before: int, now: int, every: int) -> bool:
    """Returns whether a multiple of ``every`` lies in ``(before, now]``.

    >>> [now for now in range(8, 41, 8) if crossed(now - 8, now, 10)]
    [16, 24, 32, 40]
    """
    return now // every > before // every


def step_before(agent: Any, progress: Progress) -> int:
    """Returns the total environment steps before the first turn of a ``learn``."""
    return max(progress.step - agent.n_envs, 0)


def listed(callback: Callback | Iterable[Callback] | None) -> list[Callback]:
    """Returns one callback, several or none as a list; raises ``TypeError`` if one cannot be called."""
    callbacks = [*callback] if isinstance(callback, Iterable) and not callable(callback) else [callback]
    if wrong := [function for function in callbacks if not (function is None or callable(function))]:
        raise TypeError(f"callback={wrong[0]!r:.80} must be a function (agent, progress), or a list of such functions")
    return [function for function in callbacks if function is not None]


def in_order(callbacks: Iterable[Callback]) -> list[Callback]:
    """Returns callbacks in the order in which they are called: those that run last after the others."""
    return sorted(callbacks, key=runs_last)


def runs_last(callback: Callback) -> bool:
    """Returns whether a callback is called after the others, and after the row of statistics was written."""
    return isinstance(callback, TrainingCallback) and callback.runs_last


def stateful(callbacks: Iterable[object]) -> list[Stateful]:
    """Returns the callbacks whose state a checkpoint contains."""
    return [callback for callback in callbacks if isinstance(callback, Stateful)]


def called(callback: Callback, agent: Any, turn: Progress) -> bool | None:
    """Returns the answer of a callback, ``False`` if Ctrl-C or SIGTERM ended it.

    An error because it looked at a single step of a chunk says so.
    """
    try:
        return callback(agent, turn)
    except Stopped:
        return False
    except (AttributeError, TypeError) as error:
        if turn.result is None and "NoneType" in str(error):
            error.add_note(HIDDEN)
        raise


@contextmanager
def listening(agent: Any, callbacks: Sequence[Callback]) -> Iterator[None]:
    """Tells callbacks that training starts and, on exit, that it has ended; restores their state in a resumed run."""
    started: list[TrainingCallback] = []
    error: BaseException | None = None
    saved = None if agent.call.saved_callbacks is None else [*agent.call.saved_callbacks]
    try:
        for callback in callbacks:
            if isinstance(callback, TrainingCallback):
                callback.before_training(agent)
                started.append(callback)
            if saved is not None and isinstance(callback, Stateful):
                restore_one(callback, saved)
        agent.call.saved_callbacks = None
        if saved is not None:
            for training_callback in started:
                training_callback.resumed(agent)
        if saved:
            names = shown(", ".join(name for name, _ in saved))
            warnings.warn(f"the run was saved with {names}, which learn was not given now", UserWarning, stacklevel=6)
        yield
    except BaseException as raised:
        error = raised
    with ExitStack() as ends:
        for training_callback in reversed(started):
            ends.callback(training_callback.after_training, agent, error)
        if error is not None:
            raise error  # here, so that it is the context of an error in one of these


def restore(agent: Any, callbacks: Sequence[Callback]) -> None:
    """Restores the state of callbacks of a resumed run that is not trained further.

    Raises:
        CheckpointError: if a saved state is damaged.
    """
    saved = [*(agent.call.saved_callbacks or ())]
    for callback in callbacks:
        if isinstance(callback, Stateful):
            restore_one(callback, saved)


def restore_one(callback: Stateful, saved: list[tuple[str, Any]]) -> None:
    """Restores a callback from the first saved state of its class, which is removed from ``saved``; warns without one.

    Raises:
        CheckpointError: if that state is damaged.
    """
    name = type(callback).__name__
    match = next((entry for entry in saved if entry[0] == name), None)
    if match is None:
        warnings.warn(f"the run was saved without a {name}; it starts from the beginning", UserWarning, stacklevel=7)
        return
    saved.remove(match)
    try:
        callback.load_state_dict(match[1])
    except WRONG as error:
        raise CheckpointError(f"the saved state of {name} is damaged: {brief(error)}") from error
