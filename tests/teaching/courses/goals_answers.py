"""Right and wrong answers of course 3, and what the checks say about the wrong ones."""

import numpy as np

from rejeu.teaching.courses.checks import goals
from tests.teaching.courses.solutions import solution

right = solution(3, goals)


def compute_reward(achieved, desired, info):
    return np.where(np.all(achieved == desired, axis=-1), 0.0, -1.0)


def relabel(step, goal, observation="next_obs", **changes):
    reward = float(compute_reward(getattr(step, observation)["achieved_goal"], goal, {}))
    obs, next_obs = ({**seen, "desired_goal": goal} for seen in (step.obs, step.next_obs))
    new = {"obs": obs, "next_obs": next_obs, "reward": reward, "terminated": reward == 0} | changes
    return step._replace(**new)


def hindsight(episode, k, rng, draw=lambda rng, t, n, k: rng.integers(t, n, size=k), which="next_obs"):
    result = []
    for t, step in enumerate(episode):
        result.append(step)
        for later in draw(rng, t, len(episode), k):
            result.append(relabel(step, getattr(episode[later], which)["achieved_goal"]))  # noqa: PERF401
    return result


RIGHT = [*vars(right).values()]


def changes_the_step(step, goal):
    step.obs["desired_goal"] = goal
    return relabel(step, goal)


def only_later(rng, time, first, last):
    return np.where(time + 2 <= last, rng.integers(np.minimum(time + 2, last), last + 1), last)


WRONG = [
    ("compute_reward", lambda a, d, i: float(np.all(a == d)) - 1, "single number"),
    ("compute_reward", lambda a, d, i: (a == d) - 1.0, "reward for each bit"),
    ("compute_reward", lambda a, d, i: compute_reward(a, d, i) + 1, "it is 0 and -1"),
    ("compute_reward", lambda a, d, i: -1 - compute_reward(a, d, i), "condition is reversed"),
    ("compute_reward", lambda a, d, i: (a == d).mean(axis=-1) - 1, "number of wrong bits"),
    ("compute_reward", lambda a, d, i: (a == d).any(axis=-1) - 1.0, "any or all"),
    ("compute_reward", lambda a, d, i: np.where((a == d).all(axis=1), 0, -1), "AxisError"),
    ("relabel", lambda s, g: relabel(s, g, obs=s.obs), "before the step (obs)"),
    ("relabel", lambda s, g: relabel(s, g, next_obs=s.next_obs), "after the step (next_obs)"),
    (
        "relabel",
        lambda s, g: relabel(s, g, obs={**s.obs, "desired_goal": g, "achieved_goal": g}),
        "more than the desired",
    ),
    ("relabel", lambda s, g: relabel(s, g, reward=s.reward), "reward is still 0"),
    ("relabel", lambda s, g: relabel(s, g, reward=0.0, terminated=True), "reward"),
    ("relabel", lambda s, g: relabel(s, g, observation="obs"), "before the step"),
    ("relabel", lambda s, g: relabel(s, g, terminated=False), "terminated is still False"),
    ("relabel", lambda s, g: relabel(s, g, terminated=relabel(s, g).reward == 0 or s.terminated), "was kept"),
    ("relabel", changes_the_step, "changes the arrays"),
    ("relabel", lambda s, g: relabel(s, g).obs, "a Step is expected"),
    ("hindsight", lambda e, k, rng: hindsight(e, k, rng)[1:], "steps, expected 6 x"),
    ("hindsight", lambda e, k, rng: hindsight(e, k, rng, which="obs"), "achieved in s, before the action"),
    ("hindsight", lambda e, k, rng: hindsight(e, k, rng, lambda rng, t, n, k: rng.integers(0, n, k)), "the past"),
    ("hindsight", lambda e, k, rng: hindsight(e, k, rng, lambda rng, t, n, k: [n - 1] * k), "strategy final"),
    ("hindsight", lambda e, k, rng: hindsight(e, k, rng, lambda rng, t, n, k: rng.integers(t + 1, n, k)), "ValueError"),
    ("future", lambda rng, t, first, last: rng.integers(first, last + 1), "the past"),
    ("future", lambda rng, t, first, last: rng.integers(t, last + 1), "achieved in s, before the action"),
    ("future", lambda rng, t, first, last: rng.integers(t + 1, np.maximum(last, t + 2)), "excludes high"),
    ("future", lambda rng, t, first, last: rng.integers(t + 1, last + 5), "another episode"),
    ("future", lambda rng, t, first, last: last, "strategy final"),
    ("future", only_later, "as often as every later one"),
    ("future", lambda rng, t, first, last: rng.integers(t[0] + 1, last[0] + 1), "the shape ()"),
    ("future", lambda rng, t, first, last: rng.uniform(t + 1, last), "whole numbers"),
    ("final", lambda rng, t, first, last: last - 1, "last time but one"),
    ("final", lambda rng, t, first, last: first, "the first time"),
    ("final", lambda rng, t, first, last: t, "time of the step itself"),
    ("episode", right.future, "strategy future"),
    ("episode", lambda rng, t, first, last: rng.integers(first, last), "excludes high"),
    ("episode", lambda rng, t, first, last: rng.integers(0, last + 1), "outside of the episode"),
    ("episode", lambda rng, t, first, last: rng.integers(first + 1, last + 1), "first is never drawn"),
    ("parking_reward", lambda a, d, w: -right.parking_reward(a, d, w), "a distance is a cost"),
    ("parking_reward", lambda a, d, w: -abs(a - d) @ w, "square root is missing"),
    ("parking_reward", lambda a, d, w: -np.sqrt((a - d) ** 2 @ w), "another norm"),
    ("parking_reward", lambda a, d, w: -np.sqrt(abs(a - d).sum(axis=1)), "weights are missing"),
    ("parking_reward", lambda a, d, w: -np.sqrt(abs(a - d)) @ w, "around the sum"),
    ("parking_reward", lambda a, d, w: -np.sqrt(np.sum(w * abs(a - d))), "single number"),
]
