"""Evaluation of policies: complete episodes, means and confidence intervals."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rejeu.core import Masked
from rejeu.envs.make import VectorEnv, make_vector
from rejeu.envs.masks import make_masked
from rejeu.reporting.text import counted
from rejeu.spaces import scale_action

if TYPE_CHECKING:
    from rejeu.reporting.figures import Picture


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

    @property
    def mean_return(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std_return(self) -> float:
        """Standard deviation of the returns over episodes (divided by n)."""
        return float(np.std(self.returns))

    @property
    def mean_length(self) -> float:
        """Mean episode length in steps."""
        return float(np.mean(self.lengths))

    @property
    def return_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the mean return (Student's t), NaN for a single episode."""
        n = len(self.returns)
        if n < 2:
            return math.nan, math.nan
        from scipy import stats

        half = float(stats.t.ppf(0.975, n - 1)) * float(np.std(self.returns, ddof=1)) / math.sqrt(n)
        return self.mean_return - half, self.mean_return + half

    @property
    def success_rate(self) -> float:
        """Share of successful episodes, NaN if unknown."""
        return float(np.mean(self.successes))

    @property
    def success_interval(self) -> tuple[float, float]:
        """95 % confidence interval of the success rate (Wilson score), NaN if unknown."""
        if math.isnan(self.success_rate):
            return math.nan, math.nan
        from scipy import stats

        bounds = stats.binomtest(int(self.successes.sum()), len(self.successes)).proportion_ci(method="wilson")
        return float(bounds.low), float(bounds.high)

    def plot(self, path: str | Path | None = None) -> Picture:
        """Returns a matplotlib figure of the returns and their mean, which notebooks display.

        Args:
            path: file to write, in the format of its suffix; None for none.

        Raises:
            MissingExtra: if matplotlib is not installed.
        """
        from rejeu.reporting import plots

        return plots.evaluation(self, path)

    def __str__(self) -> str:
        low, high = self.return_interval
        text = (
            f"return {self.mean_return:.2f} ± {self.std_return:.2f} (95 % CI of the mean {low:.2f} to {high:.2f}), "
            f"length {self.mean_length:.1f}, {counted(len(self.returns), 'episode')}"
        )
        if not math.isnan(self.success_rate):
            low, high = self.success_interval
            text = f"success {self.success_rate:.1%} (95 % CI {low:.1%} to {high:.1%}), {text}"
        return text

    def __repr__(self) -> str:
        return f"<Evaluation: {self}>"

    def _repr_html_(self) -> str:
        """Returns a table for notebooks."""
        (low, high), rows = self.return_interval, []
        if not math.isnan(self.success_rate):
            least, most = self.success_interval
            rows.append(("success", f"{self.success_rate:.1%}", f"{least:.1%} to {most:.1%}", ""))
        rows += [
            ("return", f"{self.mean_return:,.2f}", f"{low:,.2f} to {high:,.2f}", f"{self.std_return:,.2f}"),
            ("length", f"{self.mean_length:,.1f}", "", f"{np.std(self.lengths):,.1f}"),
        ]
        head = (counted(len(self.returns), "episode"), "mean", "95 % CI of the mean", "standard deviation")
        lines = ["".join(f"<th>{cell}</th>" for cell in head)]
        lines += [f"<th>{row[0]}</th>" + "".join(f"<td>{cell}</td>" for cell in row[1:]) for row in rows]
        return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"


def evaluate(
    policy: Callable[[Any, np.ndarray], np.ndarray],
    env: VectorEnv,
    episodes: int | None,
    success_threshold: float | None = None,
    seed: int | None = None,
    seconds: float | None = None,
) -> Evaluation:
    """Evaluates a policy for complete episodes.

    Every environment plays a fixed share of the episodes, because otherwise short episodes would be counted more often. After
    ``seconds`` no episode is started, but running episodes are completed and counted, because otherwise long episodes would
    be left out.

    Args:
        policy: maps observations ``(n_envs, ...)`` and episode starts ``bool (n_envs,)`` to actions in the algorithm's range.
        env: the environments, which are reset first.
        episodes: number of episodes, at least 1; None for as many as ``seconds`` allows.
        success_threshold: return of a successful episode, if the environment does not report success; None for the
            environment's reward threshold.
        seed: seed of the environments; None continues their random state.
        seconds: wall time after which no episode is started, None for no limit. Every environment with a share of the
            episodes plays at least one.
    """
    if episodes is None and seconds is None:
        raise ValueError("evaluate needs episodes or seconds")
    if episodes is not None and episodes < 1:
        raise ValueError(f"episodes={episodes} must be at least 1")
    n_envs, most = env.n_envs, np.iinfo(np.int64).max
    to_play = np.full(n_envs, most) if episodes is None else (episodes + np.arange(n_envs)) // n_envs
    end = math.inf if seconds is None else time.perf_counter() + seconds
    total, length = np.zeros(env.n_envs), np.zeros(env.n_envs, int)
    rows: list[tuple[float, int, float]] = []
    obs, done = env.reset(seed), np.ones(env.n_envs, bool)
    while to_play.any():
        step = env.step(scale_action(env.action_space, policy(obs, done)))
        total += step.reward
        length += 1
        done = step.terminated | step.truncated
        for i in np.flatnonzero(done).tolist():
            if to_play[i]:
                value = step.return_of(i, total[i])
                rows.append((value, length[i], env.judge(step, i, value, success_threshold)))
                to_play[i] = 0 if time.perf_counter() >= end else to_play[i] - 1
            total[i] = length[i] = 0
        obs = env.reset_done(done) if done.any() and to_play.any() else step.obs
    returns, lengths, successes = zip(*rows, strict=True)
    return Evaluation(np.array(returns), np.array(lengths), np.array(successes))


def evaluate_policy(
    model: Any,
    env: Any,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    render: bool = False,
    callback: Callable[[dict[str, Any], dict[str, Any]], None] | None = None,
    reward_threshold: float | None = None,
    return_episode_rewards: bool = False,
    warn: bool = True,
) -> tuple[float, float] | tuple[list[float], list[int]]:
    """Plays whole episodes and returns mean and standard deviation of the return, as Stable-Baselines3 does.

    Where vector wrappers such as ``VecNormalize`` change rewards, the returns are those that a ``Monitor`` beneath them
    counted, if there is one.

    An agent that takes action masks is given those of the environment. An agent that trains on the same environments goes on
    with new episodes there.

    Args:
        model: anything with ``predict(obs, state=..., episode_start=..., deterministic=...) -> (action, state)``.
        env: a Gymnasium environment, a vector environment, an id, or a function that makes an environment.
        n_eval_episodes: at least 1, spread evenly over the environments of a vector.
        deterministic: the policy's mode, or a sample.
        render: show the environment while it plays; it must have been made with ``render_mode="human"``.
        callback: called after every step with ``locals()`` and ``globals()``.
        reward_threshold: least mean return that is accepted.
        return_episode_rewards: return the lists of returns and lengths instead.
        warn: accepted and without effect: episodes are counted here, so a missing ``Monitor`` falsifies nothing.

    Raises:
        ValueError: if the mean return is below ``reward_threshold``.
        TypeError: if the model takes action masks, and those of the environment cannot be reached.
    """
    from rejeu.agents import Agent  # which imports this module
    from rejeu.agents.policy import lent

    agent = model if isinstance(model, Agent) else None
    vector = make_masked(env) if agent is not None and agent.takes_masks else make_vector(env)
    memory: Any = None

    def policy(obs: Any, began: np.ndarray) -> np.ndarray:
        nonlocal memory
        masks = {}
        if isinstance(obs, Masked):
            obs, masks["action_masks"] = obs
        action, memory = model.predict(obs, state=memory, episode_start=began, deterministic=deterministic, **masks)
        return action

    if n_eval_episodes < 1:
        raise ValueError(f"n_eval_episodes={n_eval_episodes} must be at least 1")
    share = (n_eval_episodes + np.arange(vector.n_envs)) // vector.n_envs
    current_rewards, current_lengths = np.zeros(vector.n_envs), np.zeros(vector.n_envs, int)
    episode_counts = np.zeros(vector.n_envs, int)
    episode_rewards: list[float] = []
    episode_lengths: list[int] = []
    with nullcontext() if agent is None else lent(agent, vector):
        observations, dones = vector.reset(), np.ones(vector.n_envs, bool)
        while len(episode_rewards) < n_eval_episodes:
            actions = policy(observations, dones)
            step = vector.step(actions)
            rewards, dones, infos = step.reward, step.terminated | step.truncated, step.info
            current_rewards += rewards
            current_lengths += 1
            for i in range(vector.n_envs):
                if callback is not None and episode_counts[i] < share[i]:
                    reward, done, info = rewards[i], dones[i], infos[i] if isinstance(infos, list) else infos
                    callback(locals(), globals())
                if dones[i]:
                    if episode_counts[i] < share[i]:
                        episode_rewards.append(step.return_of(i, current_rewards[i]))
                        episode_lengths.append(int(current_lengths[i]))
                        episode_counts[i] += 1
                    current_rewards[i] = current_lengths[i] = 0
            observations = vector.reset_done(dones) if dones.any() else step.obs
            if render and hasattr(env, "render"):
                env.render()
    mean, std = float(np.mean(episode_rewards)), float(np.std(episode_rewards))
    if reward_threshold is not None and not mean > reward_threshold:
        raise ValueError(f"the mean return {mean:.2f} is not above reward_threshold={reward_threshold:.2f}")
    return (episode_rewards, episode_lengths) if return_episode_rewards else (mean, std)
