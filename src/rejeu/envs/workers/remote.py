"""Workers on the machines of a Ray cluster: one actor each.

Ray places the actors, and ends them. Requests and answers do not go through Ray, because a call of an actor takes several
times as long as a message: each actor connects to this process, with a token that is accepted once. The messages are
pickles, as Ray's own are, and are not encrypted: a cluster must be in a network that it shares with nobody else.
"""

from __future__ import annotations

import hmac
import secrets
import socket
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

import gymnasium as gym
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.core import validation
from rejeu.core.errors import WorkerError
from rejeu.core.records import brief, shown
from rejeu.core.types import Settings
from rejeu.envs.workers import cluster, process
from rejeu.envs.workers.pool import LOOK_SECONDS, Starter, Worker, seconds_until
from rejeu.envs.workers.process import TOKEN_BYTES, RemoteWorker

SLOW_START_SECONDS = 30.0
"""Seconds after which a warning says that a worker still waits for its place on the cluster."""
MAX_TRIES = 5
"""Actors that are started for a worker before it counts as one that cannot be started."""
TOKEN_SECONDS = 5.0
"""Seconds that a connection has to present its token."""


@dataclass(frozen=True)
class RayOptions:
    """The resources that an environment in an actor reserves, and the cluster."""

    address: str | None = None
    """``"HOST:PORT"`` of the cluster, or ``"auto"``; see :func:`rejeu.envs.workers.cluster.connect`."""
    num_cpus: float | None = None
    """CPUs that each environment reserves; a fraction for simulators that mostly wait. None: 1, and 0 on a cluster that is
    started for this process, where nothing else needs a place."""
    num_gpus: float = 0.0
    """GPUs that each environment reserves."""
    memory: float | None = None
    """Bytes of memory that each environment reserves, None for none."""
    resources: Mapping[str, float] = field(default_factory=dict)
    """Custom resources of the cluster that each environment reserves, by name."""

    def __post_init__(self) -> None:
        if self.address is not None and not isinstance(self.address, str):
            raise TypeError(f"address={self.address!r} must be 'HOST:PORT' or 'auto'")
        validation.coerce(self, "num_gpus", validation.number, least=0)
        validation.coerce(self, ("num_cpus", "memory"), validation.number, optional=True, least=0)
        if not isinstance(self.resources, Mapping):
            raise TypeError(f"resources={self.resources!r} must be a dict of numbers by name")
        needs = self.resources.items()
        resources = {str(key): validation.number(f"resources[{key!r}]", need, least=0) for key, need in needs}
        validation.assign(self, resources=resources)

    def reserved(self, is_local: bool) -> Settings:
        """Returns the reservation as options of a Ray actor; ``is_local``: on a cluster started for this process."""
        return {
            "num_cpus": (0.0 if is_local else 1.0) if self.num_cpus is None else self.num_cpus,
            "num_gpus": self.num_gpus,
            "memory": self.memory,
            "resources": dict(self.resources),
        }


class Actors(Starter):
    """Starts workers as actors of a Ray cluster."""

    advice = "backend='gymnasium-async' uses processes of this machine"

    def __init__(self, options: Mapping[str, object]) -> None:
        """Connects to the cluster, and listens for its workers.

        Args:
            options: the fields of :class:`RayOptions`.

        Raises:
            MissingExtra: if Ray is not installed.
            ClusterError: if the cluster cannot be reached.
            TypeError, ValueError: for invalid options.
        """
        self.options = validation.build(RayOptions, options)
        self._connection = cluster.connect(self.options.address)
        self.ray = self._connection.ray
        self.reserved = self.options.reserved(self._connection.is_local)
        """The resources that each worker reserves, as options of a Ray actor."""
        try:
            self._class = self.ray.remote(RemoteWorker)
            self._server = socket.create_server((self.ray.util.get_node_ip_address(), 0), backlog=1024)
        except BaseException:
            self._connection.close()
            raise
        self._waiting: dict[bytes, ActorWorker] = {}
        """Workers that have not connected yet, by their tokens."""

    def start(self, number: int, make: Callable[[], gym.Env]) -> ActorWorker:
        return ActorWorker(number, make, self)

    def launch(self, worker: ActorWorker) -> tuple[object, object]:
        """Makes the actor of a worker, which will connect; returns it, and the reference to the end of its only task."""
        self.forget(worker)
        token = secrets.token_bytes(TOKEN_BYTES)
        # Ray would restart a lost actor by itself, but with an environment that nobody has seeded.
        actor = self._class.options(max_restarts=0, max_task_retries=0, **self.reserved).remote()
        self._waiting[token] = worker
        return actor, actor.serve.remote(self._server.getsockname()[:2], token)

    def accept(self, seconds: float) -> None:
        """Waits for one connection, for at most so many seconds. Those without a token that is expected are closed."""
        self._server.settimeout(max(seconds, 0.01))
        try:
            connected, _ = self._server.accept()
        except TimeoutError:
            return
        with suppress(OSError):
            connected.settimeout(TOKEN_SECONDS)
            token = process.receive_exactly(connected, TOKEN_BYTES)
            expected = next((candidate for candidate in self._waiting if hmac.compare_digest(candidate, token)), None)
            if expected is not None:
                self._waiting.pop(expected).connected(process.as_connection(connected))
                return
        connected.close()

    def forget(self, worker: ActorWorker) -> None:
        """Accepts no connection of a worker anymore."""
        self._waiting = {token: waiting for token, waiting in self._waiting.items() if waiting is not worker}

    def close(self) -> None:
        self._server.close()
        self._connection.close()


class ActorWorker(Worker):
    """A handle of a worker in an actor of a Ray cluster."""

    def __init__(self, number: int, make: Callable[[], gym.Env], actors: Actors) -> None:
        """Starts the actor."""
        super().__init__(number, None)
        self._make, self._actors = CloudpickleWrapper(make), actors
        self._node, self._ended = "", ""
        self._is_connected = False
        self._n_tries = 1
        self._actor, self._served = actors.launch(self)

    @property
    def place(self) -> str:
        return f"the Ray actor of environment {self.number}" + (f" on node {self._node}" if self._node else "")

    @property
    def alive(self) -> bool:
        return not self._ended and not self._actors.ray.wait([self._served], timeout=0)[0]

    def connected(self, pipe: Connection) -> None:
        """Takes the connection that the actor has made."""
        self.pipe, self._is_connected = pipe, True

    def connect(self, deadline: float | None) -> None:
        began, is_told = time.monotonic(), False
        while not self._is_connected:
            self._actors.accept(seconds_until(deadline, LOOK_SECONDS))
            if self._is_connected:
                break
            if not self.alive:
                self._try_again()
            if deadline is not None and time.monotonic() >= deadline:
                raise WorkerError(f"{self.place} found no place on the cluster, {self._needs()}: {self.end()}")
            if not is_told and time.monotonic() - began > SLOW_START_SECONDS:
                is_told = True
                warnings.warn(
                    f"{self.place} waits for a place on the cluster, {self._needs()}", RuntimeWarning, stacklevel=2
                )
        hello = self.answer(deadline)
        self._node = hello["node"]
        try:
            cluster.check_versions(hello["versions"], f"node {self._node}")
        except BaseException:
            self.end()
            raise
        self.asked, self.asked_at = "make", time.monotonic()
        process.send(self.pipe, (self._make, process.as_leaves))

    def _try_again(self) -> None:
        """Starts another actor, because Ray may place one on a node that it does not know yet to be lost.

        Raises:
            WorkerError: if the actor has raised an error, or after :data:`MAX_TRIES`.
        """
        why, is_error = self._how_it_ended()
        if is_error or self._n_tries == MAX_TRIES:
            self.end()
            raise WorkerError(f"{self.place} could not be started: {why}")
        self._n_tries += 1
        self._actor, self._served = self._actors.launch(self)

    def _needs(self) -> str:
        reserved = {key: value for key, value in self._actors.reserved.items() if value}
        resources = self._actors.ray.cluster_resources()
        return f"of which each environment reserves {reserved}, and which has {resources.get('CPU', 0):g} CPUs in all"

    def stop(self) -> None:
        if not self._ended:
            with suppress(Exception):  # Ray may be gone already
                self._actors.ray.kill(self._actor, no_restart=True)

    def join(self, seconds: float) -> None:
        self._actors.ray.wait([self._served], timeout=seconds)

    def end(self) -> str:
        if self._ended:
            return self._ended
        if self._is_connected:
            self.pipe.close()
        self._actors.forget(self)
        self._ended, _ = self._how_it_ended()
        with suppress(Exception):  # Ray may be gone already
            self._actors.ray.kill(self._actor, no_restart=True)
        return self._ended

    def _how_it_ended(self) -> tuple[str, bool]:
        """Returns how an actor has ended, on one line, and whether by an error that it has raised."""
        ray = self._actors.ray
        if not ray.is_initialized():
            return "Ray was shut down", False
        try:
            ray.get(self._served, timeout=0.5)
        except ray.exceptions.GetTimeoutError:
            return "its connection has ended", False
        except ray.exceptions.RayTaskError as error:
            return f"{type(error.cause).__name__}: {brief(error.cause)}", True
        except ray.exceptions.RayError as error:
            *_, reason = ["", *str(error).strip().splitlines()]
            return shown(reason.partition(" Some common causes")[0], 400) or type(error).__name__, False
        return "it has returned", True
