"""Checks of course 2: actor and critic in a box."""

from __future__ import annotations

import math

import numpy as np

from rejeu.core.types import Action, AnyArray, Observation, PyTree
from rejeu.teaching.courses.checks import Student, call, close, diagnose, exercise, mistakes, numbers, tabulated


def _value(state: Observation, action: Action) -> AnyArray:
    return state[:, :1] + 2.0 * action


def _action(state: Observation) -> AnyArray:
    return 0.5 * state[:, 1:]


def _layers() -> dict[str, PyTree]:
    """Returns a small critic. Both branches have as many outputs, so that their order shows."""
    rng, shapes = np.random.default_rng(0), {"state": (2, 4), "action": (1, 4), "common": (8, 5)}
    draw = rng.normal
    layers: dict[str, PyTree] = {key: [(draw(size=shape), draw(size=shape[1]))] for key, shape in shapes.items()}
    return layers | {"output": (rng.normal(size=(5, 1)), np.array([-1.0]))}


globals().update(tabulated(__name__, q=_value, mu=_action, layers=_layers()))


@exercise
def ball_step(student: Student) -> None:
    """Checks ``ball_step(position, push, kick)``."""
    position = np.array([[1.0, -2.0], [9.5, 0.0], [0.0, -9.0], [11.0, 0.0]])
    push = np.array([[0.5, 1.0], [1.0, 0.0], [0.0, -2.0], [-2.0, 0.0]])
    kick = np.array([[-0.2, 0.1], [0.25, 0.0], [0.0, -0.5], [0.0, 0.0]])
    after, results = position + push + kick, [call(student, *case) for case in zip(position, push, kick, strict=True)]
    mistakes(three_values=not all(isinstance(result, tuple | list) and len(result) == 3 for result in results))
    diagnose(
        np.stack([numbers(result[0], (2,)) for result in results]),
        after,
        no_kick=position + push,
        no_push=position + kick,
        kick_reversed=after - 2 * kick,
    )
    lost = (abs(after) > 10).any(axis=1)
    diagnose(
        np.stack([numbers(result[2], ()) for result in results]),
        lost,
        too_late=(abs(position) > 10).any(axis=1),
        all_coordinates=(abs(after) > 10).all(axis=1),
        negative_side=(after > 10).any(axis=1),
        reversed=~lost,
    )
    mistakes(reward=not close([numbers(result[1], ()) for result in results], np.where(lost, -10.0, 1.0)))


@exercise
def soft_update(student: Student) -> None:
    """Checks ``soft_update(target, online, tau)``."""
    target, online, tau = np.array([1.0, -2.0]), np.array([3.0, 4.0]), 0.1
    result = call(student, {"weight": target, "bias": [target * 2]}, {"weight": online, "bias": [online * 2]}, tau)
    mistakes(not_a_tree=not isinstance(result, dict) or result.keys() != {"weight", "bias"})
    diagnose(
        numbers(result["weight"], (2,)),
        (1 - tau) * target + tau * online,
        swapped=tau * target + (1 - tau) * online,
        copied=online,
        grows=target + tau * online,
        away=target - tau * (online - target),
    )


@exercise
def repel(student: Student) -> None:
    """Checks ``repel(action, x, strength, low, high)``."""
    action, x = np.array([2.6, 2.9, 2.0, -0.9]), np.array([1.0, 0.12, 0.9, -0.6])
    strength, low, high = 2e-3, -1.0, 3.0
    u = action + x

    def push(v: np.ndarray) -> np.ndarray:
        return strength * 6 * (math.pi / 4 * (v - 1.0)) ** 5 * math.pi / 4

    result = call(student, action, x, strength, low, high)
    mistakes(two_values=not isinstance(result, tuple | list) or len(result) != 2)
    new_action, after = numbers(result[0], (4,)), numbers(result[1], (4,))
    right = np.clip(u - push(u), low, high)
    mistakes(swapped=close(new_action, x - push(u)) and close(after, right))
    diagnose(
        new_action,
        right,
        pushed_out=np.clip(u + push(u), low, high),
        not_clipped=u - push(u),
        clipped_first=np.clip(u, low, high) - push(np.clip(u, low, high)),
        only_clipped=np.clip(u, low, high),
    )
    diagnose(
        after,
        x - push(u),
        process_not_pushed=x,
        process_pushed_out=x + push(u),
        process_clipped=right - action,
    )
