"""Experiment trackers: Weights & Biases, MLflow and Trackio. Their packages are imported when a tracker is made."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Protocol, runtime_checkable

from rejeu.errors import MissingExtra
from rejeu.io.failed_writes import MAX_ROWS, RETRY_SECONDS, FailedWrites
from rejeu.reporting.runs import flat

PROJECT = "rejeu"
"""Project or experiment where the environment variable of the tracker names none."""
CLOSE_SECONDS = 60.0
"""Longest wait at the end of training for what a tracker has not yet written."""


@runtime_checkable
class Tracker(Protocol):
    """A sink that also takes the configuration of a run, and videos."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Writes the metrics of environment step ``step``."""

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Writes the configuration of the run, before its first row."""

    def write_video(self, step: int, path: Path) -> None:
        """Adds a video."""

    def close(self) -> None:
        """Closes the output."""


class WandB:
    """Writes to Weights & Biases, in the mode of ``WANDB_MODE`` (online, offline, disabled).

    Args:
        name: name of the run; None lets the tool choose.
        run_id: identifies the run, so that a resumed one continues it; None draws one.
        folder: folder of its local files.
        project: project of the run; None: ``WANDB_PROJECT``, else ``"rejeu"``.
    """

    def __init__(
        self,
        name: str | None = None,
        run_id: str | None = None,
        folder: str | Path | None = None,
        project: str | None = None,
    ) -> None:
        self._wandb = imported("wandb")
        self.name, self.run_id, self.folder = name, run_id, folder
        self.project = project or os.environ.get("WANDB_PROJECT") or PROJECT
        self._run: Any = None

    def __str__(self) -> str:
        return "Weights & Biases"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Adds a row."""
        self._started().log(dict(metrics), step=step)

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Writes the configuration of the run."""
        self._started().config.update(dict(config), allow_val_change=True)

    def write_video(self, step: int, path: Path) -> None:
        """Adds a video."""
        self._started().log({"video": self._wandb.Video(str(path), format="mp4")}, step=step)

    def close(self) -> None:
        """Ends the run."""
        if self._run is not None:
            self._run.finish()
            self._run = None

    def _started(self) -> Any:
        if self._run is None:
            if self.folder is not None:
                Path(self.folder).mkdir(parents=True, exist_ok=True)
            is_offline = os.environ.get("WANDB_MODE") == "offline"  # where resume only warns
            self._run = self._wandb.init(
                project=self.project,
                name=self.name,
                id=self.run_id,
                dir=self.folder,
                resume=None if self.run_id is None or is_offline else "allow",
                reinit="create_new",
                settings=self._wandb.Settings(console="off"),
            )
        return self._run


class MLflow:
    """Writes to MLflow, to the server or file of ``MLFLOW_TRACKING_URI``.

    Args:
        name: name of the run; None lets the tool choose.
        run_id: identifies the run by its tag ``rejeu.run_id``, so that a resumed one continues it; None for a new run.
        experiment: experiment of the run; None: ``MLFLOW_EXPERIMENT_NAME``, else ``"rejeu"``.
    """

    def __init__(self, name: str | None = None, run_id: str | None = None, experiment: str | None = None) -> None:
        self._mlflow = imported("mlflow")
        self.name, self.run_id = name, run_id
        self.experiment = experiment or os.environ.get("MLFLOW_EXPERIMENT_NAME") or PROJECT
        self._client: Any = None
        self._id = ""

    def __str__(self) -> str:
        return "MLflow"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Adds a row."""
        client, now = self._started(), int(time.time() * 1000)
        metric = self._mlflow.entities.Metric
        client.log_batch(self._id, metrics=[metric(name, value, now, step) for name, value in metrics.items()])

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Writes the configuration of the run; MLflow does not replace values that are there already."""
        client = self._started()
        known = client.get_run(self._id).data.params
        param = self._mlflow.entities.Param
        params = [param(name, str(value)[:500]) for name, value in flat(config) if name not in known]
        for i in range(0, len(params), 100):  # the most that MLflow takes at once
            client.log_batch(self._id, params=params[i : i + 100])

    def write_video(self, step: int, path: Path) -> None:
        """Adds a video to the artifacts."""
        self._started().log_artifact(self._id, str(path), "videos")

    def close(self) -> None:
        """Ends the run."""
        if self._client is not None:
            self._client.set_terminated(self._id)
            self._client = None

    def _started(self) -> Any:
        if self._client is None:
            client = self._mlflow.MlflowClient()
            found = client.get_experiment_by_name(self.experiment)
            experiment = client.create_experiment(self.experiment) if found is None else found.experiment_id
            tags = {} if self.run_id is None else {"rejeu.run_id": self.run_id}
            earlier = client.search_runs([experiment], f"tags.`rejeu.run_id` = '{self.run_id}'") if tags else []
            if earlier:
                self._id = earlier[0].info.run_id
                client.update_run(self._id, status="RUNNING")
            else:
                self._id = client.create_run(experiment, tags=tags, run_name=self.name).info.run_id
            self._client = client
        return self._client


class Trackio:
    """Writes to Trackio: to a local database, or where ``TRACKIO_SPACE_ID`` or ``TRACKIO_SERVER_URL`` point.

    Args:
        name: name of the run; one of the same name is continued. None lets the tool choose.
        project: project of the run.
    """

    def __init__(self, name: str | None = None, project: str = PROJECT) -> None:
        self._trackio = imported("trackio")
        self.name, self.project = name, project
        self._run: Any = None

    def __str__(self) -> str:
        return "Trackio"

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Adds a row."""
        self._started({}).log(dict(metrics), step=step)

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Writes the configuration of the run, if that has no row yet."""
        self._started(dict(flat(config)))

    def write_video(self, step: int, path: Path) -> None:
        """Adds a video."""
        self._started({}).log({"video": self._trackio.Video(str(path), format="mp4")}, step=step)

    def close(self) -> None:
        """Ends the run."""
        if self._run is not None:
            self._run.finish()
            self._run = None

    def _started(self, config: Mapping[str, Any]) -> Any:
        if self._run is None:
            resume = "never" if self.name is None else "allow"
            self._run = self._trackio.init(self.project, self.name, config=dict(config), resume=resume, embed=False)
        return self._run


class Background:
    """A tracker whose rows are written in a thread, so that a slow or lost connection neither delays nor ends training.

    What fails is retried, in order, after ``RETRY_SECONDS``. The failure is reported with the next row.

    Args:
        tracker: used in that thread only, until :meth:`close` returns.
        failed: where failures are reported.
        closes: whether :meth:`close` also closes the tracker.
    """

    def __init__(self, tracker: Tracker, failed: FailedWrites, closes: bool) -> None:
        self.tracker, self.closes = tracker, closes
        self._failed = failed
        self._jobs: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._closing = threading.Event()
        self._error: Exception | None = None
        self._n_dropped = 0
        self._thread = threading.Thread(target=self._work, name=f"rejeu, {tracker}", daemon=True)
        self._thread.start()

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Queues a row."""
        self._put(partial(self.tracker.write, step, dict(metrics)))

    def write_config(self, config: Mapping[str, Any]) -> None:
        """Queues the configuration."""
        self._put(partial(self.tracker.write_config, config))

    def write_video(self, step: int, path: Path) -> None:
        """Queues a video."""
        self._put(partial(self.tracker.write_video, step, path))

    def close(self) -> None:
        """Waits up to ``CLOSE_SECONDS`` for what is queued, after one more attempt if it failed, and ends the thread."""
        if self.closes:
            self._jobs.put(self.tracker.close)
        self._jobs.put(None)
        self._closing.set()
        self._thread.join(CLOSE_SECONDS)
        if self._thread.is_alive() and self._error is None:
            self._error = TimeoutError(f"not done {CLOSE_SECONDS:.0f} seconds after the end of training")
        self._report()

    def _put(self, job: Callable[[], object]) -> None:
        if self._jobs.qsize() >= MAX_ROWS:
            with suppress(Empty):
                self._jobs.get_nowait()
                self._n_dropped += 1
        self._jobs.put(job)
        self._report()

    def _report(self) -> None:
        self._failed.attempt(f"rows of {self.tracker}", self._raise_error, retry=False)

    def _raise_error(self) -> None:
        if self._error is not None:
            raise OSError(f"{type(self._error).__name__}: {self._error}"[:500])
        if self._n_dropped:
            raise OSError(f"{self._n_dropped:,} were dropped: at most {MAX_ROWS:,} can wait")

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            while not self._is_done(job):
                if self._closing.is_set():
                    return
                self._closing.wait(RETRY_SECONDS)

    def _is_done(self, job: Callable[[], object]) -> bool:
        try:
            job()
        except Exception as error:  # of any kind, as each library has its own
            self._error = error
            return False
        self._error = None
        return True


def imported(kind: str) -> Any:
    """Returns the package of a tracker: ``"wandb"``, ``"mlflow"`` or ``"trackio"``.

    Raises:
        MissingExtra: if it is not installed.
    """
    try:
        if kind == "wandb":
            import wandb as package
        elif kind == "mlflow":
            import mlflow as package
        else:
            import trackio as package
    except ImportError:
        raise MissingExtra(f"the log {kind!r}", kind, kind) from None
    return package
