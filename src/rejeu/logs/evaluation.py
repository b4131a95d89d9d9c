"""Evaluation of policies: complete episodes, means and confidence intervals."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rejeu.core import interrupt, xla
from rejeu.core.spaces import scale_action
from rejeu.core.types import JsonObject, Observation
from rejeu.envs.base import VectorEnv
from rejeu.envs.goals import goals_in
from rejeu.logs import statistics
from rejeu.logs.formatting import counted, html_table

MOST_STEPS = 30_000
"""Steps after which an episode is cut off, unless the environment declares a higher time limit; Atari's have up to 27,000."""

if TYPE_CHECKING:
    from rejeu.logs.plots.picture import Picture


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Results of evaluating a policy for several complete episodes."""

    returns: np.ndarray
    """Sum of rewards of each episode, ``(n,)``."""
    lengths: np.ndarray
    """Steps of each episode, ``(n,)``."""
    successes: np.ndarray
    """1 or 0 for each episode, ``(n,)``: as reported by the environment, else whether the return reached the threshold, else
    NaN."""
    cut: int = 0
    """How many of the episodes did not end and were cut off after :data:`MOST_STEPS` steps."""
    goals: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """The first numbers of the desired goal of each episode, ``(n, 2)`` or ``(n, 3)``, as
    :func:`rejeu.envs.goals.goals_in` returns them; ``(0, 0)`` if they are unknown."""

    @property
    def n(self) -> int:
        """Number of episodes."""
        return len(self.returns)

    @property
    def mean_return(self) -> float:
        """Mean return, NaN without episodes."""
        return float(np.mean(self.returns)) if self.n else math.nan

    @property
    def std_return(self) -> float:
        """Standard deviation of the returns over episodes (divided by n)."""
        return float(np.std(self.returns)) if self.n else math.nan

    @property
    def mean_length(self) -> float:
        """Mean episode length in steps."""
        return float(np.mean(self.lengths)) if self.n else math.nan

    @property
    def std_length(self) -> float:
        """Standard deviation of the episode lengths (divided by n)."""
        return float(np.std(self.lengths)) if self.n else math.nan

    @property
    def return_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the mean return (Student's t), NaN for a single episode."""
        low, high = statistics.student(self.mean_return, self.std_return, self.n)
        return float(low), float(high)

    @property
    def success_rate(self) -> float:
        """Share of successes among the episodes where success is known, NaN if it never is."""
        successes = self.successes[np.isfinite(self.successes)]
        return float(np.mean(successes)) if len(successes) else math.nan

    @property
    def success_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the success rate (Wilson score), NaN if unknown."""
        low, high = statistics.wilson(self.success_rate, np.sum(np.isfinite(self.successes)) or self.n)
        return float(low), float(high)

    def to_dict(self) -> JsonObject:
        """Returns the statistics by name, as ``rejeu evaluate --json`` prints them."""
        names = ("mean_return", "std_return", "return_interval", "mean_length", "success_rate", "success_interval")
        return {"episodes": self.n, "cut": self.cut, **{name: getattr(self, name) for name in names}}

    def plot(self, path: str | Path | None = None) -> Picture:
        """Returns a matplotlib figure of the returns and their mean, which notebooks display.

        Args:
            path: file to write, in the format of its suffix; None for none.

        Raises:
            MissingExtra: if matplotlib is not installed.
        """
        from rejeu.logs import plots

        return plots.evaluation(self, path)

    def __str__(self) -> str:
        low, high = self.return_interval
        interval = "" if math.isnan(low) else f" (95 % CI of the mean {low:.2f} to {high:.2f})"
        text = (
            f"return {self.mean_return:.2f} ± {self.std_return:.2f}{interval}, "
            f"length {self.mean_length:.1f}, {counted(self.n, 'episode')}"
        )
        if not math.isnan(self.success_rate):
            low, high = self.success_interval
            text = f"success {self.success_rate:.1%} (95 % CI {low:.1%} to {high:.1%}), {text}"
        return f"{text}, {self.cut} of them cut off" if self.cut else text

    def __repr__(self) -> str:
        return f"<Evaluation: {self}>"

    def _repr_html_(self) -> str:
        """Returns a table for notebooks."""
        (low, high), rows = self.return_interval, []
        interval = "" if math.isnan(low) else f"{low:,.2f} to {high:,.2f}"
        if not math.isnan(self.success_rate):
            least, highest = self.success_interval
            rows.append(("success", f"{self.success_rate:.1%}", f"{least:.1%} to {highest:.1%}", ""))
        rows += [
            ("return", f"{self.mean_return:,.2f}", interval, f"{self.std_return:,.2f}"),
            ("length", f"{self.mean_length:,.1f}", "", f"{self.std_length:,.1f}"),
        ]
        return html_table([(counted(self.n, "episode"), "mean", "95 % CI of the mean", "standard deviation"), *rows])


def evaluate(
    policy: Callable[[Observation, np.ndarray], np.ndarray],
    env: VectorEnv,
    episodes: int | None,
    success_threshold: float | None = None,
    seed: int | None = None,
    seconds: float | None = None,
) -> Evaluation:
    """Evaluates a policy for complete episodes.

    Every environment plays a fixed share of the episodes, because otherwise short episodes would be counted more often. After
    ``seconds`` no episode is started, but running episodes are completed and counted, because otherwise long episodes would
    be left out. An episode that does not end is cut off after :data:`MOST_STEPS` steps, with a warning, and counts with its
    return so far; its environment plays no further one.

    Args:
        policy: maps observations ``(n_envs, ...)`` and episode starts ``bool (n_envs,)`` to actions in the algorithm's range.
        env: the environments, which are reset first.
        episodes: number of episodes, at least 1; None for as many as ``seconds`` allows.
        success_threshold: return of a successful episode, if the environment does not report success; None for the
            environment's reward threshold.
        seed: seed of the environments; None continues their random state.
        seconds: time, without compilation, after which no episode is started, None for no limit. Every environment with a
            share of the episodes plays at least one.

    Raises:
        Stopped: if Ctrl-C or SIGTERM asks training to stop.
    """
    if episodes is None and seconds is None:
        raise ValueError("evaluate needs episodes or seconds")
    if episodes is not None and episodes < 1:
        raise ValueError(f"episodes={episodes} must be at least 1")
    n_envs, no_limit = env.n_envs, np.iinfo(np.int64).max
    to_play = np.full(n_envs, no_limit) if episodes is None else (episodes + np.arange(n_envs)) // n_envs
    end = math.inf if seconds is None else xla.clock() + seconds
    total, length = np.zeros(env.n_envs), np.zeros(env.n_envs, int)
    longest = max(MOST_STEPS, env.max_episode_steps or 0)
    rows: list[tuple[float, int, float]] = []
    goals: list[np.ndarray] = []
    cut = 0
    obs, done = env.reset(seed), np.ones(env.n_envs, bool)
    while to_play.any():
        if (signal := interrupt.requested()) is not None:
            raise interrupt.Stopped(signal)
        step = env.step(scale_action(env.action_space, policy(obs, done)))
        total += step.reward
        length += 1
        done = step.terminated | step.truncated
        endless = ~done & (to_play > 0) & (length >= longest)
        ended = np.flatnonzero(done | endless).tolist()
        desired = goals_in(step.obs, env.n_envs) if ended else None
        for i in ended:
            if to_play[i]:
                goals += [] if desired is None else [desired[i]]
                value = step.return_of(i, total[i])
                rows.append((value, length[i], env.judge(step, i, value, success_threshold)))
                to_play[i] = 0 if endless[i] or xla.clock() >= end else to_play[i] - 1
            total[i] = length[i] = 0
        cut += int(endless.sum())
        obs = env.reset_done(done) if done.any() and to_play.any() else step.obs
    returns, lengths, successes = zip(*rows, strict=True)
    if cut:
        cut_off(cut)
    desired_goals = np.array(goals) if goals else np.zeros((0, 0))
    return Evaluation(np.array(returns), np.array(lengths), np.array(successes), cut, desired_goals)


def cut_off(n: int) -> None:
    """Warns that ``n`` episodes of an evaluation did not end."""
    warnings.warn(
        f"{counted(n, 'episode')} of an evaluation did not end in {MOST_STEPS:,} steps and "
        f"{'was' if n == 1 else 'were'} cut off; give the environment a time limit: "
        "gymnasium.register(..., max_episode_steps=1000)",
        UserWarning,
        stacklevel=3,
    )
