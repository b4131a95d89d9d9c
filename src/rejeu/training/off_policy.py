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

from collections.abc import Callable, Iterator, Sequence

import jax
import numpy as np
from jax import Array

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core.algorithm import Clock, PyTree, unmasked
from rejeu.core.spaces import action_scaler, random_action
from rejeu.envs.base import Step
from rejeu.exploration.explorer import memory_in
from rejeu.replay.hindsight import HerReplayBuffer
from rejeu.replay.uniform import ReplayBuffer
from rejeu.training.checks import check_state, checked_reset, checked_restart, checked_step
from rejeu.training.finite import gradient_steps
from rejeu.training.learner import Learner
from rejeu.training.run import Episode, Progress, Run, clock_of, record_step, start_clock, timed

STEPS_OFFLINE = 100
"""Gradient steps in one call, where no environment is stepped."""
Choice = tuple[np.ndarray | Array, int]
"""Actions, which the device may still be computing, and the number of updates that were started before them."""


def off_policy(
    run: Run, learner: Learner, config: OffPolicyConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Trains until ``n_steps`` environment steps are taken (None: until the caller stops), yielding after every turn.

    Args:
        run: mutated; consistent whenever the generator has yielded.
        learner: the algorithm.
        config: its hyperparameters.
        n_steps: over all environments; the turn that reaches it is the last.
        progress: returns the progress of schedules after a number of steps.

    Raises:
        BadEnvironmentError: if a reward or an observation is not finite.
        NonFiniteError: if the state is not finite when training begins.
        NonFiniteUpdate: if an update leaves numbers that are not finite.
    """
    env, scale = run.env, action_scaler(run.env.action_space)
    first, last = run.step, None if n_steps is None else run.step + n_steps
    check_state(run, learner)
    start_clock(run)
    while last is None or run.step < last:
        if run.obs is None or env.must_reset:
            run.replay.begin(checked_restart(run))
        if run.action is None:
            run.action = np.array(choose(run, learner, config, clock_of(run, progress(run.step - first)))[0])
        action = scale(run.action)
        step = checked_step(run, action, config)
        episodes = store(run, learner, config, step)
        last_obs = begin_where_ended(run, step)
        if learner.observe is not None:
            observe(run, learner)
        done = progress(run.step - first)
        clock = clock_of(run, done)
        n_updates = due(run, config, len(episodes))
        if config.overlap:
            choice = choose(run, learner, config, clock)
        samples = sample(run, config, n_updates, done)
        update(run, learner, samples, clock)
        if not config.overlap:
            choice = choose(run, learner, config, clock)
        read(run, choice)
        ended = n_updates > 0 or (run.step <= run.learn_from and reaches(run, config, len(episodes)))
        yield Progress(run.step, episodes, run.metrics, action, step, last_obs, ended)


def offline(
    run: Run, learner: Learner, config: OffPolicyConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Takes ``n_steps`` gradient steps on what the replay buffer holds, each of which counts as a step of training.

    No environment is stepped. The arguments are those of :func:`off_policy`. Yields after every :data:`STEPS_OFFLINE` steps,
    counted from the start of the run, so that a resumed run makes the same calls.
    """
    first, last = run.step, None if n_steps is None else run.step + n_steps
    check_state(run, learner)
    start_clock(run)
    while last is None or run.step < last:
        n = STEPS_OFFLINE - run.step % STEPS_OFFLINE
        n = n if last is None else min(n, last - run.step)
        learn_from(run, learner, config, run.replay, [progress(run.step + i - first) for i in range(n)])
        run.step += n
        run.monitor.check(run.state)
        yield Progress(run.step, [], run.metrics)


def learn_from(
    run: Run,
    learner: Learner,
    config: OffPolicyConfig,
    replay: ReplayBuffer | HerReplayBuffer,
    progress: Sequence[float],
    before: int = 0,
) -> None:
    """Starts gradient steps on batches of a replay buffer in one call, one for each progress of schedules.

    Each counts as an environment step beside the run's, for target networks that move after these; so do those ``before``.
    """
    n = len(progress)
    batch, drawn = replay.draw(run.rng, (n, config.batch_size), progress[0])
    steps = run.step + before + np.arange(n)
    clock = Clock(steps.astype(np.uint32), np.full(n, run.episode, np.uint32), np.asarray(progress, np.float32))
    update(run, learner, [(batch, drawn)], clock)
    run.td_errors = []


@timed("replay")
def store(run: Run, learner: Learner, config: OffPolicyConfig, step: Step) -> list[Episode]:
    """Adds a step to the replay buffer and to the running episodes, and returns the episodes that ended."""
    if learner.observe is not None:
        before = np.where(run.ended, np.float32(0), run.running_return)
        run.running_return = config.gamma * before + step.reward
    run.replay.add(run.action, step.reward, step.terminated, step.obs)
    run.step += run.env.n_envs
    return record_step(run, step)


def begin_where_ended(run: Run, step: Step) -> PyTree:
    """Starts new episodes where the step ended some.

    ``run.obs`` are then the observations to act on next. Returns a copy of the last ones; None if no episode ended.
    """
    run.obs = step.obs
    if not np.count_nonzero(run.ended):
        return None
    last_obs = jax.tree.map(np.copy, step.obs)
    run.obs = checked_reset(run, run.ended)
    run.replay.begin(run.obs, np.flatnonzero(run.ended))
    return last_obs


@timed("update")
def choose(run: Run, learner: Learner, config: OffPolicyConfig, clock: Clock) -> Choice:
    """Returns random actions at first, then those of the exploring policy, and how many updates are done when they are.

    A policy with memory remembers the observations of random actions too, and the replay buffer what it remembered.
    ``run.obs`` must not change before they are read.
    """
    random = None
    if run.step < config.learning_starts:
        random = random_action(run.env.action_space, run.env.n_envs, run.rng, unmasked(run.obs)[1])
        if learner.algorithm.recall is None:
            return random, len(run.monitor)
    if learner.algorithm.recall is not None:
        run.replay.ring.remember(np.asarray(memory_in(run.carry)), run.ended)
    action, run.carry = learner.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
    if random is None:
        return action, len(run.monitor)
    jax.block_until_ready(action)  # until then the device may read the observations
    return random, len(run.monitor)


@timed("update")
def read(run: Run, choice: Choice) -> None:
    """Waits for the actions, and checks the updates that were started before them."""
    run.action = np.asarray(choice[0])
    run.monitor.read(choice[1])


@timed("update")
def observe(run: Run, learner: Learner) -> None:
    """Adds the new observations to the statistics of the state.

    They are copied: the device may read an array after the environments have written the next step to it.
    """
    assert learner.observe is not None
    run.state = learner.observe(run.state, jax.tree.map(np.copy, run.obs), run.running_return)


@timed("replay")
def sample(run: Run, config: OffPolicyConfig, n_updates: int, progress: float) -> list[tuple[PyTree, PyTree]]:
    """Returns the batches of a number of gradient steps, each with its draw."""
    shapes = batch_shapes(n_updates, config, run.env.n_envs)
    return [run.replay.draw(run.rng, shape, progress) for shape in shapes]


@timed("update")
def update(run: Run, learner: Learner, samples: list[tuple[PyTree, PyTree]], clock: Clock) -> None:
    """Starts and counts the updates on samples, and sets priorities by the TD errors of the last ones."""
    run.replay.update_priorities(run.td_errors)
    run.td_errors = []
    for batch, drawn in samples:
        run.state, run.metrics, td_error = run.monitor.update(learner.update, run.state, batch, clock, run.n_updates)
        run.n_updates += gradient_steps(batch.reward)
        if td_error is not None:
            run.td_errors.append((drawn, td_error))


def due(run: Run, config: OffPolicyConfig, ended: int) -> int:
    """Returns the number of gradient steps of this turn, and counts the steps since the last update."""
    if run.step <= run.learn_from:
        return 0
    n_counted = min(run.env.n_envs, run.step - run.learn_from)
    run.steps_since_update += n_counted
    new, every = (n_counted, config.train_freq) if isinstance(config.train_freq, int) else (ended, config.train_freq[0])
    run.owed += new
    times, run.owed = divmod(run.owed, every)
    if not times or not run.replay.size():
        return 0
    steps, run.steps_since_update = run.steps_since_update, 0
    return steps if config.gradient_steps == -1 else times * config.gradient_steps


def reaches(run: Run, config: OffPolicyConfig, ended: int) -> bool:
    """Returns whether a turn in which ``ended`` episodes ended completes a period of ``train_freq``."""
    if isinstance(config.train_freq, int):
        count, passed, every = run.step, run.env.n_envs, config.train_freq
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
    single: tuple[int, ...] = (config.batch_size,)
    several = single if usual == 1 else (usual, config.batch_size)
    return [several] * (n_updates // usual) + [single] * (n_updates % usual)
