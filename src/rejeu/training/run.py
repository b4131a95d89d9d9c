"""The state of a training run, one call of ``learn``, and the bookkeeping that the loops share.

:mod:`rejeu.training.off_policy` and :mod:`rejeu.training.on_policy` are generators that train a :class:`Run` and yield its
:class:`Progress` after every turn.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jax import Array

from rejeu.core.algorithm import Clock, PyTree
from rejeu.core.records import Count, Duration, Positive, Seconds, convert
from rejeu.core.types import AnyArray, JsonObject
from rejeu.core.validation import number, whole
from rejeu.core.xla import clock
from rejeu.envs.base import Step, VectorEnv, seed_of_run
from rejeu.replay.prioritized import Draw
from rejeu.training.finite import NonFiniteMonitor
from rejeu.training.learner import Learner, PackedState

F = TypeVar("F", bound=Callable[..., Any])
MAX_STEP = 2**32 - 1
"""The last step of a run at most: steps are counted in ``uint32``."""
PARTS = ("env", "replay", "update")
"""Stepping environments; storing and sampling; waiting for the device."""


class Episode(NamedTuple):
    """One finished episode."""

    step: int
    """Total number of environment steps when it ended."""
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
    """The result of one turn of the loop."""

    step: int
    """Total number of environment steps taken."""
    episodes: list[Episode]
    """Those that ended in this turn."""
    metrics: Mapping[str, Array] | None
    """Of the newest update, on the device: reading one waits for it. None before the first."""
    action: np.ndarray | None = None
    """The actions of this turn, in the environments' own range."""
    result: Step | None = None
    """The step of the environments. Where episodes ended, its observations may already be those of the next ones."""
    last_obs: PyTree = None
    """A copy of the observations before new episodes began, in turns that ended some; None in others."""
    rollout_ended: bool = False
    """Whether this turn was the last before an update, or would have been if learning had begun."""


@dataclass
class Run:
    """Everything that a loop carries from turn to turn. Mutable; a checkpoint of a run holds all of it."""

    env: Any
    """The environments, a :class:`VectorEnv`; None for an agent that only predicts."""
    buffer: Any
    """The replay buffer or the rollout buffer, None for an agent that only predicts; read it as :attr:`replay`."""
    state: PackedState
    """The algorithm's state, packed (see :class:`Learner`)."""
    key: Array
    """Root of the randomness of exploration."""
    rng: np.random.Generator
    """Samples batches and the first random actions."""
    carry: PyTree
    """The state of exploration noise or of a recurrent policy, per environment."""
    monitor: NonFiniteMonitor
    """Checks whether updates leave finite numbers."""
    learn_from: int
    """The step after which updates begin."""
    success_threshold: float | None = None
    """Return at which an episode counts as a success; see :meth:`VectorEnv.judge`."""
    seed: int | None = None
    """Seed of the first reset."""
    step: int = 0
    episode: int = 0
    n_updates: int = 0
    obs: PyTree = None
    """The current observations; None before the first reset."""
    action: np.ndarray | None = None
    """Chosen for ``obs``, not yet taken; in the algorithm's range."""
    playing: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    """How many more episodes each environment has to play before the next update, where rollouts are whole episodes."""
    ended: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    """Where the last turn ended an episode, ``(n_envs,)``."""
    owed: int = 0
    """Environment steps (or episodes) since gradients were last taken, where they are not taken at every turn."""
    steps_since_update: int = 0
    episode_return: np.ndarray = field(default_factory=lambda: np.zeros(0))
    episode_length: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    running_return: np.ndarray = field(default_factory=lambda: np.zeros(0, np.float32))
    """The discounted sum of each running episode's rewards, ``sum_k gamma^k r_{t-k}``, for scaling rewards."""
    metrics: Mapping[str, Array] | None = None
    td_errors: list[tuple[Draw, Array]] = field(default_factory=list)
    """Those of the newest updates, each with the draw of its batch; they set the priorities of the replay buffer one turn
    later."""
    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys((*PARTS, "total"), 0.0))
    """Wall time of the parts of the loop, and in total; see :func:`timed`."""
    began: float = 0.0
    """When training would have begun had it not been interrupted; see :func:`start_clock`."""
    next_look: float = 0
    """The environment step of the next check that observations are within their declared bounds."""
    fingerprint: int | None = None
    """Of the environments when the last ``learn`` ended, to notice steps and resets by others; None before."""
    fetch: Callable[[], None] | None = None
    """Copies steps from the device to ``buffer``; None if it holds them all."""

    @property
    def replay(self) -> Any:
        """``buffer``, with all steps."""
        if self.fetch is not None:
            self.copy_replay()
        return self.buffer

    @replay.setter
    def replay(self, buffer: object) -> None:
        self.buffer, self.fetch = buffer, None

    def copy_replay(self) -> None:
        """Copies to ``buffer`` what a loop on the device has added to it there."""
        if self.fetch is not None:
            self.fetch()
            self.fetch = None  # not before: a copy that was interrupted is made again


def restart(run: Run) -> PyTree:
    """Resets all environments, which ends the running episodes, and returns the observations ``(n_envs, ...)``."""
    n_envs = run.env.n_envs
    run.obs = run.env.reset(run.seed if run.seed is None or run.env.seeds is None else run.env.seeds)
    run.seed = None
    run.ended = np.ones(n_envs, bool)
    run.episode_return = np.zeros(n_envs)
    run.episode_length = np.zeros(n_envs, np.int64)
    run.running_return = np.zeros(n_envs, np.float32)
    run.action = None
    return run.obs


def clock_of(run: Run, progress: float) -> Clock:
    """Returns the position in the run as arrays, so that no compiled function depends on the values."""
    n_envs = 1 if run.env is None else run.env.n_envs
    return Clock(np.uint32(run.step), np.uint32(run.episode), np.float32(progress), np.uint32(n_envs))


def record_step(run: Run, step: Step, stepped: np.ndarray | None = None) -> list[Episode]:
    """Adds a step to the returns and lengths of the running episodes and returns the episodes that ended.

    ``stepped`` are the environments that took it, ``bool (n_envs,)``; None stands for all.
    """
    run.ended = step.terminated | step.truncated
    run.episode_return += step.reward
    run.episode_length += 1 if stepped is None else stepped
    if not np.count_nonzero(run.ended):  # ten times as fast as any()
        return []
    episodes = []
    for env in np.flatnonzero(run.ended).tolist():
        run.episode += 1
        value = step.return_of(env, run.episode_return[env])
        success = run.env.judge(step, env, value, run.success_threshold)
        episodes.append(Episode(run.step, env, value, int(run.episode_length[env]), success, run.seconds["total"]))
        run.episode_return[env] = 0.0
        run.episode_length[env] = 0
    return episodes


def initial_run(
    env: VectorEnv | None,
    buffer: object,
    learner: Learner,
    learn_from: int,
    seed: int,
    state: PackedState | None = None,
) -> Run:
    """Returns a new run; ``seed`` determines all its random numbers.

    Without environment and buffer it is for an agent that only predicts. ``state`` is the state to start from.
    """
    learner_key, explore_key = jax.random.split(jax.random.PRNGKey(seed))
    return Run(
        env=env,
        buffer=buffer,
        state=learner.init(learner_key) if state is None else state,
        key=explore_key,
        rng=np.random.default_rng(seed),
        carry=learner.initial_carry(1 if env is None else env.n_envs),
        monitor=NonFiniteMonitor(learner.skips),
        learn_from=learn_from,
        seed=seed_of_run(seed),
    )


def start_clock(run: Run) -> None:
    """Goes on counting the wall time of a run in ``run.seconds``."""
    run.began = time.perf_counter() - run.seconds["total"]


def add_time(run: Run, phase: str, since: float) -> None:
    """Adds the wall time ``since`` a value of ``time.perf_counter`` to a phase of ``run.seconds``, and updates the total."""
    now, seconds = time.perf_counter(), run.seconds
    seconds[phase] += now - since
    seconds["total"] = now - run.began


def timed(phase: str) -> Callable[[F], F]:
    """Returns a decorator of functions ``(run, ...)`` that adds the time of each call to a phase of ``run.seconds``."""

    def decorate(function: F) -> F:
        @wraps(function)
        def call(run: Run, *arguments: object) -> Any:
            began = time.perf_counter()
            result = function(run, *arguments)
            add_time(run, phase, began)
            return result

        return call  # type: ignore[return-value]

    return decorate


def time_shares(seconds: Mapping[str, float]) -> dict[str, float]:
    """Returns the shares of ``seconds["total"]`` spent in ``env``, ``replay`` and ``update``, and the ``rest``.

    The rest is the loop's own bookkeeping and what runs between its turns: callbacks, evaluations, files. The shares sum
    to 1; before any time has passed all of it is rest.

    >>> time_shares({"env": 1.0, "replay": 1.0, "update": 5.0, "total": 8.0})
    {'env': 0.125, 'replay': 0.125, 'update': 0.625, 'rest': 0.125}
    """
    total = max(seconds["total"], 1e-9)
    shares = {activity: seconds[activity] / total for activity in PARTS}
    return shares | {"rest": 1.0 - sum(shares.values())}


def in_episodes(run: Run) -> bool:
    """Returns whether a rollout of whole episodes is under way."""
    return bool(run.playing.any() and run.buffer.length)


def last_countable(run: Run) -> int:
    """Returns the step at which a run ends that nothing else ends: the next turn might be beyond :data:`MAX_STEP`."""
    return MAX_STEP - run.env.n_envs


@dataclass
class TrainingCall:
    """One call of ``learn``. Mutable: ``logged`` is updated with each row of statistics."""

    n_steps: Positive | None
    """Environment steps to take at least; None for no such limit."""
    n_episodes: Positive | None
    """Episodes to finish; None for no such limit."""
    seconds: Duration | None
    """Time to take without compilation, in seconds; None for no such limit."""
    first_step: Count
    """Total environment steps when it started."""
    first_episode: Count
    """Total finished episodes when it started."""
    log_interval: Count
    """Episodes between two rows of statistics."""
    logged: Count
    """Episodes in the history when the last row was written."""
    last_step: Count | None
    """Total environment steps at which it is over; None without ``n_steps``."""
    steps_before: Count = 0
    """Environment steps before it that schedules count: those since the last ``learn`` that reset the counters."""
    episodes_before: Count = 0
    """Episodes before it that schedules count."""
    seconds_before: Seconds = 0.0
    """Training time before it that schedules count, in seconds."""
    spent: Seconds = 0.0
    """Time it had taken before it was last resumed, without compilation, in seconds."""
    began: float = dataclasses.field(default_factory=clock)
    """When it was started or last resumed, by :func:`rejeu.core.xla.clock`."""

    @property
    def elapsed(self) -> float:
        """Time it has taken, without interruptions and compilation, in seconds."""
        return self.spent + clock() - self.began

    def progress(self, step: AnyArray, episode: int) -> AnyArray:
        """Returns the progress of schedules, in [0, 1], after ``step`` environment steps and ``episode`` episodes in total.

        ``step`` is a number, or an array of numbers, each of which gets its own progress.

        As in Stable-Baselines3, earlier steps count as done and as part of the total: with 100 steps before and 300 to
        take, progress goes from 0.25 to 1, and stays there until the last rollout is complete. With several limits the
        nearest one counts.
        """
        by_steps = share(self.steps_before, step - self.first_step, self.n_steps)
        by_episodes = share(self.episodes_before, episode - self.first_episode, self.n_episodes)
        by_time = share(self.seconds_before, self.elapsed, self.seconds)
        others = max(by_episodes, by_time)
        if isinstance(by_steps, np.ndarray):
            return np.minimum(np.maximum(by_steps, others), 1.0)
        return min(max(by_steps, others), 1.0)

    def is_over(self, run: Run) -> bool:
        """Returns whether one of its limits is reached."""
        last_step = last_countable(run) if self.last_step is None else self.last_step
        by_steps = run.step >= last_step and not in_episodes(run)
        by_episodes = self.n_episodes is not None and run.episode - self.first_episode >= self.n_episodes
        return by_steps or by_episodes or (self.seconds is not None and self.elapsed >= self.seconds)

    def to_json(self) -> JsonObject:
        """Returns it as JSON values."""
        return {**{key: getattr(self, key) for key in SAVED}, "spent": self.elapsed}

    @classmethod
    def from_json(cls, saved: Mapping[str, object]) -> TrainingCall:
        """Returns the call that :meth:`to_json` saved, resumed now.

        Raises:
            CheckpointError: if the values are damaged.
        """
        call = convert(saved, cls)
        call.began = clock()
        return call


SAVED = [field.name for field in dataclasses.fields(TrainingCall) if field.name not in ("spent", "began")]


def checked_limits(
    total_timesteps: int | None, episodes: int | None, minutes: float | None
) -> tuple[int | None, int | None, float | None]:
    """Returns the limits of a ``learn``, as users give them, as numbers of steps, episodes and seconds.

    Raises:
        ValueError: if one is not a positive number.
    """
    return (
        None if total_timesteps is None else whole("total_timesteps", total_timesteps, least=1),
        None if episodes is None else whole("episodes", episodes, least=1),
        None if minutes is None else 60 * number("minutes", minutes, above=0),
    )


def share(before: float, n_done: AnyArray, limit: float | None) -> AnyArray:
    """Returns the share of ``before + limit`` that is done after ``n_done`` more; 0 without a limit.

    >>> share(100, 0, 300), share(100, 300, 300), share(100, 50, None)
    (0.25, 1.0, 0.0)
    """
    return 0.0 if limit is None else (before + n_done) / (before + limit)
