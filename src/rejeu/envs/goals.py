"""Reward functions of goal environments, which HER calls with relabeled goals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.types import Observation
from rejeu.envs.validation import describe_value

PARKING_WEIGHTS = np.array([1.0, 0.3, 0.0, 0.0, 0.02, 0.02])
"""Weights of x, y, vx, vy, cos h, sin h in highway-env's ``parking-v0`` (1.12, default configuration)."""
PARKED = -0.12
"""Reward above which a vehicle is parked there, and the episode ends."""

MOST_PARTS = 3
"""Numbers of a goal that are kept of each episode: enough for a place in space."""

NUMBERS = {bool, int, float, np.bool_, np.float32, np.float64}
"""Types of one number that functions of goals usually return."""


class GoalFunctions(NamedTuple):
    """The reward and termination functions of a goal environment: ``(achieved (n, ...), desired (n, ...)) -> (n,)``."""

    reward: Callable[..., np.ndarray]
    """Returns the rewards; takes ``infos``, one dict for each row, as a third argument."""
    terminated: Callable[..., np.ndarray] | None = None
    """Returns which steps are terminal, with the same arguments. If it is None, relabeled steps keep their flags."""


def parking_reward(achieved: np.ndarray, desired: np.ndarray, infos: object = None) -> np.ndarray:
    """Returns ``-sqrt(weights . |achieved - desired|)``, the reward of ``parking-v0`` without its collision penalty.

    Shapes ``(..., 6)`` to ``(...)``. It is equal to highway-env's ``compute_reward`` with the default configuration,
    which does not include the -5 that ``step`` adds on a collision either. Infos have no effect.
    """
    return -np.sqrt(np.abs(achieved - desired) @ PARKING_WEIGHTS.astype(achieved.dtype))


def goals_in(obs: Observation, n: int) -> np.ndarray | None:
    """Returns the first two or three numbers of the desired goals in ``n`` observations, ``(n, 2 or 3)``; None without two."""
    desired = obs.get("desired_goal") if isinstance(obs, Mapping) else None
    numbers = np.zeros((n, 0)) if desired is None else np.reshape(desired, (n, -1))[:, :MOST_PARTS].astype(float)
    return numbers if numbers.shape[1] > 1 else None


def goal_functions(env: Any) -> GoalFunctions | None:
    """Returns the goal functions of a Gymnasium environment, or None if it has no ``compute_reward``.

    ``compute_terminated`` is included if the environment has it, or is one of highway-env's, which end at a reward that
    their ``config`` has. Whether the functions accept batches is determined at the first call, see :func:`over_batches`.
    """
    reward = attribute(env, "compute_reward")
    if reward is None:
        return None
    terminated, config = attribute(env, "compute_terminated"), attribute(env, "config")
    if terminated is None and isinstance(config, dict) and "success_goal_reward" in config:
        terminated = lambda *goals: reward(*goals) > -config["success_goal_reward"]  # noqa: E731
    return GoalFunctions(over_batches(reward, np.float32), terminated and over_batches(terminated, np.bool_))


def attribute(env: Any, name: str) -> Any:
    """Returns an attribute of an environment or of one of its wrappers, or None if there is none, or an abstract method."""
    try:
        value = env.get_wrapper_attr(name)
    except AttributeError:
        return None
    return None if getattr(value, "__isabstractmethod__", False) else value


def goal_fault(name: str, error: Exception, goal: np.ndarray) -> BadEnvironmentError:
    """Returns the error to raise where a function of goals raises one of one goal."""
    if isinstance(error, KeyError):
        return BadEnvironmentError(
            f"{name} found no key {error}: the info is empty in hindsight replay; let it depend on the goals alone, or "
            "keep infos with replay_buffer_kwargs={'copy_info_dict': True}"
        )
    return BadEnvironmentError(
        f"{name} raised {type(error).__name__} of goals of the shape {goal.shape}: {error}; it must take two goals of one "
        "step, and may take many at once: compute over the last axis"
    )


def over_batches(function: Callable[..., Any], dtype: DTypeLike) -> Callable[..., np.ndarray]:
    """Returns ``function(achieved, desired, info)`` as a function of batches of goals, and of their infos if they are given.

    The first call with at least two rows compares the results for the whole batch with those for each of the first eight
    rows. If they agree, it is treated as vectorized from then on. Otherwise, and with infos, it is called row by row.

    Raises:
        BadEnvironmentError: by the returned function, if ``function`` returns neither a number nor an array of one for a
            single goal.
    """
    vectorized: bool | None = None
    name = getattr(function, "__name__", "the function of goals")

    def by_row(achieved: np.ndarray, desired: np.ndarray, infos: Sequence[Any] | None = None) -> np.ndarray:
        each = [{}] * len(achieved) if infos is None else infos
        try:
            rows = [function(a, d, info) for a, d, info in zip(achieved, desired, each, strict=True)]
        except Exception as error:  # a function that takes batches only can raise anything of one goal
            raise goal_fault(name, error, achieved[0]) from error
        if not set(map(type, rows)) <= NUMBERS:  # of any other kind, each is looked at, which takes far longer
            rows = [one_number(row) for row in rows]
            wrong = [row for row in rows if row is None or np.shape(row) != ()]
            if wrong:
                raise BadEnvironmentError(
                    f"{name} returned {describe_value(wrong[0])} of one goal, expected one number; "
                    "rejeu.check_env(env) says more"
                )
        return np.array(rows, dtype)

    def call(achieved: np.ndarray, desired: np.ndarray, infos: Sequence[Any] | None = None) -> np.ndarray:
        nonlocal vectorized
        if infos is None and vectorized is None and len(achieved) > 1:
            vectorized = is_vectorized(function, by_row, achieved, desired)
        if infos is None and vectorized:
            return np.asarray(function(achieved, desired, {})).astype(dtype, copy=False)
        return by_row(achieved, desired, infos)

    return call


def one_number(value: Any) -> Any:
    """Returns an array of one number as that number; anything else unchanged."""
    return np.asarray(value).reshape(()) if np.shape(value) == (1,) else value


def is_batch(values: Any, n: int) -> bool:
    """Returns whether these are ``n`` numbers or bools."""
    return np.shape(values) == (n,) and np.asarray(values).dtype.kind in "biuf"


def is_vectorized(
    function: Callable[..., Any], by_row: Callable[..., np.ndarray], achieved: np.ndarray, desired: np.ndarray
) -> bool:
    """Returns whether ``function`` takes the whole batch, with the results of its first rows one by one."""
    try:
        whole = np.asarray(function(achieved, desired, {}))
    except Exception:  # a function of one row can raise anything for a batch; it is then called row by row
        return False
    if not is_batch(whole, len(achieved)):
        return False
    rows = by_row(achieved[:8], desired[:8])
    return np.allclose(whole[:8].astype(np.float64), rows.astype(np.float64), rtol=1e-4, atol=1e-5)
