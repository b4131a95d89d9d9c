"""Worker processes on this machine.

A process that uses JAX has threads, so forking it is unsafe. On Linux, workers are forked from a server process without
threads. On other systems they are spawned. Both run the main script again, up to its ``if __name__ == "__main__":``.
"""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.envs.workers import process
from rejeu.envs.workers.pool import CLOSE_SECONDS, Starter, Worker
from rejeu.envs.workers.process import Copied, Encoder

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
        """
        start_method = START_METHOD if start_method is None else start_method
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
        "It runs the main script again from its beginning, so what starts workers must stand under "
        "`if __name__ == '__main__':`; backend='gymnasium' does without workers"
    )
