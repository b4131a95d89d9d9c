"""The plain replay buffer: steps are drawn uniformly, or by priority; n-step returns by option."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rejeu.buffers.prioritized import Draw, Priorities
from rejeu.buffers.ring import LAST, TERMINATED, Ring, Rows
from rejeu.core import Transition


class ReplayBuffer:
    """Draws transitions from a :class:`Ring`, uniformly or by priority."""

    def __init__(
        self,
        ring: Ring,
        gamma: float,
        n_steps: int = 1,
        priorities: Priorities | None = None,
        each_reward: bool = False,
    ) -> None:
        """Draws from ``ring``; with ``each_reward`` transitions of several steps have :attr:`Transition.rewards`."""
        self.ring = ring
        self.gamma = gamma
        self.n_steps = n_steps
        self.priorities = priorities
        self.each_reward = each_reward and n_steps > 1
        self._discounts = discounts_by_kind(gamma)

    def size(self) -> int:
        """Returns the number of transitions kept."""
        return len(self.ring)

    def begin(self, obs: Any, envs: np.ndarray | None = None) -> None:
        """Starts episodes; see :meth:`Ring.begin`."""
        begin(self.ring, self.priorities, obs, envs)

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

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0) -> Transition:
        """Returns transitions, every leaf ``(*shape, ...)``; ``rng`` advances, ``progress`` anneals the weights."""
        return self.draw(rng, shape, progress)[0]

    def draw(
        self, rng: np.random.Generator, shape: tuple[int, ...], progress: float = 1.0
    ) -> tuple[Transition, Draw | None]:
        """Returns what :meth:`sample` does and, with priorities, what :meth:`reprioritise` takes; None without."""
        rows, weight, drawn = draw(self.ring, self.priorities, rng, math.prod(shape), progress)
        step, obs = self.ring.read(rows.position)
        steps: int | np.ndarray = 1
        rewards = None
        if self.n_steps == 1:
            reward, discount = step["reward"], self._discounts.take(rows.kind)
        else:
            window = look_ahead(self.ring, rows, self.n_steps)
            rewards = np.where(window.valid, self.ring.reward[window.position], np.float32(0.0))
            reward = discounted_sum(rewards, self.gamma)
            steps, discount = window.steps, bootstrap_discount(self.gamma, window.steps, window.terminated)
        _, next_obs = self.ring.read(self.ring.index(rows.env, rows.time + steps))
        rewards = discounted(rewards, self.gamma) if self.each_reward and rewards is not None else None
        return batch(self.ring, shape, obs, step["action"], reward, next_obs, discount, weight, rewards), drawn

    def reprioritise(self, td_errors: Iterable[tuple[Draw, Any]]) -> None:
        """Sets priorities by pairs of what :meth:`draw` returned and the absolute TD errors of that batch."""
        if self.priorities is not None:
            self.priorities.update(td_errors)

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns everything kept, as named arrays."""
        return self.ring.arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Puts back what :meth:`arrays` returned; see :meth:`Ring.restore`. Priorities start equal."""
        self.ring.restore(arrays)
        if self.priorities is not None:
            self.priorities.restore()


def begin(ring: Ring, priorities: Priorities | None, obs: Any, envs: np.ndarray | None) -> None:
    """Starts episodes in the ring and takes their first rows out of what can be drawn."""
    ring.begin(obs, envs)
    if priorities is not None:
        envs = ring.all_envs if envs is None else envs
        priorities.tree.set(ring.index(envs, ring.head[envs]), 0.0)


def draw(
    ring: Ring, priorities: Priorities | None, rng: np.random.Generator, n: int, progress: float
) -> tuple[Rows, np.ndarray | None, Draw | None]:
    """Returns ``n`` steps, and where there are priorities their importance weights and what gives TD errors back."""
    return (ring.draw(rng, n), None, None) if priorities is None else priorities.draw(rng, n, progress)


def batch(
    ring: Ring,
    shape: tuple[int, ...],
    obs: list[np.ndarray],
    action: np.ndarray,
    reward: np.ndarray,
    next_obs: list[np.ndarray],
    discount: np.ndarray,
    weight: np.ndarray | None,
    rewards: np.ndarray | None = None,
) -> Transition:
    """Returns transitions in ``shape`` from flat arrays; weights are divided by the largest of each batch."""

    def shaped(array: np.ndarray) -> np.ndarray:
        return array.reshape(shape + array.shape[1:])

    if weight is not None:
        weight = shaped(weight)
        weight /= weight.max(axis=-1, keepdims=True)
    if rewards is not None:
        rewards = shaped(rewards)
    if len(shape) == 1:
        return Transition(ring.tree(obs), action, reward, ring.tree(next_obs), discount, weight, rewards)
    return Transition(
        ring.tree([shaped(leaf) for leaf in obs]),
        shaped(action),
        shaped(reward),
        ring.tree([shaped(leaf) for leaf in next_obs]),
        shaped(discount),
        weight,
        rewards,
    )


class Window(NamedTuple):
    """The steps that an n-step return sums, by sampled row."""

    position: np.ndarray
    """Positions in the ring of the n rows from the sampled one on, ``(batch, n)``."""
    valid: np.ndarray
    """Which of them belong to the return, ``bool (batch, n)``; the first always does."""
    steps: np.ndarray
    """How many do, ``(batch,)``."""
    terminated: np.ndarray
    """Whether the last of them entered a terminal state, ``bool (batch,)``."""


def look_ahead(ring: Ring, rows: Rows, n: int) -> Window:
    """Returns the up to ``n`` steps from each row to its episode's end or to the newest step."""
    times = rows.time[:, None] + np.arange(n)
    index = ring.index(rows.env[:, None], times)
    kind = ring.kind[index]
    is_step = (kind != LAST) & (times < ring.head[rows.env][:, None])
    goes_on = is_step & (kind != TERMINATED)
    valid = is_step.copy()
    valid[:, 1:] &= np.logical_and.accumulate(goes_on, axis=1)[:, :-1]
    return Window(index, valid, valid.sum(axis=1), ((kind == TERMINATED) & valid).any(axis=1))


def discounted_sum(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """Returns ``sum_i gamma^i r_i`` of rewards ``(batch, n)``, ``float32 (batch,)``."""
    return (rewards @ gamma ** np.arange(rewards.shape[1])).astype(np.float32)


def discounted(rewards: np.ndarray, gamma: float) -> np.ndarray:
    """Returns ``gamma^i r_i`` of rewards ``(batch, n)``, ``float32``."""
    return (rewards * gamma ** np.arange(rewards.shape[1])).astype(np.float32)


def bootstrap_discount(gamma: float, steps: int | np.ndarray, terminated: np.ndarray) -> np.ndarray:
    """Returns ``gamma^steps``, and 0 where the MDP terminated, ``float32``."""
    return np.where(terminated, np.float32(0.0), np.asarray(gamma**steps, np.float32))


def discounts_by_kind(gamma: float) -> np.ndarray:
    """Returns :func:`bootstrap_discount` of single steps, by the kind of their row, ``float32 (3,)``."""
    return bootstrap_discount(gamma, 1, np.arange(3) == TERMINATED)
