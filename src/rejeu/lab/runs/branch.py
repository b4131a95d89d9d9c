"""How a run begins from a checkpoint of another."""

from __future__ import annotations

import dataclasses
import secrets
import shutil
from pathlib import Path

from rejeu.agents import Agent
from rejeu.checkpoints.run_folder import RunFolder, check_free, checkpoint_files, create, step_of
from rejeu.core.types import JsonObject
from rejeu.lab.runs.arguments import Branch
from rejeu.lab.runs.config import DecidedRun, Origin, read_folder
from rejeu.lab.runs.output import echo
from rejeu.lab.runs.read import is_file
from rejeu.lab.runs.resume import train_on
from rejeu.lab.runs.session import Report


def write_best(agent: Agent, path: Path) -> None:
    """Writes the model that evaluated best so far, if there is one; the file of the other run may be of a later step."""
    run, best = agent.run, agent.best
    if best is None or best.by != "evaluation":
        return
    now = run.state, run.step
    run.state, run.step = best.state, best.step
    try:
        agent.save(path)
    finally:
        run.state, run.step = now


def nearest(checkpoints: Path, step: int | None) -> Path:
    """Returns the newest checkpoint up to a step; None for the newest of all.

    Raises:
        FileNotFoundError: if there is none.
    """
    every = checkpoint_files(checkpoints)
    checkpoint = next((path for path in every if step is None or step_of(path) <= step), None)
    if checkpoint is None:
        steps = ", ".join(f"{step_of(path):,}" for path in reversed(every))
        has = f"there are those of steps {steps}" if every else f"there is no checkpoint in {checkpoints}"
        raise FileNotFoundError(f"--at {step}: no checkpoint is of this step or before it; {has}")
    return checkpoint


def branch(arguments: Branch, report: Report) -> tuple[int, JsonObject]:
    """Trains as ``rejeu resume`` does, in a folder of its own, which is there once the checkpoint is read."""
    check_free(arguments.out)
    parent = RunFolder(arguments.run)
    read_folder(parent)  # it has no checkpoint to name if it is no run folder
    checkpoint = nearest(parent.checkpoints, arguments.at)

    def begin(agent: Agent, config: DecidedRun) -> tuple[RunFolder, DecidedRun]:
        folder = create(arguments.out, config.env, config.algorithm, config.seed)
        for table in (parent.metrics, parent.metrics.with_suffix(".json"), parent.evaluations):
            if is_file(table):
                shutil.copyfile(table, folder.path / table.name)  # the session leaves out later rows
        agent.run_id = secrets.token_hex(8)
        write_best(agent, folder.best)
        step = step_of(checkpoint)
        nearest_to = (
            "" if arguments.at in (None, step) else f", whose checkpoint nearest before step {arguments.at:,} is used"
        )
        echo(f"branch of     {parent.path}{nearest_to}")
        origin = Origin(run=str(parent.path), step=step, changes=arguments.hyperparameters)
        return folder, dataclasses.replace(config, origin=origin)

    return train_on(arguments, checkpoint, report, begin)
