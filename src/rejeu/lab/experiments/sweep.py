"""``rejeu.sweep``: from a plan to trained runs, with a table of their progress.

Each job of the sweep is a run of the scheduler.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from rejeu.agents import modules_of
from rejeu.checkpoints.run_folder import dated
from rejeu.core.interrupt import Interrupt
from rejeu.core.types import JsonObject
from rejeu.core.validation import as_path
from rejeu.lab.experiments import display
from rejeu.lab.experiments.folder import SweepFolder, open_folder, read_folder
from rejeu.lab.experiments.plan import read_plan
from rejeu.lab.experiments.scheduler import Launcher, Scheduler
from rejeu.lab.experiments.work import HIDDEN, Work
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.process import LocalLauncher, default_workers, threads_of

STATES = ("running", "done", "failed", "stopped", "waiting")

echo = partial(print, flush=True)


def imports_of(folder: SweepFolder, typed: RunConfig) -> tuple[str, ...]:
    """Returns the modules that each run of a folder imports: those that the command line named, or that offer its algorithms.

    Raises:
        ValueError: if the processes of the runs could not find an algorithm.
    """
    algorithms = {job.run.algorithm: None for job in folder.plan.jobs if job.run.algorithm is not None}
    modules = {name: None for algorithm in algorithms for name in modules_of(algorithm, typed.imports)}
    return tuple(modules) or typed.imports


def count(states: Iterable[str]) -> dict[str, int]:
    """Returns how often each state occurs.

    >>> count(["done", "failed", "done"])
    {'running': 0, 'done': 2, 'failed': 1, 'stopped': 0, 'waiting': 0}
    """
    return dict.fromkeys(STATES, 0) | Counter(states)


@dataclass(frozen=True)
class SweepResult:
    """Result of :func:`sweep`. ``rejeu.compare(result.path)`` compares its runs."""

    path: Path
    """Folder of the sweep."""
    outcomes: tuple[Work, ...]
    """The jobs, each with its ``state``, its folder ``path`` and its ``log``."""

    @property
    def runs(self) -> list[Path]:
        """Folders of the runs that are done."""
        return [work.path for work in self.outcomes if work.state == "done"]

    @property
    def failed(self) -> list[Work]:
        """The jobs that failed; the log of each says why."""
        return [work for work in self.outcomes if work.state == "failed"]

    @property
    def is_complete(self) -> bool:
        """Whether all jobs are done."""
        return all(work.state == "done" for work in self.outcomes)

    def counts(self) -> dict[str, int]:
        """Returns how many jobs are in each state."""
        return count(work.state for work in self.outcomes)

    def table(self) -> list[JsonObject]:
        """Returns one row for each job, ready for ``pandas.DataFrame``."""
        return [
            {
                **{"name": work.job.name, "setting": work.job.setting},
                **{key: getattr(work.job.run, key) for key in ("env", "algorithm", "seed")},
                **{"state": work.state, "exit_status": work.exit_status() if work.status is None else work.status},
                **{"path": work.path, "log": work.log},
            }
            for work in self.outcomes
        ]


def prepare(
    plan: str | Path | Mapping[str, object],
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
    checked, text = read_plan(plan)
    at_once = min(workers or default_workers(), len(checked.jobs))
    share = threads_of(at_once) if ray is None else max(int(checked.resources.cpus), 1)
    path = Path(folder or dated("sweep" if isinstance(plan, Mapping) else Path(plan).stem))
    return open_folder(path, dataclasses.replace(checked, threads=checked.threads or share), text, typed)


def make_launcher(folder: SweepFolder, workers: int | None, ray: str | None) -> Launcher:
    """Returns the launcher of runs: of processes on this machine, or of tasks on a Ray cluster.

    Raises:
        MissingExtra: if Ray is needed and not installed.
        ConnectionError, ValueError: if the cluster cannot be used.
    """
    if ray is not None:
        from rejeu.lab.experiments.ray import RayLauncher  # Ray is an extra

        return RayLauncher(ray, folder.path / HIDDEN, folder.plan.resources, folder.plan.threads or 1, workers)
    return LocalLauncher(min(workers or default_workers(), len(folder.plan.jobs)), folder.plan.threads)


def sweep(
    plan: str | Path | Mapping[str, object],
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
    is_folder = not isinstance(plan, Mapping) and as_path(plan).is_dir()
    prepared = read_folder(Path(plan), typed) if is_folder else prepare(plan, folder, workers, typed, ray)  # type: ignore[arg-type]
    with Interrupt() as stop:
        imports = imports_of(prepared, typed)
        scheduler = train(prepared, make_launcher(prepared, workers, ray), stop, imports, retry, progress)
        stop.check()
    return SweepResult(prepared.path, tuple(scheduler.works))


def train(
    folder: SweepFolder,
    launcher: Launcher,
    stop: Interrupt,
    imports: tuple[str, ...],
    retry: bool = False,
    progress: bool = True,
) -> Scheduler:
    """Works through the jobs of a folder until none is left that this process may take, and shows how far they are.

    Args:
        folder: of the sweep.
        launcher: what starts runs.
        stop: a requested stop ends all runs, with checkpoints.
        imports: what each run imports first; see :func:`imports_of`.
        retry: whether jobs that have failed are tried again, once.
        progress: as for :func:`sweep`.
    """
    scheduler = Scheduler(launcher, stop, echo if progress else lambda text: None)
    scheduler.add(folder.works(imports, retry))
    with display.shown(scheduler, lambda: states_text(scheduler.works), progress) as watch:
        scheduler.run(watch)
    return scheduler


def states_text(works: Iterable[Work]) -> str:
    """Returns how many runs are in each state, such as ``2 running, 3 done``."""
    counts = count(work.state for work in works)
    return ", ".join(f"{number} {state}" for state, number in counts.items() if number)
