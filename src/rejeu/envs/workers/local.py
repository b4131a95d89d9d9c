"""Worker processes on this machine.

A process that uses JAX has threads, so forking it is unsafe. On Linux, workers are forked from a server process without
threads. On other systems they are spawned. Both run the main script again, up to its ``if __name__ == "__main__":``.
"""

from __future__ import annotations

import ast
import linecache
import multiprocessing
import signal
import sys
from collections.abc import Callable
from multiprocessing.reduction import ForkingPickler
from typing import Any

import gymnasium as gym
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.envs.workers import process
from rejeu.envs.workers.process import Copied, Encoder
from rejeu.envs.workers.worker import CLOSE_SECONDS, Starter, Worker
from rejeu.errors import WorkerError

START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"


class ProcessWorker(Worker):
    """A handle of a worker process on this machine."""

    def __init__(self, number: int, make: Callable[[], gym.Env], context: Any, encoder: Encoder) -> None:
        """Starts the process. ``encoder`` is passed to :func:`rejeu.envs.workers.process.serve`."""
        pipe, theirs = context.Pipe()
        super().__init__(number, pipe)
        self._ended: str | None = None
        arguments = (theirs, CloudpickleWrapper(make), encoder)
        self.process = context.Process(target=process.serve, args=arguments, daemon=True)
        self.process.start()
        theirs.close()

    @property
    def place(self) -> str:
        return f"the worker process of environment {self.number}"

    @property
    def alive(self) -> bool:
        return self._ended is None and self.process.is_alive()

    def connect(self, deadline: float | None) -> None:
        """Does nothing: the pipe exists before the process."""

    def stop(self) -> None:
        if self.alive:
            self.process.terminate()

    def join(self, seconds: float) -> None:
        self.process.join(seconds)

    def end(self) -> str:
        if self._ended is not None:
            return self._ended
        self.pipe.close()
        process = self.process
        process.join(0.2)  # the pipe may close shortly before the process exits
        for stop in (process.terminate, process.kill):
            if process.is_alive():
                stop()
                process.join(CLOSE_SECONDS)
        code = process.exitcode
        names = {-one: one.name for one in signal.Signals}
        self._ended = f"exit code {code}" + (f", {names[code]}" if code in names else "")
        if code is not None:
            process.close()
        return self._ended


class Processes(Starter):
    """Starts worker processes on this machine."""

    def __init__(
        self,
        start_method: str | None = None,
        encoders: Callable[[Any], Callable[[int], Encoder]] | None = None,
        preload: str | None = None,
    ) -> None:
        """Prepares the start of processes.

        Args:
            start_method: start method of ``multiprocessing``. None uses :data:`START_METHOD`.
            encoders: takes the ``multiprocessing`` context and returns a function that returns the encoder of each worker by
                its number. None: observations are sent with the dtypes of the space.
            preload: name of an additional module that the workers need.

        Raises:
            WorkerError: if the main script would start workers recursively.
        """
        start_method = START_METHOD if start_method is None else start_method
        if start_method != "fork" and main_runs_again():
            raise WorkerError(
                "worker processes run the main script again from its beginning, so what starts them must stand under "
                "`if __name__ == '__main__':`; put it there, or use backend='gymnasium'"
            )
        self._context: Any = multiprocessing.get_context(start_method)
        if start_method == "forkserver":
            # Imported once, in the server, so that a worker starts in milliseconds. The import starts no threads.
            self._context.set_forkserver_preload([process.__name__, *([] if preload is None else [preload])])
        self._encoder_of = (lambda number: Copied()) if encoders is None else encoders(self._context)

    def start(self, number: int, make: Callable[[], gym.Env]) -> ProcessWorker:
        return ProcessWorker(number, make, self._context, self._encoder_of(number))

    def close(self) -> None:
        """Does nothing: the workers own all that was started."""

    advice = (
        "It runs the main script again, so that must be possible to import; backend='gymnasium' does without workers"
    )


def check_sendable(make_one: Callable[[], gym.Env]) -> None:
    """Raises ``TypeError`` unless the function can be pickled and sent to another process."""
    try:
        ForkingPickler.dumps(CloudpickleWrapper(make_one))
    except Exception as error:  # pickling the objects that it refers to can raise anything
        raise TypeError(
            f"the function that makes environments is sent to worker processes, and cannot be pickled: {error}; let it "
            "make what it needs instead of referring to it, or use backend='gymnasium'"
        ) from error


def main_runs_again() -> bool | None:
    """Returns whether a worker process, which imports the main script, would execute the current statement again.

    None if this is unknown: in a thread other than the main thread, or if the source of the script is unavailable.
    """
    main = sys.modules["__main__"]
    spec = getattr(main, "__spec__", None)
    path = getattr(main, "__file__", None)
    if path is None or (spec is not None and spec.name.endswith("__main__")):
        return False  # interactive, or a package run with -m: a worker imports neither
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
