"""The loop of on-policy learning: environments fill a rollout under one policy, and the policy learns from all of it.

:func:`on_policy` is a generator: it trains, and whoever iterates it decides what else happens. One turn is one step of all
environments; where it fills the rollout, the update follows, one call into compiled code for all epochs and minibatches.
Acting costs one call for all environments, and gives actions only: the values and log-probabilities that learning needs
are computed with the update, in one pass over the rollout.

The rollout is handed to XLA as it lies in memory, and written to again only after the next actions were read, which the
update must precede.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from rejeu.algorithms.actor_critic import OnPolicyConfig
from rejeu.core import PyTree
from rejeu.envs.make import Step
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
from rejeu.spaces import action_scaler


def on_policy(
    run: Run, learner: Learner, config: OnPolicyConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps (None: until the caller stops), yielding after every turn.

    A rollout that is not complete after the last step is learned from if ``config.learns_from_part`` says that it holds
    enough. Otherwise it stays in the buffer, and the next call adds to it.

    Args:
        run: mutated; consistent whenever the generator has yielded. ``run.replay`` is a rollout buffer.
        learner: the algorithm.
        config: its hyper-parameters.
        n_steps: over all environments; where their number does not divide it, the last turn keeps as many as remain.
        progress: gives the progress of schedules after so many steps.

    Raises:
        BadEnvironmentError: if a reward or an observation is not finite.
        NonFiniteError: if the state is not finite to begin with.
        Broken: if an update leaves numbers that are not finite.
    """
    env, n_envs, scale, rollout = run.env, run.env.n_envs, action_scaler(run.env.action_space), run.replay
    first, last = run.step, None if n_steps is None else run.step + n_steps
    began = time.perf_counter() - run.seconds["total"]
    check_state(run, learner)
    while last is None or run.step < last:
        if run.obs is None or (env.must_reset and not rollout.length):
            begin_episodes(run, config)
        t0 = time.perf_counter()
        run.action = np.asarray(choose(run, learner, clock_of(run, progress(run.step - first))))
        run.watch.read(run, learner)  # while the rollout that it learnt from still stands
        rollout.observe(run.obs)
        t1 = time.perf_counter()
        stepped = None if config.n_episodes is None or run.playing.all() else run.playing > 0
        action = scale(run.action)
        step = env.step(action, stepped)
        t2 = time.perf_counter()
        check_finite(run, step, run.step)
        if run.step >= run.next_look:
            look_at_bounds(run, step.obs)
        counts = which_count(run, stepped, last)
        run.running_return = np.where(run.ended, 0.0, config.gamma * run.running_return) + step.reward
        valid = True if counts is None else counts
        rollout.add(run.action, step.reward, step.terminated, step.truncated, step.obs, run.running_return, valid)
        run.step += n_envs if counts is None else int(counts.sum())
        run.seconds["total"] = t2 - began
        episodes = book(run, step, counts, stepped)
        rollout.cut(run.ended)
        if config.n_episodes is not None:
            run.playing -= run.ended
        is_complete = rollout.full or (config.n_episodes is not None and not run.playing.any())
        is_done = is_complete or (run.step == last and config.learns_from_part(rollout.size(), n_envs))
        t3 = time.perf_counter()
        last_obs = last_of(run, step)
        run.obs = renewed(run, step, config, is_done)
        t4 = time.perf_counter()
        if is_done:
            clock = clock_of(run, progress(run.step - first))
            n_updates = config.gradient_steps(rollout.size())
            run.watch.update(run, learner, rollout.rollout(), clock)
            assert run.metrics is not None
            run.n_updates += int(run.metrics["gradient_steps"]) if config.stops_early else n_updates
            begin(run, config)
        t5 = time.perf_counter()
        run.seconds["env"] += (t2 - t1) + (t4 - t3)
        run.seconds["replay"] += t3 - t2
        run.seconds["update"] += (t1 - t0) + (t5 - t4)
        run.seconds["total"] = t5 - began
        yield Progress(run.step, episodes, run.metrics, action, step, last_obs, is_done)


def begin_episodes(run: Run, config: OnPolicyConfig) -> None:
    """Begins an episode in every environment; those that run are given up.

    The rollout under way keeps its steps, unless it is to hold whole episodes: then it begins again too.
    """
    restart(run)
    if run.replay.length and config.n_episodes is None:
        run.replay.cut()
    else:
        begin(run, config)


def begin(run: Run, config: OnPolicyConfig) -> None:
    """Begins a rollout where the environments stand."""
    run.replay.begin(run.carry, run.ended)
    run.playing = np.full(run.env.n_envs, config.n_episodes or 0)


def which_count(run: Run, stepped: np.ndarray | None, last: int | None) -> np.ndarray | None:
    """Returns of which environments the step is kept, ``bool (n_envs,)``; None for all."""
    n_envs = run.env.n_envs
    remaining = counted(run, n_envs if stepped is None else int(stepped.sum()), last)
    if remaining is None:
        return stepped
    among = np.ones(n_envs, bool) if stepped is None else stepped
    return among & (np.cumsum(among) <= remaining)


def renewed(run: Run, step: Step, config: OnPolicyConfig, is_done: bool) -> PyTree:
    """Returns the observations to act on next, episodes begun anew where they ended.

    Where rollouts are whole episodes, an environment that has played its share waits, and all begin anew together.
    """
    if config.n_episodes is None:
        return reset_done(run, run.ended) if run.ended.any() else step.obs
    if is_done:
        run.ended = np.ones(run.env.n_envs, bool)
        run.episode_return[:], run.episode_length[:] = 0.0, 0  # of episodes that the update cut off
        return reset_done(run, run.ended)
    renew = run.ended & (run.playing > 0)
    return reset_done(run, renew) if renew.any() else step.obs
