"""What hindsight replay needs of a goal environment: a reward that is a function of the goals alone, for many at once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from rejeu.envs.checker import Finding, Seen
from rejeu.spaces import GOAL_KEYS, check_goal_space

MOST_ROWS = 32
"""Steps whose goals are looked at."""


def goal_findings(env: gym.Env, seen: Sequence[Seen]) -> list[Finding]:
    """Returns what is wrong with the goals of an environment, by steps that were seen of it."""
    try:
        check_goal_space(env.observation_space)
    except ValueError as error:
        return [Finding("error", str(error))]
    if not env.has_wrapper_attr("compute_reward"):
        return [
            Finding(
                "error",
                "observations with a desired_goal need the method compute_reward(achieved_goal, desired_goal, info), and "
                "there is none; add it, for hindsight replay",
            )
        ]
    ended = [one for one in seen if one.terminated][: MOST_ROWS // 4]
    rows = [*seen[:MOST_ROWS], *ended]
    found = _of_function("compute_reward", env.get_wrapper_attr("compute_reward"), rows)
    if env.has_wrapper_attr("compute_terminated"):
        found += _of_function("compute_terminated", env.get_wrapper_attr("compute_terminated"), rows)
    return found


def _of_function(name: str, function: Callable[..., Any], rows: Sequence[Seen]) -> list[Finding]:
    """Returns what is wrong with ``compute_reward`` or ``compute_terminated``, the worst only."""
    for row in rows:
        own = function(*_goals(row), row.info)
        if np.shape(own) != ():
            return [
                Finding(
                    "error", f"{name} returned the shape {np.shape(own)} of one goal, expected one number; index it"
                )
            ]
        if (finding := _against_step(name, own, row)) is not None:
            return [finding]
        alone = _attempt(function, *_goals(row), {})
        if isinstance(alone, Exception) or not _agree(own, alone):
            return [
                Finding(
                    "error",
                    f"{name} gave {own} with the info of the step, and {_told(alone)} with an empty info; hindsight replay "
                    "keeps no infos: let it depend on the goals alone",
                )
            ]
    return _of_batches(name, function, rows)


def _against_step(name: str, own: Any, row: Seen) -> Finding | None:
    """Returns how a step and the function disagree about one goal."""
    if name == "compute_terminated":
        if bool(own) == row.terminated:
            return None
        level: Any = "error" if own else "warning"
        text = (
            f"compute_terminated gave {bool(own)} where step gave terminated={row.terminated}; hindsight replay goes by the "
            "former: let step return it too"
            + ("" if own else ", unless something else than the goal ended the episode")
        )
        return Finding(level, text)
    if _agree(own, row.reward):
        return None
    text = f"step gave the reward {row.reward}, and compute_reward of the same goals {own}"
    if row.terminated:
        return Finding("warning", f"{text}, where the episode ended; hindsight replay will not know of the difference")
    return Finding("error", f"{text}; they must agree: let step call compute_reward")


def _of_batches(name: str, function: Callable[..., Any], rows: Sequence[Seen]) -> list[Finding]:
    """Returns whether the function says of many goals at once what it says of each."""
    achieved, desired = (np.array([_goals(row)[k] for row in rows]) for k in range(2))
    achieved, desired = np.concatenate([achieved] * 2), np.concatenate([np.roll(desired, 1, axis=0), achieved])
    single = [_attempt(function, a, d, {}) for a, d in zip(achieved, desired, strict=True)]
    if (raised := next((one for one in single if isinstance(one, Exception)), None)) is not None:
        return [
            Finding("error", f"{name} of goals of other steps {_told(raised)}; it must take any goals of the space")
        ]
    whole = _attempt(function, achieved, desired, {})
    if isinstance(whole, Exception) or np.shape(whole) != (len(achieved),):
        what = _told(whole) if isinstance(whole, Exception) else f"gave the shape {np.shape(whole)}"
        return [
            Finding(
                "warning",
                f"{name} of {len(achieved)} goals at once {what}, expected ({len(achieved)},); rejeu then calls it row by "
                "row, which is slow: compute over the last axis, as np.linalg.norm(achieved - desired, axis=-1) does",
            )
        ]
    if not _agree(whole, np.array(single)):
        at = int(np.flatnonzero(~np.isclose(whole, single, rtol=1e-4, atol=1e-5))[0])
        return [
            Finding(
                "error",
                f"{name} of many goals at once gave {whole[at]} in row {at}, and {single[at]} of the same goals one by one; "
                "compute each row by itself: over the last axis",
            )
        ]
    return []


def _goals(row: Seen) -> tuple[Any, Any]:
    _, achieved, desired = (row.obs[key] for key in GOAL_KEYS)
    return achieved, desired


def _attempt(function: Callable[..., Any], *arguments: Any) -> Any:
    """Returns what a function returns or raises."""
    try:
        return function(*arguments)
    except Exception as error:  # whatever it raises of goals that it did not expect
        return error


def _agree(one: Any, two: Any) -> bool:
    first, second = np.asarray(one, np.float64), np.asarray(two, np.float64)
    return bool(np.allclose(first, second, rtol=1e-4, atol=1e-5))


def _told(result: Any) -> str:
    return f"raised {type(result).__name__}: {result}" if isinstance(result, Exception) else f"{result}"
