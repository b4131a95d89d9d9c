"""Runs as tasks on a Ray cluster. Only Ray Core is used."""

from __future__ import annotations

import json
import math
import os
import secrets
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rejeu import cluster, hardware
from rejeu.errors import ClusterError
from rejeu.experiments.folder import HIDDEN, SweepFolder
from rejeu.experiments.jobs import Resources
from rejeu.experiments.node import PACKAGES, Spec, Storage, look, train_task
from rejeu.experiments.process import LOST, THREADS
from rejeu.io import atomic

REFRESH = 5.0
"""Seconds between two looks at the nodes of the cluster."""
ANSWER = 60.0
"""Seconds that a node has to answer when the sweep begins."""
PATIENCE = 120.0
"""Seconds after which a run that was asked to stop, but waits for a node or hangs, is canceled."""
END = 30.0
"""Seconds that the tasks have to end when the sweep ends early."""


class RayRun:
    """A run on a cluster. Mutable."""

    def __init__(self, launcher: RayLauncher, name: str, result: Any, log: Path) -> None:
        self._launcher, self._name, self._result, self._log = launcher, name, result, log
        self._cancel_at = math.inf

    def poll(self) -> int | None:
        """Returns the exit status, ``LOST`` if the node or the worker process was lost; None while it runs."""
        ray = self._launcher.ray
        ready, _ = ray.wait([self._result], timeout=0)
        if not ready:
            if time.monotonic() > self._cancel_at:
                self._cancel_at = math.inf
                ray.cancel(self._result)
            return None
        try:
            return int(ray.get(self._result))
        except ray.exceptions.RayTaskError as error:
            self._note(error.cause if isinstance(error.cause, Exception) else error)
            return 2
        except ray.exceptions.RayError as error:
            self._note(error)
            return LOST

    def stop(self) -> None:
        """Asks it to stop after the current step, with a checkpoint."""
        self._launcher.storage.stop.remote(self._name)
        self._cancel_at = time.monotonic() + PATIENCE

    def _note(self, error: Exception) -> None:
        """Writes an error of the cluster to the log."""
        with suppress(OSError), atomic.open_log(self._log) as file:
            file.write(f"{type(error).__name__}: {cluster.one_line(error)}\n".encode())


class RayLauncher:
    """Starts runs on a Ray cluster. Mutable."""

    def __init__(self, address: str, folder: SweepFolder, workers: int | None) -> None:
        """Connects to the cluster and looks at its nodes.

        Args:
            address: ``"auto"`` or ``"HOST:PORT"``.
            folder: of the sweep.
            workers: most runs at once; None for as many as fit.

        Raises:
            MissingExtra: if Ray is not installed.
            ClusterError: if the cluster cannot be reached, a node has other versions, or none has room for a run.
        """
        self._connection = cluster.connect(address, "rejeu sweep --ray", shows_output=False)
        self.ray = self._connection.ray
        self._resources, self._workers = folder.sweep.resources, workers
        self._path = folder.path.resolve()
        self._marker, self._token = write_marker(self._path)
        self._environ = {**dict.fromkeys(THREADS, str(folder.sweep.threads)), hardware.CORES: str(folder.sweep.threads)}
        self._capacity, self._look_at = 0, -math.inf
        self._handles: list[RayRun] = []
        try:
            self._versions = cluster.versions(PACKAGES)
            self.n_sharing = self._check_nodes()
            if not self.capacity:
                raise ClusterError(
                    f"no node of the Ray cluster has room for a run with {described(self._resources)}; lower [resources]"
                )
            self.storage = self._actor(Storage).remote(str(self._path))
            self._task = self.ray.remote(train_task).options(
                max_retries=0, scheduling_strategy="SPREAD", **requested(self._resources)
            )
        except BaseException:
            self.close()
            raise

    @property
    def capacity(self) -> int:
        """Runs at once: as many as the nodes that are there now have room for."""
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + REFRESH
            room = sum(places(node["Resources"], self._resources) for node in self.ray.nodes() if node["Alive"])
            self._capacity = room if self._workers is None else min(room, self._workers)
        return self._capacity

    def start(self, task: Path, log: Path, lock: Path) -> RayRun:
        """Starts a run."""
        content = json.loads(task.read_bytes())
        content["folder"] = str(Path(content["folder"]).resolve())
        task.write_text(json.dumps(content), encoding="utf-8")
        name = Path(content["folder"]).name
        spec = Spec(
            name=name,
            task=str(task.resolve()),
            content=content,
            log=str(log.resolve()),
            lock=str(lock.resolve()),
            marker=str(self._marker),
            token=self._token,
            folder=os.getcwd(),
            environ=self._environ,
            versions=self._versions,
        )
        self.storage.start.remote(name)
        handle = RayRun(self, name, self._task.remote(spec, self.storage), log)
        self._handles.append(handle)
        return handle

    def close(self) -> None:
        """Waits a little for runs that were asked to stop, and disconnects; what still runs then stops by itself."""
        until = time.monotonic() + END
        with suppress(Exception):
            while any(one.poll() is None for one in self._handles) and time.monotonic() < until:
                time.sleep(0.2)
        with suppress(OSError):
            self._marker.unlink()
        self._connection.close()

    def _actor(self, kind: type) -> Any:
        """Returns an actor class whose actor runs on this machine and needs no CPU."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        strategy = NodeAffinitySchedulingStrategy(self.ray.get_runtime_context().get_node_id(), soft=False)
        return self.ray.remote(kind).options(num_cpus=0, scheduling_strategy=strategy, max_concurrency=1)

    def _check_nodes(self) -> int:
        """Returns how many nodes see the folder of the sweep. Nodes that are lost meanwhile do not count.

        Raises:
            ClusterError: if a node has other versions, or does not answer.
        """
        ray = self.ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        nodes = [node for node in ray.nodes() if node["Alive"]]
        task = ray.remote(look)
        answers = {
            node["NodeID"]: task.options(
                num_cpus=0,
                max_retries=0,
                scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False),
            ).remote(str(self._marker), self._token)
            for node in nodes
        }
        sharing = 0
        for node in nodes:
            where = f"the node {node['NodeManagerHostname']}"
            try:
                there, is_shared = ray.get(answers[node["NodeID"]], timeout=ANSWER)
            except ray.exceptions.GetTimeoutError:
                raise ClusterError(f"{where} has not answered for {ANSWER:g} s; look at its raylet") from None
            except (
                ray.exceptions.NodeDiedError,
                ray.exceptions.TaskUnschedulableError,
                ray.exceptions.WorkerCrashedError,
            ):
                continue  # the node has been lost since the cluster was asked for its nodes
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                raise ClusterError(
                    f"{where} cannot run rejeu: {cluster.one_line(cause)}; install the same packages on all machines"
                ) from None
            cluster.check_versions(there, where, self._versions)
            sharing += is_shared
        return sharing


def write_marker(folder: Path) -> tuple[Path, str]:
    """Writes a file by which a node sees whether it shares a folder; returns its path and its content."""
    token = secrets.token_hex(16)
    path = folder / HIDDEN / f"marker-{token[:8]}"
    path.write_text(token, encoding="utf-8")
    return path, token


def requested(resources: Resources) -> dict[str, Any]:
    """Returns resources as Ray's options."""
    found: dict[str, Any] = {"num_cpus": resources.cpus, "num_gpus": resources.gpus}
    found |= {} if resources.memory is None else {"memory": resources.memory}
    return {**found, "resources": resources.custom} if resources.custom else found


def wanted(resources: Resources) -> dict[str, float]:
    """Returns resources by Ray's names, those of which there are none left out."""
    memory = float(resources.memory or 0)
    found = {"CPU": resources.cpus, "GPU": resources.gpus, "memory": memory, **resources.custom}
    return {name: value for name, value in found.items() if value}


def places(there: Mapping[str, float], resources: Resources) -> int:
    """Returns how many runs a node has room for.

    >>> places({"CPU": 8.0, "GPU": 1.0}, Resources(cpus=2, gpus=0.5))
    2
    """
    return min(math.floor(there.get(name, 0.0) / value + 1e-6) for name, value in wanted(resources).items())


def described(resources: Resources) -> str:
    """Returns resources as text.

    >>> described(Resources(gpus=1))
    'CPU=1, GPU=1'
    """
    return ", ".join(f"{name}={value:g}" for name, value in wanted(resources).items())
