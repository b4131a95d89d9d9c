"""Off-policy runs on the device: their arguments, and what comes back to the host after a chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import Mesh

from rejeu import spaces
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.buffers import device_priorities
from rejeu.buffers.device import DeviceReplay, DeviceRing, uploaded, written
from rejeu.buffers.device_priorities import DevicePriorities
from rejeu.buffers.prioritized import Draw
from rejeu.core import Clock, Transition
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.loops.device.driver import Stops, capacity_of
from rejeu.loops.device.machine import Machine
from rejeu.loops.device.off_policy import Carry, Counts, OffPolicyProgram, choose, draw, draws, most_updates
from rejeu.loops.device.sharing import over_runs
from rejeu.loops.device.transfer import copies, players_of, rounded_up, unstacked
from rejeu.loops.device.variants import Variants
from rejeu.loops.learner import Learner
from rejeu.loops.run import Run


class OffPolicyMachine(Machine):
    """Runs with a replay buffer. Mutable."""

    def __init__(
        self,
        runs: Sequence[Run],
        learner: Learner,
        config: OffPolicyConfig,
        stops: Stops,
        variants: Variants | None = None,
        hyper: Mapping[int, dict[str, float]] | None = None,
        size: int = 1,
        devices: Sequence[jax.Device] = (),
    ) -> None:
        """Takes runs of equal settings in JAX environments, apart from the hyperparameters ``hyper`` of each, by its ``id``.

        ``devices`` share several runs; see :class:`Machine` for ``size``.
        """
        run = runs[0]
        program = OffPolicyProgram(
            learner.algorithm,
            learner.explorer,
            config,
            replay_of(run, config),
            learner.packing,
            min(capacity_of(run.env.n_envs), (run.replay.ring.rows - 1) // 2),
            learner.skips,
            stops.at_episodes,
            variants,
        )
        super().__init__(runs, learner, program, size, devices)
        self.heads: np.ndarray = np.zeros(0)
        """Times of the newest rows that the hosts' rings have, ``int64 (n_runs, n_envs)``."""
        self.hyper = {} if hyper is None else hyper

    def uses_part(self, run: Run, n_turns: int, last: int | None) -> bool:
        return False

    def carry_of(self, run: Run, progress: float) -> Carry:
        action = run.action
        if action is None:  # of its shape
            action = spaces.random_action(run.env.action_space, run.env.n_envs, np.random.default_rng(0))
        carry = Carry(
            state=run.state,
            key=jnp.asarray(run.key),
            explorer=jax.tree.map(jnp.asarray, run.carry),
            action=jnp.array(action),
            players=players_of(run),
            counts=Counts(
                jnp.uint32(run.step),
                jnp.int32(run.owed),
                jnp.int32(run.steps_since_update),
                jnp.int32(sum(len(draw.position) for draw, _ in run.td_errors) // self.program.replay.batch_size),
            ),
            in_a_row=jnp.int32(0),
            hyper={name: jnp.float32(value) for name, value in self.hyper.get(id(run), {}).items()},
        )
        if run.action is None:
            run.action = np.array(self.compiled(first_action)(carry, np.float32(progress)))
            carry = carry._replace(action=jnp.array(run.action))
        return carry

    def begin(self, runs: Sequence[Run]) -> None:
        self.heads = np.stack([run.replay.ring.head for run in runs])
        replay = self.program.replay
        for run in runs:
            version = run.replay.ring.version
            run.td_errors = [(draw, td_error) for draw, td_error in run.td_errors if draw.version == version]
            if not device_priorities.fit(run.td_errors, replay.most_updates, replay.batch_size):
                run.replay.update_priorities(run.td_errors)
                run.td_errors = []

    def store_of(self, run: Run) -> DeviceRing:
        replay, buffer = self.program.replay, run.replay
        ring = uploaded(replay, buffer.ring)
        if buffer.priorities is None:
            return ring
        sizes = (replay.most_updates, replay.batch_size)
        return ring._replace(priorities=device_priorities.uploaded(buffer.priorities, run.td_errors, *sizes))

    def fetch(self, carries: Sequence[Any]) -> list[Any]:
        heads = np.asarray(self.store.head).astype(np.int64).reshape(self.n, -1)
        size = rounded_up(int((heads - self.heads).max()) + 1, self.program.replay.rows)
        first = self.heads.astype(np.int32)
        if self.n > 1:
            rows = self.compiled(partial(rows_of_each, self.mesh), static_argnums=3)(self.store, first, size)
        else:
            rows = self.compiled(rows_from, static_argnums=3)(self.store, first[0], size)
        self.heads = heads
        priorities: list[Any] = [None] * self.n
        if self.store.priorities is not None:
            priorities = unstacked(jax.device_get(self.store.priorities._replace(sums=None)), self.n)
        return list(zip(heads, unstacked(jax.device_get(rows), self.n), priorities, strict=True))

    def put(self, run: Run, carry: Any, experience: Any) -> None:
        run.action = np.array(carry.action)
        run.owed, run.steps_since_update = int(carry.counts.owed), int(carry.counts.since_update)
        head, rows, priorities = experience
        run.replay.ring.write(head, rows)
        if priorities is not None:
            put_priorities(run, priorities, int(carry.counts.pending))

    def batch(self, run: Run, clock: Clock, number: int) -> Transition:
        return copies(self.compiled(drawn)(self.store, self.carry.key, clock, np.uint32(number + 1)))


def put_priorities(run: Run, priorities: DevicePriorities, n_pending: int) -> None:
    """Puts priorities on the host, and the gradient steps that are pending, into a run."""
    ring, pending = run.replay.ring, priorities.pending
    n = ring.rows * ring.n_envs
    run.replay.priorities.load(np.asarray(priorities.values[:n], np.float64), float(priorities.largest))
    run.td_errors = [
        (Draw(position.astype(np.int64), time.astype(np.int64), ring.version), jnp.array(td_error))
        for position, time, td_error in zip(*(part[:n_pending] for part in pending), strict=True)
    ]


def first_action(program: OffPolicyProgram, env: FunctionalEnv, carry: Carry, progress: Any) -> Array:
    """Returns the first actions of a run."""
    program = program if program.variants is None else program.variants.applied(program, carry.hyper)
    clock = Clock(carry.counts.step, carry.players.episode, progress)
    return choose(program, env, carry, program.packing.unpack(carry.state), clock).action


def drawn(
    program: OffPolicyProgram, env: FunctionalEnv, ring: DeviceRing, key: Array, clock: Clock, number: Any
) -> Transition:
    """Returns the batch of a gradient step of a turn."""
    return draw(program.replay, env, ring, jax.random.fold_in(draws(key, clock.step), number), clock.progress)[0]


def rows_from(program: OffPolicyProgram, env: FunctionalEnv, ring: DeviceRing, first: Any, size: int) -> dict[str, Any]:
    """Returns rows of a ring; see :func:`rejeu.buffers.device.written`."""
    return written(program.replay, ring, first, size)


def rows_of_each(
    mesh: Mesh | None, program: OffPolicyProgram, env: FunctionalEnv, ring: DeviceRing, first: Any, size: int
) -> dict[str, Any]:
    """Returns rows of the rings of several runs."""
    return over_runs(lambda ring, first: written(program.replay, ring, first, size), mesh, (0, 0), 0)(ring, first)


def replay_of(run: Run, config: OffPolicyConfig) -> DeviceReplay:
    """Returns how batches are drawn on the device from the replay buffer of a run."""
    buffer, hindsight = run.replay, config.hindsight
    ring = buffer.ring
    paths = [leaf.path for leaf in ring.obs_leaves]
    goals: dict[str, Any] = {} if hindsight is None else {
        "strategy": hindsight.goal_selection_strategy,
        "n_sampled_goal": hindsight.n_sampled_goal,
        "achieved": paths.index("achieved_goal"),
        "desired": paths.index("desired_goal"),
    }  # fmt: skip
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
