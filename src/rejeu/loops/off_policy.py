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
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import Clock
from rejeu.loops.checks import check_obs, check_state, check_step, checked_reset
from rejeu.loops.learner import Learner
from rejeu.loops.nonfinite import gradient_steps
from rejeu.loops.run import Progress, Run, clock_of, record_step, restart
from rejeu.loops.timing import Timer
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
    env, n_envs, scale = run.env, run.env.n_envs, action_scaler(run.env.action_space)
    first, last = run.step, None if n_steps is None else run.step + n_steps
    check_state(run, learner)
    timer = Timer(run.seconds)
    while last is None or run.step < last:
        run.monitor.follow(run.state)
        if run.obs is None or env.must_reset:
            begin_episodes(run)
        if run.action is None:
            run.action = np.asarray(choose(run, learner, config, clock_of(run, progress(run.step - first))))
        n_kept = n_envs if last is None else min(n_envs, last - run.step)
        kept = None if n_kept == n_envs else np.arange(n_kept)
        timer.lap()
        action = scale(run.action)
        step = env.step(action)
        timer.lap("env")
        check_step(run, step)
        if learner.observe is not None:
            run.running_return = np.where(run.ended, 0.0, config.gamma * run.running_return) + step.reward
        run.replay.add(run.action, step.reward, step.terminated, step.obs, kept)
        run.step += n_kept
        episodes = record_step(run, step, None if kept is None else np.arange(n_envs) < n_kept)
        timer.lap("replay")
        run.obs, last_obs = step.obs, None
        if np.count_nonzero(run.ended):
            last_obs = jax.tree.map(np.copy, step.obs)
            run.obs = checked_reset(run, run.ended)
        timer.lap("env")
        if last_obs is not None:
            run.replay.begin(run.obs, np.flatnonzero(run.ended))
        if learner.observe is not None:
            observe(run, learner)
        done = progress(run.step - first)
        n_updates = due(run, config, n_kept, len(episodes))
        timer.lap("replay")
        clock = clock_of(run, done)
        if config.overlap:
            chosen = choose(run, learner, config, clock)
        timer.lap("update")
        samples = [run.replay.draw(run.rng, shape, done) for shape in batch_shapes(n_updates, config, n_envs)]
        timer.lap("replay")
        n_unread = len(run.monitor)
        update(run, learner, samples, clock)
        if not config.overlap:
            chosen, n_unread = choose(run, learner, config, clock), len(run.monitor)
        run.action = np.asarray(chosen)
        run.monitor.read(n_unread)  # those are done, since the actions came after them
        timer.lap("update")
        ended = n_updates > 0 or (run.step <= run.learn_from and reaches(run, config, n_kept, len(episodes)))
        yield Progress(run.step, episodes, run.metrics, action, step, last_obs, ended)


def begin_episodes(run: Run) -> None:
    """Starts an episode in every environment, which ends the running ones."""
    check_obs(run, restart(run), run.step, "reset returned")
    run.replay.begin(run.obs)


def choose(run: Run, learner: Learner, config: OffPolicyConfig, clock: Clock) -> np.ndarray | Array:
    """Returns random actions at first, then those of the exploring policy, which the device may still be computing.

    ``run.obs`` must not change before they are read.
    """
    if run.step < config.learning_starts:
        return random_action(run.env.action_space, run.env.n_envs, run.rng)
    action, run.carry = learner.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
    return action


def observe(run: Run, learner: Learner) -> None:
    """Adds the observations to the statistics of the state.

    They are copied: the device may read an array after the environments have written the next step to it.
    """
    assert learner.observe is not None
    seen = jax.tree.map(np.copy, run.obs)
    run.state = learner.observe(run.state, seen, run.running_return)
    run.monitor.record(run.state, learner.observe, seen, run.running_return)


def update(run: Run, learner: Learner, samples: list[tuple[Any, Any]], clock: Clock) -> None:
    """Starts and counts the updates on samples, and sets priorities by the TD errors of the last ones."""
    run.replay.update_priorities(run.td_errors)
    run.td_errors = []
    for batch, drawn in samples:
        run.state, run.metrics, td_error = learner.update(run.state, batch, clock)
        run.monitor.record(run.state, learner.update, batch, clock, readings=run.metrics, n_updates=run.n_updates)
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
