"""Reports of runs: one HTML page that needs no network, with curves, tables, videos and the command that repeats the run.

Everything in a run folder is untrusted. Jinja2 escapes all text, JSON is escaped for scripts, and the page's
Content-Security-Policy allows its own scripts by a random nonce and nothing from elsewhere.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rejeu.agents.agent import Agent
from rejeu.algorithms import config as configs
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import atomic
from rejeu.core.validation import as_path
from rejeu.lab.reporting.report import page, sections
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.read import RunSummary, read_run
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.tables import Table, evaluation_table

MAX_RUNS = 50
"""Most runs of a page."""


def write_report(
    runs: str | Path | Agent | Sequence[str | Path],
    out: str | Path | None = None,
    evaluations: Iterable[tuple[int, Evaluation]] = (),
) -> Path:
    """Writes the report of one or several runs as one HTML page, and returns its path.

    Args:
        runs: run folders, or an agent, whose training so far is shown.
        out: file to write; None for ``report.html`` in the folder of a single run, or in the current folder.
        evaluations: of an agent: ``(step, Evaluation)`` pairs, such as ``Evaluate.results``.

    Raises:
        FileNotFoundError: if a folder does not exist, or holds nothing of a run.
        MissingExtra: if plotly or jinja2 is not installed.
        ValueError: for no run, or more than ``MAX_RUNS``.
    """
    if isinstance(runs, Agent):
        out = Path("report.html" if out is None else out)
        read = [record(runs, out, [*evaluations])]
    else:
        paths = [as_path(run) for run in (runs if isinstance(runs, Iterable) and not isinstance(runs, str) else [runs])]
        if not 1 <= len(paths) <= MAX_RUNS:
            raise ValueError(f"a report shows 1 to {MAX_RUNS} runs, got {len(paths)}")
        read = [read_run(path) for path in paths]
        usual = RunFolder(read[0].path).report if len(read) == 1 else Path("report.html")
        out = usual if out is None else Path(out)
    return atomic.write(out, render(read, out.absolute().parent))


def render(runs: Sequence[RunSummary], folder: Path | None = None) -> str:
    """Returns the report of runs as one HTML page; ``folder`` is that of its file, from which it refers to large videos.

    Raises:
        MissingExtra: if plotly or jinja2 is not installed.
    """
    parts = sections.build(runs, folder)
    return page.render("report.html", parts.data, title=sections.title_of(runs), sections=parts.runs)


def record(agent: Agent, path: Path, evaluations: Sequence[tuple[int, Evaluation]]) -> RunSummary:
    """Returns the training of an agent so far as a run; ``path`` is only for its name."""
    env = agent.run.env
    history = agent.history
    return RunSummary(
        path=path.absolute(),
        name=path.stem,
        format="agent",
        config=RunConfig(
            env="" if env is None else env.env_id,
            algorithm=agent.name,
            seed=agent.seed,
            n_envs=None if env is None else env.n_envs,
            hyperparameters=configs.to_json(given_config(agent)),
        ),
        state="running" if agent.call.is_learning else "finished",
        steps=agent.run.step,
        seconds=agent.seconds["total"],
        episodes=Table(history.to_dict()),
        evaluations=evaluation_table(evaluations),
    )


def given_config(agent: Agent) -> Any:
    """Returns the configuration of an agent without the widths of layers that follow from its observations."""
    config = agent.config
    default = type(config)()
    is_default = config.policy_kwargs == configs.with_widths(default, agent.obs_leaves).policy_kwargs
    return dataclasses.replace(config, policy_kwargs=default.policy_kwargs) if is_default else config
