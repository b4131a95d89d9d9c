"""The code of a worker process: it runs one environment and answers requests through a pipe."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.envs import batching, snapshot, validation
from rejeu.errors import BadEnvironmentError
from rejeu.spaces import leaves


class Failure(NamedTuple):
    """An error in a worker, as text, since not every exception can be pickled."""

    kind: Literal["raised", "bad answer", "no attribute"]
    message: str
    trace: str


class Description(NamedTuple):
    """Sent by a worker when its environment is made."""

    observation_space: gym.Space
    action_space: gym.Space
    metadata: dict[str, Any]
    render_mode: str | None


def send(pipe: Connection, what: Any) -> None:
    """Sends an object, which may contain lambdas and classes of the main script.

    A closed pipe is ignored, so that the last message of a process that exited can still be received.
    """
    try:
        data = ForkingPickler.dumps(what)
    except Exception:  # pickling its parts can raise anything
        data = ForkingPickler.dumps(CloudpickleWrapper(what))
    with suppress(BrokenPipeError, ConnectionResetError):
        pipe.send_bytes(data)


def receive(pipe: Connection) -> Any:
    """Waits for an object from the other process and returns it."""
    what = pipe.recv()
    return what.fn if isinstance(what, CloudpickleWrapper) else what


def rows(space: gym.Space, buffers: Sequence[Any], n_envs: int) -> list[np.ndarray]:
    """Returns views of shared memory as the leaves of a batch of observations, each ``(n_envs, *leaf.shape)``."""
    sized = [(leaf, n_envs * leaf.nbytes) for leaf in leaves(space)]
    return [
        np.frombuffer(buffer, np.uint8, size).view(leaf.dtype).reshape(n_envs, *leaf.shape)
        for buffer, (leaf, size) in zip(buffers, sized, strict=True)
    ]


def serve(
    pipe: Connection, make: CloudpickleWrapper, number: int, buffers: Sequence[Any] | None, n_envs: int = 0
) -> None:
    """Answers requests for one environment, until it is closed or the main process exits.

    Args:
        pipe: connection to the main process.
        make: makes the environment.
        number: index of the environment.
        buffers: shared memory for the observations of ``n_envs`` environments. None sends them through the pipe.
        n_envs: total number of environments.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C, and may take another step
    env: gym.Env | None = None
    try:
        env = make.fn()
        put = None
        if buffers is not None:
            put = batching.make_writer(env.observation_space, rows(env.observation_space, buffers, n_envs))
        send(pipe, Description(env.observation_space, env.action_space, env.metadata, env.render_mode))
        while (request := receive(pipe))[0] != "close":
            send(pipe, _answered(env, request, put, number))
    except (EOFError, ConnectionResetError):
        pass
    except Exception as error:  # any exception of the constructor: the main process raises it
        send(pipe, Failure("raised", str(error), traceback.format_exc()))
    finally:
        if env is not None:
            env.close()
        pipe.close()


def _answered(env: gym.Env, request: Any, put: Callable[[int, Any], None] | None, number: int) -> Any:
    """Returns the answer of the environment, or a :class:`Failure`."""
    try:
        answer = _answer(env, *request)
        if put is None or request[0] not in ("step", "reset"):
            return answer
        put(number, answer[0])
        return answer[1:]
    except BadEnvironmentError as error:
        return Failure("bad answer", str(error), traceback.format_exc())
    except Exception as error:  # the environment can raise anything
        kind: Literal["raised", "no attribute"] = "no attribute" if isinstance(error, AttributeError) else "raised"
        return Failure(kind, str(error), traceback.format_exc())


def _answer(env: gym.Env, name: str, *arguments: Any) -> Any:
    """Returns the answer of an environment to one request."""
    if name == "step":
        return checked_step(env, arguments[0])
    if name == "reset":
        return batching.reset_env(env, *arguments)
    if name == "snapshot":
        return snapshot.state_of(env)
    if name == "restore":
        snapshot.restore(env, arguments[0])
        return snapshot.is_over(env)
    assert name == "call", name
    function, *rest = arguments
    return function(env, *rest)


def checked_step(env: gym.Env, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Steps an environment and returns the result, with numbers as Python scalars.

    Raises:
        BadEnvironmentError: if ``step`` does not return the five values, or the observation does not match its space.
    """
    answer = env.step(action)
    fault = validation.step_fault(answer, env.observation_space)
    if fault is not None:
        raise BadEnvironmentError(fault)
    return validation.convert_step(answer)
