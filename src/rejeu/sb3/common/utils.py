"""Seeds and schedules."""

import random
from typing import Any

import numpy as np

from rejeu import schedules
from rejeu.schedules import Linear, Linear as LinearSchedule


def set_random_seed(seed: int, using_cuda: bool = False) -> None:
    """Seeds Python's and NumPy's global generators; rejeu itself draws from none of them, see ``seed`` of the agents.

    ``using_cuda`` is accepted and without effect.
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the global generator is what is meant


def get_linear_fn(start: float, end: float, end_fraction: float) -> Linear:
    """Returns a straight line from ``start`` to ``end``, reached when ``end_fraction`` of the run is done.

    Called, it takes the share of the run that is done, where Stable-Baselines3 takes what remains.
    """
    return Linear(start, end, end_fraction)


def get_schedule_fn(value_schedule: Any) -> Any:
    """Returns a number or a schedule as agents take it."""
    return schedules.parse("value_schedule", value_schedule)


__all__ = ["LinearSchedule", "get_linear_fn", "get_schedule_fn", "set_random_seed"]
