"""Checks of course 4: demonstrations."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from rejeu.teaching.courses.checks import Wrong, call, compiles, diagnose, exercise, mistakes, numbers


@exercise
def toward(student: Any) -> None:
    """Checks ``toward(position, velocity, target)``."""
    cases = [
        ([0.0, 0.5], [0.0, 0.0], [0.1, 0.45]),
        ([0.0, 0.0], [0.3, -0.2], [0.0, 0.0]),
        ([0.0, 0.0], [0.0, 1.0], [2.0, 0.9]),
    ]
    found = np.stack([numbers(call(student, *map(np.array, case)), (2,)) for case in cases])
    position, velocity, target = (np.array([case[i] for case in cases]) for i in range(3))
    push = 4 * (target - position) - 2 * velocity
    diagnose(
        found,
        np.clip(push, -1, 1),
        reversed=np.clip(4 * (position - target) - 2 * velocity, -1, 1),
        no_brake=np.clip(4 * (target - position), -1, 1),
        speeds_up=np.clip(4 * (target - position) + 2 * velocity, -1, 1),
        not_limited=push,
    )


@exercise
def cloning_loss(student: Any) -> None:
    """Checks ``cloning_loss(action, shown)``."""
    rng = np.random.default_rng(0)
    action, shown = (rng.normal(size=(5, 2)).astype(np.float32) for _ in range(2))
    result = call(student, jnp.asarray(action), jnp.asarray(shown))
    mistakes(each_step=np.shape(result) in {(5,), (5, 1)}, each_component=np.shape(result) == (2,))
    error = action - shown
    diagnose(
        numbers(result, ()),
        np.square(error).sum(axis=1).mean(),
        sum_of_steps=np.square(error).sum(),
        mean_of_components=np.square(error).mean(),
        not_squared=error.sum(axis=1).mean(),
        absolute=np.abs(error).sum(axis=1).mean(),
        reversed=-np.square(error).sum(axis=1).mean(),
    )
    compiles(student, jnp.asarray(action), jnp.asarray(shown))


@exercise
def aggregate(student: Any) -> None:
    """Checks ``aggregate(known, visited, expert)`` with an expert that adds 10."""
    known, visited = [(0.0, 10.0), (1.0, 11.0)], [(2.0, -2.0), (3.0, -3.0), (4.0, -4.0)]
    asked: list[float] = []

    def expert(obs: float) -> float:
        asked.append(obs)
        return obs + 10

    result = call(student, known, visited, expert, copies=False)
    if not isinstance(result, list | tuple) or not all(isinstance(one, tuple) and len(one) == 2 for one in result):
        raise Wrong("not_pairs")
    pairs = [(float(numbers(obs, ())), float(numbers(action, ()))) for obs, action in result]
    labeled = [(obs, obs + 10) for obs, _ in visited]
    mistakes(
        own_actions=any(pair in pairs for pair in visited),
        known_lost=sorted(pairs) == labeled,
        never_asked=not asked,
        known_alone=sorted(pairs) == known,
        expert_of_pairs=any(not isinstance(obs, float) for obs in asked),
    )
    if sorted(pairs) != sorted(known + labeled):
        raise Wrong("other_pairs", n=len(pairs))


@exercise
def symmetric(student: Any) -> None:
    """Checks ``symmetric(own, shown, n, rng)``."""
    own, shown, n = np.arange(5000), 10_000 + np.arange(20), 1000
    drawn = numbers(call(student, own, shown, n, np.random.default_rng(0)), (n,))
    n_shown = int((drawn >= 10_000).sum())
    mistakes(own_alone=n_shown == 0, pooled=n_shown < 50, shown_alone=n_shown == n)
    if n_shown != n // 2:
        raise Wrong("other_share", n=n_shown)
    first, second = drawn[drawn < 10_000], drawn[drawn >= 10_000]
    mistakes(
        foreign=not np.isin(drawn, np.concatenate([own, shown])).all(),
        always_first=first.max() < 4000 or len(set(second)) < 20,
    )
    again = numbers(call(student, own, shown, n, np.random.default_rng(1)), (n,))
    mistakes(not_random=np.array_equal(drawn, again))
