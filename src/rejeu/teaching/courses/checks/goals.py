"""Checks of course 3: goals and hindsight replay."""

from __future__ import annotations

import math
import tempfile
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.agents import SAC
from rejeu.core.types import Action
from rejeu.teaching.courses.checks import Student, Wrong, call, close, diagnose, exercise, mistakes, numbers, tabulated

N = 4_000
"""Draws of a strategy, enough that every time occurs."""


class GoalStep(NamedTuple):
    """A step of an episode in a goal environment."""

    obs: dict[str, np.ndarray]
    """``observation``, ``achieved_goal`` and ``desired_goal`` before the step."""
    action: Action
    reward: float
    next_obs: dict[str, np.ndarray]
    """Those after the step."""
    terminated: bool


globals().update(tabulated(__name__))


@exercise
def compute_reward(student: Student) -> None:
    """Checks ``compute_reward(achieved_goal, desired_goal, info)`` for bits, one goal and a batch."""
    achieved = np.array([[0, 1, 1], [0, 1, 0], [1, 0, 0]], np.int8)
    desired = np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]], np.int8)
    result = call(student, achieved, desired, {})
    if np.shape(result) == ():
        raise Wrong("single_number", result=result)
    mistakes(per_bit=np.shape(result) == (3, 3))
    share = (achieved == desired).mean(axis=-1)
    diagnose(
        numbers(result, (3,)),
        [0, -1, -1],
        one_and_zero=[1, 0, 0],
        reversed=[-1, 0, 0],
        number_of_bits=share - 1,
        any_bit=[0, -1, 0],
    )
    mistakes(single_goal=not close(numbers(call(student, achieved[1], desired[1], {}), ()), -1))


@exercise
def relabel(student: Student) -> None:
    """Checks ``relabel(step, goal)`` with the reward of bits."""
    a, b, c = (np.array(bits, np.int8) for bits in ([0, 0, 1], [0, 1, 1], [1, 1, 1]))
    missed = GoalStep(_observe(a, c), 1, -1.0, _observe(b, c), False)
    reached = GoalStep(_observe(a, b), 1, 0.0, _observe(b, b), True)
    _one_relabeling(call(student, missed, a), missed, a, achieved=False)
    _one_relabeling(call(student, reached, c), reached, c, achieved=False)
    _one_relabeling(call(student, missed, b), missed, b, achieved=True)


def _observe(achieved: np.ndarray, desired: np.ndarray) -> dict[str, np.ndarray]:
    return {"observation": achieved, "achieved_goal": achieved, "desired_goal": desired}


def _one_relabeling(result: Any, step: GoalStep, goal: np.ndarray, achieved: bool) -> None:
    """Checks a relabeled step; ``achieved``: whether the step reaches its new goal."""
    mistakes(not_a_step=getattr(result, "_fields", None) != GoalStep._fields)
    for name in ("obs", "next_obs"):
        new, before = getattr(result, name), getattr(step, name)
        if not isinstance(new, dict) or new.keys() != before.keys() or not np.array_equal(new["desired_goal"], goal):
            raise Wrong(f"{name}_without_goal")
        if any(not np.array_equal(new[key], before[key]) for key in ("observation", "achieved_goal")):
            raise Wrong("more_changed", name=name)
    reward, right = numbers(result.reward, ()), 0.0 if achieved else -1.0
    of_before = 0.0 if np.array_equal(step.obs["achieved_goal"], goal) else -1.0
    if not close(reward, right):
        is_kept, is_before = close(reward, step.reward), close(reward, of_before)
        raise Wrong(
            "reward_kept" if is_kept else "reward_before" if is_before else "reward", reward=reward, right=right
        )
    if bool(result.terminated) != achieved:
        raise Wrong("still_going" if achieved else "terminated_kept")


@exercise
def hindsight(student: Student) -> None:
    """Checks ``hindsight(episode, k, rng)``, the steps of an episode with ``k`` relabeled copies of each."""
    states = [np.array([(t >> bit) & 1 for bit in range(4)], np.int8) for t in range(7)]
    goal = np.array([1, 1, 1, 1], np.int8)
    pairs = pairwise(states)
    episode = [GoalStep(_observe(s, goal), t, -1.0, _observe(n, goal), False) for t, (s, n) in enumerate(pairs)]
    result = call(student, episode, 40, np.random.default_rng(0))
    if not isinstance(result, list) or not all(
        isinstance(step, tuple) and hasattr(step, "next_obs") for step in result
    ):
        raise Wrong("not_a_list")
    if len(result) != 6 * 41:
        raise Wrong("how_many", n=len(result))
    drawn: list[tuple[int, int]] = []
    for step in result:
        time = int(step.action)
        new = step.next_obs["desired_goal"]
        if not np.array_equal(new, goal):
            drawn.append((time, int(new @ (1 << np.arange(4)))))
    if len(drawn) != 240:
        raise Wrong("how_many_relabeled", n=len(drawn))
    _check_times(np.array([time for time, _ in drawn]), np.array([number for _, number in drawn]), last=6)


def _check_times(time: np.ndarray, drawn: np.ndarray, last: np.ndarray | int) -> None:
    """Checks that the times of the new goals are from ``time + 1`` to ``last``, and that both occur."""
    mistakes(other_episode=(drawn > last).any(), past=(drawn < time).any(), achieved_before=(drawn == time).any())
    inner = time < np.asarray(last) - 1
    mistakes(
        last_never=not (drawn == last)[inner].any(),
        always_last=(drawn == last).all(),
        next_never=not (drawn == time + 1)[inner].any() or (drawn == time + 1).all(),
    )


def _draw(student: Student) -> tuple[np.ndarray, ...]:
    """Returns ``time``, ``first``, ``last`` and the times that a strategy chose for steps of two episodes."""
    rng = np.random.default_rng(0)
    first = np.where(np.arange(N) % 2 == 0, 101, 1)
    last = first + 9
    time = first - 1 + rng.integers(0, 10, N)
    result = call(student, rng, time, first, last)
    if np.shape(result) != (N,):
        raise Wrong("how_many_times", n=N, shape=np.shape(result))
    drawn = np.asarray(result)
    if drawn.dtype.kind not in "iu":
        raise Wrong("not_whole", dtype=drawn.dtype)
    return time, first, last, drawn


@exercise
def future(student: Student) -> None:
    """Checks ``future(rng, time, first, last)``."""
    time, _, last, drawn = _draw(student)
    _check_times(time, drawn, last)


@exercise
def final(student: Student) -> None:
    """Checks ``final(rng, time, first, last)``."""
    time, first, last, drawn = _draw(student)
    diagnose(
        drawn - last,
        0 * last,
        own_time=time - last,
        first_time=first - last,
        last_but_one=0 * last - 1,
    )


@exercise
def episode(student: Student) -> None:
    """Checks ``episode(rng, time, first, last)``."""
    time, first, last, drawn = _draw(student)
    mistakes(
        outside=(drawn < first).any() or (drawn > last).any(),
        only_later=(drawn > time).all(),
        last_never=not (drawn == last).any(),
        first_never=not (drawn == first).any(),
    )


@exercise
def saving(save_all: Student, load_all: Student, agent: Any = None, env: Any = "Pendulum-v1") -> None:
    """Checks ``save_all(agent, folder)`` and ``load_all(folder, env)`` with an agent, by default one of SAC."""
    if agent is None:
        agent = SAC("MlpPolicy", env, learning_starts=100, buffer_size=1_000, seed=0).learn(20)
    observations = gym.vector.utils.batch_space(agent.observation_space, 256).sample()
    with tempfile.TemporaryDirectory() as folder:
        call(lambda: (save_all(agent, Path(folder)), True))
        loaded = call(lambda: load_all(Path(folder), env))
        if type(loaded) is not type(agent):
            raise Wrong("other_class", loaded=type(loaded).__name__, agent=type(agent).__name__)
        mistakes(same_agent=loaded is agent)
        actions = [model.predict(observations, deterministic=True)[0] for model in (agent, loaded)]
        mistakes(acts_differently=not np.array_equal(*actions))
        expected, n = (model.replay_buffer.size() for model in (agent, loaded))
        if n != expected:
            raise Wrong("buffer", n=n, expected=expected)


@exercise
def steps_needed(estimate: object) -> None:
    """Checks the mean number of episodes until a random agent of 12 bits stands on its goal in the end, about 4,096."""
    number = float(numbers(estimate, ()))
    diagnose(
        np.asarray(math.log2(max(number, 1e-9))),
        12.0,
        number_of_bits=math.log2(12),
        squared=math.log2(144),
        probability=-12.0,
    )
