"""The code of a worker process: it runs one environment and answers requests through a pipe."""

from __future__ import annotations

import os
import random
import socket
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.core import interrupt
from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import leaves
from rejeu.core.types import Action, Info, Observation, Settings
from rejeu.envs import snapshot, validation
from rejeu.envs.workers import cluster

TOKEN_BYTES = 32
"""Length of the token that a worker on another machine presents."""
CONNECT_SECONDS = 30.0
"""Seconds that a worker has to connect to the machine that has started it."""


SAFE_PATH, OURS = "PYTHONSAFEPATH", "rejeu"
"""The variable with which Python leaves the current folder out, and our value of it; any other is the user's."""


class WorkerFailure(NamedTuple):
    """An error in a worker, as text, since not every exception can be pickled."""

    cause: Literal["raised", "bad answer", "no attribute"]
    message: str
    trace: str


class WorkerDescription(NamedTuple):
    """Sent by a worker when its environment is made."""

    observation_space: gym.Space
    action_space: gym.Space
    metadata: dict[str, object]
    render_mode: str | None


def send(pipe: Connection, message: Any) -> None:
    """Sends an object, which may contain lambdas and classes of the main script.

    A closed pipe is ignored, so that the last message of a process that exited can still be received.
    """
    try:
        data = ForkingPickler.dumps(message)
    except Exception:  # pickling its parts can raise anything
        data = ForkingPickler.dumps(CloudpickleWrapper(message))
    with suppress(BrokenPipeError, ConnectionResetError):
        pipe.send_bytes(data)


def receive(pipe: Connection) -> Any:
    """Waits for an object from the other process and returns it."""
    message = pipe.recv()
    return message.fn if isinstance(message, CloudpickleWrapper) else message


def rows(space: gym.Space, buffers: Sequence[Any], n_envs: int) -> list[np.ndarray]:
    """Returns views of shared memory as the leaves of a batch of observations, each ``(n_envs, *leaf.shape)``."""
    sized = [(leaf, n_envs * leaf.nbytes) for leaf in leaves(space)]
    return [
        np.frombuffer(buffer, np.uint8, size).view(leaf.dtype).reshape(n_envs, *leaf.shape)
        for buffer, (leaf, size) in zip(buffers, sized, strict=True)
    ]


Encode = Callable[[Any], Any]
"""Takes an observation, and returns its message; an observation may change afterwards."""
Handover = Callable[[gym.Space], Encode]
"""How a worker hands over observations of a space; sent to the worker."""


def in_shared_memory(buffers: Sequence[object], n_envs: int, number: int, space: gym.Space) -> Encode:
    """Writes observations of environment ``number`` into the memory of :func:`rows`."""
    return partial(validation.make_writer(space, rows(space, buffers, n_envs)), number)


def as_leaves(space: gym.Space) -> Encode:
    """Sends observations as the list of their leaves, arrays of the kept dtypes."""
    stores = [np.zeros((1, *leaf.shape), leaf.dtype) for leaf in leaves(space)]
    put = validation.make_writer(space, stores)

    def encode(obs: Observation) -> list[np.ndarray]:
        put(0, obs)
        return [np.array(store[0]) for store in stores]

    return encode


def as_declared(space: gym.Space) -> Encode:
    """Sends observations with their structure and the dtypes of the space."""
    return partial(validation.copy_observation, space)


@contextmanager
def safe_path() -> Iterator[None]:
    """Context in which processes of Python begin without files of the current folder in place of its own modules.

    What they then import is found as in this process.
    """
    os.environ.setdefault(SAFE_PATH, OURS)
    try:
        yield
    finally:
        _end_safe_path()


def _end_safe_path() -> None:
    """Removes the variable, which is not for processes that an environment starts."""
    if os.environ.get(SAFE_PATH) == OURS:
        del os.environ[SAFE_PATH]


def serve(pipe: Connection, make: CloudpickleWrapper, handover: Handover) -> None:
    """Answers requests for one environment, until it is closed or the main process exits.

    The global generators of NumPy and Python, of which an environment may draw, are its own: seeded at random here, and from
    the seed of each reset that has one.

    Args:
        pipe: connection to the main process.
        make: makes the environment.
        handover: how observations are handed over.
    """
    interrupt.install(interrupt.disregard)  # the main process handles Ctrl-C and SIGTERM, and may take another step
    env: gym.Env | None = None
    _end_safe_path()
    seed_globals(None)  # the fork server has imported NumPy, so that all its children would draw the same
    try:
        env = make.fn()
        if (fault := validation.environment_fault(env)) is not None:
            raise TypeError(fault)
        encode = handover(env.observation_space)
        send(pipe, WorkerDescription(env.observation_space, env.action_space, env.metadata, env.render_mode))
        while (request := receive(pipe))[0] != "close":
            send(pipe, _answered(env, request, encode))
    except (EOFError, ConnectionError):
        pass
    except Exception as error:  # any exception of the constructor: the main process raises it
        send(pipe, WorkerFailure("raised", str(error), traceback.format_exc()))
    finally:
        if env is not None:
            env.close()
        pipe.close()


class RemoteWorker:
    """A worker that connects to the process that has started it; a Ray actor is made of this class."""

    def serve(self, address: tuple[str, int], token: bytes) -> None:
        """Connects, says where it runs, and answers requests until the environment is closed or the connection ends."""
        connected = socket.create_connection(address, CONNECT_SECONDS)
        connected.sendall(token)
        pipe = as_connection(connected)
        send(pipe, {"node": node_address(), "versions": cluster.versions()})
        try:
            make, handover = receive(pipe)
        except EOFError:
            return
        except Exception as error:  # unpickling a function of a module that is missing here can raise anything
            send(pipe, WorkerFailure("raised", str(error), traceback.format_exc()))
            return
        serve(pipe, make, handover)


def node_address() -> str:
    """Returns the address of the Ray node on which this process runs."""
    import ray

    return str(ray.util.get_node_ip_address())


def as_connection(connected: socket.socket) -> Connection:
    """Returns a connected socket, which is detached, as a connection for messages."""
    connected.settimeout(None)
    connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connected.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    return Connection(connected.detach())


def receive_exactly(connected: socket.socket, n: int) -> bytes:
    """Returns ``n`` bytes of a socket.

    Raises:
        OSError: if it ends before, or times out.
    """
    data = b""
    while len(data) < n:
        chunk = connected.recv(n - len(data))
        if not chunk:
            raise ConnectionError("the connection has ended")
        data += chunk
    return data


def _answered(env: gym.Env, request: Any, encode: Encode) -> Any:
    """Returns the answer of the environment, or a :class:`WorkerFailure`."""
    try:
        return _answer(env, encode, *request)
    except BadEnvironmentError as error:
        return WorkerFailure("bad answer", str(error), traceback.format_exc())
    except Exception as error:  # the environment can raise anything
        cause: Literal["raised", "no attribute"] = "no attribute" if isinstance(error, AttributeError) else "raised"
        return WorkerFailure(cause, str(error), traceback.format_exc())


def _answer(env: gym.Env, encode: Encode, name: str, *arguments: Any) -> Any:
    """Returns the answer of an environment to one request."""
    if name == "step":
        obs, *result = validation.step_env(env, *arguments)
        return encode(obs), *result
    if name == "step_and_reset":
        return step_and_reset(env, encode, *arguments)
    if name == "reset":
        if arguments and arguments[0] is not None:
            seed_globals(arguments[0])
        obs, info = validation.reset_env(env, *arguments)
        return encode(obs), info
    if name == "snapshot":
        return snapshot.state_of(env)
    if name == "restore":
        snapshot.restore(env, *arguments)
        return snapshot.is_over(env)
    assert name == "call", name
    return arguments[0](env, *arguments[1:])


def seed_globals(seed: int | None) -> None:
    """Seeds the global generators of NumPy and Python; None: at random."""
    random.seed(seed)
    np.random.seed(None if seed is None else seed % 2**32)  # noqa: NPY002 - the one that environments draw from


def step_and_reset(
    env: gym.Env, encode: Encode, action: Action
) -> tuple[Observation, float, bool, bool, Info, Observation, Info]:
    """Steps an environment, and resets it if the episode has ended.

    Args:
        env: the environment.
        encode: of the observations.
        action: the action.

    Returns:
        The encoded observation to act on, the reward, both flags, the info, and the final observation and the info of the
        reset, which are None and empty if the episode goes on.
    """
    obs, reward, terminated, truncated, info = validation.step_env(env, action)
    if not (terminated or truncated):
        return encode(obs), reward, terminated, truncated, info, None, {}
    final = encode(obs)
    obs, reset_info = validation.reset_env(env)
    return encode(obs), reward, terminated, truncated, info, final, reset_info


def call_method(env: gym.Env, name: str, arguments: tuple[Any, ...], keywords: Settings) -> Any:
    """Calls a method, looked up through the wrappers, and returns its result."""
    return env.get_wrapper_attr(name)(*arguments, **keywords)
