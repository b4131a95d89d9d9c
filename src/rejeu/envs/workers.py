"""Environments in worker processes: Gymnasium's ``AsyncVectorEnv``, started safely beside JAX, with errors that come back.

A process that uses JAX has threads, and forking it is unsafe, so workers are forked from a server that has none (Linux) or
started anew (elsewhere). Both run the main script again, up to its ``if __name__ == "__main__":``.
"""

from __future__ import annotations

import ast
import linecache
import multiprocessing
import signal
import sys
import traceback
from collections.abc import Callable
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.errors import WorkerError

START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
FAILURE = "rejeu_failure"
"""Where the info of a step or reset holds the traceback of what went wrong in it."""


def start(make_one: Callable[[], gym.Env], one: gym.Env, n_envs: int) -> AsyncVectorEnv:
    """Returns ``n_envs`` environments, each in a process of its own, observations in shared memory, nothing reset by itself.

    Args:
        make_one: makes an environment; it is sent to the workers.
        one: an environment that it made, for its spaces; closed here.
        n_envs: how many.

    Raises:
        TypeError: if ``make_one`` cannot be sent.
        WorkerError: if a worker cannot be started, or fails to make its environment.
    """
    check_sendable(make_one)
    if main_runs_again():
        raise WorkerError(
            "worker processes run the main script again from its beginning, so what starts them must stand under "
            "`if __name__ == '__main__':`; put it there, or use backend='gymnasium'"
        )
    if START_METHOD == "forkserver":
        # Imported once, in the server: a worker is then there in milliseconds. It starts no threads.
        multiprocessing.set_forkserver_preload([__name__])
    functions = [_Remote(make_one, one) for _ in range(n_envs)]
    try:
        env = AsyncVectorEnv(functions, shared_memory=True, context=START_METHOD, autoreset_mode=AutoresetMode.DISABLED)
        failures = [failure for failure in env.get_attr("failure") if failure]
    except (EOFError, ConnectionError) as error:
        raise WorkerError(
            "a worker process ended before it had made its environment; what it printed says why. It runs the main "
            "script again, so that must be possible to import; backend='gymnasium' does without workers"
        ) from error
    if failures:
        env.close()
        raise WorkerError(f"the environment could not be made in a worker process:\n{failures[0]}")
    return env


def check_sendable(make_one: Callable[[], gym.Env]) -> None:
    """Raises ``TypeError`` unless the function can be sent to another process."""
    try:
        ForkingPickler.dumps(CloudpickleWrapper(make_one))
    except Exception as error:  # whatever the things that it refers to raise
        raise TypeError(
            f"the function that makes environments is sent to worker processes, and cannot be pickled: {error}; let it "
            "make what it needs instead of referring to it, or use backend='gymnasium'"
        ) from error


def failed(info: dict[str, Any]) -> WorkerError:
    """Returns the error that a step or reset met with in a worker, which left ``FAILURE`` in its info."""
    found = [(i, text) for i, text in enumerate(info[FAILURE]) if text]
    which = "environments" if len(found) > 1 else "environment"
    numbers = ", ".join(str(i) for i, _ in found)
    return WorkerError(f"{which} {numbers} failed in a worker process:\n{found[0][1]}")


def ended(env: AsyncVectorEnv) -> WorkerError:
    """Returns the error that says which worker is gone, after ending the others."""
    gone = [(i, process) for i, process in enumerate(env.processes) if not _lives(process)]
    said = "; ".join(f"that of environment {i} with exit code {process.exitcode}" for i, process in gone)
    for process in env.processes:
        process.terminate()
    for process in env.processes:
        process.join()
    env.closed = True  # closing it in the ordinary way would wait for answers
    return WorkerError(f"a worker process ended by itself: {said or 'unknown which'}; what it printed may say why")


def _lives(process: Any) -> bool:
    process.join(0.2)  # its pipe may close a moment before it is gone
    return process.exitcode is None


def main_runs_again() -> bool | None:
    """Returns whether a worker process, which imports the main script, would come by the present statement again.

    None if that cannot be told: in another thread than the main one, or without the script's text.
    """
    main = sys.modules["__main__"]
    spec = getattr(main, "__spec__", None)
    path = getattr(main, "__file__", None)
    if path is None or (spec is not None and spec.name.endswith("__main__")):
        return False  # an interactive session, or a package that is run: neither is imported by a worker
    frame, here = sys._getframe(), None
    while frame is not None:
        if frame.f_globals is vars(main) and frame.f_code.co_name == "<module>":
            here = frame.f_lineno
        frame = frame.f_back  # type: ignore[assignment]
    source = "".join(linecache.getlines(path, vars(main)))
    if here is None or not source:
        return None
    try:
        statements = ast.parse(source).body
    except SyntaxError:
        return None
    return not any(
        isinstance(statement, ast.If)
        and statement.lineno <= here <= (statement.end_lineno or here)
        and any(isinstance(node, ast.Name) and node.id == "__name__" for node in ast.walk(statement.test))
        for statement in statements
    )


class _Remote:
    """Makes the environment in a worker; here, it hands out the one that was made for its spaces."""

    def __init__(self, make_one: Callable[[], gym.Env], one: gym.Env) -> None:
        self.make_one = make_one
        self.spaces = one.observation_space, one.action_space
        self.here: gym.Env | None = one

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "here": None}

    def __call__(self) -> gym.Env:
        if self.here is not None:
            return self.here
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the main process, which may want another step
        try:
            return _Reporting(self.make_one())
        except Exception:  # whatever the environment raises
            return _Unmade(traceback.format_exc(), *self.spaces)


class _Reporting(gym.Wrapper):
    """Hands on an exception as text in the info: not every exception can be sent from one process to another."""

    failure = None

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        try:
            return self.env.step(action)
        except Exception:  # whatever the environment raises
            return self.observation_space.sample(), 0.0, False, False, {FAILURE: traceback.format_exc()}

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        try:
            return self.env.reset(**kwargs)
        except Exception:  # whatever the environment raises
            return self.observation_space.sample(), {FAILURE: traceback.format_exc()}


class _Unmade(gym.Env):
    """Stands for an environment that could not be made, so that it can be said why."""

    def __init__(self, failure: str, observation_space: gym.Space, action_space: gym.Space) -> None:
        self.failure = failure
        self.observation_space, self.action_space = observation_space, action_space
