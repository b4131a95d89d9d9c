"""Random seeds and schedules."""

import random
from typing import Any

import numpy as np

from rejeu import schedules
from rejeu.schedules import Linear, Linear as LinearSchedule


def set_random_seed(seed: int, using_cuda: bool = False) -> None:
    """Seeds the global generators of Python and NumPy. rejeu does not use them; see the ``seed`` of the agents.

    ``using_cuda`` is accepted and ignored.
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the global generator is what is meant


def get_linear_fn(start: float, end: float, end_fraction: float) -> Linear:
    """Returns a linear schedule from ``start`` to ``end``, which is reached after the fraction ``end_fraction`` of the run.

    It is called with the completed fraction of the run, in Stable-Baselines3 with the remaining one.
    """
    return Linear(start, end, end_fraction)


def get_schedule_fn(value_schedule: Any) -> Any:
    """Returns a number or a schedule in the form that agents accept."""
    return schedules.parse("value_schedule", value_schedule)


__all__ = ["LinearSchedule", "get_linear_fn", "get_schedule_fn", "set_random_seed"]
