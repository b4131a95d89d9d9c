"""Checks of course 4: demonstrations."""

from __future__ import annotations

import numpy as np

from rejeu.teaching.courses.checks import Student, Wrong, call, exercise, mistakes, numbers, tabulated

globals().update(tabulated(__name__))


@exercise
def aggregate(student: Student) -> None:
    """Checks ``aggregate(known, visited, expert)`` with an expert that adds 10."""
    before, visited = [(0.0, 10.0), (1.0, 11.0)], [(2.0, -2.0), (3.0, -3.0), (4.0, -4.0)]
    asked: list[float] = []

    def expert(obs: float) -> float:
        asked.append(obs)
        return obs + 10

    result = call(student, before, visited, expert, copies=False)
    if not isinstance(result, list | tuple) or not all(isinstance(pair, tuple) and len(pair) == 2 for pair in result):
        raise Wrong("not_pairs")
    pairs = [(float(numbers(obs, ())), float(numbers(action, ()))) for obs, action in result]
    labeled = [(obs, obs + 10) for obs, _ in visited]
    mistakes(
        own_actions=any(pair in pairs for pair in visited),
        known_lost=sorted(pairs) == labeled,
        never_asked=not asked,
        known_alone=sorted(pairs) == before,
        expert_of_pairs=any(not isinstance(obs, float) for obs in asked),
    )
    if sorted(pairs) != sorted(before + labeled):
        raise Wrong("other_pairs", n=len(pairs))


@exercise
def symmetric(student: Student) -> None:
    """Checks ``symmetric(own, shown, n, rng)``."""
    replayed, shown, n = np.arange(5000), 10_000 + np.arange(20), 1000
    drawn = numbers(call(student, replayed, shown, n, np.random.default_rng(0)), (n,))
    n_shown = int((drawn >= 10_000).sum())
    mistakes(own_alone=n_shown == 0, pooled=n_shown < 50, shown_alone=n_shown == n)
    if n_shown != n // 2:
        raise Wrong("other_share", n=n_shown)
    first, second = drawn[drawn < 10_000], drawn[drawn >= 10_000]
    mistakes(
        foreign=not np.isin(drawn, np.concatenate([replayed, shown])).all(),
        always_first=first.max() < 4000 or len(set(second)) < 20,
    )
    again = numbers(call(student, replayed, shown, n, np.random.default_rng(1)), (n,))
    mistakes(not_random=np.array_equal(drawn, again))
