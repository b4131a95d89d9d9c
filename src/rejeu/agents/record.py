"""What a report shows of an agent that was trained without a run folder."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.agents.base import BaseAgent
from rejeu.algorithms import config as configs
from rejeu.reporting.evaluation import Evaluation
from rejeu.reporting.history import COLUMNS
from rejeu.reporting.runs import Episodes, Run
from rejeu.reporting.tables import Table


def record(agent: BaseAgent, path: Path, evaluations: Sequence[tuple[int, Evaluation]]) -> Run:
    """Returns the training of an agent so far as a run; ``path`` is only for its name."""
    env = agent.run.env
    history = agent.history
    results = [evaluation for _, evaluation in evaluations]
    columns = {
        "step": [step for step, _ in evaluations],
        "success_rate": [one.success_rate for one in results],
        "mean_return": [one.mean_return for one in results],
        "std_return": [one.std_return for one in results],
        "mean_length": [one.mean_length for one in results],
        "episodes": [len(one.returns) for one in results],
    }
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
        episodes=Episodes(*(history[column] for column in COLUMNS)),
        evaluations=Table({name: np.array(values, np.float64) for name, values in columns.items()}),
    )


def given_config(agent: BaseAgent) -> Any:
    """Returns the configuration of an agent without the widths of layers that follow from its observations."""
    config = agent.config
    default = type(config)()
    is_default = config.policy_kwargs == configs.with_widths(default, agent.obs_leaves).policy_kwargs
    return dataclasses.replace(config, policy_kwargs=default.policy_kwargs) if is_default else config
