"""Schedules: numbers that change over a run, as frozen dataclasses of its progress.

A schedule is called with ``progress`` in [0, 1] and returns the value there; it works on Python numbers and on traced
arrays alike. Being data, it is saved with a model, compared, and printed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import jax.numpy as jnp


@dataclass(frozen=True)
class Linear:
    """A straight line from ``start`` to ``end``, reached when ``fraction`` of the run is done, and constant after.

    >>> Linear(1.0, 0.1, fraction=0.5)(0.25)
    0.55
    """

    start: float
    """Value at the beginning of the run."""
    end: float = 0.0
    """Value from ``fraction`` of the run on."""
    fraction: float = 1.0
    """Share of the run over which the value moves, in (0, 1]."""

    def __post_init__(self) -> None:
        _check_numbers(self)

    def __call__(self, progress: Any) -> Any:
        done = _clip(progress / self.fraction)
        return self.start + (self.end - self.start) * done


@dataclass(frozen=True)
class Exponential:
    """A geometric path from ``start`` to ``end``: the same factor for every equal stretch of the run.

    >>> round(Exponential(1.0, 0.01)(0.5), 6)
    0.1
    """

    start: float
    """Value at the beginning of the run, positive."""
    end: float
    """Value from ``fraction`` of the run on, positive."""
    fraction: float = 1.0
    """Share of the run over which the value moves, in (0, 1]."""

    def __post_init__(self) -> None:
        _check_numbers(self)
        if not (self.start > 0 and self.end > 0):
            raise ValueError(f"an exponential schedule needs positive ends, got start={self.start}, end={self.end}")

    def __call__(self, progress: Any) -> Any:
        done = _clip(progress / self.fraction)
        return self.start * (self.end / self.start) ** done


Schedule = Linear | Exponential
SCHEDULES: dict[str, type[Linear] | type[Exponential]] = {"linear": Linear, "exponential": Exponential}


def at(value: float | Schedule, progress: Any) -> Any:
    """Returns the value of a number or of a schedule at ``progress``."""
    return value if isinstance(value, int | float) else value(progress)


def parse(name: str, value: Any) -> float | Schedule:
    """Returns a number or a schedule from what a user or a file may give.

    Accepted: a number, a schedule, ``"lin_3e-4"`` (RL Zoo's spelling of a line to zero), or the JSON form
    ``{"schedule": "linear", "start": 1e-3, "end": 0}``.

    Raises:
        TypeError: for anything else, a Python function among them: it could not be saved with the model.
        ValueError: for a number that is not finite.
    """
    if isinstance(value, Linear | Exponential):
        return value
    if isinstance(value, bool):
        raise TypeError(f"{name}={value!r} must be a number or a schedule")
    if isinstance(value, int | float):
        if not math.isfinite(value):
            raise ValueError(f"{name}={value} must be finite")
        return float(value)
    try:
        if isinstance(value, str) and value.startswith("lin_"):
            return Linear(float(value.removeprefix("lin_")))
        if isinstance(value, Mapping) and value.get("schedule") in SCHEDULES:
            fields = {key: float(number) for key, number in value.items() if key != "schedule"}
            return SCHEDULES[value["schedule"]](**fields)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}={value!r} is no schedule: {error}") from None
    raise TypeError(
        f"{name}={value!r} must be a number, rejeu.Linear(start, end), rejeu.Exponential(start, end) or 'lin_<number>'"
        + ("; a function cannot be saved with the model" if callable(value) else "")
    )


def to_json(schedule: Schedule) -> dict[str, Any]:
    """Returns the JSON form that :func:`parse` reads."""
    name = next(key for key, kind in SCHEDULES.items() if isinstance(schedule, kind))
    return {"schedule": name, **asdict(schedule)}


def _check_numbers(schedule: Schedule) -> None:
    if not (math.isfinite(schedule.start) and math.isfinite(schedule.end)):
        raise ValueError(f"start={schedule.start} and end={schedule.end} must be finite")
    if not 0 < schedule.fraction <= 1:
        raise ValueError(f"fraction={schedule.fraction} must be above 0 and at most 1")


def _clip(done: Any) -> Any:
    return min(max(done, 0.0), 1.0) if isinstance(done, int | float) else jnp.clip(done, 0.0, 1.0)
