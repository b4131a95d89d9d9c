"""Goal strategies of hindsight replay: whose achieved goals become the new goals. One definition for host and device."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class HindsightSteps:
    """The transitions of a batch that get new goals, as a strategy sees them; each array has an entry for each, ``(n, ...)``.

    Arrays are those of NumPy with the loop of the host and those of JAX in the program on the device. Times count the
    observations of one environment over the whole run, so only their differences matter.
    """

    np: Any
    """The module that computes with the arrays: ``numpy`` or ``jax.numpy``."""
    time: Any
    """Times of the observations; ``time + 1`` is that of the next ones."""
    first: Any
    """The first times of the same episodes that may be chosen: those after the oldest observations that are stored. None for
    ``future`` and ``final``."""
    last: Any
    """The last times that may be chosen: those of the newest observations."""
    achieved: Callable[[Any], Any]
    """``achieved(times)`` returns the achieved goals of the same episodes at times ``(n,)`` or ``(n, k)``."""
    desired: Callable[[], Any]
    """``desired()`` returns the goals that the transitions have."""
    integers: Callable[[Any, Any], Any]
    """``integers(low, high)`` returns random whole numbers from ``low`` to ``high - 1``, arrays ``(n,)`` or ``(n, k)``."""

    @classmethod
    def of(
        cls,
        np: Any,
        index: Callable[[Any, Any], Any],
        env: Any,
        times: tuple[Any, Any, Any],
        goals_at: tuple[Callable[[Any], Any], Callable[[Any], Any]],
        integers: Callable[[Any, Any], Any],
    ) -> HindsightSteps:
        """Returns transitions of the environments ``env`` ``(n,)``.

        Args:
            np: the module of the arrays.
            index: returns positions in a ring, given environments and times.
            env: the environments.
            times: ``time``, ``first`` and ``last``.
            goals_at: return the achieved and the desired goals at positions.
            integers: as above.
        """
        achieved_at, desired_at = goals_at
        achieved = lambda at: achieved_at(index(env.reshape(-1, *[1] * (at.ndim - 1)), at))  # noqa: E731
        return cls(np, *times, achieved, lambda: desired_at(index(env, times[0])), integers)

    def chosen_by(self, strategy: str | GoalStrategy) -> Any:
        """Returns the times of the new goals that a strategy, or the one of this name, chooses."""
        return (STRATEGIES[strategy] if isinstance(strategy, str) else strategy)(self)


GoalStrategy = Callable[[HindsightSteps], Any]
"""A goal strategy of your own: ``strategy(steps) -> times``, for the loop of the host and for the program on the device.

The result says at which times of the same episodes the achieved goals are taken, whole numbers ``(n,)`` from
``steps.first`` to ``steps.last``. Others are an error on the host, and the nearest allowed time on the device.
:func:`register_goal_strategy` gives it a name, by which it is saved. A function ``(rng, time, first, last) -> times`` of
NumPy's generator and arrays works as well, on the host only."""


def future(steps: HindsightSteps) -> Any:
    """Returns later times."""
    return steps.integers(steps.time + 1, steps.last + 1)


def final(steps: HindsightSteps) -> Any:
    """Returns the last times."""
    return steps.last


def episode(steps: HindsightSteps) -> Any:
    """Returns any times of the episodes."""
    return steps.integers(steps.first, steps.last + 1)


BUILT_IN = {"future": future, "final": final, "episode": episode}
"""Without ``random``, which takes the goals of other episodes."""
STRATEGIES: dict[str, GoalStrategy] = dict(BUILT_IN)
"""All strategies that have a name."""


def register_goal_strategy(name: str) -> Callable[[GoalStrategy], GoalStrategy]:
    """Returns a decorator that gives a goal strategy a name, for ``goal_selection_strategy`` and for files.

    A later registration of the same name replaces the earlier one.

    >>> @register_goal_strategy("soon")
    ... def soon(steps):
    ...     return steps.np.minimum(steps.time + 3, steps.last)
    """

    def register(strategy: GoalStrategy) -> GoalStrategy:
        if name == "random" or name in BUILT_IN:
            raise ValueError(f"{name!r} is the name of a goal strategy of rejeu; choose another")
        STRATEGIES[name] = strategy
        return strategy

    return register


def name_of(strategy: str | Callable[..., Any]) -> str | Callable[..., Any]:
    """Returns the name of a strategy, or the function itself if it has none."""
    names = [name for name, known in STRATEGIES.items() if known is strategy]
    return names[0] if names else strategy


def takes_generator(strategy: str | Callable[..., Any]) -> bool:
    """Returns whether a strategy is a function ``(rng, time, first, last)``, for the host only."""
    return callable(strategy) and len(inspect.signature(strategy).parameters) != 1
