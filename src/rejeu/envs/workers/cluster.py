"""Connections to a Ray cluster: bounded waits, errors of one line, and no Ray left running when nothing uses it.

Ray is imported here, when it is needed first. Only Ray Core is used.
"""

from __future__ import annotations

import logging
import os
import platform
import signal
import socket
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType

from rejeu.core.errors import ClusterError, MissingExtra, installed
from rejeu.core.records import brief

LOOPBACK = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Environment variable without which Ray listens on the address of a network card, also for processes of one machine."""
REACH_SECONDS = 10.0
"""Seconds that a cluster has to accept a connection."""
MATCHING = ("rejeu", "gymnasium", "numpy")
"""Packages whose versions must be the same on all machines, like those of Python and Ray."""

_connections: set[Connection] = set()
"""Those that are open; Ray has one connection for the whole process."""
_is_ours = False
"""Whether Ray was connected here, and not by the user's program."""
_is_local = False
"""Whether the cluster was started for this process."""


class Connection:
    """The use of a Ray cluster by one part of a program. Mutable; see :func:`connect`."""

    def __init__(self, ray: ModuleType) -> None:
        self.ray = ray
        """The module ``ray``."""
        self.is_local = _is_local
        """Whether the cluster was started for this process."""
        _connections.add(self)

    def close(self) -> None:
        """Ends this use, and disconnects from Ray with the last one, unless the program itself connected to Ray.

        Further calls do nothing. A cluster that was started for this process ends then.
        """
        global _is_ours, _is_local
        _connections.discard(self)
        if _is_ours and not _connections:
            _is_ours = _is_local = False
            self.ray.shutdown()


def connect(address: str | None = None, purpose: str = "backend='ray'", shows_output: bool = True) -> Connection:
    """Connects this process to a Ray cluster, or uses the connection that it has.

    Args:
        address: ``"HOST:PORT"`` of the cluster, or ``"auto"`` for the one that this machine belongs to. None: the one in the
            environment variable ``RAY_ADDRESS``, else one that is started on this machine for this process.
        purpose: what needs Ray, for the message if it is not installed.
        shows_output: whether this process prints what others of the cluster print, and Ray's notices of lost nodes.

    Raises:
        MissingExtra: if Ray is not installed.
        ClusterError: if there is no such cluster, it does not answer, or has another version of Python or Ray.
        ValueError: for an address of another form.
    """
    global _is_ours, _is_local
    if not (address or os.environ.get("RAY_ADDRESS")):
        os.environ.setdefault(LOOPBACK, "0")  # read when Ray is imported, and by the processes that it starts
    try:
        import ray
    except ImportError as error:
        raise MissingExtra(purpose, "ray", "ray") from error
    if not ray.is_initialized():
        address = address or os.environ.get("RAY_ADDRESS") or None
        if address == "auto":
            address = os.environ.get("RAY_ADDRESS") or current_address() or "auto"
        if address is not None and address != "auto":
            check_reachable(as_ray_resolves(address, ray))
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # a cluster that is started here reports nothing
        try:
            with signals_kept(), warnings.catch_warnings():
                # Ray starts its own programs so, at once and without Python in between.
                warnings.filterwarnings("ignore", "os.fork", RuntimeWarning)
                ray.init(
                    address or "local",  # else Ray would join any cluster that somebody started on this machine
                    include_dashboard=None if address else False,
                    logging_level=logging.ERROR,
                    configure_logging=False,
                    log_to_driver=shows_output,
                )
        except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
            where = "a cluster on this machine" if address is None else f"the Ray cluster {address!r}"
            raise ClusterError(f"cannot connect to {where}: {brief(error)}") from error
        _is_ours, _is_local = True, address is None
    return Connection(ray)


def current_address() -> str | None:
    """Returns the address of the cluster that this machine belongs to, None if there is none or Ray does not say."""
    try:
        from ray._private.utils import read_ray_address  # there is no public way to ask
    except ImportError:
        return None
    address = read_ray_address()
    return address or None


def as_ray_resolves(address: str, ray: ModuleType) -> str:
    """Returns an address as Ray uses it, which replaces the loopback address by that of this machine in the network."""
    host, _, port = address.rpartition(":")
    return f"{ray.util.get_node_ip_address()}:{port}" if host in ("127.0.0.1", "localhost") else address


def check_reachable(address: str) -> None:
    """Connects to an address once, because Ray itself may wait for minutes.

    Raises:
        ValueError: unless the address is ``HOST:PORT``.
        ClusterError: if nothing accepts the connection within :data:`REACH_SECONDS`.
    """
    host, _, port = address.rpartition(":")
    if "://" in address:
        raise ValueError(
            f"the Ray address {address!r} is that of a client; run on a machine of the cluster, with 'auto'"
        )
    if not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 2**16:
        raise ValueError(f"the Ray address is {address!r}, expected HOST:PORT such as '10.0.0.1:6379', or 'auto'")
    try:
        socket.create_connection((host.strip("[]"), int(port)), REACH_SECONDS).close()
    except OSError as error:
        raise ClusterError(
            f"the Ray cluster {address!r} cannot be reached: {error}; start it with `ray start --head`, or check the address"
        ) from error


@contextmanager
def signals_kept() -> Iterator[None]:
    """Restores the handlers of SIGINT and SIGTERM on exit, because Ray replaces them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if handler is not None:
                signal.signal(number, handler)


def versions(more: Iterable[str] = ()) -> dict[str, str]:
    """Returns the versions that must be the same on all machines; empty for a package that has none.

    Args:
        more: further packages.
    """
    python = ".".join(platform.python_version_tuple()[:2])
    return {"Python": python, **{package: installed(package) or "" for package in (*MATCHING, *more)}}


def check_versions(there: Mapping[str, str], where: str, here: Mapping[str, str] | None = None) -> None:
    """Raises ``ClusterError`` if the versions of another machine, called ``where``, differ from those here.

    Args:
        there: its versions.
        where: what it is called in the message.
        here: by default those of :func:`versions`.
    """
    here = versions() if here is None else here
    different = [name for name in here if there.get(name) != here[name]]
    wrong = [f"{name} {there.get(name) or 'of no version'} and not {here[name]}" for name in different]
    if wrong:
        raise ClusterError(f"{where} has {', '.join(wrong)} as here; install the same versions on all machines")
