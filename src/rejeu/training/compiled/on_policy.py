"""On-policy learning in one program: the turns of :mod:`rejeu.training.on_policy`, on the device.

Everything happens in the order of the host's loop, with the same functions of the algorithm and the same keys.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.core.algorithm import Clock, PyTree, Rollout, Scalar
from rejeu.core.prng import nth
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.training.compiled.program import Carry, Limits, Loop, Program, capacity_of, step_envs
from rejeu.training.on_policy import begin_episodes
from rejeu.training.run import Run


class RolloutCounts(NamedTuple):
    """Counters of a run, equal for all seeds."""

    step: Array
    """Environment steps, ``uint32[]``."""
    length: Array
    """Turns of the current rollout, ``int32[]``."""


@dataclass(frozen=True, kw_only=True)
class OnPolicyProgram(Program):
    """Turns that fill a rollout, and updates on all of it."""

    @classmethod
    def of(cls, run: Run, config: RolloutConfig, **settings: Any) -> OnPolicyProgram:
        """Returns the program for runs like ``run``."""
        return cls(config=config, capacity=capacity_of(run.env.n_envs), **settings)

    def batch(
        self, env: FunctionalEnv, carry: Carry, experience: Rollout, clock: Clock, number: Array | int
    ) -> Rollout:
        return rollout_of(experience, carry.counts.length)

    def turns(self, env: FunctionalEnv, loop: Loop, limits: Limits, may_go_on: Callable[[Array, Loop], Array]) -> Loop:
        n_steps = self.config.n_steps

        def fills(inner: tuple[Array, Loop]) -> Array:
            return may_go_on(*inner) & (inner[1].carry.counts.length < n_steps)

        def one_turn(inner: tuple[Array, Loop]) -> tuple[Array, Loop]:
            i, loop = inner
            return i + 1, take_turn(self, env, loop, limits, i)

        def one_rollout(outer: tuple[Array, Loop]) -> tuple[Array, Loop]:
            i, loop = jax.lax.while_loop(fills, one_turn, outer)
            counts = loop.carry.counts
            clock = Clock(counts.step, loop.carry.episodes.n_finished, limits.progress[i])
            is_done = counts.length == n_steps
            loop = jax.lax.cond(is_done, lambda loop: end_of_rollout(self, loop, clock), lambda loop: loop, loop)
            return i, loop

        return jax.lax.while_loop(lambda outer: may_go_on(*outer), one_rollout, (jnp.int32(0), loop))[1]

    def begin_episodes(self, run: Run) -> None:
        begin_episodes(run, self.config)

    def counts_of(self, run: Run) -> RolloutCounts:
        return RolloutCounts(jnp.uint32(run.step), jnp.int32(run.replay.length))

    def action_of(self, run: Run) -> None:
        return None

    def upload(self, run: Run) -> Rollout:
        steps: PyTree = jax.tree.map(jnp.array, run.replay.rollout())
        return steps if steps.carry != () else steps._replace(carry=jax.tree.map(jnp.array, run.carry))

    def download(self, run: Run, experience: Rollout, counts: RolloutCounts) -> None:
        buffer, n = run.buffer, int(counts.length)
        buffer.length = n
        buffer.started, buffer.carry = np.array(experience.started), jax.tree.map(jnp.array, experience.carry)
        if n:
            both = [data._replace(started=None, carry=None) for data in (buffer.rollout(), experience)]
            stores, downloaded = map(jax.tree.leaves, both)
            for host, device in zip(stores, downloaded, strict=True):
                host[:n] = np.asarray(device)[:n]

    def pull_counts(self, run: Run, carry: Carry) -> None:
        """Does nothing: the length of the rollout is copied with it."""


def take_turn(program: OnPolicyProgram, env: FunctionalEnv, loop: Loop, limits: Limits, i: Array) -> Loop:
    """Returns the loop after the ``i``-th turn of a chunk, before the update."""
    config, carry, steps = program.config, loop.carry, loop.experience
    counts, before, t = carry.counts, carry.episodes, carry.counts.length
    clock = Clock(counts.step, before.n_finished, limits.progress[i])
    actor, key = program.algorithm.actor(loop.learned.state), nth(carry.key, clock.step)
    action, explorer = program.explorer.act(carry.explorer, actor, before.obs, before.ended, key, clock)
    action = action.astype(steps.action.dtype)
    loop, result = step_envs(program, env, loop, action, i)
    episodes = loop.carry.episodes
    put = lambda stores, values: jax.tree.map(lambda s, v: s.at[t].set(v.astype(s.dtype)), stores, values)  # noqa: E731
    steps = steps._replace(
        obs=put(steps.obs, before.obs),
        next_obs=put(steps.next_obs, result.obs),
        action=put(steps.action, action),
        reward=put(steps.reward, result.reward),
        discount=put(steps.discount, jnp.where(result.terminated, 0.0, config.gamma)),
        ended=put(steps.ended, episodes.ended),
        valid=put(steps.valid, jnp.ones(program.n_envs, bool)),
        running_return=put(steps.running_return, episodes.running_return),
    )
    counts = RolloutCounts(counts.step + jnp.uint32(program.n_envs), t + 1)
    return loop._replace(carry=loop.carry._replace(explorer=explorer, counts=counts), experience=steps)


def end_of_rollout(program: OnPolicyProgram, loop: Loop, clock: Clock) -> Loop:
    """Returns the loop after learning from the rollout; the next one begins."""
    carry = loop.carry
    learned, _ = program.learn(loop.learned, rollout_of(loop.experience, carry.counts.length), clock)
    steps = loop.experience._replace(started=carry.episodes.ended, carry=carry.explorer)
    counts = carry.counts._replace(length=jnp.zeros_like(carry.counts.length))
    return loop._replace(carry=carry._replace(counts=counts), experience=steps, learned=learned)


def rollout_of(steps: Rollout, length: Scalar) -> Rollout:
    """Returns the first ``length`` steps as the update takes them."""
    return steps._replace(valid=steps.valid & (jnp.arange(len(steps.valid)) < length)[:, None])
