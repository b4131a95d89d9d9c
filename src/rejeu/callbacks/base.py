"""Callbacks: functions of ``(agent, progress)``, and objects that are also told when training starts and ends."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Protocol, runtime_checkable

from rejeu.loops.run import Progress

Callback = Callable[[Any, Progress], bool | None]
"""Called after every step of the environments as ``callback(agent, progress)``. Only ``False`` stops training."""


class TrainingCallback(ABC):
    """A callback that is also told when training starts and ends. Abstract: subclasses define ``__call__``."""

    runs_last: ClassVar[bool] = False
    """Whether it is called after all others. A checkpoint is, so that it contains what they did."""
    every_step: ClassVar[bool] = False
    """Whether it must be called after every step, so that an agent in a JAX environment trains with the loop of the host."""

    def before_training(self, agent: Any) -> None:  # noqa: B027 - optional
        """Called by ``learn`` before the first step; ``agent.training_call`` has its limits."""

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

    def state_dict(self) -> dict[str, Any]:
        """Returns its state: numbers, strings, lists, dicts and arrays."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
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


def step_before(agent: Any, progress: Progress, n_steps: int | None = None) -> int:
    """Returns the total environment steps before the first turn of a ``learn`` of ``n_steps`` (None: of more than a turn)."""
    taken = agent.n_envs if n_steps is None else min(agent.n_envs, n_steps)
    return max(progress.step - taken, 0)
