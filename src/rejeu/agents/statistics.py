"""The numbers of a run that people watch: windows over its last episodes, and the rows of its log."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from rejeu import xla
from rejeu.loops.run import Episode, time_shares

if TYPE_CHECKING:
    from rejeu.agents.base import Agent


def record(agent: Agent, episode: Episode) -> None:
    """Adds an episode to the history and to the windows."""
    agent.history.append(episode)
    agent.ep_info_buffer.append({"r": episode.episode_return, "l": episode.length, "t": episode.seconds})
    if not math.isnan(episode.success):
        agent.ep_success_buffer.append(episode.success)


def fill_windows(agent: Agent) -> None:
    """Fills the windows from the history."""
    episodes = agent.history.last(agent.stats_window_size)
    agent.ep_info_buffer.extend({"r": e.episode_return, "l": e.length, "t": e.seconds} for e in episodes)
    successes = agent.history["success"]
    agent.ep_success_buffer.extend(successes[~np.isnan(successes)][-agent.stats_window_size :].tolist())


def row(agent: Agent) -> dict[str, float]:
    """Returns the numbers of one log row: means over the last episodes, losses, rates. Waits for the device."""
    numbers: dict[str, float] = {}
    if agent.ep_info_buffer:
        numbers["rollout/ep_len_mean"] = float(np.mean([e["l"] for e in agent.ep_info_buffer]))
        numbers["rollout/ep_rew_mean"] = float(np.mean([e["r"] for e in agent.ep_info_buffer]))
        numbers["rollout/ep_rew_best"] = agent.history.best_return
    if agent.ep_success_buffer:
        numbers["rollout/success_rate"] = float(np.mean(agent.ep_success_buffer))
    run = agent.run
    numbers["time/episodes"] = run.episode
    numbers["time/steps_per_second"] = float(agent.steps_per_second)
    numbers["time/seconds"] = run.seconds["total"]
    for part, share in time_shares(run.seconds).items():
        numbers[f"time/{part}_share"] = share
    numbers["time/compile_seconds"] = xla.seconds()
    numbers["train/n_updates"] = run.n_updates
    if agent.learner.skips:
        numbers["train/skipped_updates"] = run.watch.n_skipped
    for key, value in (run.metrics or {}).items():
        numbers[f"train/{key}"] = float(value)
    return numbers
