"""``rejeu.sweep``: from a plan to trained runs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rejeu.experiments import table
from rejeu.experiments.coordinator import Coordinator, Outcome, count
from rejeu.experiments.folder import Sweep, SweepFolder, open_folder, read_folder
from rejeu.experiments.plan import read_plan
from rejeu.experiments.process import LocalLauncher, default_workers, threads_of
from rejeu.experiments.scheduler import Launcher
from rejeu.interrupt import Interrupt
from rejeu.runs.config import RunConfig


@dataclass(frozen=True)
class SweepResult:
    """What :func:`sweep` returns. ``rejeu.compare(result.path)`` compares its runs."""

    path: Path
    """Folder of the sweep."""
    outcomes: tuple[Outcome, ...]
    """The outcome of each job."""

    @property
    def runs(self) -> list[Path]:
        """Folders of the runs that are done."""
        return [one.path for one in self.outcomes if one.state == "done"]

    @property
    def failed(self) -> list[Outcome]:
        """The jobs that failed; the log of each says why."""
        return [one for one in self.outcomes if one.state == "failed"]

    @property
    def is_complete(self) -> bool:
        """Whether all jobs are done."""
        return all(one.state == "done" for one in self.outcomes)

    def counts(self) -> dict[str, int]:
        """Returns how many jobs are in each state."""
        return count(one.state for one in self.outcomes)

    def table(self) -> list[dict[str, Any]]:
        """Returns one row for each job, ready for ``pandas.DataFrame``."""
        of_run, of_outcome = ("env", "algorithm", "seed"), ("state", "exit_status", "path", "log")
        return [
            {
                **{"name": one.job.name, "setting": one.job.setting},
                **{key: getattr(one.job.run, key) for key in of_run},
                **{key: getattr(one, key) for key in of_outcome},
            }
            for one in self.outcomes
        ]


def prepare(
    plan: str | Path | Mapping[str, Any],
    folder: str | Path | None,
    workers: int | None,
    typed: RunConfig,
    ray: str | None = None,
) -> SweepFolder:
    """Returns the folder of a checked plan, new or joined.

    Args:
        plan: path of a TOML file, or its content as a dict.
        folder: of the sweep; None makes one under ``runs``, named after the plan and the time.
        workers: runs at once, which determines their threads; None for half as many as there are cores.
        typed: what the command line named for import.
        ray: address of a Ray cluster, on which runs have as many threads as CPUs.

    Raises:
        PlanError: for a mistake in the plan, with its line.
        ValueError, FileExistsError: if the folder belongs to something else.
    """
    found, text = read_plan(plan)
    at_once = min(workers or default_workers(), len(found.jobs))
    share = threads_of(at_once) if ray is None else max(int(found.resources.cpus), 1)
    sweep_of_plan = Sweep(jobs=found.jobs, threads=found.threads or share, resources=found.resources)
    if folder is None:
        stem = "sweep" if isinstance(plan, Mapping) else Path(plan).stem
        folder = Path("runs") / f"{stem}-{time.strftime('%Y%m%d-%H%M%S')}"
    return open_folder(Path(folder), sweep_of_plan, text, typed)


def make_launcher(folder: SweepFolder, workers: int | None, ray: str | None) -> Launcher:
    """Returns what starts runs: processes on this machine, or tasks on a Ray cluster.

    Raises:
        MissingExtra: if Ray is needed and not installed.
        ConnectionError, ValueError: if the cluster cannot be used.
    """
    if ray is not None:
        from rejeu.experiments.ray import RayLauncher  # Ray is an extra

        return RayLauncher(ray, folder, workers)
    return LocalLauncher(min(workers or default_workers(), len(folder.jobs)), folder.sweep.threads)


def sweep(
    plan: str | Path | Mapping[str, Any],
    folder: str | Path | None = None,
    *,
    workers: int | None = None,
    ray: str | None = None,
    retry: bool = False,
    imports: Sequence[str] = (),
    progress: bool = True,
) -> SweepResult:
    """Trains every run of a plan, each in a process and a folder of its own, and returns their outcomes.

    Runs of an existing folder of the same plan that are done are not repeated; those that were interrupted continue exactly
    from their newest checkpoint. Several processes and machines may work on one folder at the same time.

    Args:
        plan: path of a TOML file, or its content as a dict; see ``docs/scaling.md``. The folder of a sweep continues it.
        folder: of the sweep; None makes one under ``runs``.
        workers: runs at once; by default half as many as there are cores, on a cluster as many as fit.
        ray: ``"auto"`` or the address of a Ray cluster, on which the runs are trained.
        retry: try failed runs again.
        imports: modules and Python files that each run imports first.
        progress: show a table of the runs on a terminal, and lines elsewhere.

    Raises:
        PlanError: for a mistake in the plan, before anything starts.
        KeyboardInterrupt: after Ctrl-C or SIGTERM, when all runs have stopped with a checkpoint.

    ::

        result = rejeu.sweep({"environments": ["CartPole-v1"], "algorithms": ["DQN", "PPO"], "seeds": 5, "steps": 50_000})
        print(rejeu.compare(result.path))
    """
    typed = RunConfig(env="", imports=tuple(imports))
    is_folder = not isinstance(plan, Mapping) and Path(plan).is_dir()
    found = read_folder(Path(plan), typed) if is_folder else prepare(plan, folder, workers, typed, ray)  # type: ignore[arg-type]
    with Interrupt() as stop:
        with table.shown(progress) as (watch, say):
            coordinator = Coordinator(found, make_launcher(found, workers, ray), stop, typed, retry, say)
            coordinator.run(watch)
        stop.check()
    return SweepResult(found.path, tuple(coordinator.outcomes()))
