"""Random seeds and schedules."""

import random
from dataclasses import dataclass
from typing import Any

import numpy as np

from rejeu import schedules
from rejeu.schedules import Exponential, Linear


def set_random_seed(seed: int, using_cuda: bool = False) -> None:
    """Seeds the global generators of Python and NumPy. rejeu does not use them; see the ``seed`` of the agents.

    ``using_cuda`` is accepted and ignored.
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the global generator is what is meant


@dataclass(frozen=True)
class LinearSchedule:
    """A straight line from ``start`` to ``end``, reached when ``end_fraction`` of the run is done, and constant after.

    >>> LinearSchedule(1.0, 0.1, end_fraction=0.5)(0.75)
    0.55
    """

    start: float
    """Value at the beginning of the run."""
    end: float
    """Value from ``end_fraction`` of the run on."""
    end_fraction: float
    """Share of the run over which the value moves, in (0, 1]."""

    def __call__(self, progress_remaining: Any) -> Any:
        return self.to_linear()(1.0 - progress_remaining)

    def to_linear(self) -> Linear:
        """Returns the same line as a function of the progress, which a model file contains."""
        return Linear(self.start, self.end, self.end_fraction)


def get_linear_fn(start: float, end: float, end_fraction: float) -> LinearSchedule:
    """Returns a linear schedule from ``start`` to ``end``, which is reached after the fraction ``end_fraction`` of the run."""
    return LinearSchedule(start, end, end_fraction)


def get_schedule_fn(value_schedule: Any) -> Any:
    """Returns a number or a schedule in the form that agents accept."""
    return value_schedule if callable(value_schedule) else schedules.parse("value_schedule", value_schedule)


def of_progress(value: Any) -> Any:
    """Returns a schedule of the remaining progress as one of the progress; anything else unchanged."""
    if isinstance(value, LinearSchedule):
        return value.to_linear()
    if isinstance(value, Linear | Exponential) or not callable(value):
        return value

    def schedule(progress: Any) -> Any:
        return value(1.0 - progress)

    schedule.__name__ = getattr(value, "__name__", type(value).__name__)  # by which a model file mentions it
    return schedule


__all__ = ["LinearSchedule", "get_linear_fn", "get_schedule_fn", "set_random_seed"]
