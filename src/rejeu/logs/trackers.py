"""Experiment trackers: Weights & Biases, MLflow and Trackio. Their packages are imported when a tracker is made."""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Protocol, runtime_checkable

from rejeu.core.errors import requires
from rejeu.logs.tables import flat

PROJECT = "rejeu"
"""Project or experiment where the environment variable of the tracker names none."""


@runtime_checkable
class Tracker(Protocol):
    """A sink that also takes the configuration of a run, and videos."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Writes the metrics of environment step ``step``."""

    def write_config(self, config: Mapping[str, object]) -> None:
        """Writes the configuration of the run, before its first row."""

    def write_video(self, step: int, path: Path) -> None:
        """Adds a video."""

    def close(self) -> None:
        """Closes the output."""


class Logged(ABC):
    """A tracker whose package has runs with ``log`` and ``finish``; the run starts with the first write. Abstract."""

    def __init__(self, package: ModuleType, name: str | None, project: str) -> None:
        self._package, self.name, self.project = package, name, project
        self._run: Any = None

    @abstractmethod
    def _start(self, config: Mapping[str, object]) -> Any:
        """Returns a new run."""

    def _started(self, config: Mapping[str, object] = MappingProxyType({})) -> Any:
        if self._run is None:
            self._run = self._start(config)
        return self._run

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Adds a row."""
        self._started().log(dict(metrics), step=step)

    def write_video(self, step: int, path: Path) -> None:
        """Adds a video."""
        self._started().log({"video": self._package.Video(str(path), format="mp4")}, step=step)

    def close(self) -> None:
        """Ends the run."""
        if self._run is not None:
            self._run.finish()
            self._run = None


class WandB(Logged):
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
        super().__init__(imported("wandb"), name, project or os.environ.get("WANDB_PROJECT") or PROJECT)
        self.run_id, self.folder = run_id, folder

    def __str__(self) -> str:
        return "Weights & Biases"

    def write_config(self, config: Mapping[str, object]) -> None:
        """Writes the configuration of the run."""
        self._started().config.update(dict(config), allow_val_change=True)

    def _start(self, config: Mapping[str, object]) -> Any:
        if self.folder is not None:
            Path(self.folder).mkdir(parents=True, exist_ok=True)
        is_offline = os.environ.get("WANDB_MODE") == "offline"  # where resume only warns
        return self._package.init(
            project=self.project,
            name=self.name,
            id=self.run_id,
            dir=self.folder,
            resume=None if self.run_id is None or is_offline else "allow",
            reinit="create_new",
            settings=self._package.Settings(console="off"),
        )


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

    def write_config(self, config: Mapping[str, object]) -> None:
        """Writes the configuration of the run; MLflow does not replace values that are there already."""
        client = self._started()
        logged = client.get_run(self._id).data.params
        param = self._mlflow.entities.Param
        params = [param(name, str(value)[:500]) for name, value in flat(config) if name not in logged]
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
            entry = client.get_experiment_by_name(self.experiment)
            experiment = client.create_experiment(self.experiment) if entry is None else entry.experiment_id
            tags = {} if self.run_id is None else {"rejeu.run_id": self.run_id}
            earlier = client.search_runs([experiment], f"tags.`rejeu.run_id` = '{self.run_id}'") if tags else []
            if earlier:
                self._id = earlier[0].info.run_id
                client.update_run(self._id, status="RUNNING")
            else:
                self._id = client.create_run(experiment, tags=tags, run_name=self.name).info.run_id
            self._client = client
        return self._client


class Trackio(Logged):
    """Writes to Trackio: to a local database, or where ``TRACKIO_SPACE_ID`` or ``TRACKIO_SERVER_URL`` point.

    Args:
        name: name of the run; one of the same name is continued. None lets the tool choose.
        project: project of the run.
    """

    def __init__(self, name: str | None = None, project: str = PROJECT) -> None:
        super().__init__(imported("trackio"), name, project)

    def __str__(self) -> str:
        return "Trackio"

    def write_config(self, config: Mapping[str, object]) -> None:
        """Writes the configuration of the run, if that has no row yet."""
        self._started(dict(flat(config)))

    def _start(self, config: Mapping[str, object]) -> Any:
        resume = "never" if self.name is None else "allow"
        return self._package.init(self.project, self.name, config=dict(config), resume=resume, embed=False)


def imported(name: str) -> Any:
    """Returns the package of a tracker: ``"wandb"``, ``"mlflow"`` or ``"trackio"``.

    Raises:
        MissingExtra: if it is not installed.
    """
    with requires(f"the log {name!r}", name, name):
        if name == "wandb":
            import wandb as package
        elif name == "mlflow":
            import mlflow as package
        else:
            import trackio as package
    return package
