"""The loop of off-policy learning: environments fill a replay buffer, and gradients are taken on batches of it.

:func:`off_policy` is a generator: it trains, and whoever iterates it decides what else happens. One turn is one step of
all environments::

    environments step        while the update of the turn before still runs in XLA's own threads
    the ring keeps the step; episodes that ended are counted and begun anew
    actions are asked for    of the device, which chooses them as soon as that update is done
    batches are drawn        meanwhile
    the update is queued     one gradient step per environment step by default, all in one call
    the actions are read     while it begins

So the environments never wait for the gradient nor the gradient for them, and yet every number depends on the seed
alone: the action at a step always follows the update of the step before the last. With ``overlap=False`` actions are asked
for after the update is queued, and wait for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core import Clock
from rejeu.loops.learner import Learner
from rejeu.loops.run import (
    Progress,
    Run,
    book,
    check_finite,
    check_state,
    choose,
    clock_of,
    counted,
    last_of,
    look_at_bounds,
    reset_done,
    restart,
)
from rejeu.spaces import action_scaler, random_action


def off_policy(
    run: Run, learner: Learner, config: OffPolicyConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps (None: until the caller stops), yielding after every turn.

    Args:
        run: mutated; consistent whenever the generator has yielded.
        learner: the algorithm.
        config: its hyper-parameters.
        n_steps: over all environments; where their number does not divide it, the last turn keeps as many as remain.
        progress: gives the progress of schedules after so many steps.

    Raises:
        BadEnvironmentError: if a reward or an observation is not finite.
        NonFiniteError: if the state is not finite to begin with.
        Broken: if an update leaves numbers that are not finite.
    """
    env, n_envs, scale = run.env, run.env.n_envs, action_scaler(run.env.action_space)
    first, last = run.step, None if n_steps is None else run.step + n_steps
    began = time.perf_counter() - run.seconds["total"]
    per_turn = updates_per_turn(config, n_envs)
    check_state(run, learner)
    while last is None or run.step < last:
        if run.obs is None or env.must_reset:
            begin_episodes(run)
        if run.action is None:
            run.action = np.asarray(choose_or_draw(run, learner, config, clock_of(run, progress(run.step - first))))
        remaining = counted(run, n_envs, last)
        active = None if remaining is None else np.arange(remaining)
        t0 = time.perf_counter()
        action = scale(run.action)
        step = env.step(action)
        t1 = time.perf_counter()
        check_finite(run, step, run.step)
        if run.step >= run.next_look:
            look_at_bounds(run, step.obs)
        if learner.observe is not None:
            run.running_return = np.where(run.ended, 0.0, config.gamma * run.running_return) + step.reward
        run.replay.add(run.action, step.reward, step.terminated, step.obs, active)
        taken = n_envs if active is None else len(active)
        run.step += taken
        run.seconds["total"] = t1 - began
        episodes = book(run, step, None if active is None else np.arange(n_envs) < taken)
        t2 = time.perf_counter()
        last_obs = last_of(run, step)
        run.obs = step.obs if last_obs is None else reset_done(run, run.ended)
        t3 = time.perf_counter()
        if np.count_nonzero(run.ended):
            run.replay.begin(run.obs, np.flatnonzero(run.ended))

        if learner.observe is not None:
            run.watch.observe(run, learner)
        done = progress(run.step - first)
        n_updates = due(run, config, taken, len(episodes))
        sizes = chunks(n_updates, per_turn)
        t4 = time.perf_counter()
        clock = clock_of(run, done)
        if config.overlap:
            chosen = choose_or_draw(run, learner, config, clock)
        t5 = time.perf_counter()
        shapes = [(config.batch_size,) if size == 1 else (size, config.batch_size) for size in sizes]
        samples = [run.replay.draw(run.rng, shape, done) for shape in shapes]
        t6 = time.perf_counter()
        run.replay.reprioritise(run.td_errors)
        run.td_errors = []
        n_before = len(run.watch)
        for batch, drawn in samples:
            td_error = run.watch.update(run, learner, batch, clock)
            if td_error is not None:
                run.td_errors.append((drawn, td_error))
        run.n_updates += n_updates
        if not config.overlap:
            chosen = choose_or_draw(run, learner, config, clock)
        run.action = np.asarray(chosen)
        run.watch.read(run, learner, n_before)  # the actions came after them
        t7 = time.perf_counter()
        run.seconds["env"] += (t1 - t0) + (t3 - t2)
        run.seconds["replay"] += (t2 - t1) + (t4 - t3) + (t6 - t5)
        run.seconds["update"] += (t5 - t4) + (t7 - t6)
        run.seconds["total"] = t7 - began
        ended = n_updates > 0 or (run.step <= run.learn_from and reaches(run, config, taken, len(episodes)))
        yield Progress(run.step, episodes, run.metrics, action, step, last_obs, ended)


def begin_episodes(run: Run) -> None:
    """Begins an episode in every environment; those that run are given up."""
    restart(run)
    run.replay.begin(run.obs)


def choose_or_draw(run: Run, learner: Learner, config: OffPolicyConfig, clock: Clock) -> np.ndarray | Array:
    """Returns random actions at first, then the exploring policy's; see :func:`rejeu.loops.run.choose`."""
    if run.step < config.learning_starts:
        return random_action(run.env.action_space, run.env.n_envs, run.rng)
    return choose(run, learner, clock)


def due(run: Run, config: OffPolicyConfig, taken: int, ended: int) -> int:
    """Returns how many gradient steps this turn owes; counts what has passed since the last ones."""
    if run.step <= run.learn_from:
        return 0
    taken = min(taken, run.step - run.learn_from)
    run.steps_since_update += taken
    if isinstance(config.train_freq, int):
        run.owed += taken
        every = config.train_freq
    else:
        run.owed += ended
        every = config.train_freq[0]
    times, run.owed = divmod(run.owed, every)
    if not times or not run.replay.size():
        return 0
    steps, run.steps_since_update = run.steps_since_update, 0
    return steps if config.gradient_steps == -1 else times * config.gradient_steps


def reaches(run: Run, config: OffPolicyConfig, taken: int, ended: int) -> bool:
    """Returns whether a turn of ``taken`` steps, in which ``ended`` episodes ended, completes what ``train_freq`` asks for."""
    if isinstance(config.train_freq, int):
        count, passed, every = run.step, taken, config.train_freq
    else:
        count, passed, every = run.episode, ended, config.train_freq[0]
    return count // every > (count - passed) // every


def updates_per_turn(config: OffPolicyConfig, n_envs: int) -> int:
    """Returns how many gradient steps one turn usually owes: the size for which the scan is learner, at most 64."""
    if isinstance(config.train_freq, int) and config.gradient_steps > 0:
        return min(max(n_envs // config.train_freq, 1) * config.gradient_steps, 64)
    return 16


def chunks(n: int, usual: int) -> list[int]:
    """Returns ``n`` as a sum of the usual size and of ones, so that only two sizes are ever learner."""
    return [usual] * (n // usual) + [1] * (n % usual)
