"""Runs as tasks on a Ray cluster whose machines share the folder of the sweep. Only Ray Core is used.

This module is imported on the nodes, so it does not import JAX.
"""

from __future__ import annotations

import math
import os
import platform
import secrets
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from rejeu.core import atomic, hardware
from rejeu.core.errors import ClusterError
from rejeu.core.records import brief
from rejeu.core.types import Settings
from rejeu.envs.workers import cluster
from rejeu.lab.runs.config import read_task, write_task
from rejeu.lab.runs.process import LOST, THREADS, Process

if TYPE_CHECKING:
    from rejeu.lab.experiments.folder import Resources

POLL = 0.5
"""Seconds between two looks at the process on a node."""
GRACE = 300.0
"""Seconds after which a process that was asked to stop is killed."""
REFRESH = 5.0
"""Seconds between two looks at the nodes of the cluster."""
ANSWER = 60.0
"""Seconds that a node has to answer when the sweep begins."""
PATIENCE = 120.0
"""Seconds after which a run that was asked to stop, but waits for a node or hangs, is canceled."""
END = 30.0
"""Seconds that the tasks have to end when the sweep ends early."""
PACKAGES = ("jax", "jaxlib", "optax")
"""Further packages whose versions results depend on."""


def look(marker: str) -> tuple[dict[str, str], bool]:
    """Returns the versions of this node, and whether it sees the folder of the sweep."""
    return cluster.versions(PACKAGES), Path(marker).is_file()


def train(
    task: Path, log: Path, stop: Path, marker: str, folder: Path, environ: dict[str, str], versions: dict[str, str]
) -> int:
    """Trains on this node until the process ends, and returns its exit status. A Ray task.

    The process stops with a checkpoint when it is asked to, and when this function is left by an error.

    Args:
        task: file with what the process is asked to do. Paths are the same on all machines.
        log: what the process prints.
        stop: file that asks the run to stop.
        marker: file that a node sees if it shares the folder of the sweep; no other file has its name.
        folder: current folder.
        environ: further environment variables.
        versions: versions that the node must have.

    Raises:
        ClusterError: if this node has other versions, or does not see the folder of the sweep.
    """
    where = f"the node {platform.node()}"
    check_node(*look(marker), where, versions, marker)
    process = Process(task, log, {**os.environ, **environ}, folder if folder.is_dir() else None)
    kill_at = math.inf
    try:
        while (status := process.poll()) is None:
            time.sleep(POLL)
            if kill_at == math.inf and stop.exists():
                kill_at = time.monotonic() + GRACE
                process.stop()
            if time.monotonic() > kill_at:
                process.kill()
        return status
    finally:
        process.stop()


def check_node(node_versions: dict[str, str], is_seen: bool, where: str, versions: dict[str, str], marker: str) -> None:
    """Raises ``ClusterError`` if a machine, called ``where``, has other versions or does not see the folder of the sweep."""
    cluster.check_versions(node_versions, where, versions)
    if not is_seen:
        raise ClusterError(
            f"{where} does not see {Path(marker).parents[1]}, the folder of the sweep; name one with --out that all "
            "machines share under the same path"
        )


class RayRun:
    """A run on a cluster. Mutable."""

    def __init__(self, ray: ModuleType, result: object, log: Path, stop: Path) -> None:
        self._ray, self._result, self._log, self._stop = ray, result, log, stop
        self._cancel_at = math.inf

    def poll(self) -> int | None:
        """Returns the exit status, ``LOST`` if the node or the worker process was lost; None while it runs."""
        ray = self._ray
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
        with suppress(OSError):
            atomic.touch(self._stop)
        self._cancel_at = time.monotonic() + PATIENCE

    def _note(self, error: Exception) -> None:
        """Writes an error of the cluster to the log."""
        with suppress(OSError), atomic.open_file(self._log) as file:
            file.write(f"{type(error).__name__}: {brief(error)}\n".encode())


class RayLauncher:
    """Starts runs on a Ray cluster. Mutable."""

    def __init__(self, address: str, hidden: Path, resources: Resources, threads: int, workers: int | None) -> None:
        """Connects to the cluster and looks at its nodes.

        Args:
            address: ``"auto"`` or ``"HOST:PORT"``.
            hidden: folder for files about the runs, in that of the sweep.
            resources: what a run needs.
            threads: of each run.
            workers: most runs at once; None for as many as fit.

        Raises:
            MissingExtra: if Ray is not installed.
            ClusterError: if the cluster cannot be reached, a node has other versions or does not see the folder, or none has
                room for a run.
        """
        self._connection = cluster.connect(address, "rejeu sweep --ray", shows_output=False)
        self._ray = self._connection.ray
        self._resources, self._workers = resources, workers
        self._environ = {**dict.fromkeys(THREADS, str(threads)), hardware.CORES: str(threads)}
        self._capacity, self._look_at = 0, -math.inf
        self._handles: list[RayRun] = []
        self._marker = write_marker(hidden.resolve())
        try:
            self._versions = cluster.versions(PACKAGES)
            self._check_nodes()
            if not self.capacity:
                raise ClusterError(
                    f"no node of the Ray cluster has room for a run with {described(resources)}; lower [resources]"
                )
            options = {"max_retries": 0, "scheduling_strategy": "SPREAD", **requested(resources)}
            self._task = self._ray.remote(train).options(**options)
        except BaseException:
            self.close()
            raise

    @property
    def capacity(self) -> int:
        """Runs at once: as many as the nodes that are there now have room for."""
        now = time.monotonic()
        if now >= self._look_at:
            self._look_at = now + REFRESH
            room = sum(places(node["Resources"], self._resources) for node in self._ray.nodes() if node["Alive"])
            self._capacity = room if self._workers is None else min(room, self._workers)
        return self._capacity

    def start(self, task: Path, log: Path) -> RayRun:
        """Starts a run."""
        description = read_task(task)
        write_task(task, replace(description, folder=str(Path(description.folder).resolve())))
        stop = task.with_suffix(".stop")
        stop.unlink(missing_ok=True)
        files = task.resolve(), log.resolve(), stop.resolve(), self._marker, Path.cwd()
        result = self._task.remote(*files, self._environ, self._versions)
        self._handles.append(RayRun(self._ray, result, log, stop))
        return self._handles[-1]

    def close(self) -> None:
        """Waits a little for runs that were asked to stop, and disconnects; what still runs then stops by itself."""
        until = time.monotonic() + END
        with suppress(Exception):
            while any(handle.poll() is None for handle in self._handles) and time.monotonic() < until:
                time.sleep(0.2)
        with suppress(OSError):
            Path(self._marker).unlink()
        self._connection.close()

    def _check_nodes(self) -> None:
        """Looks at all nodes, but not at those that are lost meanwhile.

        Raises:
            ClusterError: if a node has other versions, does not see the folder, or does not answer.
        """
        ray = self._ray
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        nodes = [node for node in ray.nodes() if node["Alive"]]
        task, options = ray.remote(look), {"num_cpus": 0, "max_retries": 0}
        there = [NodeAffinitySchedulingStrategy(node["NodeID"], soft=False) for node in nodes]
        references = [task.options(**options, scheduling_strategy=node).remote(self._marker) for node in there]
        lost = ray.exceptions.NodeDiedError, ray.exceptions.TaskUnschedulableError, ray.exceptions.WorkerCrashedError
        for node, reference in zip(nodes, references, strict=True):
            where = f"the node {node['NodeManagerHostname']}"
            try:
                node_versions, is_seen = ray.get(reference, timeout=ANSWER)
            except ray.exceptions.GetTimeoutError:
                raise ClusterError(f"{where} has not answered for {ANSWER:g} s; look at its raylet") from None
            except lost:
                continue  # since the cluster was asked for its nodes
            except ray.exceptions.RayError as error:
                cause = getattr(error, "cause", None) or error
                raise ClusterError(
                    f"{where} cannot run rejeu: {brief(cause)}; install the same packages on all machines"
                ) from None
            check_node(node_versions, is_seen, where, self._versions, self._marker)


def write_marker(folder: Path) -> str:
    """Writes an empty file with a name of its own to a folder, and returns its path."""
    path = folder / f"marker-{secrets.token_hex(16)}"
    atomic.touch(path)
    return str(path)


def requested(resources: Resources) -> Settings:
    """Returns resources as Ray's options."""
    options: Settings = {"num_cpus": resources.cpus, "num_gpus": resources.gpus}
    options |= {} if resources.memory is None else {"memory": resources.memory}
    return {**options, "resources": resources.custom} if resources.custom else options


def wanted(resources: Resources) -> dict[str, float]:
    """Returns resources by Ray's names, those of which there are none left out."""
    memory = float(resources.memory or 0)
    amounts = {"CPU": resources.cpus, "GPU": resources.gpus, "memory": memory, **resources.custom}
    return {name: value for name, value in amounts.items() if value}


def places(available: Mapping[str, float], resources: Resources) -> int:
    """Returns how many runs a node has room for.

    >>> from rejeu.lab.experiments.folder import Resources
    >>> places({"CPU": 8.0, "GPU": 1.0}, Resources(cpus=2, gpus=0.5))
    2
    """
    return min(math.floor(available.get(name, 0.0) / value + 1e-6) for name, value in wanted(resources).items())


def described(resources: Resources) -> str:
    """Returns resources as text.

    >>> from rejeu.lab.experiments.folder import Resources
    >>> described(Resources(gpus=1))
    'CPU=1, GPU=1'
    """
    return ", ".join(f"{name}={value:g}" for name, value in wanted(resources).items())
