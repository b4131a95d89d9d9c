"""The loop of off-policy learning where environments do not wait for each other.

One turn takes the results of the ``env.wait_for`` environments that have them first, and gives these environments new
actions, while the others still step. Otherwise it is :func:`rejeu.loops.off_policy.off_policy`, whose results it equals bit
for bit if a turn takes the results of all environments. Arrays of one turn have a row for each environment; only the
rows of ``which`` are new.

The results depend on the seed and on the order of arrival, which ``env.arrivals`` records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import numpy as np
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import Clock, PyTree
from rejeu.loops import off_policy
from rejeu.loops.checks import check_state, check_step, checked_reset
from rejeu.loops.learner import Learner
from rejeu.loops.off_policy import batch_shapes, due, reaches, update
from rejeu.loops.run import Progress, Run, clock_of, record_step
from rejeu.loops.timing import Timer
from rejeu.spaces import action_scaler, random_action


def first_of_n(
    run: Run, learner: Learner, config: OffPolicyConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps; arguments and errors are those of ``off_policy``."""
    env, scale = run.env, action_scaler(run.env.action_space)
    first, last = run.step, None if n_steps is None else run.step + n_steps
    check_state(run, learner)
    timer = Timer(run.seconds)
    while last is None or run.step < last:
        run.monitor.follow(run.state)
        if run.obs is None or env.must_reset:
            off_policy.begin_episodes(run)
        if run.action is None:
            run.action = np.array(off_policy.choose(run, learner, config, clock_of(run, progress(run.step - first))))
        timer.lap()
        action = scale(run.action)
        env.send(action)
        step = env.receive()
        timer.lap("env")
        check_step(run, step)
        kept = step.which if last is None else step.which[: last - run.step]
        if learner.observe is not None:
            run.running_return[step.which] = (config.gamma * run.running_return + step.reward)[step.which]
        run.replay.add(run.action, step.reward, step.terminated, step.obs, kept)
        run.step += len(kept)
        episodes = record_step(run, step, mask(kept, env.n_envs), mask(step.which, env.n_envs))
        timer.lap("replay")
        run.obs, last_obs = step.obs, None
        if np.count_nonzero(run.ended):
            last_obs = jax.tree.map(np.copy, step.obs)
            run.obs = checked_reset(run, run.ended)
        timer.lap("env")
        if last_obs is not None:
            run.replay.begin(run.obs, np.flatnonzero(run.ended))
        if learner.observe is not None:
            observe(run, learner, step.which)
        done = progress(run.step - first)
        n_updates = due(run, config, len(kept), len(episodes))
        timer.lap("replay")
        clock = clock_of(run, done)
        if config.overlap:
            chosen = choose(run, learner, config, clock, step.which)
        timer.lap("update")
        samples = [run.replay.draw(run.rng, shape, done) for shape in batch_shapes(n_updates, config, env.wait_for)]
        timer.lap("replay")
        n_unread = len(run.monitor)
        update(run, learner, samples, clock)
        if not config.overlap:
            chosen, n_unread = choose(run, learner, config, clock, step.which), len(run.monitor)
        run.action = run.action.copy()
        run.action[step.which] = np.asarray(chosen)
        run.monitor.read(n_unread)  # those are done, since the actions came after them
        timer.lap("update")
        ended = n_updates > 0 or (run.step <= run.learn_from and reaches(run, config, len(kept), len(episodes)))
        yield Progress(run.step, episodes, run.metrics, action, step, last_obs, ended)


def mask(which: np.ndarray, n_envs: int) -> np.ndarray:
    """Returns indices as a mask, ``bool (n_envs,)``."""
    chosen = np.zeros(n_envs, bool)
    chosen[which] = True
    return chosen


def choose(run: Run, learner: Learner, config: OffPolicyConfig, clock: Clock, which: np.ndarray) -> np.ndarray | Array:
    """Returns actions of the environments ``which``, as :func:`rejeu.loops.off_policy.choose` does for all.

    Noise and other state of exploration advance in these environments only. What they share, arrays without an axis of
    environments, advances with every call.
    """
    if run.step < config.learning_starts:
        return random_action(run.env.action_space, len(which), run.rng)
    carry = jax.tree.map(lambda leaf: leaf[which] if leaf.ndim else leaf, run.carry)
    obs = jax.tree.map(lambda leaf: leaf[which], run.obs)
    action, carry = learner.act(run.state, carry, obs, run.ended[which], run.key, clock)
    run.carry = jax.tree.map(lambda old, new: old.at[which].set(new) if old.ndim else new, run.carry, carry)
    return action


def observe(run: Run, learner: Learner, which: np.ndarray) -> None:
    """Adds the new observations to the statistics, as ``off_policy`` does, and begins returns where episodes ended."""
    assert learner.observe is not None
    seen: PyTree = jax.tree.map(lambda leaf: leaf[which], run.obs)
    returns = run.running_return[which]
    run.state = learner.observe(run.state, seen, returns)
    run.monitor.record(run.state, learner.observe, seen, returns)
    run.running_return[run.ended] = 0.0
