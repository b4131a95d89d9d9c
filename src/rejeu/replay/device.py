"""The replay buffer as arrays on the device and pure functions, for training programs that contain the environments.

The layout is that of :class:`rejeu.replay.ring.Ring`, and so is the meaning of every row. Instead of counters in every row,
hindsight uses the number of the row's episode and two tables of when episodes began and ended, because an episode that ends
then writes one number instead of one into each of its rows.

Batches are those that :class:`~rejeu.replay.uniform.ReplayBuffer` and :class:`~rejeu.replay.hindsight.HerReplayBuffer`
return for the same content and the same random numbers, bit for bit. Only the sums of n-step returns may differ in their
last bit, because the host adds them up in 64 bits; for priorities see :mod:`rejeu.replay.device_priorities`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core import schedules
from rejeu.core.algorithm import PyTree, Scalar, Transition
from rejeu.core.prng import below
from rejeu.replay import device_priorities
from rejeu.replay.device_priorities import DevicePriorities
from rejeu.replay.hindsight import GoalStrategy, HindsightSteps, MixedStrategies
from rejeu.replay.prioritized import PriorityConfig
from rejeu.replay.ring import LAST, STEP, TERMINATED, Ring, episode_counters
from rejeu.replay.uniform import NewGoals, discounts_of, outcome, replaced

RUNNING = np.iinfo(np.int32).max
"""The end of an episode that has not ended."""

GoalFunction = Callable[[Array, Array], Array]
"""A traceable function of achieved and desired goals ``(n, ...)`` that returns ``(n,)``."""


class DeviceRing(NamedTuple):
    """The rows of all environments, those of an environment together; and counters of environments."""

    obs: list[Array]
    """Leaves of the observations, ``(n_envs * rows, ...)`` each."""
    action: Array
    reward: Array
    kind: Array
    """``STEP``, ``TERMINATED`` or ``LAST``, ``uint8``."""
    episode: Array
    """Number of the row's episode in its environment, ``int32``; empty without hindsight."""
    begins: Array
    """Absolute time of the first row of episode ``i`` at place ``i % rows``, ``int32``; empty without hindsight."""
    ends: Array
    """Likewise of the last row, ``RUNNING`` before it is known."""
    head: Array
    """Absolute time of each environment's newest row, ``int32 (n_envs,)``."""
    n_begun: Array
    """Number of episodes that each environment has begun, ``int32 (n_envs,)``."""
    priorities: DevicePriorities | None = None
    """None if steps are drawn uniformly."""


class DeviceRows(NamedTuple):
    """Rows that were drawn, ``int32 (n,)`` each."""

    env: Array
    time: Array
    position: Array


@dataclass(frozen=True)
class DeviceReplay:
    """How batches are drawn from a :class:`DeviceRing`: pure functions of it. Hashable."""

    rows: int
    """Rows of each environment, at least 3."""
    n_envs: int
    obs_structure: PyTree
    gamma: float
    batch_size: int
    n_steps: int = 1
    each_reward: bool = False
    """Whether transitions of several steps have :attr:`Transition.rewards`."""
    strategy: str | GoalStrategy | MixedStrategies | None = None
    """The goal strategy, None without hindsight."""
    n_sampled_goal: int = 4
    achieved: int = 0
    """Index of the leaf of the achieved goal."""
    desired: int = 0
    priorities: PriorityConfig | None = None
    """None to draw steps uniformly."""
    most_updates: int = 1
    """Gradient steps of a turn at most; needed for priorities."""

    def positions(self, env: Array, time: Array) -> Array:
        """Returns the positions of rows given by environment and absolute time."""
        return env * self.rows + time % self.rows

    def add(
        self, ring: DeviceRing, action: Array, reward: Array, terminated: Array, next_obs: PyTree, is_stored: Array
    ) -> DeviceRing:
        """Returns the ring after one step of each environment if ``is_stored``, ``bool[]``; see :meth:`Ring.add`."""
        envs = jnp.arange(self.n_envs)
        index = jnp.where(is_stored, self.positions(envs, ring.head), len(ring.kind))
        kinds_of_rows = jnp.where(terminated, TERMINATED, STEP).astype(jnp.uint8)
        ring = ring._replace(
            action=put(ring.action, index, action),
            reward=put(ring.reward, index, reward),
            kind=put(ring.kind, index, kinds_of_rows),
        )
        ring = self._advance(ring, next_obs, is_stored)
        if ring.priorities is None:
            return ring
        following = jnp.where(is_stored, self.positions(envs, ring.head), device_priorities.NOWHERE)
        index = jnp.where(is_stored, index, device_priorities.NOWHERE)
        return ring._replace(priorities=device_priorities.add(ring.priorities, index, following))

    def begin(self, ring: DeviceRing, obs: PyTree, begins: Array) -> DeviceRing:
        """Returns the ring after episodes began with ``obs`` in the environments ``begins``; see :meth:`Ring.begin`.

        These environments must have begun an episode before, which ends.
        """
        envs = jnp.arange(self.n_envs)
        index = jnp.where(begins, self.positions(envs, ring.head), len(ring.kind))
        ring = ring._replace(kind=put(ring.kind, index, jnp.full(self.n_envs, LAST, jnp.uint8)))
        if self.strategy is not None:
            outside = len(ring.ends)
            old = jnp.where(begins, self.positions(envs, ring.n_begun - 1), outside)
            new = jnp.where(begins, self.positions(envs, ring.n_begun), outside)
            ends = put(put(ring.ends, old, ring.head), new, jnp.full(self.n_envs, RUNNING, jnp.int32))
            ring = ring._replace(ends=ends, begins=put(ring.begins, new, ring.head + 1))
        ring = ring._replace(n_begun=ring.n_begun + begins.astype(jnp.int32))
        ring = self._advance(ring, obs, begins)
        if ring.priorities is None:
            return ring
        index = jnp.where(begins, self.positions(envs, ring.head), device_priorities.NOWHERE)
        return ring._replace(priorities=device_priorities.changed(ring.priorities, index, jnp.zeros(self.n_envs)))

    def _advance(self, ring: DeviceRing, obs: PyTree, advances: Array) -> DeviceRing:
        """Returns the ring with a further row for the observations of the environments that advance."""
        envs = jnp.arange(self.n_envs)
        head = ring.head + advances.astype(jnp.int32)
        index = jnp.where(advances, self.positions(envs, head), len(ring.kind))
        pairs = zip(ring.obs, jax.tree.leaves(obs), strict=True)
        stores = [put(store, index, leaf.astype(store.dtype)) for store, leaf in pairs]
        kinds_of_rows = put(ring.kind, index, jnp.full(self.n_envs, STEP, jnp.uint8))
        episode = put(ring.episode, index, ring.n_begun - 1) if self.strategy is not None else ring.episode
        return ring._replace(obs=stores, kind=kinds_of_rows, episode=episode, head=head)

    def oldest(self, ring: DeviceRing) -> Array:
        """Returns the absolute time of the oldest row that is kept, by environment, ``(n_envs,)``."""
        return jnp.maximum(ring.head - self.rows + 1, 0)

    def draw_by_priority(self, ring: DeviceRing, key: Array, progress: Scalar) -> tuple[DeviceRows, Array]:
        """Returns the steps of a batch drawn by priority, and their importance weights, ``float32 (batch_size,)``."""
        assert ring.priorities is not None
        assert self.priorities is not None
        beta = schedules.at(self.priorities.beta, progress)
        position, weight = device_priorities.draw(ring.priorities, key, self.batch_size, beta)
        env = position // self.rows
        head = ring.head[env]
        return DeviceRows(env, head - (head - position % self.rows) % self.rows, position), weight

    def update_priorities(self, ring: DeviceRing, n_pending: Array) -> DeviceRing:
        """Returns the ring after the first ``n_pending`` of the gradient steps that are pending set their priorities."""
        if ring.priorities is None:
            return ring
        assert self.priorities is not None
        after = device_priorities.updated(ring.priorities, self.priorities, self.rows, ring.head, n_pending)
        return ring._replace(priorities=after)

    def draw_rows(self, ring: DeviceRing, key: Array, n: int) -> DeviceRows:
        """Returns ``n`` steps drawn uniformly, with replacement; rows that are ``LAST`` are drawn again.

        The i-th of them to be drawn again takes the i-th number of the next key.
        """
        first = self._rows_of(ring, jax.random.bits(jax.random.fold_in(key, 0), (n,), jnp.uint32))

        def again(carry: tuple[Array, DeviceRows, Array]) -> tuple[Array, DeviceRows, Array]:
            i, rows, is_last = carry
            number = jnp.cumsum(is_last) - 1
            bits = jax.random.bits(jax.random.fold_in(key, i), (n,), jnp.uint32)[number]
            rows = jax.tree.map(lambda new, old: jnp.where(is_last, new, old), self._rows_of(ring, bits), rows)
            return i + 1, rows, ring.kind[rows.position] == LAST

        begin = (jnp.uint32(1), first, ring.kind[first.position] == LAST)
        return jax.lax.while_loop(lambda carry: carry[2].any(), again, begin)[1]

    def _rows_of(self, ring: DeviceRing, bits: Array) -> DeviceRows:
        """Returns the rows, of any kind except the newest ones, that random bits ``uint32 (n,)`` stand for."""
        oldest = self.oldest(ring)
        if self.n_envs == 1:
            env = jnp.zeros(bits.shape, jnp.int32)
            time = oldest[0] + below(bits, ring.head[0] - oldest[0])
        else:
            ends = jnp.cumsum(ring.head - oldest)
            ticket = below(bits, ends[-1])
            method = "compare_all" if self.n_envs <= 64 else "scan"
            env = jnp.searchsorted(ends, ticket, side="right", method=method).astype(jnp.int32)
            time = ring.head[env] - (ends[env] - ticket)
        return DeviceRows(env, time, self.positions(env, time))

    def draw(
        self,
        ring: DeviceRing,
        key: Array,
        progress: Scalar = 1.0,
        reward: GoalFunction | None = None,
        terminated: GoalFunction | None = None,
    ) -> tuple[Transition, DeviceRows]:
        """Returns a batch of transitions, and its rows.

        Args:
            ring: the rows. Some environment must have taken a step.
            key: of the random numbers.
            progress: the schedule's progress for importance weights.
            reward: the reward of achieved and desired goals, for hindsight.
            terminated: whether they end the episode; None if relabeled steps keep their own flags.
        """
        rows_key, goals_key = jax.random.fold_in(key, 0), jax.random.fold_in(key, 1)
        if self.priorities is None:
            rows, weight = self.draw_rows(ring, rows_key, self.batch_size), None
        else:
            rows, weight = self.draw_by_priority(ring, rows_key, progress)
        goals = None
        if self.strategy is not None:
            assert reward is not None
            n = self.n_relabeled
            goal_rows = self.goal_positions(ring, goals_key, jax.tree.map(lambda x: x[:n], rows))
            goal = ring.obs[self.achieved][goal_rows]
            if isinstance(self.strategy, MixedStrategies):
                goal = self.strategy.goals(goal, goal_rows, ring.obs[self.desired].__getitem__)
            goals = NewGoals(slice(n), goal, (self.achieved, self.desired), reward, terminated)
        return self.batch(ring, rows, goals)._replace(weight=weight), rows

    @property
    def n_relabeled(self) -> int:
        """The number of transitions of a batch that get a new goal: the first of it."""
        return int(self.batch_size * self.n_sampled_goal / (self.n_sampled_goal + 1))

    def batch(self, ring: DeviceRing, rows: DeviceRows, goals: NewGoals | None = None) -> Transition:
        """Returns the transitions of ``rows``, with new goals if there are any; see :meth:`BaseReplayBuffer.batch`."""
        obs, action = [store[rows.position] for store in ring.obs], ring.action[rows.position]
        rewards, steps, ends = outcome(jnp, ring, self.positions, rows, self.n_steps, goals)
        each = None
        if self.n_steps > 1:
            each = rewards * jnp.asarray((self.gamma ** np.arange(self.n_steps)).astype(np.float32))[None]
            rewards, each = each.sum(axis=1), each if self.each_reward else None
        next_obs = [store[self.positions(rows.env, rows.time + steps)] for store in ring.obs]
        for leaves in (obs, next_obs) if goals is not None else ():
            leaves[self.desired] = replaced(leaves[self.desired], goals.which, goals.goal)  # type: ignore[union-attr]
        tree = lambda leaves: jax.tree.unflatten(self.obs_structure, leaves)  # noqa: E731
        discount = jnp.asarray(discounts_of(self.gamma, self.n_steps))[2 * steps + ends]
        return Transition(tree(obs), action, rewards, tree(next_obs), discount, None, each)

    def goal_positions(self, ring: DeviceRing, key: Array, rows: DeviceRows, strategy: Any = None) -> Array:
        """Returns the positions of the rows whose goals become the new goals of ``rows``; see :class:`HerReplayBuffer`."""
        strategy = strategy or self.strategy
        if isinstance(strategy, MixedStrategies):
            choose = lambda i, env, time, position, name: self.goal_positions(  # noqa: E731
                ring, jax.random.fold_in(key, i), DeviceRows(env, time, position), name
            )
            return jnp.asarray(strategy.joined(jnp, choose, *rows))
        newest, numbers = ring.head[rows.env], count()

        def episode(times: Array) -> Array:
            return self.positions(rows.env, ring.episode[self.positions(rows.env, jnp.maximum(times, steps.oldest))])

        def integers(low: Array, high: Array) -> Array:
            shape = jnp.broadcast_shapes(jnp.shape(low), jnp.shape(high))
            return low + below(jax.random.bits(jax.random.fold_in(key, next(numbers)), shape, jnp.uint32), high - low)

        begin = lambda times: jnp.maximum(ring.begins[episode(times)], steps.oldest)  # noqa: E731
        end = lambda times: jnp.minimum(ring.ends[episode(times)], newest)  # noqa: E731
        goals_at = [ring.obs[leaf].__getitem__ for leaf in (self.achieved, self.desired)]
        drawn = lambda: self.draw_rows(ring, key, len(rows.time))  # noqa: E731
        steps: HindsightSteps = HindsightSteps(
            jnp, rows.env, rows.time, newest, self.rows, begin, end, integers, drawn, self.positions, goals_at
        )
        positions: Array = steps.chosen_by(strategy)
        return positions


def put(store: Array, index: Array, values: Array) -> Array:
    """Returns ``store`` with ``values`` ``(n, ...)`` at the positions ``index`` ``(n,)``; positions outside are ignored."""
    if len(index) > 1:
        return store.at[index].set(values, mode="drop", unique_indices=True)
    # A slice of one row, which XLA on a CPU writes faster than it scatters.
    row_index = jnp.minimum(index[0], len(store) - 1)
    before = jax.lax.dynamic_slice_in_dim(store, row_index, 1)
    row = jnp.where(index[0] < len(store), values, before)
    return jax.lax.dynamic_update_slice_in_dim(store, row, row_index, 0)


def upload(replay: DeviceReplay, ring: Ring) -> DeviceRing:
    """Returns the content of a ring of the host, in which every environment has begun an episode."""
    n = ring.rows * ring.n_envs if replay.strategy is not None else 0
    episode, begins, ends = (np.zeros(n, np.int32) for _ in range(3))
    n_begun = np.ones(ring.n_envs, np.int32)
    for env in range(ring.n_envs if replay.strategy is not None else 0):
        times = np.arange(ring.oldest()[env], ring.head[env] + 1)
        index = ring.index(np.full(len(times), env), times)
        since_start, until_end = episode_counters(ring.kind[index])
        numbers = np.cumsum(since_start == 0) - 1
        numbers[0] = 0
        closed = (until_end > 0) | (ring.kind[index] == LAST)
        places = env * ring.rows + numbers % ring.rows
        episode[index] = numbers
        begins[places] = times - since_start
        ends[places] = np.where(closed, times + until_end, RUNNING)
        n_begun[env] = numbers[-1] + 1
    return DeviceRing(
        [jnp.array(store) for store in ring.obs],
        jnp.array(ring.action),
        jnp.array(ring.reward),
        jnp.array(ring.kind),
        jnp.array(episode),
        jnp.array(begins),
        jnp.array(ends),
        jnp.asarray(ring.head, jnp.int32),
        jnp.array(n_begun),
    )


def download(ring: Ring, source: DeviceRing) -> None:
    """Copies the content of a ring on the device into one of the host, which has as many rows."""
    head = np.asarray(source.head).astype(np.int64)
    n_used = int(min(head.max() + 1, ring.rows))
    pairs = zip([*ring.obs, ring.action, ring.reward, ring.kind], [*source.obs, *source[1:4]], strict=True)
    for store, values in pairs:
        by_env = (ring.n_envs, ring.rows, *store.shape[1:])
        store.reshape(by_env)[:, :n_used] = np.asarray(values).reshape(by_env)[:, :n_used]
    ring.recount(head)
