"""What else happens while an agent learns: evaluation, checkpoints, a progress bar, stopping early.

A callback is anything that ``agent.learn`` can call after every step of the environments as
``callback(agent, progress)``; ``False``, and nothing else, stops training. All frequencies are in environment steps,
whatever the number of environments.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.agents.checkpoints import Checkpoint as Checkpoint
from rejeu.config import whole
from rejeu.envs.auto_reset import DummyVecEnv
from rejeu.envs.vector import InProcess, VectorEnv, make_vector
from rejeu.evaluation import Evaluation
from rejeu.loops.host import Episode, Progress, time_shares

if TYPE_CHECKING:
    from rich.console import Console

    from rejeu.agents import Agent, Callback

REFRESH_SECONDS = 0.125
"""Least time between two refreshes of the progress bar on a terminal."""
LINE_SECONDS = 10.0
"""Least time between two lines of progress where the output is no terminal."""
EVALUATED = ("returns", "lengths", "successes")
"""The arrays of an :class:`Evaluation`."""
EVALUATION = 0x4556
"""Sets the random numbers of evaluations apart from all others."""
RATE_SECONDS = 10.0
"""Stretch over which the shown steps per second and shares of time are measured."""


class Evaluated(NamedTuple):
    """One evaluation during a run."""

    step: int
    """Environment steps taken in all when it was made."""
    evaluation: Evaluation
    """What it came to."""


class Evaluate:
    """Evaluates the deterministic policy every so many steps, on environments of its own, and keeps the best model.

    ``agent.restore_best()`` puts the best weights back.

    >>> import rejeu
    >>> evaluate = Evaluate("Pendulum-v1", every=200, episodes=2, seed=0)
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=400, seed=0).learn(400, evaluate)
    >>> [result.step for result in evaluate.results]
    [200, 400]
    """

    def __init__(
        self,
        env: str | gym.Env | Callable[[], gym.Env] | gym.vector.VectorEnv | VectorEnv,
        every: int,
        episodes: int = 20,
        best_path: str | Path | None = None,
        seed: int | None = None,
        report: Callable[[Evaluated, bool], object] | None = None,
    ) -> None:
        """Makes the environments at once, so that a wrong name is found before training.

        Args:
            env: as for the agent; an id or a function is made into at most 16 environments. Never the agent's own.
            every: environment steps between two evaluations.
            episodes: of each evaluation.
            best_path: where the best model so far is saved, replacing the one before it; None for nowhere.
            seed: with the number of steps taken, of the environments at each evaluation; None takes the agent's.
            report: called with each result and whether it is the best so far.
        """
        self.every = whole("every", every, least=1)
        self.episodes = whole("episodes", episodes, least=1)
        self.best_path = None if best_path is None else Path(best_path)
        self.report = report
        self.results: list[Evaluated] = []
        """Every evaluation so far, oldest first."""
        self.best: Evaluated | None = None
        """The best so far: by success rate, then by mean return."""
        self._made_here = isinstance(env, str) or callable(env)
        self.env = make_vector(env, min(self.episodes, 16) if self._made_here else 1, seed=seed)
        self.seed = seed
        self._last_step: int | None = None

    def __call__(self, agent: Agent, progress: Progress) -> None:
        """Evaluates if an evaluation has fallen due in this step."""
        before = step_before(agent, progress) if self._last_step is None else self._last_step
        self._last_step = progress.step
        if crossed(before, progress.step, self.every):
            self.run(agent, progress.step)

    def run(self, agent: Agent, step: int) -> Evaluated:
        """Evaluates now, whatever ``every`` says, and returns the result, which is also kept.

        Raises:
            ValueError: if the environments are those that the agent trains on.
        """
        if agent.env is not None and _identities(agent.env) & _identities(self.env):
            raise ValueError("Evaluate was given the environments that the agent trains on; give it others, or an id")
        root = agent.seed if self.seed is None else self.seed
        seed = int(np.random.SeedSequence([root, step, EVALUATION]).generate_state(1)[0])
        result = Evaluated(step, agent.evaluate(self.episodes, env=self.env, seed=seed))
        self.results.append(result)
        is_best = self.best is None or better(result.evaluation, self.best.evaluation)
        if is_best:
            self.best = result
            agent.remember_best(merit(result.evaluation), "evaluation")
            if self.best_path is not None:
                agent.save(self.best_path)
        if self.report is not None:
            self.report(result, is_best)
        return result

    def state_dict(self) -> dict[str, Any]:
        """Returns every result so far, as plain data for a checkpoint."""
        parts = [r.evaluation for r in self.results]
        columns = {key: [getattr(part, key) for part in parts] for key in EVALUATED}
        return {
            "steps": np.array([r.step for r in self.results], np.int64),
            "counts": np.array([len(part.returns) for part in parts], np.int64),
            **{key: np.concatenate([np.zeros(0), *arrays]) for key, arrays in columns.items()},
            "best": None if self.best is None else self.results.index(self.best),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes back what :meth:`state_dict` returned."""
        ends = np.cumsum(state["counts"])[:-1]
        returns, lengths, successes = (np.split(state[key], ends) for key in EVALUATED)
        parts = zip(state["steps"].tolist(), returns, lengths, successes, strict=False)
        self.results = [Evaluated(step, Evaluation(r, n.astype(int), s)) for step, r, n, s in parts]
        self.best = None if state["best"] is None else self.results[state["best"]]

    def close(self) -> None:
        """Releases the environments, unless they were given ready-made."""
        if self._made_here:
            self.env.close()


class Film:
    """Films the deterministic policy while it learns, every so many steps or training episodes.

    Each film is ``folder/step_<step>.mp4``, an episode or more in an environment of its own, so that training goes on as if
    nothing had been filmed, on any backend. To film the training episodes themselves, give the agent an environment in
    ``gymnasium.wrappers.RecordVideo``.
    """

    def __init__(
        self,
        folder: str | Path,
        every: int | None = None,
        *,
        every_episodes: int | None = None,
        env: str | gym.Env | Callable[[], gym.Env] | None = None,
        episodes: int = 1,
        max_steps: int = 1500,
        seed: int | None = None,
    ) -> None:
        """Films nothing yet.

        Args:
            folder: of the films; made with the first.
            every: environment steps between two films; None with ``every_episodes``.
            every_episodes: finished training episodes between two films.
            env: as for :func:`rejeu.record_video`; None takes new environments like the agent's own.
            episodes: of each film.
            max_steps: environment steps after which a film ends.
            seed: of the filmed environment, the same for every film; None draws one each time.

        Raises:
            ValueError: unless one of ``every`` and ``every_episodes`` is given.
        """
        if (every is None) == (every_episodes is None):
            raise ValueError(f"give one of every={every!r} (steps) and every_episodes={every_episodes!r}")
        self.every = None if every is None else whole("every", every, least=1)
        self.every_episodes = None if every_episodes is None else whole("every_episodes", every_episodes, least=1)
        self.folder, self.env, self.seed = Path(folder), env, seed
        self.episodes = whole("episodes", episodes, least=1)
        self.max_steps = max_steps
        self.paths: list[Path] = []
        """The films so far."""
        self._last_step: int | None = None
        self._n_episodes = 0

    def __call__(self, agent: Agent, progress: Progress) -> None:
        """Films if that has fallen due in this step."""
        before = step_before(agent, progress) if self._last_step is None else self._last_step
        self._last_step = progress.step
        episodes_before = self._n_episodes
        self._n_episodes += len(progress.episodes)
        if self.every is not None:
            due = crossed(before, progress.step, self.every)
        else:
            assert self.every_episodes is not None
            due = crossed(episodes_before, self._n_episodes, self.every_episodes)
        if due:
            from rejeu.video import record_video

            path = self.folder / f"step_{progress.step}.mp4"
            self.paths.append(record_video(agent, path, self.env, self.episodes, self.max_steps, self.seed))

    def state_dict(self) -> dict[str, Any]:
        """Returns what it counts, as plain data for a checkpoint."""
        return {"n_episodes": self._n_episodes, "paths": [str(path) for path in self.paths]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Takes back what :meth:`state_dict` returned."""
        self._n_episodes = int(state["n_episodes"])
        self.paths = [Path(path) for path in state["paths"]]


def stop_on_return(threshold: float, episodes: int = 100) -> Callback:
    """Returns a callback that stops once the mean return of the last ``episodes`` episodes is at least ``threshold``.

    >>> import rejeu
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=10_000, seed=0)
    >>> agent.learn(10_000, stop_on_return(-5_000, episodes=2)).num_timesteps
    400
    """
    return _stop_on_mean(threshold, episodes, lambda episode: episode.episode_return)


def stop_on_success(rate: float, episodes: int = 100) -> Callback:
    """Returns a callback that stops once at least ``rate`` (in [0, 1]) of the last ``episodes`` episodes succeeded.

    In an environment that does not say whether an episode succeeded it never stops.

    Raises:
        ValueError: if ``rate`` is not a share.
    """
    if not 0 <= rate <= 1:
        raise ValueError(f"rate={rate} must be a share in [0, 1]; for 90 % write 0.9")
    return _stop_on_mean(rate, episodes, lambda episode: episode.success)


def _stop_on_mean(least: float, episodes: int, value: Callable[[Episode], float]) -> Callback:
    whole("episodes", episodes, least=1)

    def stop(agent: Agent, progress: Progress) -> bool:
        last = agent.history.last(episodes) if progress.episodes else []
        return not (len(last) == episodes and np.mean([value(episode) for episode in last]) >= least)

    return stop


class _Mark(NamedTuple):
    """Where a run stood at a moment."""

    time: float
    step: int
    seconds: dict[str, float]
    """See :attr:`Agent.seconds`."""


class ProgressBar:
    """Shows how far training has come; on a terminal as a bar, elsewhere as a line every ten seconds.

    Beneath the bar, or at the end of the line, stands what the time went into: the environment's steps and resets, the replay
    buffer, the update (off-policy: the time that the loop waited for the device) and everything else.

    Between two refreshes a call costs a look at the clock.
    """

    def __init__(
        self,
        n_steps: int | None,
        seconds: float | None,
        console: Console | None = None,
        taken: int = 0,
        spent: float = 0.0,
    ) -> None:
        """Starts counting time; the bar appears with the first step.

        Args:
            n_steps: environment steps that will be taken, None if only time ends the run.
            seconds: wall time after which the run ends, None if only steps do.
            console: where to write; None: standard output.
            taken: how many of the steps a resumed run had taken before.
            spent: how much of the wall time it had taken, in seconds.
        """
        from rich.console import Console
        from rich.progress import BarColumn, Progress as RichProgress, TaskProgressColumn, TextColumn

        self.n_steps, self.seconds = n_steps, seconds
        self._console = Console() if console is None else console
        widgets = self._console.is_jupyter and importlib.util.find_spec("ipywidgets") is not None
        self._animated = widgets or (self._console.is_terminal and not self._console.is_dumb_terminal)
        columns = (BarColumn(bar_width=None), TaskProgressColumn(), TextColumn("{task.description}", markup=False))
        self._bar = RichProgress(*columns, console=self._console, auto_refresh=False, expand=True)
        self._task = self._bar.add_task("", total=1.0)
        self._began = time.perf_counter()
        self._refresh_at = 0.0
        self._taken, self._spent = taken, spent
        self._first_step = 0
        self._latest: tuple[Agent, int] | None = None
        self._shown_step = -1
        self._marks: deque[_Mark] = deque()

    def __call__(self, agent: Agent, progress: Progress) -> None:
        """Takes note of the step, and shows it if the last refresh is long enough ago."""
        now = time.perf_counter()
        if self._latest is None:
            self._start(agent, progress, now)
        self._latest = agent, progress.step
        if now >= self._refresh_at:
            self._refresh(agent, progress.step, now)

    def close(self) -> None:
        """Shows where the run ended and gives the terminal back."""
        if self._latest is None:
            return
        agent, step = self._latest
        if step != self._shown_step:
            self._refresh(agent, step, time.perf_counter())
        if self._animated:
            self._bar.stop()

    def _start(self, agent: Agent, progress: Progress, now: float) -> None:
        before = step_before(agent, progress, None if self.n_steps is None else self.n_steps - self._taken)
        self._first_step = before - self._taken
        self._marks.append(_Mark(self._began, before, agent.seconds))
        if self._animated:
            self._bar.start()
        else:
            self._refresh_at = now + LINE_SECONDS

    def _refresh(self, agent: Agent, step: int, now: float) -> None:
        self._shown_step = step
        self._refresh_at = now + (REFRESH_SECONDS if self._animated else LINE_SECONDS)
        self._marks.append(_Mark(now, step, agent.seconds))
        while len(self._marks) > 2 and self._marks[1].time <= now - RATE_SECONDS:
            self._marks.popleft()
        then, done = self._marks[0], step - self._first_step
        rate = (step - then.step) / max(now - then.time, 1e-9)
        shares, left = [], []
        if self.n_steps is not None:
            shares.append(done / self.n_steps)
            left.append((self.n_steps - done) / max(rate, 1e-9))
        if self.seconds is not None:
            spent_seconds = self._spent + now - self._began
            shares.append(spent_seconds / self.seconds)
            left.append(max(self.seconds - spent_seconds, 0.0))
        share = min(max(shares, default=0.0), 1.0)
        text = status(
            done, self.n_steps, rate, _mean(e["r"] for e in agent.ep_info_buffer), _mean(agent.ep_success_buffer),
            min(left, default=math.nan),
        )  # fmt: skip
        spent = time_spent(then.seconds, agent.seconds)
        if self._animated:
            self._bar.update(self._task, completed=share, description="\n".join(filter(None, (text, spent))))
            self._bar.refresh()
        else:
            line = " · ".join(filter(None, (text, spent)))
            self._console.print(f"{share:4.0%}  {line}", soft_wrap=True, highlight=False, markup=False)
            self._console.file.flush()


def status(
    step: int, n_steps: int | None, rate: float, mean_return: float, success_rate: float, seconds_left: float
) -> str:
    """Returns one line on a run: steps, steps per second, return, success rate, time left; NaN is left out.

    >>> status(1500, 20_000, 812.3, -1204.5, math.nan, 22.8)
    '1,500/20,000 steps · 812/s · return -1,204.50 · 0:23 left'
    """
    parts = [f"{step:,}" + ("" if n_steps is None else f"/{n_steps:,}") + " steps", f"{rate:,.0f}/s"]
    if not math.isnan(mean_return):
        parts.append(f"return {mean_return:,.2f}")
    if not math.isnan(success_rate):
        parts.append(f"success {success_rate:.0%}")
    if not math.isnan(seconds_left):
        parts.append(f"{duration(seconds_left)} left")
    return " · ".join(parts)


def time_spent(before: Mapping[str, float], now: Mapping[str, float]) -> str:
    """Returns what the time between two readings of ``agent.seconds`` went into, empty if none has passed.

    >>> time_spent(
    ...     {"env": 1.0, "replay": 0.5, "update": 3.0, "total": 5.0},
    ...     {"env": 2.2, "replay": 1.4, "update": 10.0, "total": 15.0},
    ... )
    'env 12% · replay 9% · update 70% · rest 9%'
    """
    passed = {part: now[part] - before[part] for part in now}
    if passed["total"] <= 0.0:
        return ""
    return " · ".join(f"{part} {max(share, 0.0):.0%}" for part, share in time_shares(passed).items())


def duration(seconds: float) -> str:
    """Returns a time as ``m:ss`` or ``h:mm:ss``.

    >>> duration(59.6), duration(3725)
    ('1:00', '1:02:05')
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def better(evaluation: Evaluation, other: Evaluation) -> bool:
    """Returns whether an evaluation beats another: by success rate, then by mean return.

    An unknown success rate counts as none, so where the environment does not say, the return decides.
    """
    return merit(evaluation) > merit(other)


def crossed(before: int, now: int, every: int) -> bool:
    """Returns whether a multiple of ``every`` lies in ``(before, now]``.

    >>> [now for now in range(8, 41, 8) if crossed(now - 8, now, 10)]
    [16, 24, 32, 40]
    """
    return now // every > before // every


def step_before(agent: Agent, progress: Progress, n_steps: int | None = None) -> int:
    """Returns the step count before this first turn of a run that takes ``n_steps`` (None: more than one turn's)."""
    taken = agent.n_envs if n_steps is None else min(agent.n_envs, n_steps)
    return max(progress.step - taken, 0)


def merit(evaluation: Evaluation) -> tuple[float, float]:
    """Returns what evaluations are compared by: success rate, -1 where it is unknown, and mean return."""
    rate = evaluation.success_rate
    return (-1.0 if math.isnan(rate) else rate), evaluation.mean_return


def _mean(values: Iterable[float]) -> float:
    values = list(values)
    return sum(values) / len(values) if values else math.nan


def _identities(env: VectorEnv) -> set[int]:
    """Identifies the environments behind a vector, so that two vectors around the same ones are recognised."""
    base = env.venv.unwrapped if env.venv is not None else env
    inside = env.envs if isinstance(env, InProcess) else base.envs if isinstance(base, DummyVecEnv) else []
    return {id(env), id(base), *map(id, inside)}
