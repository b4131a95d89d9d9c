"""What runs in a worker process: one environment, which answers what it is asked through a pipe."""

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
    """What went wrong in a worker, in words: not every exception can be sent from one process to another."""

    kind: Literal["raised", "bad answer", "no attribute"]
    message: str
    trace: str


class Description(NamedTuple):
    """What a worker says once its environment is made."""

    observation_space: gym.Space
    action_space: gym.Space
    metadata: dict[str, Any]
    render_mode: str | None


def send(pipe: Connection, what: Any) -> None:
    """Sends anything, lambdas and classes of a script too; what it said last can be read from a side that has gone."""
    try:
        data = ForkingPickler.dumps(what)
    except Exception:  # whatever the things in it raise when they are pickled
        data = ForkingPickler.dumps(CloudpickleWrapper(what))
    with suppress(BrokenPipeError, ConnectionResetError):
        pipe.send_bytes(data)


def receive(pipe: Connection) -> Any:
    """Returns what the other side sent; waits for it."""
    what = pipe.recv()
    return what.fn if isinstance(what, CloudpickleWrapper) else what


def rows(space: gym.Space, buffers: Sequence[Any], n_envs: int) -> list[np.ndarray]:
    """Returns shared memory as the leaves of a batch of observations, ``(n_envs, *leaf.shape)`` each."""
    sized = [(leaf, n_envs * leaf.nbytes) for leaf in leaves(space)]
    return [
        np.frombuffer(buffer, np.uint8, size).view(leaf.dtype).reshape(n_envs, *leaf.shape)
        for buffer, (leaf, size) in zip(buffers, sized, strict=True)
    ]


def serve(
    pipe: Connection, make: CloudpickleWrapper, number: int, buffers: Sequence[Any] | None, n_envs: int = 0
) -> None:
    """Serves one environment until it is told to close or the other side is gone.

    Args:
        pipe: to the process that asks.
        make: makes the environment.
        number: of the environment.
        buffers: shared memory for the observations of ``n_envs`` environments; None if there is none.
        n_envs: how many there are in all.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the main process, which may want another step
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
    except Exception as error:  # whatever making the environment raised: the other side raises it
        send(pipe, Failure("raised", str(error), traceback.format_exc()))
    finally:
        if env is not None:
            env.close()
        pipe.close()


def _answered(env: gym.Env, request: Any, put: Callable[[int, Any], None] | None, number: int) -> Any:
    """Returns what the environment answers, or how it failed."""
    try:
        answer = _answer(env, *request)
        if put is None or request[0] not in ("step", "reset"):
            return answer
        put(number, answer[0])
        return answer[1:]
    except BadEnvironmentError as error:
        return Failure("bad answer", str(error), traceback.format_exc())
    except Exception as error:  # whatever the environment raises
        kind: Literal["raised", "no attribute"] = "no attribute" if isinstance(error, AttributeError) else "raised"
        return Failure(kind, str(error), traceback.format_exc())


def _answer(env: gym.Env, name: str, *arguments: Any) -> Any:
    """Returns what an environment says to one request."""
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
    """Returns what a step of an environment returned, its numbers as plain ones.

    Raises:
        BadEnvironmentError: if that is something else than the five values, or an observation does not fit its space.
    """
    answer = env.step(action)
    fault = validation.step_fault(answer, env.observation_space)
    if fault is not None:
        raise BadEnvironmentError(fault)
    return validation.convert_step(answer)
