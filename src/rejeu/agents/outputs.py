"""What an agent reports: rows of statistics and the outputs they go to, its configuration, and its record in a report."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from rejeu import schedules, xla
from rejeu.agents.base import BaseAgent
from rejeu.algorithms import config as configs
from rejeu.loops.run import time_shares
from rejeu.loops.training_call import TrainingCall
from rejeu.reporting.evaluation import Evaluation
from rejeu.reporting.logging import Console, RetryingSink, Sink, guarded, next_folder, open_log
from rejeu.reporting.runs import Episodes, Run, evaluation_table
from rejeu.reporting.tables import Table

TABLE_SECONDS = 2.0
"""Least time between two tables that ``verbose=1`` prints; other outputs get every row."""
LOG_FOLDER = "logs"
"""Folder of the folders of logs, in the current folder."""
LOGGED_AS = {"exploration_rate": "rollout/exploration_rate"}
"""Names of metrics in the log, where they are not ``train/NAME``."""


def open_outputs(
    agent: BaseAgent, sinks: Iterable[Sink], tb_log_name: str | None, stack: ExitStack
) -> Sequence[RetryingSink]:
    """Returns the outputs for rows of statistics; ``stack`` closes those that are opened here."""
    given, opened = [*sinks, *agent.logger.outputs], list[Sink]()
    if agent.verbose and not agent.logger.outputs:
        opened.append(Console(TABLE_SECONDS))
    if agent.log and not agent.logger.outputs:
        folder = next_folder(agent.tensorboard_log or LOG_FOLDER, tb_log_name or agent.name)
        opened += [open_log(kind, folder, run_name(agent), tracker_id(agent)) for kind in agent.log]
    outputs = [guarded(one, agent.failed_writes) for one in given]
    for one, output in zip(given, outputs, strict=True):
        if output.in_background and output is not one:
            stack.callback(output.close)
    for one in opened:
        outputs.append(guarded(one, agent.failed_writes, closes=True))
        stack.callback(outputs[-1].close)
    return outputs


def run_name(agent: BaseAgent) -> str:
    """Returns a name for the run in a tracker: environment, algorithm, seed and :func:`tracker_id`."""
    assert agent.env is not None
    return f"{agent.env.env_id}-{agent.name}-seed{agent.seed}-{tracker_id(agent)}"


def tracker_id(agent: BaseAgent) -> str:
    """Returns what identifies the run in a tracker. A ``learn`` that counts steps from 0 starts another run."""
    return agent.run_id + (f"-{agent.reset_step}" if agent.reset_step else "")


def run_config(agent: BaseAgent, call: TrainingCall) -> dict[str, Any]:
    """Returns what trackers show as the configuration of a run: environment, algorithm, limits, hyperparameters."""
    assert agent.env is not None
    return {
        "algorithm": agent.name,
        "env_id": agent.env.env_id,
        "n_envs": agent.n_envs,
        "backend": agent.env.backend,
        "policy": agent.policy_name,
        "seed": agent.seed,
        "total_timesteps": call.n_steps,
        "episodes": call.n_episodes,
        "minutes": None if call.seconds is None else call.seconds / 60,
        **configs.to_json(agent.config),
    }


def statistics_row(agent: BaseAgent) -> dict[str, float]:
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
    numbers["time/fps"] = float(agent.steps_per_second)
    numbers["time/time_elapsed"] = run.seconds["total"]
    numbers["time/total_timesteps"] = agent.num_timesteps
    for part, share in time_shares(run.seconds).items():
        numbers[f"time/{part}_share"] = share
    numbers["time/compile_seconds"] = xla.seconds()
    numbers["train/n_updates"] = run.n_updates
    if agent.learner.skips:
        numbers["train/skipped_updates"] = run.monitor.n_skipped
    if agent.training_call is not None:
        progress = agent.training_call.progress(run.step, run.episode)
        numbers["train/learning_rate"] = float(schedules.at(agent.config.learning_rate, progress))
    for key, value in (run.metrics or {}).items():
        numbers[LOGGED_AS.get(key, f"train/{key}")] = float(value)
    return numbers


def record(agent: BaseAgent, path: Path, evaluations: Sequence[tuple[int, Evaluation]]) -> Run:
    """Returns the training of an agent so far as a run; ``path`` is only for its name."""
    env = agent.run.env
    history = agent.history
    return Run(
        path=path.absolute(),
        name=path.stem,
        algorithm=agent.name,
        env_id="" if env is None else env.env_id,
        seed=agent.seed,
        n_envs=None if env is None else env.n_envs,
        hyperparameters=configs.to_json(given_config(agent)),
        state="running" if agent.is_learning else "finished",
        steps=agent.run.step,
        seconds=agent.seconds["total"],
        episodes=Episodes.of(Table(history.to_dict())),
        evaluations=evaluation_table(evaluations),
    )


def given_config(agent: BaseAgent) -> Any:
    """Returns the configuration of an agent without the widths of layers that follow from its observations."""
    config = agent.config
    default = type(config)()
    is_default = config.policy_kwargs == configs.with_widths(default, agent.obs_leaves).policy_kwargs
    return dataclasses.replace(config, policy_kwargs=default.policy_kwargs) if is_default else config
