"""``rejeu resume`` and ``rejeu branch``: a run goes on from a checkpoint.

A run is continued exactly where it was stopped, a complete one is trained further, or a new run begins from the state of
another.
"""

from __future__ import annotations

from rejeu.core import atomic
from rejeu.core.types import JsonObject
from rejeu.lab.cli import sweep, tune
from rejeu.lab.experiments.folder import is_sweep
from rejeu.lab.experiments.study import StudyFolder
from rejeu.lab.reporting.report import write_report
from rejeu.lab.runs.arguments import Branch, Resume
from rejeu.lab.runs.branch import branch
from rejeu.lab.runs.resume import resume


def run_resume(arguments: Resume) -> tuple[int, JsonObject]:
    """Trains, as ``rejeu train``, ``rejeu sweep`` or ``rejeu tune`` does.

    Raises:
        ValueError: for options of a sweep with the folder of a run, or of a run with that of a sweep or a study.
        RunInUseError: if another process trains there.
        OSError: if a symbolic link leads out of the folder.
    """
    atomic.check_no_links(arguments.run)
    holds_sweep = is_sweep(arguments.run)
    if holds_sweep or StudyFolder(arguments.run).plan.is_file():
        if arguments.steps is not None or arguments.minutes is not None:
            raise ValueError(f"{arguments.run} holds runs that have a length; leave out --steps and --minutes")
        return sweep.resume(arguments) if holds_sweep else tune.resume_study(arguments)
    if arguments.workers is not None:
        raise ValueError(f"{arguments.run} is a single run; --workers is for the folder of a sweep or a study")
    return resume(arguments, write_report)


def run_branch(arguments: Branch) -> tuple[int, JsonObject]:
    """Trains a new run from a checkpoint of another; the exit status is that of ``rejeu train``."""
    return branch(arguments, write_report)
