"""Schedules: hyperparameters as functions of the progress of a run.

A schedule is called with ``progress`` in [0, 1], a Python number or a traced array, and returns the value.
:class:`Linear`, :class:`Exponential` and :class:`TableSchedule` are saved with a model. Any other function that JAX can trace
is a schedule too; a file mentions its name only, so it must be given again to ``load``::

    rejeu.SAC("MlpPolicy", env, learning_rate=lambda progress: 3e-4 * jnp.cos(progress * jnp.pi / 2))
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.core.types import Scalar
from rejeu.core.validation import assign, coerce, number


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
        coerce(self, ("start", "end"), number)
        coerce(self, "fraction", number, above=0, most=1)

    def __call__(self, progress: Scalar) -> Scalar:
        done = _clip(progress / self.fraction)
        return self.start + (self.end - self.start) * done


@dataclass(frozen=True)
class Exponential:
    """A geometric path from ``start`` to ``end``: the same factor for equal parts of the run.

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
        coerce(self, ("start", "end"), number, above=0)
        coerce(self, "fraction", number, above=0, most=1)

    def __call__(self, progress: Scalar) -> Scalar:
        done = _clip(progress / self.fraction)
        return self.start * (self.end / self.start) ** done


@dataclass(frozen=True)
class TableSchedule:
    """Values at equal steps of the progress from 0 to 1, joined by straight lines: any function, as data.

    >>> TableSchedule((1.0, 0.5, 0.0))(0.25)
    0.75
    """

    values: tuple[float, ...]
    """The values, two or more."""

    def __post_init__(self) -> None:
        assign(self, values=tuple(map(float, self.values)))
        if len(self.values) < 2 or not all(map(math.isfinite, self.values)):
            raise ValueError(f"a schedule needs two values or more, all finite; got {self.values!s:.80}")

    def __call__(self, progress: Scalar) -> Scalar:
        position = _clip(progress) * (len(self.values) - 1)
        if isinstance(position, int | float):
            below = min(int(position), len(self.values) - 2)
            return self.values[below] + (position - below) * (self.values[below + 1] - self.values[below])
        return jnp.interp(position, jnp.arange(len(self.values)), jnp.array(self.values, jnp.float32))


class Live:
    """A number that compiled functions read when they run, so that it can be set without compiling them again.

    A model file contains the number. Before it is set, wait for the updates that have been started.
    """

    def __init__(self, value: float) -> None:
        self.value = value

    def __call__(self, progress: Scalar) -> Any:
        if isinstance(progress, int | float):
            return self.value
        shape = jax.ShapeDtypeStruct((), jnp.float32)
        return jax.pure_callback(lambda _: np.float32(self.value), shape, progress, vmap_method="sequential")


ROUNDING = 1e-6
"""Relative error by which the end of a schedule may fall below its limit, such as the end of a cosine."""
Schedule = Callable[[Any], Any]
"""A function from the progress in [0, 1] to a value: one of ``SCHEDULES`` or one of your own."""
SCHEDULES: dict[str, type[Linear] | type[Exponential] | type[TableSchedule]] = {
    "linear": Linear,
    "exponential": Exponential,
    "table": TableSchedule,
}


def at(value: float | Schedule, progress: Scalar) -> Any:
    """Returns the value of a number or of a schedule at ``progress``."""
    return value(progress) if callable(value) else value


def parse(name: str, value: object, least: float = -math.inf) -> float | Schedule:
    """Returns a number or a schedule from what a user or a file gives.

    Accepted: a number, a schedule, ``"lin_3e-4"`` (RL Zoo's notation for a line to zero), the JSON form
    ``{"schedule": "linear", "start": 1e-3, "end": 0}``, or any function of the progress that JAX can trace.

    Raises:
        TypeError: for anything else.
        ValueError: for a number that is not finite, or a value below ``least`` at the beginning or the end.
    """
    is_plain = isinstance(value, int | float) and not isinstance(value, bool)
    parsed = number(name, value) if is_plain else _schedule_of(name, value)
    ends = [float(at(parsed, end)) for end in (0.0, 1.0)]
    if min(ends) < least - ROUNDING * max(map(abs, ends)):
        raise ValueError(f"{name}={value!r} must not fall below {least:g}")
    return parsed


def _schedule_of(name: str, value: object) -> Schedule:
    if isinstance(value, Linear | Exponential | TableSchedule):
        return value
    try:
        if isinstance(value, str) and value.startswith("lin_"):
            return Linear(float(value.removeprefix("lin_")))
        if isinstance(value, Mapping) and value.get("schedule") in SCHEDULES:
            fields = {key: number for key, number in value.items() if key != "schedule"}
            return SCHEDULES[value["schedule"]](**fields)
    except (TypeError, ValueError) as error:
        raise type(error)(f"{name}={value!r} is not a schedule: {error}") from None
    if callable(value):
        check_function(name, value)
        return value
    raise TypeError(
        f"{name}={value!r} must be a number, rejeu.Linear(start, end), rejeu.Exponential(start, end), 'lin_<number>' or "
        "a function of the progress from 0 to 1"
    )


def check_function(name: str, function: Schedule) -> None:
    """Checks that a function of the user's own is a schedule.

    Raises:
        TypeError: if JAX cannot trace it, or it returns something other than one number.
        ValueError: if it takes the remaining progress, as in Stable-Baselines3.
    """
    if "progress_remaining" in inspect.signature(function).parameters:
        raise ValueError(
            f"{name}: functions are called with the progress, which runs from 0 to 1, and this one takes "
            "progress_remaining; give lambda progress: function(1 - progress), or use the algorithms of rejeu.sb3"
        )
    try:
        result = jax.eval_shape(function, jax.ShapeDtypeStruct((), jnp.float32))
    except jax.errors.JAXTypeError:
        raise TypeError(f"{name}: the function must use jax.numpy, instead of NumPy, if and float()") from None
    if getattr(result, "shape", None) != ():
        raise TypeError(f"{name}: the function must return one number, got {result}")


def to_json(schedule: Any) -> dict[str, Any]:
    """Returns the JSON form that :func:`parse` reads."""
    name = next(key for key, schedule_class in SCHEDULES.items() if isinstance(schedule, schedule_class))
    return {"schedule": name, **asdict(schedule)}


def _clip(done: Scalar) -> Scalar:
    return min(max(done, 0.0), 1.0) if isinstance(done, int | float) else jnp.clip(done, 0.0, 1.0)
