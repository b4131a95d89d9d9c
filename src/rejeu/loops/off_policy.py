"""The loop of off-policy learning: environments fill a replay buffer, and gradient steps are taken on batches of it.

:func:`off_policy` is a generator that trains while its caller iterates over it. One turn steps all environments once::

    the environments step      while the update of the previous turn still runs in XLA's own threads
    the step is stored         and new episodes begin where some ended
    actions are requested      from the device, which computes them as soon as that update is done
    batches are sampled        meanwhile
    the updates are started    by default one gradient step per environment step, all in one call
    the actions are read       while the updates begin

So environments and updates do not wait for each other. The results still depend on the seed only, because the action at
a step always follows the update of the step before the last. With ``overlap=False`` actions are requested after the
updates are started, and wait for them.

With ``env.wait_for`` one turn takes the results of so many environments that have them first, ``step.which``, and gives these
new actions, while the others still step. Arrays of a turn have a row for each environment; only the rows of ``which`` are
new. The results depend on the seed and on the order of arrival, which ``env.arrivals`` records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import Clock, PyTree, unmasked
from rejeu.envs.base import Step
from rejeu.exploration.explorer import memory_in
from rejeu.loops.checks import check_obs, check_state, checked_reset, checked_step
from rejeu.loops.learner import Learner
from rejeu.loops.nonfinite import gradient_steps
from rejeu.loops.run import Episode, Progress, Run, Timer, clock_of, record_step, restart
from rejeu.spaces import action_scaler, random_action


def off_policy(
    run: Run, learner: Learner, config: OffPolicyConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps (None: until the caller stops), yielding after every turn.

    Args:
        run: mutated; consistent whenever the generator has yielded.
        learner: the algorithm.
        config: its hyperparameters.
        n_steps: over all environments; if their number does not divide it, the last turn keeps as many as remain.
        progress: returns the progress of schedules after a number of steps.

    Raises:
        BadEnvironmentError: if a reward or an observation is not finite.
        NonFiniteError: if the state is not finite when training begins.
        NonFiniteUpdate: if an update leaves numbers that are not finite.
    """
    env, scale = run.env, action_scaler(run.env.action_space)
    first, last = run.step, None if n_steps is None else run.step + n_steps
    check_state(run, learner)
    timer = Timer(run.seconds)
    while last is None or run.step < last:
        if run.obs is None or env.must_reset:
            begin_episodes(run)
        if run.action is None:
            run.action = np.array(choose(run, learner, config, clock_of(run, progress(run.step - first)), None))
        timer.lap()
        action = scale(run.action)
        step = checked_step(run, action)
        timer.lap("env")
        n_kept, episodes = store(run, learner, config, step, last)
        timer.lap("replay")
        last_obs = begin_where_ended(run, step)
        timer.lap("env")
        if last_obs is not None:
            run.replay.begin(run.obs, np.flatnonzero(run.ended))
        observe(run, learner, step.which)
        done = progress(run.step - first)
        clock = clock_of(run, done)
        n_updates = due(run, config, n_kept, len(episodes))
        timer.lap("replay")
        chosen = choose(run, learner, config, clock, step.which) if config.overlap else None
        timer.lap("update")
        shapes = batch_shapes(n_updates, config, env.wait_for or env.n_envs)
        samples = [run.replay.draw(run.rng, shape, done) for shape in shapes]
        timer.lap("replay")
        n_unread = len(run.monitor)
        update(run, learner, samples, clock)
        if chosen is None:
            chosen, n_unread = choose(run, learner, config, clock, step.which), len(run.monitor)
        run.action = merged(run.action, np.asarray(chosen), step.which)
        run.monitor.read(n_unread)  # those are done, since the actions came after them
        timer.lap("update")
        ended = n_updates > 0 or (run.step <= run.learn_from and reaches(run, config, n_kept, len(episodes)))
        yield Progress(run.step, episodes, run.metrics, action, step, last_obs, ended)


def begin_episodes(run: Run) -> None:
    """Starts an episode in every environment, which ends the running ones."""
    check_obs(run, restart(run), run.step, "reset returned")
    run.replay.begin(run.obs)


def store(
    run: Run, learner: Learner, config: OffPolicyConfig, step: Step, last: int | None
) -> tuple[int, list[Episode]]:
    """Adds a step to the replay buffer and to the running episodes.

    Returns how many environments' steps were kept, so that there are ``last`` in all, and the episodes that ended.
    """
    n_envs = run.env.n_envs
    which = np.arange(n_envs) if step.which is None else step.which
    n_kept = len(which) if last is None else min(len(which), last - run.step)
    kept = None if n_kept == n_envs else which[:n_kept]
    if learner.observe is not None:
        before = np.where(run.ended, np.float32(0), run.running_return)
        run.running_return = merged(before, config.gamma * before + step.reward, step.which)
    run.replay.add(run.action, step.reward, step.terminated, step.obs, kept)
    run.step += n_kept
    return n_kept, record_step(run, step, mask(kept, n_envs), mask(step.which, n_envs))


def begin_where_ended(run: Run, step: Step) -> PyTree:
    """Starts new episodes where the step ended some.

    ``run.obs`` are then the observations to act on next. Returns a copy of the last ones; None if no episode ended.
    """
    run.obs = step.obs
    if not np.count_nonzero(run.ended):
        return None
    last_obs = jax.tree.map(np.copy, step.obs)
    run.obs = checked_reset(run, run.ended)
    return last_obs


def merged(old: np.ndarray, new: np.ndarray, which: np.ndarray | None) -> np.ndarray:
    """Returns ``old`` with the rows ``which`` of ``new``, which has all rows or only these; ``new`` where that is None."""
    if which is None:
        return new
    old = old.copy()
    old[which] = new if len(new) == len(which) else new[which]
    return old


def mask(which: np.ndarray | None, n_envs: int) -> np.ndarray | None:
    """Returns indices as a mask, ``bool (n_envs,)``; None, which stands for all, as it is."""
    return None if which is None else np.bincount(which, minlength=n_envs) > 0


def choose(
    run: Run, learner: Learner, config: OffPolicyConfig, clock: Clock, which: np.ndarray | None
) -> np.ndarray | Array:
    """Returns random actions at first, then those of the exploring policy, which the device may still be computing.

    A policy with memory remembers the observations of random actions too, and the replay buffer what it remembered.
    ``run.obs`` must not change before they are read. ``which`` are the environments; None stands for all. Noise and other
    state of exploration advance in these only. What they share, arrays without an axis of environments, advances with every
    call.
    """
    random = None
    if run.step < config.learning_starts:
        mask = unmasked(run.obs)[1]
        mask = mask if mask is None or which is None else mask[which]
        n = run.env.n_envs if which is None else len(which)
        random = random_action(run.env.action_space, n, run.rng, mask)
        if learner.algorithm.recall is None:
            return random
    if learner.algorithm.recall is not None:
        run.replay.ring.remember(np.asarray(memory_in(run.carry)), run.ended, which)
    if which is None:
        action, run.carry = learner.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
    else:
        carry = jax.tree.map(lambda leaf: leaf[which] if leaf.ndim else leaf, run.carry)
        action, carry = learner.act(run.state, carry, rows(run.obs, which), run.ended[which], run.key, clock)
        run.carry = jax.tree.map(lambda old, new: old.at[which].set(new) if old.ndim else new, run.carry, carry)
    if random is None:
        return action
    jax.block_until_ready(action)  # until then the device may read the observations
    return random


def rows(obs: PyTree, which: np.ndarray | None) -> PyTree:
    """Returns a copy of the observations of the environments ``which``; None stands for all."""
    return jax.tree.map(np.copy if which is None else (lambda leaf: leaf[which]), obs)


def observe(run: Run, learner: Learner, which: np.ndarray | None) -> None:
    """Adds the new observations to the statistics of the state, if it has some.

    They are copied: the device may read an array after the environments have written the next step to it.
    """
    if learner.observe is not None:
        returns = run.running_return if which is None else run.running_return[which]
        run.state = run.monitor.follow(learner.observe, run.state, rows(run.obs, which), returns)


def update(run: Run, learner: Learner, samples: list[tuple[Any, Any]], clock: Clock) -> None:
    """Starts and counts the updates on samples, and sets priorities by the TD errors of the last ones."""
    run.replay.update_priorities(run.td_errors)
    run.td_errors = []
    for batch, drawn in samples:
        run.state, run.metrics, td_error = run.monitor.update(learner.update, run.state, batch, clock, run.n_updates)
        run.n_updates += gradient_steps(batch.reward)
        if td_error is not None:
            run.td_errors.append((drawn, td_error))


def due(run: Run, config: OffPolicyConfig, taken: int, ended: int) -> int:
    """Returns the number of gradient steps of this turn, and counts the steps since the last update."""
    if run.step <= run.learn_from:
        return 0
    taken = min(taken, run.step - run.learn_from)
    run.steps_since_update += taken
    new, every = (taken, config.train_freq) if isinstance(config.train_freq, int) else (ended, config.train_freq[0])
    run.owed += new
    times, run.owed = divmod(run.owed, every)
    if not times or not run.replay.size():
        return 0
    steps, run.steps_since_update = run.steps_since_update, 0
    return steps if config.gradient_steps == -1 else times * config.gradient_steps


def reaches(run: Run, config: OffPolicyConfig, taken: int, ended: int) -> bool:
    """Returns whether a turn of ``taken`` steps, in which ``ended`` episodes ended, completes a period of ``train_freq``."""
    if isinstance(config.train_freq, int):
        count, passed, every = run.step, taken, config.train_freq
    else:
        count, passed, every = run.episode, ended, config.train_freq[0]
    return count // every > (count - passed) // every


def batch_shapes(n_updates: int, config: OffPolicyConfig, n_envs: int) -> list[tuple[int, ...]]:
    """Returns the shapes of the samples for a number of gradient steps.

    Several steps are one scan. So that few sizes are compiled, it has the number of steps of an ordinary turn, at most
    64; the remaining steps are taken one by one.
    """
    usual = 16
    if isinstance(config.train_freq, int) and config.gradient_steps > 0:
        usual = min(max(n_envs // config.train_freq, 1) * config.gradient_steps, 64)
    one: tuple[int, ...] = (config.batch_size,)
    several = one if usual == 1 else (usual, config.batch_size)
    return [several] * (n_updates // usual) + [one] * (n_updates % usual)
