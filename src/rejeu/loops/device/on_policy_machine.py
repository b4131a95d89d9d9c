"""On-policy runs on the device: their arguments, and what comes back to the host after a chunk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.core import Clock, Rollout
from rejeu.loops.device.driver import Stops, capacity_of
from rejeu.loops.device.machine import Machine
from rejeu.loops.device.on_policy import Carry, Counts, OnPolicyProgram, Steps, rollout_of
from rejeu.loops.device.transfer import copies, players_of, unstacked
from rejeu.loops.device.variants import Variants
from rejeu.loops.learner import Learner
from rejeu.loops.run import Run

FIELDS = ("action", "reward", "discount", "ended", "valid", "running_return")
"""Arrays of a rollout buffer that have the same names on the device."""


class OnPolicyMachine(Machine):
    """Runs with a rollout buffer. Mutable."""

    def __init__(
        self,
        runs: Sequence[Run],
        learner: Learner,
        config: RolloutConfig,
        stops: Stops,
        variants: Variants | None = None,
        hyper: Mapping[int, dict[str, float]] | None = None,
        size: int = 1,
        devices: Sequence[jax.Device] = (),
    ) -> None:
        """Takes runs of equal settings in JAX environments, apart from the hyperparameters ``hyper`` of each, by its ``id``.

        ``devices`` share several runs; see :class:`Machine` for ``size``.
        """
        program = OnPolicyProgram(
            learner.algorithm,
            learner.explorer,
            config,
            runs[0].env.n_envs,
            learner.packing,
            capacity_of(runs[0].env.n_envs),
            learner.skips,
            stops.at_episodes,
            variants,
        )
        super().__init__(runs, learner, program, size, devices)
        self.hyper = {} if hyper is None else hyper

    def uses_part(self, run: Run, n_turns: int, last: int | None) -> bool:
        """Returns whether the rollout that is under way at the step ``last`` is learned from.

        It begins in this chunk or holds the steps of the buffer.
        """
        if last is None:
            return False
        n_steps, n_envs, length = self.program.config.n_steps, run.env.n_envs, run.replay.length
        turns, size = (length + n_turns) % n_steps, run.replay.size() + last - run.step
        if length + n_turns >= n_steps:
            size = turns * n_envs - (run.step + n_turns * n_envs - last)
        return bool(turns) and self.program.config.learns_from_part(size, n_envs)

    def carry_of(self, run: Run, progress: float) -> Carry:
        return Carry(
            state=run.state,
            key=jnp.asarray(run.key),
            explorer=jax.tree.map(jnp.asarray, run.carry),
            players=players_of(run),
            counts=Counts(jnp.uint32(run.step), jnp.int32(run.replay.length)),
            in_a_row=jnp.int32(0),
            hyper={name: jnp.float32(value) for name, value in self.hyper.get(id(run), {}).items()},
        )

    def store_of(self, run: Run) -> Steps:
        buffer = run.replay
        tree = lambda stores: jax.tree.unflatten(buffer.obs_structure, [jnp.array(x) for x in stores])  # noqa: E731
        carry = jax.tree.map(jnp.array, run.carry if buffer.carry == () else buffer.carry)
        return Steps(
            tree(buffer.obs),
            tree(buffer.next_obs),
            **{name: jnp.array(getattr(buffer, name)) for name in FIELDS},
            started=jnp.array(buffer.started),
            carry=carry,
        )

    def begin(self, runs: Sequence[Run]) -> None:
        """Does nothing: rollouts are fetched as a whole."""

    def fetch(self, carries: Sequence[Any]) -> list[Any]:
        if carries[0].counts.length:
            steps = jax.device_get(self.store)
            if self.n == 1:
                return [steps]
            return [one._replace(valid=steps.valid) for one in unstacked(steps._replace(valid=None), self.n)]
        beginnings = jax.device_get((self.store.started, self.store.carry))
        return [self.store._replace(started=a, carry=b) for a, b in unstacked(beginnings, self.n)]

    def put(self, run: Run, carry: Any, experience: Any) -> None:
        store: Steps = experience
        buffer, n = run.replay, int(carry.counts.length)
        buffer.length = n
        if n:
            pairs = [(getattr(buffer, name), getattr(store, name)) for name in FIELDS]
            for stores, values in ((buffer.obs, store.obs), (buffer.next_obs, store.next_obs)):
                pairs += zip(stores, jax.tree.leaves(values), strict=True)
            for host, device in pairs:
                host[:n] = np.asarray(device)[:n]
        buffer.started, buffer.carry = np.array(store.started), jax.tree.map(jnp.array, store.carry)

    def batch(self, run: Run, clock: Clock, number: int) -> Rollout:
        return copies(rollout_of(self.store, self.carry.counts.length))
