"""Hindsight experience replay: past steps, relabeled with goals that the agent reached.

Source: Andrychowicz et al. 2017, "Hindsight Experience Replay" (arXiv 1707.01495). Relabeling happens when a batch is
drawn: the share ``k / (k + 1)`` of every batch gets, in place of its own goal, an achieved goal from (section 4.5)

- ``future``: a later moment of the same episode,
- ``final``: the episode's last moment,
- ``episode``: any moment of the same episode,
- ``random``: any moment in the buffer,
- ``desired``: not an achieved goal but the desired one of any step in the buffer,
- ``closest``: of some later moments of the same episode the one whose achieved goal is closest to the goal (proximity, of
  Fang et al. 2019, "Curriculum-guided Hindsight Experience Replay"),
- ``next_future``: of every four, one the very next moment, which succeeds in one step, and three as ``future`` (Ozgur et al.
  2025, "Next-Future", arXiv 2504.11247),

and the environment's reward for that goal. Several strategies may have shares of the relabeled transitions. The mix of later
achieved goals and desired goals of other steps is that of the code of Pitis et al. 2020, "Maximum Entropy Gain Exploration for
Long Horizon Multi-goal Reinforcement Learning" (arXiv 2007.02832).

Of episodes that still run, or whose beginning was overwritten, the stored part is used. ``terminated`` is recomputed if the
environment has ``compute_terminated``, and kept otherwise. An episode that ended where its own goal was not reached, as in a
crash, ends there with any goal. Each strategy is one definition for host and device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from enum import Enum
from functools import cache, cached_property, partial
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rejeu.core.algorithm import PyTree, Transition
from rejeu.core.types import AnyArray, Observation
from rejeu.core.validation import assign, coerce, flag, whole
from rejeu.envs.goals import GoalFunctions
from rejeu.replay.prioritized import Draw, Priorities
from rejeu.replay.ring import LAST, Ring
from rejeu.replay.uniform import BaseReplayBuffer, NewGoals, replaced

N_CANDIDATES = 8
"""Later moments of which ``closest`` takes one. All of an episode would always choose the same."""
N_GOALS = 4
"""Goals of a transition of which ``next_future`` takes one from the next moment; those of the paper."""


@dataclass(frozen=True)
class HindsightSteps:
    """The transitions of a batch that get new goals, as a strategy sees them; each array has an entry for each, ``(n, ...)``.

    Arrays are those of NumPy with the loop of the host and those of JAX in the program on the device. Times count the
    observations of one environment over the whole run, so only their differences matter.
    """

    np: ModuleType
    """The module that computes with the arrays: ``numpy`` or ``jax.numpy``."""
    env: AnyArray
    """Their environments."""
    time: AnyArray
    """Times of the observations; ``time + 1`` is that of the next ones."""
    newest: AnyArray
    """Times of the newest observations of the same environments."""
    rows: int
    """How many observations of an environment are stored at most."""
    begin: Callable[[AnyArray], AnyArray]
    """``begin(times)`` returns the times of the first observations of the episodes at times ``(n,)``, or the oldest stored."""
    end: Callable[[AnyArray], AnyArray]
    """``end(times)`` returns the times of the last observations of these episodes, or the newest."""
    integers: Callable[[AnyArray, AnyArray], AnyArray]
    """``integers(low, high)`` returns random whole numbers from ``low`` to ``high - 1``, arrays ``(n,)`` or ``(n, k)``."""
    drawn: Callable[[], tuple[AnyArray, ...]]
    """``drawn()[:2]`` are environments and times of steps drawn from all that are stored."""
    index: Callable[[AnyArray, AnyArray], AnyArray]
    """Returns positions in the ring, given environments and times."""
    goals_at: Sequence[Callable[[AnyArray], AnyArray]]
    """Return the achieved and the desired goals at positions."""

    @cached_property
    def oldest(self) -> AnyArray:
        """Times of the oldest observations of the same environments that are stored."""
        return self.np.maximum(self.newest - self.rows + 1, 0)

    @cached_property
    def first(self) -> PyTree:
        """The first times of the same episodes with a goal that was reached by an action."""
        return self.begin(self.time) + 1

    @cached_property
    def last(self) -> AnyArray:
        """The last times of the same episodes."""
        return self.end(self.time)

    def achieved(self, times: AnyArray) -> AnyArray:
        """Returns the achieved goals of the same environments at times ``(n,)`` or ``(n, k)``."""
        return self.goals_at[0](self.index(self.env.reshape(-1, *[1] * (times.ndim - 1)), times))

    def desired(self) -> AnyArray:
        """Returns the goals that the transitions have."""
        return self.goals_at[1](self.index(self.env, self.time))

    def chosen_by(self, strategy: str | GoalStrategy) -> AnyArray:
        """Returns the positions of the new goals that a strategy, or the one of this name, chooses."""
        if strategy in ANY_STEP:
            env, time = self.drawn()[:2]
            return self.index(env, time + (strategy == "random"))
        times = (STRATEGIES[strategy] if isinstance(strategy, str) else strategy)(self)
        return self.index(self.env, times if strategy in BUILT_IN else stored(self, times))


GoalStrategy = Callable[[HindsightSteps], Any]
"""A goal strategy of your own: ``strategy(steps) -> times``, for the loop of the host and for the program on the device.

The result says at which times of the same environments the achieved goals are taken, whole numbers ``(n,)`` from
``steps.oldest`` to ``steps.newest``: from ``steps.first`` to ``steps.last`` those of the same episodes, before and after them
those of others. Others are an error on the host, and the nearest stored time on the device.
:func:`register_goal_strategy` gives it a name, by which it is saved."""


def future(steps: HindsightSteps) -> AnyArray:
    """Returns later times."""
    return steps.integers(steps.time + 1, steps.last + 1)


def final(steps: HindsightSteps) -> AnyArray:
    """Returns the last times."""
    return steps.last


def episode(steps: HindsightSteps) -> AnyArray:
    """Returns any times of the episodes."""
    return steps.integers(steps.first, steps.last + 1)


def closest(steps: HindsightSteps) -> AnyArray:
    """Returns the time, of :data:`N_CANDIDATES` later ones, whose achieved goal has the least distance to the goal."""
    np = steps.np
    times = steps.integers(np.repeat(steps.time[:, None] + 1, N_CANDIDATES, axis=1), steps.last[:, None] + 1)
    difference = steps.achieved(times).astype("float32") - steps.desired().astype("float32")[:, None]
    distance = np.square(difference).sum(axis=tuple(range(2, difference.ndim)))
    return np.take_along_axis(times, distance.argmin(axis=1)[:, None], axis=1)[:, 0]


def next_future(steps: HindsightSteps) -> AnyArray:
    """Returns the next time for one of :data:`N_GOALS` transitions, chosen at random, and later times for the others."""
    nothing = steps.np.zeros_like(steps.time)
    is_next = steps.integers(nothing, nothing + N_GOALS) == 0
    return steps.np.where(is_next, steps.time + 1, future(steps))


FROM_LATER = {"future": future, "final": final, "closest": closest, "next_future": next_future}
BUILT_IN = {**FROM_LATER, "episode": episode}
"""Without those of :data:`ANY_STEP`."""
ANY_STEP = ("random", "desired")
"""Strategies that take the goal of any stored step, of other environments too."""
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
        if name in ANY_STEP or name in BUILT_IN:
            raise ValueError(f"{name!r} is the name of a goal strategy of rejeu; choose another")
        STRATEGIES[name] = strategy
        return strategy

    return register


def name_of(strategy: str | Callable[..., Any]) -> str | Callable[..., Any]:
    """Returns the name of a strategy, or the function itself if it has none."""
    names = [name for name, registered in STRATEGIES.items() if registered is strategy]
    return names[0] if names else strategy


class GoalSelectionStrategy(str, Enum):
    """Where the goals of hindsight come from; the strings do as well."""

    FUTURE = "future"
    FINAL = "final"
    EPISODE = "episode"
    RANDOM = "random"
    CLOSEST = "closest"
    NEXT_FUTURE = "next_future"
    DESIRED = "desired"


MAX_SHARE = 1000
"""Upper limit on the share of a strategy."""


class MixedStrategies(NamedTuple):
    """Goal strategies with shares of the relabeled transitions, which take turns."""

    shares: tuple[tuple[str | GoalStrategy, int], ...]
    """Strategies and shares, such as ``(("future", 2), ("desired", 2))`` for half of the transitions each."""

    def joined(self, xp: ModuleType, choose: Callable[..., AnyArray], *arrays: AnyArray) -> AnyArray:
        """Returns ``choose(number, *rows, strategy)`` of all strategies, each with its rows of the arrays, in their order."""
        rows, order = rows_of_shares(tuple(share for _, share in self.shares), len(arrays[0]))
        parts = [choose(i, *(array[rows[i]] for array in arrays), self.shares[i][0]) for i in range(len(rows))]
        return xp.concatenate(parts)[order]

    def goals(self, achieved: AnyArray, index: AnyArray, desired: Callable[[AnyArray], AnyArray]) -> AnyArray:
        """Returns the goals at positions, of which ``achieved`` are those of one kind, and ``desired`` returns the other."""
        turns, _ = rows_of_shares(tuple(share for _, share in self.shares), len(index))
        for rows in (turns[i] for i, (strategy, _) in enumerate(self.shares) if strategy == "desired"):
            achieved = replaced(achieved, rows, desired(index[rows]))
        return achieved


@cache
def rows_of_shares(shares: tuple[int, ...], n: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Returns the indices of each share of ``n`` transitions, which take turns, and the order that sorts all of them.

    The turns of each share are evenly spread, so that a batch with fewer transitions than turns has all shares too.

    >>> [len(rows) for rows in rows_of_shares((60, 40), 50)[0]]
    [30, 20]
    """
    times = np.concatenate([(np.arange(share) + 0.5) / share for share in shares])
    turns = np.resize(np.repeat(np.arange(len(shares)), shares)[times.argsort(kind="stable")], n)
    rows = [np.flatnonzero(turns == i) for i in range(len(shares))]
    return rows, np.argsort(np.concatenate(rows))


@dataclass(frozen=True)
class HindsightConfig:
    """Settings of hindsight replay (Stable-Baselines3's ``replay_buffer_kwargs``)."""

    n_sampled_goal: int = 4
    """Relabeled transitions per original one. Raising it learns more from failures and less from the real goals."""
    goal_selection_strategy: str | GoalStrategy | MixedStrategies = "future"
    """``future``, ``final``, ``episode``, ``random``, ``closest``, ``next_future``, ``desired``, a ``GoalSelectionStrategy``,
    a strategy of your own, which is a function ``(steps) -> times`` or its registered name (see
    ``rejeu.replay.hindsight.GoalStrategy``), or a dict of names and shares of the relabeled transitions, such as
    ``{"future": 2, "desired": 2}``."""
    copy_info_dict: bool = False
    """Give ``compute_reward`` and ``compute_terminated`` the info of each step, row by row, instead of an empty one. Files of
    the buffer and checkpoints do not contain infos: after loading, those of earlier steps are empty."""

    def __post_init__(self) -> None:
        coerce(self, "n_sampled_goal", whole, least=0)
        coerce(self, "copy_info_dict", flag)
        strategy = checked_strategy(self.goal_selection_strategy)
        assign(self, goal_selection_strategy=strategy)


def checked_strategy(strategy: object) -> str | GoalStrategy | MixedStrategies:
    """Returns a goal strategy as settings have it: a name, a function without a name, or several names with shares.

    Raises:
        ValueError: for anything else.
    """
    shares = strategy.shares if isinstance(strategy, MixedStrategies) else ((strategy, 1),)
    shares = tuple(strategy.items()) if isinstance(strategy, Mapping) else shares
    names = [registered_strategy(name) for name, _ in shares]
    if not isinstance(strategy, Mapping | MixedStrategies) and names != ["desired"]:
        return names[0]
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(
            f"goal_selection_strategy={strategy!r} must have names of strategies as keys, such as "
            '{"future": 2, "desired": 2}; register_goal_strategy gives a function a name'
        )
    pairs = zip(names, shares, strict=True)
    label = "goal_selection_strategy"
    return MixedStrategies(tuple((name, whole(f"{label} {name}", n, 1, MAX_SHARE)) for name, (_, n) in pairs))


def registered_strategy(strategy: Any) -> str | GoalStrategy:
    """Returns the name of a strategy, or a function without a name.

    Raises:
        ValueError: if there is none of this name.
    """
    strategy = name_of(strategy)
    strategy = strategy.value if isinstance(strategy, GoalSelectionStrategy) else strategy
    names = [*dict.fromkeys([*(member.value for member in GoalSelectionStrategy), *STRATEGIES])]
    if not callable(strategy) and strategy not in names:
        raise ValueError(
            f"goal_selection_strategy={strategy!r} must be one of {', '.join(names)}, a function (steps) -> times, or a dict "
            "of such names and their shares; the name of a function of yours is enough if it was registered before "
            "(register_goal_strategy)"
        )
    return strategy


def counters(config: HindsightConfig) -> tuple[str, ...]:
    """Returns the counters that the ring must keep of every row for these settings.

    >>> counters(HindsightConfig(goal_selection_strategy="future"))
    ('until_end',)
    """
    strategy = config.goal_selection_strategy
    names = {*dict(strategy.shares)} if isinstance(strategy, MixedStrategies) else {strategy}
    strategies = names - {*ANY_STEP}
    return () if not strategies else ("until_end",) if strategies <= {*FROM_LATER} else ("since_start", "until_end")


class HerReplayBuffer(BaseReplayBuffer):
    """Draws transitions from a :class:`Ring`, uniformly or by priority, and gives most of them a goal that was reached.

    Subclasses may override :meth:`goal_index`, which chooses these goals.
    """

    def __init__(
        self,
        ring: Ring,
        gamma: float,
        config: HindsightConfig,
        goals: GoalFunctions,
        n_steps: int = 1,
        priorities: Priorities | None = None,
        each_reward: bool = False,
    ) -> None:
        """Takes a ring that keeps the ``counters`` of ``config``; ``each_reward`` is as for :class:`ReplayBuffer`.

        Raises:
            ValueError: if it does not.
        """
        if missing := [name for name in counters(config) if name not in ring.counters]:
            raise ValueError(
                f"goal_selection_strategy={config.goal_selection_strategy!r} needs a ring that keeps "
                f"{' and '.join(missing)}; make it with Ring(..., counters={counters(config)})"
            )
        super().__init__(ring, gamma, n_steps, priorities, each_reward)
        self.config, self.goals = config, goals
        paths = [leaf.path for leaf in ring.obs_leaves]
        self.achieved = paths.index("achieved_goal")
        self.desired = paths.index("desired_goal")
        self.infos: Any = np.full(ring.rows * ring.n_envs, None) if config.copy_info_dict else None
        """The info of each step, with ``copy_info_dict``."""
        self.last_infos: Callable[[], Any] = tuple
        """Returns the infos of the step that is added, one for each environment; set by the agent."""

    def add(self, action: np.ndarray, reward: np.ndarray, terminated: np.ndarray, next_obs: Observation) -> None:
        """Records one step of each environment; see :meth:`Ring.add`."""
        if self.infos is not None:
            last = self.last_infos()
            for env, position in enumerate(self.ring.index(self.ring.all_envs, self.ring.head)):
                self.infos[position] = deepcopy(last[env]) if last else {}
        super().add(action, reward, terminated, next_obs)

    def draw(
        self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0
    ) -> tuple[Transition, Draw | None]:
        """Returns batches as :meth:`ReplayBuffer.draw` does; of each batch, the first ``k / (k + 1)`` are relabeled."""
        ring = self.ring
        rows, weight, drawn = self.draw_rows(rng, math.prod(shape), progress)
        read = ring.read(rows.position)
        relabeled = relabeled_positions(shape, self.config.n_sampled_goal)
        index = self.goal_index(rng, rows.env[relabeled], rows.time[relabeled], read[0][relabeled])
        goal, strategy = ring.read_leaf(self.achieved, index), self.config.goal_selection_strategy
        if isinstance(strategy, MixedStrategies):
            goal = strategy.goals(goal, index, partial(ring.read_leaf, self.desired))
        functions = self.goals if self.infos is None else self.functions_of(rows.env[relabeled], rows.time[relabeled])
        goals = NewGoals(relabeled, goal, (self.achieved, self.desired), *functions)
        return self.batch(shape, rows, read, weight, goals), drawn

    def functions_of(self, env: np.ndarray, time: np.ndarray) -> GoalFunctions:
        """Returns the functions of goals with the infos of steps ``(n,)`` and of the ``n_steps - 1`` that follow each."""
        infos_of_rows = self.infos[self.ring.index(env[:, None], time[:, None] + np.arange(self.n_steps))]
        # After the end of an episode there is none, and what a function returns there does not count.
        infos = [(info or row[0] or {}) for row in infos_of_rows for info in row]
        reward, terminated = self.goals
        return GoalFunctions(partial(reward, infos=infos), terminated and partial(terminated, infos=infos))

    def goal_index(self, rng: np.random.Generator, env: np.ndarray, time: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Returns the positions ``(n,)`` of the rows whose goals are new ones: achieved goals, desired ones by ``desired``.

        Args:
            rng: the only source of random numbers.
            env: environments of the relabeled rows, ``(n,)``.
            time: their times, as in :data:`GoalStrategy`, ``(n,)``.
            step: their records, ``(n,)``, with the :func:`counters` of the strategy, as :class:`Ring` keeps them.
        """
        if isinstance(strategy := self.config.goal_selection_strategy, MixedStrategies):
            return np.asarray(strategy.joined(np, lambda _, *rows: self.chosen_by(rng, *rows), env, time, step))
        return self.chosen_by(rng, env, time, step, strategy)

    def chosen_by(
        self, rng: np.random.Generator, env: np.ndarray, time: np.ndarray, step: np.ndarray, strategy: Any
    ) -> np.ndarray:
        """Returns the positions that one strategy chooses; the other arguments are those of :meth:`goal_index`."""
        ring, newest = self.ring, self.ring.head[env]

        def begin(times: np.ndarray) -> np.ndarray:
            times = np.maximum(times, steps.oldest)
            return np.maximum(times - ring.since_start[ring.index(env, times)], steps.oldest)  # type: ignore[index]

        def end(times: np.ndarray) -> np.ndarray:
            if times is time:  # whose rows have been read
                return np.where(step["until_end"], time + step["until_end"], newest)
            position = ring.index(env, times)
            until_end = ring.until_end[position]  # type: ignore[index]
            return np.where((until_end > 0) | (ring.kind[position] == LAST), times + until_end, newest)

        def integers(low: np.ndarray, high: np.ndarray) -> np.ndarray:
            return low + (rng.random(np.broadcast(low, high).shape) * (high - low)).astype(np.int64)

        goals_at = [partial(ring.read_leaf, leaf) for leaf in (self.achieved, self.desired)]
        drawn = partial(ring.draw, rng, len(time))
        steps = HindsightSteps(np, env, time, newest, ring.rows, begin, end, integers, drawn, ring.index, goals_at)
        return np.asarray(steps.chosen_by(strategy))


@cache
def relabeled_positions(shape: tuple[int, ...], k: int) -> slice | np.ndarray:
    """Returns which of the flattened transitions of ``shape`` get a new goal: the first ``k / (k + 1)`` of each batch."""
    n = int(shape[-1] * k / (k + 1))
    if math.prod(shape) == shape[-1]:
        return slice(n)
    is_relabeled = np.zeros(shape, bool)
    is_relabeled[..., :n] = True
    return np.flatnonzero(is_relabeled)


def stored(steps: HindsightSteps, times: AnyArray) -> AnyArray:
    """Returns the times that a strategy of the user's own chose; on the device, where they are not known yet, in the range.

    Raises:
        ValueError: if they are not whole numbers ``(n,)``, or on the host one is not stored.
    """
    times, wanted = times if hasattr(times, "dtype") else np.asarray(times), steps.time.shape
    message = (
        f"goal_selection_strategy must return whole numbers, times that are stored, of shape {wanted}; it returned"
    )
    if times.shape != wanted or times.dtype.kind not in "iu":
        raise ValueError(f"{message} {times.dtype} of shape {times.shape}")
    if steps.np is not np:
        return steps.np.clip(times.astype(steps.time.dtype), steps.oldest, steps.newest)
    if (wrong := np.flatnonzero((times < steps.oldest) | (times > steps.newest))).size:
        i = wrong[0]
        raise ValueError(f"{message} {times[i]} where oldest is {steps.oldest[i]} and newest is {steps.newest[i]}")
    return times
