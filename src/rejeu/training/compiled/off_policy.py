"""Off-policy learning in one program: the turns of :mod:`rejeu.training.off_policy`, on the device.

Everything happens in the order of the host's loop, with the same functions of the algorithm and the same keys. Only the
random numbers of batches, goals and of the first actions come from JAX instead of NumPy: they are functions of the
environment step, so a run needs no state of a generator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import spaces
from rejeu.core.algorithm import Clock, PyTree, Scalar, Transition, unmasked
from rejeu.core.prng import nth
from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv, of_two_goals
from rejeu.envs.masks import FunctionalMask
from rejeu.replay import device_priorities
from rejeu.replay.device import DeviceReplay, DeviceRing, DeviceRows, download, upload
from rejeu.replay.device_priorities import Pending, noted
from rejeu.replay.hindsight import HerReplayBuffer
from rejeu.replay.prioritized import Draw
from rejeu.training.checks import checked_restart
from rejeu.training.compiled.program import (
    Carry,
    Learned,
    Limits,
    Loop,
    Program,
    all_finite,
    capacity_of,
    random_action,
    step_envs,
)
from rejeu.training.run import Run

DRAWS = 2**32 - 1
"""Number of the key of batches and random actions; those before are the keys of exploration, by environment step."""


class Counts(NamedTuple):
    """Counters of a run, equal for all seeds."""

    step: Array
    """Environment steps, ``uint32[]``."""
    owed: Array
    """See :attr:`rejeu.training.run.Run.owed`, ``int32[]``."""
    since_update: Array
    """Environment steps since the last update, ``int32[]``."""
    pending: Array
    """Gradient steps of the last turn, whose TD errors set priorities in the next, ``int32[]``."""


@dataclass(frozen=True, kw_only=True)
class OffPolicyProgram(Program):
    """Turns with a replay buffer."""

    replay: DeviceReplay

    @classmethod
    def of(cls, run: Run, config: OffPolicyConfig, **settings: Any) -> OffPolicyProgram:
        """Returns the program for runs like ``run``."""
        replay = replay_of(run, config)
        capacity = min(capacity_of(replay.n_envs), (replay.rows - 1) // 2)
        return cls(config=config, replay=replay, capacity=capacity, **settings)

    def batch(
        self, env: FunctionalEnv, carry: Carry, experience: DeviceRing, clock: Clock, number: Array | int
    ) -> Transition:
        key = jax.random.fold_in(draws(carry.key, clock.step), number + 1)
        return self.draw(env, experience, key, clock.progress)[0]

    def turns(self, env: FunctionalEnv, loop: Loop, limits: Limits, may_go_on: Callable[[Array, Loop], Array]) -> Loop:
        next_turn = lambda loop: (loop[0] + 1, take_turn(self, env, loop[1], limits, loop[0]))  # noqa: E731
        return jax.lax.while_loop(lambda loop: may_go_on(*loop), next_turn, (jnp.int32(0), loop))[1]

    def choose(self, env: FunctionalEnv, carry: Carry, state: PyTree, clock: Clock) -> Carry:
        """Returns the carry with the actions of the next turn; see :func:`rejeu.training.off_policy.choose`."""
        episodes, before = carry.episodes, carry.action
        assert before is not None

        def explored() -> tuple[Array, PyTree]:
            actor, key = self.algorithm.actor(state), nth(carry.key, clock.step)
            action, explorer = self.explorer.act(carry.explorer, actor, episodes.obs, episodes.ended, key, clock)
            return action.astype(before.dtype), explorer

        def random() -> tuple[Array, PyTree]:
            key = jax.random.fold_in(draws(carry.key, clock.step), 0)
            mask = unmasked(episodes.obs)[1]
            return random_action(env.action_space, self.n_envs, key, mask).astype(before.dtype), carry.explorer

        if self.config.learning_starts:
            action, explorer = jax.lax.cond(clock.step < self.config.learning_starts, random, explored)
        else:
            action, explorer = explored()
        return carry._replace(action=action, explorer=explorer)

    def draw(self, env: FunctionalEnv, ring: DeviceRing, key: Array, progress: Scalar) -> tuple[Transition, DeviceRows]:
        """Returns a batch and its rows; with hindsight, the rewards of new goals are those of ``env``."""
        if self.replay.strategy is None:
            return self.replay.draw(ring, key, progress)
        env = env.env if isinstance(env, FunctionalMask) else env
        assert isinstance(env, GoalEnv)
        goal = ring.obs[self.replay.achieved][:1]
        reward, terminated = of_two_goals(env.compute_reward), of_two_goals(env.compute_terminated)
        judges = jax.eval_shape(terminated, goal, goal) is not None
        return self.replay.draw(ring, key, progress, reward, terminated if judges else None)

    def begin_episodes(self, run: Run) -> None:
        run.replay.begin(checked_restart(run))

    def counts_of(self, run: Run) -> Counts:
        pending = sum(len(draw.position) for draw, _ in run.td_errors) // self.replay.batch_size
        return Counts(jnp.uint32(run.step), jnp.int32(run.owed), jnp.int32(run.steps_since_update), jnp.int32(pending))

    def action_of(self, run: Run) -> Array:
        random = lambda: spaces.random_action(run.env.action_space, self.n_envs, np.random.default_rng(0))  # noqa: E731
        return jnp.array(random() if run.action is None else run.action)

    def upload(self, run: Run) -> DeviceRing:
        replay, buffer = self.replay, run.replay
        ring = upload(replay, buffer.ring)
        if buffer.priorities is None:
            return ring
        sizes = replay.most_updates, replay.batch_size
        run.td_errors = [pair for pair in run.td_errors if pair[0].version == buffer.ring.version]
        if not device_priorities.fit(run.td_errors, *sizes):
            buffer.update_priorities(run.td_errors)
            run.td_errors = []
        return ring._replace(priorities=device_priorities.upload(buffer.priorities, run.td_errors, *sizes))

    def download(self, run: Run, experience: DeviceRing, counts: Counts) -> None:
        download(run.buffer.ring, experience)
        priorities = experience.priorities
        if priorities is None:
            return
        ring = run.buffer.ring
        values = np.asarray(priorities.values)[: ring.rows * ring.n_envs]
        run.buffer.priorities.load(values.astype(np.float64), float(priorities.largest))
        run.td_errors = [
            (Draw(position.astype(np.int64), time.astype(np.int64), ring.version), jnp.array(td_error))
            for position, time, td_error in zip(
                *(np.asarray(pending)[: int(counts.pending)] for pending in priorities.pending), strict=True
            )
        ]

    def pull_counts(self, run: Run, carry: Carry) -> None:
        run.action = np.array(carry.action)
        run.owed, run.steps_since_update = int(carry.counts.owed), int(carry.counts.since_update)


def take_turn(program: OffPolicyProgram, env: FunctionalEnv, loop: Loop, limits: Limits, i: Array) -> Loop:
    """Returns the loop after the ``i``-th turn of a chunk."""
    config, algorithm, replay, before = program.config, program.algorithm, program.replay, loop.carry
    assert before.action is not None
    loop, result = step_envs(program, env, loop, before.action, i)
    episodes, learned = loop.carry.episodes, loop.learned
    is_stored = ~loop.nonfinite_env & all_finite(before.action)  # a run with NaN goes on until the chunk ends
    ring = replay.add(loop.experience, before.action, result.reward, result.terminated, result.obs, is_stored)
    ring = replay.begin(ring, episodes.obs, episodes.ended)
    if algorithm.observe is not None:
        learned = learned._replace(state=algorithm.observe(learned.state, episodes.obs, episodes.running_return))
    n_ended = (episodes.n_finished - before.episodes.n_finished).astype(jnp.int32)
    n, counts = due(config, before.counts, program.n_envs, n_ended, limits.learn_from)
    clock = Clock(counts.step, episodes.n_finished, limits.progress[i + 1], program.n_envs)
    carry, root = loop.carry._replace(counts=counts), draws(before.key, clock.step)

    def one(u: Array, passed: tuple[Learned, Pending | None]) -> tuple[Learned, Pending | None]:
        learned, pending = passed
        batch, rows = program.draw(env, ring, jax.random.fold_in(root, u + 1), clock.progress)
        learned, td_error = program.learn(learned, batch, clock)
        if pending is not None and td_error is not None:
            pending = noted(pending, u, rows.position, rows.time, td_error)
        return learned, pending

    if config.overlap:
        carry = program.choose(env, carry, learned.state, clock)
    pending = None if ring.priorities is None else ring.priorities.pending
    learned, pending = jax.lax.fori_loop(0, n, one, (learned, pending))
    if not config.overlap:
        carry = program.choose(env, carry, learned.state, clock)
    ring = replay.update_priorities(ring, before.counts.pending)  # all batches of the turn have been drawn
    if pending is not None and ring.priorities is not None:
        ring = ring._replace(priorities=ring.priorities._replace(pending=pending))
    return loop._replace(carry=carry, experience=ring, learned=learned)


def draws(key: Array, step: Scalar) -> Array:
    """Returns the key of the random actions and batches of a turn that ends at the environment step ``step``."""
    return jax.random.fold_in(nth(key, jnp.uint32(DRAWS)), step)


def due(config: OffPolicyConfig, counts: Counts, n_envs: int, ended: Array, learn_from: Array) -> tuple[Array, Counts]:
    """Returns the gradient steps of a turn, and the counters after it; see the host's ``due``."""
    step = counts.step + jnp.uint32(n_envs)
    learns = step > learn_from
    counted = jnp.where(learns, jnp.minimum(jnp.uint32(n_envs), step - learn_from).astype(jnp.int32), 0)
    since = counts.since_update + counted
    if isinstance(config.train_freq, int):
        owed, every = counts.owed + counted, config.train_freq
    else:
        owed, every = counts.owed + jnp.where(learns, ended, 0), config.train_freq[0]
    times, owed = jnp.divmod(owed, every)
    n = since if config.gradient_steps == -1 else times * config.gradient_steps
    n = jnp.where(times > 0, n, 0)
    return n, Counts(step, owed, jnp.where(times > 0, 0, since), n)


def most_updates(config: OffPolicyConfig, n_envs: int) -> int | None:
    """Returns the largest number of gradient steps of a turn; None if it depends on the length of episodes.

    >>> most_updates(OffPolicyConfig(train_freq=4, gradient_steps=2), n_envs=10)
    6
    """
    every = config.train_freq if isinstance(config.train_freq, int) else config.train_freq[0]
    if config.gradient_steps != -1:
        return (every - 1 + n_envs) // every * config.gradient_steps
    return every - 1 + n_envs if isinstance(config.train_freq, int) else None


def replay_of(run: Run, config: OffPolicyConfig) -> DeviceReplay:
    """Returns how batches are drawn on the device from the replay buffer of a run."""
    buffer, ring, goals = run.buffer, run.buffer.ring, dict[str, Any]()
    if isinstance(buffer, HerReplayBuffer):
        hindsight, leaves = buffer.config, {"achieved": buffer.achieved, "desired": buffer.desired}
        goals = {"strategy": hindsight.goal_selection_strategy, "n_sampled_goal": hindsight.n_sampled_goal, **leaves}
    return DeviceReplay(
        ring.rows,
        ring.n_envs,
        ring.obs_structure,
        config.gamma,
        config.batch_size,
        config.n_steps,
        buffer.each_reward,
        **goals,
        priorities=config.priorities,
        most_updates=1 if config.priorities is None else most_updates(config, ring.n_envs) or 1,
    )
