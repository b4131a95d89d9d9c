"""The replay buffer: steps are drawn uniformly, or by priority, with one-step or n-step returns."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np

from rejeu.buffers import ring_io
from rejeu.buffers.n_step import look_ahead
from rejeu.buffers.prioritized import Draw, Priorities
from rejeu.buffers.ring import TERMINATED, Ring, Rows
from rejeu.core import Transition


class BaseReplayBuffer(ABC):
    """Stores steps in a :class:`Ring`; subclasses define how batches are drawn from it."""

    def __init__(
        self,
        ring: Ring,
        gamma: float,
        n_steps: int = 1,
        priorities: Priorities | None = None,
        each_reward: bool = False,
    ) -> None:
        """Takes a ring; with ``each_reward``, transitions of several steps have :attr:`Transition.rewards`."""
        self.ring, self.gamma, self.n_steps, self.priorities = ring, gamma, n_steps, priorities
        self.each_reward = each_reward and n_steps > 1
        self.discounts = bootstrap_discount(gamma, 1, np.arange(3) == TERMINATED)
        """Discounts of single steps, by the kind of their row, ``float32 (3,)``."""

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

    def size(self) -> int:
        """Returns the number of transitions kept."""
        return len(self.ring)

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.size():,} of {self.ring.rows * self.ring.n_envs:,} steps>"

    def begin(self, obs: Any, envs: np.ndarray | None = None) -> None:
        """Starts episodes; see :meth:`Ring.begin`."""
        self.ring.begin(obs, envs)
        if self.priorities is not None:
            envs = self.ring.all_envs if envs is None else envs
            self.priorities.tree.set(self.ring.index(envs, self.ring.head[envs]), 0.0)

    def add(
        self,
        action: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
        next_obs: Any,
        envs: np.ndarray | None = None,
    ) -> None:
        """Records one step of each environment; see :meth:`Ring.add`."""
        index, following = self.ring.add(action, reward, terminated, next_obs, envs)
        if self.priorities is not None:
            self.priorities.add(index, following)

    def draw_rows(
        self, rng: np.random.Generator, n: int, progress: float
    ) -> tuple[Rows, np.ndarray | None, Draw | None]:
        """Returns ``n`` steps and, with priorities, their importance weights and what :meth:`update_priorities` takes."""
        if self.priorities is None:
            return self.ring.draw(rng, n), None, None
        return self.priorities.draw(rng, n, progress)

    def update_priorities(self, td_errors: Iterable[tuple[Draw, Any]]) -> None:
        """Sets priorities by pairs of a :class:`Draw` and the absolute TD errors of its batch."""
        if self.priorities is not None:
            self.priorities.update(td_errors)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the contents as named arrays."""
        return ring_io.arrays(self.ring)

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restores the result of :meth:`arrays`; see :func:`rejeu.buffers.ring_io.restore`. Priorities start equal."""
        ring_io.restore(self.ring, arrays)
        if self.priorities is not None:
            self.priorities.restore()


class ReplayBuffer(BaseReplayBuffer):
    """Draws transitions uniformly, or by priority."""

    def draw(
        self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0
    ) -> tuple[Transition, Draw | None]:
        """Returns the batch of :meth:`sample` and, with priorities, the argument of :meth:`update_priorities`."""
        rows, weight, drawn = self.draw_rows(rng, math.prod(shape), progress)
        step, obs = self.ring.read(rows.position)
        steps: int | np.ndarray = 1
        rewards = None
        if self.n_steps == 1:
            reward, discount = step["reward"], self.discounts.take(rows.kind)
        else:
            window = look_ahead(np, self.ring, self.ring.index, rows, self.n_steps)
            rewards = np.where(window.valid, self.ring.reward[window.position], np.float32(0.0))
            reward, steps = discounted_sum(rewards, self.gamma), window.valid.sum(axis=1)
            discount = bootstrap_discount(self.gamma, steps, window.terminal.any(axis=1))
        _, next_obs = self.ring.read(self.ring.index(rows.env, rows.time + steps))
        rewards = discounted(rewards, self.gamma) if self.each_reward and rewards is not None else None
        return batch(self.ring, shape, step, obs, reward, next_obs, discount, weight, rewards), drawn


def batch(
    ring: Ring,
    shape: tuple[int, ...],
    step: np.ndarray,
    obs: list[np.ndarray],
    reward: np.ndarray,
    next_obs: list[np.ndarray],
    discount: np.ndarray,
    weight: np.ndarray | None,
    rewards: np.ndarray | None = None,
) -> Transition:
    """Returns transitions in ``shape`` from flat arrays and records; weights are divided by the largest of each batch."""
    flat = Transition(ring.tree(obs), step["action"], reward, ring.tree(next_obs), discount, weight, rewards)
    shaped = flat if len(shape) == 1 else jax.tree.map(lambda array: array.reshape(shape + array.shape[1:]), flat)
    if weight is not None:
        return shaped._replace(weight=shaped.weight / shaped.weight.max(axis=-1, keepdims=True))
    return shaped


def discounted_sum(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """Returns ``sum_i gamma^i r_i`` of rewards ``(batch, n)``, ``float32 (batch,)``."""
    return (rewards @ gamma ** np.arange(rewards.shape[1])).astype(np.float32)


def discounted(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """Returns ``gamma^i r_i`` of rewards ``(batch, n)``, ``float32``."""
    return (rewards * gamma ** np.arange(rewards.shape[1])).astype(np.float32)


def bootstrap_discount(gamma: float, steps: int | np.ndarray, terminated: np.ndarray) -> np.ndarray:
    """Returns ``gamma^steps``, and 0 where the MDP terminated, ``float32``."""
    return np.where(terminated, np.float32(0.0), np.asarray(gamma**steps, np.float32))
