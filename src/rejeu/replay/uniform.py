"""The replay buffer: steps are drawn uniformly, or by priority, with one-step or n-step returns.

What the rows of a batch lead to is one definition for the arrays of NumPy and those of JAX, with and without new goals
(:func:`outcome`). ``xp`` is the module that computes with the arrays, ``numpy`` or ``jax.numpy``. ``ring`` has ``kind``,
``reward``, ``obs`` and ``head``, and ``index(env, time)`` returns positions in it, as :class:`rejeu.replay.ring.Ring` does.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from types import ModuleType
from typing import Any, NamedTuple

import jax
import numpy as np

from rejeu.core.algorithm import Masked, PyTree, Sequences, Transition, unmasked
from rejeu.core.types import Action, AnyArray, Observation
from rejeu.replay import ring_io
from rejeu.replay.prioritized import Draw, Priorities
from rejeu.replay.ring import LAST, TERMINATED, Ring, Rows


class BaseReplayBuffer(ABC):
    """Stores steps in a :class:`Ring`; subclasses define how batches are drawn from it."""

    achieved = desired = 0
    """Indices of the leaves of the two goals, where there are some."""
    with_next_action = False
    """Whether transitions have :attr:`Transition.next_action`."""

    def __init__(
        self,
        ring: Ring,
        gamma: float,
        n_steps: int = 1,
        priorities: Priorities | None = None,
        each_reward: bool = False,
        sequence: tuple[int, int] | None = None,
    ) -> None:
        """Takes a ring; with ``each_reward``, transitions of several steps have :attr:`Transition.rewards`.

        ``sequence``, the numbers of steps that networks with memory learn from together and of those before them, makes the
        observations of batches :class:`Sequences`.
        """
        self.ring, self.gamma, self.n_steps, self.priorities = ring, gamma, n_steps, priorities
        self.sequence = sequence
        self.each_reward = each_reward and n_steps > 1
        self.discounts = discounts_of(gamma, n_steps)
        """Discounts of the next observation: at ``2 i`` after ``i`` steps, at ``2 i + 1`` if the MDP terminated with them."""

    @abstractmethod
    def draw(
        self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0
    ) -> tuple[Transition, Draw | None]:
        """Returns the batch of :meth:`sample` and, with priorities, the argument of :meth:`update_priorities`."""

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0) -> Transition:
        """Returns transitions, every leaf ``(*shape, ...)``, the last axis of ``shape`` being one batch.

        ``progress`` is the schedule's progress for importance weights.
        """
        return self.draw(rng, shape, progress)[0]

    def set_gamma(self, gamma: float) -> None:
        """Sets the discount factor of the transitions that are drawn from now on."""
        self.gamma, self.discounts = gamma, discounts_of(gamma, self.n_steps)

    def size(self) -> int:
        """Returns the number of transitions kept."""
        return len(self.ring)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.size():,} of {self.ring.rows * self.ring.n_envs:,} steps>"

    def begin(self, obs: Observation, envs: np.ndarray | None = None) -> None:
        """Starts episodes; see :meth:`Ring.begin`."""
        self.ring.begin(obs, envs)
        if self.priorities is not None:
            envs = self.ring.all_envs if envs is None else envs
            self.priorities.tree.set(self.ring.index(envs, self.ring.head[envs]), 0.0)

    def add(self, action: np.ndarray, reward: np.ndarray, terminated: np.ndarray, next_obs: Observation) -> None:
        """Records one step of each environment; see :meth:`Ring.add`."""
        index, following = self.ring.add(action, reward, terminated, next_obs)
        if self.priorities is not None:
            self.priorities.add(index, following)

    def draw_rows(
        self, rng: np.random.Generator, n: int, progress: float
    ) -> tuple[Rows, np.ndarray | None, Draw | None]:
        """Returns ``n`` steps and, with priorities, their importance weights and what :meth:`update_priorities` takes."""
        if self.priorities is None:
            return self.ring.draw(rng, n), None, None
        return self.priorities.draw(rng, n, progress)

    def batch(
        self,
        shape: tuple[int, ...],
        rows: Rows,
        read: tuple[np.ndarray, list[np.ndarray]],
        weight: np.ndarray | None,
        goals: NewGoals | None = None,
    ) -> Transition:
        """Returns the transitions of rows, in ``shape``.

        Args:
            shape: the last axis is one batch, whose weights are divided by the largest of them.
            rows: ``(n,)``.
            read: what :meth:`Ring.read` returned for them.
            weight: their importance weights, or None.
            goals: the new goals of some of them, or None.
        """
        ring, (step, obs) = self.ring, read
        if self.n_steps == 1 and goals is None:  # all has been read
            result = Outcome(step["reward"], 1, rows.kind)
        else:
            result = outcome(np, ring, ring.index, rows, self.n_steps, goals)
        after = rows.time + result.steps
        following, next_obs = ring.read(ring.index(rows.env, after))
        if goals is not None:
            for leaves in (obs, next_obs):
                leaves[self.desired][goals.which] = goals.goal
        next_action = self.taken(following["action"], rows.env, after) if self.with_next_action else None
        return self.transition(shape, ring.tree(obs), step["action"], result, ring.tree(next_obs), weight, next_action)

    def taken(self, action: np.ndarray, env: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Returns the actions of rows ``(n, ...)``, NaN where the episode has ended or no step was taken yet."""
        was_taken = (self.ring.kind[self.ring.index(env, time)] != LAST) & (time < self.ring.head[env])
        return np.where(was_taken[:, None], action, np.float32(np.nan))

    def transition(
        self,
        shape: tuple[int, ...],
        obs: Observation,
        action: Action,
        result: Outcome,
        next_obs: Observation,
        weight: PyTree = None,
        next_action: Action = None,
    ) -> Transition:
        """Returns transitions in ``shape``, from observations and actions ``(n, ...)`` and what they lead to."""
        rewards, steps, terminated = result
        reward, each, discount = rewards, None, self.discounts.take(2 * steps + terminated)
        if self.n_steps > 1:
            powers = self.gamma ** np.arange(self.n_steps)
            reward = (rewards @ powers).astype(np.float32)
            each = (rewards * powers).astype(np.float32) if self.each_reward else None
        flat = Transition(obs, action, reward, next_obs, discount, weight, each, next_action)
        split = lambda array: array.reshape(*shape[:-1], -1, *array.shape[1:])  # noqa: E731
        shaped = flat if len(shape) == 1 else jax.tree.map(split, flat)
        if weight is not None:
            return shaped._replace(weight=shaped.weight / shaped.weight.max(axis=-1, keepdims=True))
        return shaped

    def update_priorities(self, td_errors: Iterable[tuple[Draw, AnyArray]]) -> None:
        """Sets priorities by pairs of a :class:`Draw` and the absolute TD errors of its batch."""
        if self.priorities is not None:
            self.priorities.update(td_errors)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the contents as named arrays."""
        return ring_io.arrays(self.ring)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restores the result of :meth:`arrays`; see :func:`rejeu.replay.ring_io.restore`. Priorities start equal."""
        ring_io.restore(self.ring, arrays)
        if self.priorities is not None:
            self.priorities.restore()


class ReplayBuffer(BaseReplayBuffer):
    """Draws transitions uniformly, or by priority."""

    def draw(
        self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0
    ) -> tuple[Transition, Draw | None]:
        """Returns the batch of :meth:`sample` and, with priorities, the argument of :meth:`update_priorities`."""
        if self.sequence is not None:
            return self.draw_sequences(rng, shape, *self.sequence), None
        rows, weight, drawn = self.draw_rows(rng, math.prod(shape), progress)
        return self.batch(shape, rows, self.ring.read(rows.position), weight), drawn

    def draw_sequences(self, rng: np.random.Generator, shape: tuple[int, ...], length: int, burn_in: int) -> Transition:
        """Returns sequences of ``length`` steps as transitions whose observations are :class:`Sequences`.

        The first step of each is drawn uniformly. ``burn_in`` rows before it belong to the sequence, and those after it that
        the steps and their successors need. It may reach into the next episode. Where there are fewer steps, because the
        newest one was reached or several episodes were short, they are repeated from the first on.
        """
        ring = self.ring
        start = ring.draw(rng, math.prod(shape) // length)
        env = start.env[:, None]
        oldest, head = ring.oldest()[env], ring.head[env]
        # One final observation is passed without a loss of steps.
        times = start.time[:, None] + np.arange(-burn_in, length + 1 + self.n_steps)[None]
        position = ring.index(env, times.clip(oldest, head))
        kinds_of_rows = ring.kind[position]
        is_step = ((kinds_of_rows != LAST) & (times < head))[:, burn_in : burn_in + length + 1]
        steps_first = np.argsort(~is_step, axis=1, kind="stable")
        step_numbers = np.arange(length)[None] % is_step.sum(axis=1, keepdims=True)
        reads = burn_in + np.take_along_axis(steps_first, step_numbers, axis=1)
        _, obs = ring.read(position)
        begins = np.pad(kinds_of_rows[:, :-1] == LAST, ((0, 0), (1, 0)))
        n_absent = (times[:, :burn_in] < oldest).sum(axis=1, dtype=np.int32)
        memory = ring.memory[position[:, 0]]
        tree, mask = unmasked(ring.tree(obs))

        def read(rows: np.ndarray) -> AnyArray:
            sequences = Sequences(tree, begins, n_absent, memory, rows.astype(np.int32))
            if mask is None:
                return sequences
            masks = np.take_along_axis(mask, rows[..., None], axis=1)
            return Masked(sequences, masks.reshape(-1, mask.shape[-1]))

        flat = lambda array: np.take_along_axis(array, reads, axis=1).ravel()  # noqa: E731
        rows = ring.at(np.broadcast_to(env, reads.shape).ravel(), flat(times))
        result = outcome(np, ring, ring.index, rows, self.n_steps)
        after = reads + np.broadcast_to(result.steps, rows.env.shape).reshape(reads.shape)
        return self.transition(shape, read(reads), ring.action[rows.position], result, read(after))


def discounts_of(gamma: float, n_steps: int) -> np.ndarray:
    """Returns ``gamma^i`` for ``i`` from 0 to ``n_steps``, each with a 0 behind it, ``float32 (2 * n_steps + 2,)``."""
    return (gamma ** np.arange(n_steps + 1)[:, None] * np.array([1, 0])).astype(np.float32).reshape(-1)


class StepWindow(NamedTuple):
    """The steps that n-step returns sum, ``(batch, n)`` each."""

    position: AnyArray
    """Positions in the ring of the n rows from the sampled one on."""
    valid: AnyArray
    """Which of them belong to the return; the first always does."""
    terminal: AnyArray
    """Which of these entered a terminal state."""


def look_ahead(xp: ModuleType, ring: Any, index: Callable[..., AnyArray], rows: PyTree, n: int) -> StepWindow:
    """Returns the up to ``n`` steps from each of ``rows`` to its episode's end or to the newest step."""
    times = rows.time[:, None] + xp.arange(n)[None]
    position = index(rows.env[:, None], times)
    kinds_of_rows = ring.kind[position]
    is_step = (kinds_of_rows != LAST) & (times < ring.head[rows.env][:, None])
    continues = xp.cumprod(is_step & (kinds_of_rows != TERMINATED), axis=1).astype(bool)
    valid = xp.concatenate([is_step[:, :1], is_step[:, 1:] & continues[:, :-1]], axis=1)
    return StepWindow(position, valid, (kinds_of_rows == TERMINATED) & valid)


class NewGoals(NamedTuple):
    """The goals that replace those of some transitions of a batch."""

    which: AnyArray
    """Which transitions."""
    goal: AnyArray
    """Their new goals, ``(n_goals, ...)``."""
    leaves: tuple[int, int]
    """Indices of the leaves of the achieved and of the desired goal."""
    reward: Callable[[AnyArray, AnyArray], AnyArray]
    """The reward of achieved and desired goals."""
    terminated: AnyArray
    """Whether they end the episode, a function as ``reward``; None if the steps keep their own flags."""

    def ends(self, reached: AnyArray, goal: AnyArray, own_goal: AnyArray, ended: AnyArray) -> AnyArray:
        """Returns which steps end an episode: those that reach ``goal``, and those that ended otherwise, as in a crash.

        ``ended`` says which of them ended with ``own_goal``.
        """
        ends = self.terminated(reached, goal).astype(bool)
        none_ended = isinstance(ended, np.ndarray) and not ended.any()  # functions of single goals take long
        return ends if none_ended else ends | (ended & ~self.terminated(reached, own_goal).astype(bool))


class Outcome(NamedTuple):
    """The rewards and ends of the steps that transitions cover."""

    rewards: AnyArray
    """``(batch,)``; of n steps ``(batch, n)``, 0 after the last."""
    steps: AnyArray
    """Number of steps to the next observation, ``(batch,)``, or 1 for all."""
    terminated: AnyArray
    """1 where the MDP terminated, else 0, of any dtype, ``(batch,)``."""


def outcome(
    xp: ModuleType, ring: Any, index: Callable[..., AnyArray], rows: PyTree, n_steps: int, goals: NewGoals | None = None
) -> Outcome:
    """Returns rewards and ends of up to ``n_steps`` steps from ``rows``, with new goals if there are any."""
    if goals is not None:
        new, times = goals.which, rows.time[goals.which, None] + 1 + xp.arange(n_steps)[None]
        position = index(rows.env[new, None], times).reshape(-1)
        reached, own_goal = (ring.obs[leaf][position] for leaf in goals.leaves)
    if n_steps == 1:
        rewards, terminated = ring.reward[rows.position], ring.kind[rows.position]  # which is STEP or TERMINATED
        if goals is not None:
            rewards = replaced(rewards, new, goals.reward(reached, goals.goal))
            if goals.terminated is not None:
                ended = goals.ends(reached, goals.goal, own_goal, terminated[new] == TERMINATED)
                terminated = replaced(terminated, new, ended)
        return Outcome(rewards, 1, terminated)
    position, valid, terminal = look_ahead(xp, ring, index, rows, n_steps)
    rewards = ring.reward[position]
    if goals is not None:
        each = xp.repeat(goals.goal, n_steps, axis=0)
        rewards = replaced(rewards, new, goals.reward(reached, each).reshape(-1, n_steps))
        if goals.terminated is not None:
            ends = goals.ends(reached, each, own_goal, terminal[new].reshape(-1)).reshape(-1, n_steps) & valid[new]
            goes_on = xp.cumsum(ends, axis=1)[:, :-1] == 0
            valid = replaced(valid, (new, slice(1, None)), valid[new][:, 1:] & goes_on)
            terminal = replaced(terminal, new, ends) & valid
    return Outcome(xp.where(valid, rewards, xp.float32(0)), valid.sum(axis=1), terminal.any(axis=1))


def replaced(array: AnyArray, index: AnyArray, values: AnyArray) -> AnyArray:
    """Returns ``array`` with ``values`` at ``index``; an array of NumPy is mutated."""
    if isinstance(array, np.ndarray):
        array[index] = values
        return array
    return array.at[index].set(values.astype(array.dtype))
