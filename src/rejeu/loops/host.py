"""The loop between environments on the host and a compiled algorithm.

:func:`off_policy` is a generator: it trains, and whoever iterates it decides what else happens. One turn is one step of
all environments::

    environments step        while the update of the turn before still runs in XLA's own threads
    the ring keeps the step; episodes that ended are counted and begun anew
    actions are asked for    of the device, which chooses them as soon as that update is done
    batches are drawn        meanwhile
    the update is queued     one gradient step per environment step by default, all in one call
    the actions are read     while it begins

So the environments never wait for the gradient nor the gradient for them, and yet every number depends on the seed
alone: the action at a step always follows the update of the step before the last.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from rejeu.config import OffPolicyConfig
from rejeu.core import Clock, PyTree
from rejeu.envs.vector import Step, VectorEnv
from rejeu.errors import BadEnvironmentError
from rejeu.loops.compiled import Compiled, PackedState
from rejeu.replay.hindsight import HerReplayBuffer
from rejeu.replay.uniform import ReplayBuffer
from rejeu.spaces import action_scaler, random_action


class Episode(NamedTuple):
    """One finished episode."""

    step: int
    """Environment steps taken in all when it ended."""
    env: int
    """Which environment it ran in."""
    episode_return: float
    """Sum of its rewards."""
    length: int
    """Steps that it took."""
    success: float
    """1.0 or 0.0, NaN if the environment does not say."""
    seconds: float
    """Wall time since training began when it ended."""


class Progress(NamedTuple):
    """What one turn of the loop did."""

    step: int
    """Environment steps taken in all."""
    episodes: list[Episode]
    """Those that ended in this turn."""
    metrics: Mapping[str, Array] | None
    """Of the newest update, on the device: reading one waits for it. None before the first."""


@dataclass
class Run:
    """Everything that a loop carries from turn to turn, and that a checkpoint of a run must hold. Mutable."""

    env: Any
    """The environments, a :class:`VectorEnv`; None for an agent that only predicts."""
    replay: Any
    """The replay buffer; None likewise."""
    state: PackedState
    """The algorithm's state, packed (see :class:`Compiled`)."""
    key: Array
    """Root of the randomness of exploration."""
    rng: np.random.Generator
    """Draws batches and the first random actions."""
    carry: PyTree
    """What exploration remembers, per environment."""
    learn_from: int
    """The step from which on gradients are taken."""
    seed: int | None = None
    """Handed to the environments at their first reset."""
    step: int = 0
    episode: int = 0
    n_updates: int = 0
    obs: PyTree = None
    """The present observations; None before the first reset."""
    action: np.ndarray | None = None
    """Chosen for ``obs``, not yet taken; in the algorithm's range."""
    ended: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """Where the last turn ended an episode, ``(n_envs,)``."""
    owed: int = 0
    """Environment steps (or episodes) since gradients were last taken, where they are not taken at every turn."""
    steps_since_update: int = 0
    episode_return: np.ndarray = field(default_factory=lambda: np.zeros(0))
    episode_length: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    metrics: Mapping[str, Array] | None = None
    td_errors: list[Array] = field(default_factory=list)
    """Of the newest updates, on their way to the priorities of the replay buffer, which get them one turn later."""
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("env", "replay", "update", "total"), 0.0))
    """Wall time by what it went into; ``update`` is the time that the loop waited for the device."""


def off_policy(
    run: Run, compiled: Compiled, config: OffPolicyConfig, n_steps: int | None, progress: Callable[[int], float]
) -> Iterator[Progress]:
    """Trains for exactly ``n_steps`` environment steps (None: until the caller stops), yielding after every turn.

    Args:
        run: mutated; consistent whenever the generator has yielded.
        compiled: the algorithm.
        config: its hyper-parameters.
        n_steps: over all environments; where their number does not divide it, the last turn keeps as many as remain.
        progress: gives the fraction of the run that is done after so many steps of it; schedules follow it.

    Raises:
        BadEnvironmentError: if a reward is not a finite number.
    """
    env, n_envs, scale = run.env, run.env.n_envs, action_scaler(run.env.action_space)
    first, last = run.step, None if n_steps is None else run.step + n_steps
    began = time.perf_counter() - run.seconds["total"]
    per_turn = updates_per_turn(config, n_envs)
    if run.obs is None:
        restart(run)
    if run.action is None:
        run.action = np.asarray(choose(run, compiled, config, clock_of(run, 0.0)))
    while last is None or run.step < last:
        active = None if last is None or last - run.step >= n_envs else np.arange(last - run.step)
        t0 = time.perf_counter()
        step = env.step(scale(run.action))
        t1 = time.perf_counter()
        check_rewards(step, env, run.step)
        run.replay.add(run.action, step.reward, step.terminated, step.obs, active)
        taken = n_envs if active is None else len(active)
        run.step += taken
        run.seconds["total"] = t1 - began
        episodes = book(run, step, active)
        t2 = time.perf_counter()
        if run.ended.any():
            run.obs = env.reset_done(run.ended)
        else:
            run.obs = step.obs
        t3 = time.perf_counter()
        if run.ended.any():
            run.replay.begin(run.obs, np.flatnonzero(run.ended))

        done = progress(run.step - first)
        n_updates = due(run, config, taken, len(episodes))
        sizes = chunks(n_updates, per_turn)
        t4 = time.perf_counter()
        clock = clock_of(run, done)
        chosen = choose(run, compiled, config, clock)
        t5 = time.perf_counter()
        samples = [run.replay.sample(run.rng, (size, config.batch_size), done) for size in sizes]
        t6 = time.perf_counter()
        run.replay.reprioritise(run.td_errors)
        run.td_errors = []
        for batch in samples:
            run.state, run.metrics, td_error = compiled.update(run.state, batch, clock)
            if td_error is not None:
                run.td_errors.append(td_error)
        run.n_updates += n_updates
        run.action = np.asarray(chosen)
        t7 = time.perf_counter()
        run.seconds["env"] += (t1 - t0) + (t3 - t2)
        run.seconds["replay"] += (t2 - t1) + (t4 - t3) + (t6 - t5)
        run.seconds["update"] += (t5 - t4) + (t7 - t6)
        run.seconds["total"] = t7 - began
        yield Progress(run.step, episodes, run.metrics)


def restart(run: Run) -> None:
    """Resets every environment and starts their episodes in the ring."""
    n_envs = run.env.n_envs
    run.obs = run.env.reset(run.seed)
    run.seed = None
    run.replay.begin(run.obs)
    run.ended = np.ones(n_envs, bool)
    run.episode_return = np.zeros(n_envs)
    run.episode_length = np.zeros(n_envs, np.int64)
    run.action = None


def choose(run: Run, compiled: Compiled, config: OffPolicyConfig, clock: Clock) -> np.ndarray | Array:
    """Returns the actions for the present observations: random ones at first, then the exploring policy's.

    The latter may still be under way on the device; ``run.obs`` must not change until they were read.
    """
    if run.step < config.learning_starts:
        return random_action(run.env.action_space, run.env.n_envs, run.rng)
    action, run.carry = compiled.act(run.state, run.carry, run.obs, run.ended, run.key, clock)
    return action


def clock_of(run: Run, progress: float) -> Clock:
    """Returns where the run stands, as arrays, so that no compiled function depends on the values."""
    return Clock(np.uint32(run.step), np.uint32(run.episode), np.float32(progress))


def book(run: Run, step: Step, active: np.ndarray | None) -> list[Episode]:
    """Adds a step to the running episodes and returns those that ended.

    Where only some environments are ``active``, the step of the others is not kept and their episodes are given up.
    """
    run.ended = step.terminated | step.truncated
    if active is not None:
        run.ended[len(active) :] = True
    counted = slice(None) if active is None else active
    run.episode_return[counted] += step.reward[counted]
    run.episode_length[counted] += 1
    if not run.ended.any():
        return []
    episodes = []
    for env in np.flatnonzero(run.ended).tolist():
        if active is None or env in active:
            run.episode += 1
            episodes.append(
                Episode(
                    run.step,
                    env,
                    float(run.episode_return[env]),
                    int(run.episode_length[env]),
                    run.env.success(step, env),
                    run.seconds["total"],
                )
            )
        run.episode_return[env] = 0.0
        run.episode_length[env] = 0
    return episodes


def check_rewards(step: Step, env: VectorEnv, taken: int) -> None:
    """Raises ``BadEnvironmentError`` if a reward is NaN or infinite: nothing can be learnt from it."""
    if not np.isfinite(step.reward).all():
        which = int(np.flatnonzero(~np.isfinite(step.reward))[0])
        raise BadEnvironmentError(
            f"{env.env_id} returned the reward {step.reward[which]} in environment {which} after {taken} steps; rewards "
            "must be finite numbers: mend the environment, or wrap it with gymnasium.wrappers.TransformReward"
        )


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


def updates_per_turn(config: OffPolicyConfig, n_envs: int) -> int:
    """Returns how many gradient steps one turn usually owes: the size for which the scan is compiled, at most 64."""
    if isinstance(config.train_freq, int) and config.gradient_steps > 0:
        return min(max(n_envs // config.train_freq, 1) * config.gradient_steps, 64)
    return 16


def chunks(n: int, usual: int) -> list[int]:
    """Returns ``n`` as a sum of the usual size and of ones, so that only two sizes are ever compiled."""
    return [usual] * (n // usual) + [1] * (n % usual)


def initial_run(
    env: VectorEnv | None, replay: ReplayBuffer | HerReplayBuffer | None, compiled: Compiled, learn_from: int, seed: int
) -> Run:
    """Returns the beginning of a run; ``seed`` determines everything that is drawn in it.

    Without environment and replay it serves an agent that only predicts.
    """
    learner_key, explore_key = jax.random.split(jax.random.PRNGKey(seed))
    return Run(
        env=env,
        replay=replay,
        state=compiled.init(learner_key),
        key=explore_key,
        rng=np.random.default_rng(seed),
        carry=compiled.initial_carry(1 if env is None else env.n_envs),
        learn_from=learn_from,
        seed=seed,
    )
