"""What every worker has, wherever it runs: a connection for requests and answers, and an end."""

from __future__ import annotations

import selectors
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from multiprocessing import connection
from multiprocessing.connection import Connection
from typing import Any

import gymnasium as gym

from rejeu.envs.workers import process
from rejeu.errors import WorkerError

CLOSE_SECONDS = 5.0
"""Seconds that workers have to exit before they are terminated."""
LOOK_SECONDS = 1.0
"""Interval at which it is checked whether a worker that has not answered still runs, in seconds."""


class Lost(Exception):
    """A worker exited unexpectedly or timed out. The message states which worker and which request."""


class Worker(ABC):
    """A handle of a worker, which runs one environment in another process. Abstract. Mutable."""

    pipe: Connection

    def __init__(self, number: int, pipe: Connection | None) -> None:
        """Takes the index of the environment, and the connection unless :meth:`connect` makes it."""
        self.number = number
        self.asked: str | None = "make"
        """The pending request, None if there is none."""
        self.asked_at = time.monotonic()
        """When it was sent."""
        if pipe is not None:
            self.pipe = pipe

    @property
    @abstractmethod
    def place(self) -> str:
        """What error messages call it."""

    @property
    @abstractmethod
    def alive(self) -> bool:
        """Whether it is running, as far as is known."""

    @abstractmethod
    def connect(self, deadline: float | None) -> None:
        """Waits for the connection of a new worker. Raises as :meth:`answer` does."""

    @abstractmethod
    def stop(self) -> None:
        """Requests the end of the worker, without waiting for it."""

    @abstractmethod
    def join(self, seconds: float) -> None:
        """Waits until the worker exits by itself, for at most so many seconds."""

    @abstractmethod
    def end(self) -> str:
        """Terminates the worker immediately, and returns how it ended as text. Further calls return the same."""

    def ask(self, request: str, *arguments: Any) -> None:
        """Sends a request. The answer must be fetched with :meth:`answer`."""
        name = getattr(arguments[0], "__name__", request) if request == "call" else request
        self.asked = name.removesuffix("_and_reset")
        self.asked_at = time.monotonic()
        process.send(self.pipe, (request, *arguments))

    def answer(self, deadline: float | None) -> Any:
        """Waits for the answer and returns it.

        Args:
            deadline: in the time of ``time.monotonic``. None waits without limit.

        Raises:
            Lost: if there is no answer.
            WorkerError: if the answer cannot be unpickled in this process.
        """
        try:
            while not self.pipe.poll(seconds_until(deadline, LOOK_SECONDS)):
                if not self.alive and not self.pipe.poll(0):
                    raise EOFError
                if deadline is not None and time.monotonic() >= deadline:
                    raise Lost(f"{self.place} gave no answer to {self.asked!r}")
        except (EOFError, OSError):
            raise self._lost() from None
        return self.receive()

    def receive(self) -> Any:
        """Returns the answer, which has arrived; errors are those of :meth:`answer`."""
        try:
            answer = process.receive(self.pipe)
        except (EOFError, OSError):
            raise self._lost() from None
        except Exception as error:  # unpickling an object of an unknown class can raise anything
            self.asked = None
            raise WorkerError(f"what environment {self.number} sent cannot be read in this process: {error}") from error
        self.asked = None
        return answer

    def _lost(self) -> Lost:
        return Lost(f"{self.place} ended by itself at {self.asked!r} ({self.end()})")


class Listener:
    """Waits for the first of several workers to answer. Mutable: connections stay registered between calls."""

    def __init__(self) -> None:
        self._pipes: list[Connection] = []
        self._selector: selectors.BaseSelector | None = None

    def ready(self, workers: Sequence[Worker], seconds: float) -> list[int]:
        """Waits for at most so many seconds, and returns the indices of workers whose connection has an answer, or an end."""
        pipes = [worker.pipe for worker in workers]
        if sys.platform == "win32":  # where selectors take sockets only
            found = {*connection.wait(pipes, seconds)}
            return [i for i, pipe in enumerate(pipes) if pipe in found]
        if pipes != self._pipes or self._selector is None:
            self.close()
            self._pipes, self._selector = pipes, selectors.DefaultSelector()
            for i, pipe in enumerate(pipes):
                if not pipe.closed:
                    self._selector.register(pipe, selectors.EVENT_READ, i)
        return [key.data for key, _ in self._selector.select(seconds)]

    def close(self) -> None:
        """Forgets the connections."""
        if self._selector is not None:
            self._selector.close()
        self._selector = None


class Starter(ABC):
    """Starts workers. Abstract."""

    advice: str
    """What an error message adds if a worker cannot be started."""

    @abstractmethod
    def start(self, number: int, make: Callable[[], gym.Env]) -> Worker:
        """Starts the worker of environment ``number``, which calls ``make``, and returns without waiting for it."""

    @abstractmethod
    def close(self) -> None:
        """Releases what workers share, after all have ended. Further calls do nothing."""


def seconds_until(deadline: float | None, most: float) -> float:
    """Returns the seconds until a deadline, None for never, but not more than ``most``."""
    return most if deadline is None else min(max(deadline - time.monotonic(), 0.0), most)
