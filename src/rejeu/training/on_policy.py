"""The loop of on-policy learning: environments fill a rollout under one policy, and the policy learns from all of it.

:func:`on_policy` is a generator that trains while its caller iterates over it. One turn is one step of all
environments. When the rollout is full, the update follows: one call of compiled code for all epochs and minibatches.
Acting takes one call for all environments and returns actions only. The values and log-probabilities for learning are
computed with the update, in one pass over the rollout.

XLA reads the rollout without a copy. The rollout is written to again only after the next actions were read, which
requires that the update is done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import numpy as np

from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.core.algorithm import GRADIENT_STEPS, Clock, PyTree
from rejeu.core.spaces import action_scaler
from rejeu.envs.base import Step
from rejeu.training.checks import check_state, checked_reset, checked_restart, checked_step
from rejeu.training.learner import Learner
from rejeu.training.run import Episode, Progress, Run, clock_of, in_episodes, record_step, start_clock, timed


def on_policy(
    run: Run, learner: Learner, config: RolloutConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Trains until ``n_steps`` environment steps are taken (None: until the caller stops), yielding after every turn.

    A rollout of whole episodes that is under way then is completed. One of a number of steps stays in the buffer, and the
    next call adds to it.

    Args:
        run: mutated; consistent whenever the generator has yielded. ``run.replay`` is a rollout buffer.
        learner: the algorithm.
        config: its hyperparameters.
        n_steps: over all environments; :func:`steps_to_take` rounds it up to whole rollouts.
        progress: returns the progress of schedules after a number of steps.

    Raises:
        BadEnvironmentError: if a reward or an observation is not finite.
        NonFiniteError: if the state is not finite when training begins.
        NonFiniteUpdate: if an update leaves numbers that are not finite.
    """
    env, scale, rollout = run.env, action_scaler(run.env.action_space), run.replay
    first, last = run.step, None if n_steps is None else run.step + n_steps
    check_state(run, learner)
    start_clock(run)
    while last is None or run.step < last or in_episodes(run):
        if run.obs is None or (env.must_reset and not rollout.length):
            begin_episodes(run, config, learner)
        run.action = act(run, learner, clock_of(run, progress(run.step - first)))
        stepped = None if config.n_episodes is None or run.playing.all() else run.playing > 0
        action = scale(run.action)
        step = checked_step(run, action, config, stepped)
        episodes = store(run, config, step, stepped)
        is_done = rollout.full if config.n_episodes is None else not run.playing.any()
        last_obs = jax.tree.map(np.copy, step.obs) if run.ended.any() else None
        run.obs = next_obs(run, step, config, is_done)
        if is_done:
            update(run, learner, config, clock_of(run, progress(run.step - first)))
            begin(run, config)
        elif rollout.full:  # by turns that not all environments took: its episodes are played again
            rollout.length, run.obs = 0, None
        yield Progress(run.step, episodes, run.metrics, action, step, last_obs, is_done)


@timed("update")
def act(run: Run, learner: Learner, clock: Clock) -> np.ndarray:
    """Returns the actions at the current observations, and puts these into the rollout."""
    choice, run.carry = learner.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
    action = np.asarray(choice)
    run.monitor.check(run.state)  # before the rollout of the last update is overwritten
    run.replay.observe(run.obs)
    return action


@timed("replay")
def store(run: Run, config: RolloutConfig, step: Step, stepped: np.ndarray | None) -> list[Episode]:
    """Adds a step to the rollout and to the running episodes, and returns the episodes that ended.

    ``stepped`` are the environments that took it, ``bool (n_envs,)``; None stands for all.
    """
    run.running_return = np.where(run.ended, 0.0, config.gamma * run.running_return) + step.reward
    valid = True if stepped is None else stepped
    run.replay.add(run.action, step.reward, step.terminated, step.truncated, step.obs, run.running_return, valid)
    run.step += run.env.n_envs if stepped is None else int(stepped.sum())
    episodes = record_step(run, step, stepped)
    if config.n_episodes is not None:
        end_long_episodes(run, config)
        run.playing -= run.ended
    run.replay.cut(run.ended)
    return episodes


@timed("update")
def update(run: Run, learner: Learner, config: RolloutConfig, clock: Clock) -> None:
    """Starts the update on the rollout, and counts its gradient steps."""
    n_updates: float = config.gradient_steps(run.replay.size())
    rollout = run.replay.rollout()
    run.state, run.metrics, _ = run.monitor.update(learner.update, run.state, rollout, clock, run.n_updates)
    if config.stops_early:  # NaN of an update that was undone
        n_updates = float(np.nan_to_num(run.metrics[GRADIENT_STEPS], nan=n_updates))
    run.n_updates += int(n_updates)


def begin_episodes(run: Run, config: RolloutConfig, learner: Learner | None = None) -> None:
    """Starts an episode in every environment, which ends the running ones.

    The current rollout keeps its steps, unless it is full, because an error prevented the update, or rollouts hold whole
    episodes: then it starts again too, and with it what ``learner`` carries, such as the number of the episode.
    """
    checked_restart(run)
    if config.n_episodes is not None and learner is not None:
        run.carry = learner.initial_carry(run.env.n_envs)
    if 0 < run.replay.length < run.replay.n_steps and config.n_episodes is None:
        run.replay.cut()
    else:
        begin(run, config)


def begin(run: Run, config: RolloutConfig) -> None:
    """Starts a rollout at the current observations."""
    run.replay.begin(run.carry, run.ended)
    run.playing = np.full(run.env.n_envs, 0 if config.n_episodes is None else config.episodes(run.env.n_envs))


def steps_to_take(run: Run, config: RolloutConfig, n_steps: int) -> int:
    """Returns ``n_steps`` environment steps rounded up, so that they end with a rollout.

    The end of a rollout of whole episodes is not known before; then it is ``n_steps``.
    """
    if config.n_episodes is not None:
        return n_steps
    n_envs, turns_of_rollout = run.env.n_envs, run.replay.n_steps
    turns_before = run.replay.length % turns_of_rollout
    turns = -(-n_steps // n_envs) + turns_before
    return (-(-turns // turns_of_rollout) * turns_of_rollout - turns_before) * n_envs


def end_long_episodes(run: Run, config: RolloutConfig) -> None:
    """Ends episodes that have taken all the steps that a rollout has room for in each; the history leaves them out."""
    is_long = run.episode_length >= run.replay.n_steps // config.episodes(run.env.n_envs)
    run.ended |= is_long
    run.episode_return[is_long], run.episode_length[is_long] = 0.0, 0


def next_obs(run: Run, step: Step, config: RolloutConfig, is_done: bool) -> PyTree:
    """Returns the observations to act on next, and starts new episodes where some ended.

    If rollouts hold whole episodes, an environment that has played its share waits, and all start again together.
    """
    if config.n_episodes is None:
        return checked_reset(run, run.ended) if run.ended.any() else step.obs
    if is_done:
        run.ended = np.ones(run.env.n_envs, bool)
        run.episode_return[:], run.episode_length[:] = 0.0, 0  # of episodes that the update cut off
        return checked_reset(run, run.ended)
    renew = run.ended & (run.playing > 0)
    return checked_reset(run, renew) if renew.any() else step.obs
