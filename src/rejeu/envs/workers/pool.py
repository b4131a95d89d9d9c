"""A pool of workers with one environment each, with timeouts and optional restarts.

A worker runs in another process, wherever that is, and has a connection for requests and answers.
"""

from __future__ import annotations

import math
import multiprocessing
import selectors
import signal
import sys
import time
import warnings
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from multiprocessing import connection
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.core.errors import WorkerError
from rejeu.core.validation import whole
from rejeu.envs.workers import process
from rejeu.envs.workers.process import Handover, WorkerDescription, WorkerFailure

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
        """The name of the worker in error messages."""

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

    def ask(self, request: str, *arguments: object) -> None:
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
            reply = process.receive(self.pipe)
        except (EOFError, OSError):
            raise self._lost() from None
        except Exception as error:  # unpickling an object of an unknown class can raise anything
            self.asked = None
            raise WorkerError(f"what environment {self.number} sent cannot be read in this process: {error}") from error
        self.asked = None
        return reply

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
            ready = {*connection.wait(pipes, seconds)}
            return [i for i, pipe in enumerate(pipes) if pipe in ready]
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
    """The end of an error message if a worker cannot be started."""

    @abstractmethod
    def start(self, number: int, make: Callable[[], gym.Env]) -> Worker:
        """Starts the worker of environment ``number``, which calls ``make``, and returns without waiting for it."""

    @abstractmethod
    def close(self) -> None:
        """Releases what workers share, after all have ended. Further calls do nothing."""


def seconds_until(deadline: float | None, limit: float) -> float:
    """Returns the seconds until a deadline, None for never, but not more than ``limit``."""
    return limit if deadline is None else min(max(deadline - time.monotonic(), 0.0), limit)


TIMEOUT = 300.0
"""Default timeout of a step or a reset, in seconds."""
START_SECONDS = 600.0
"""Minimum timeout for making an environment, in seconds. It does not apply if there is no timeout."""
IDLE_SECONDS = 0.001
"""Pause where only workers are ready that nothing was asked of, in seconds."""
RESTARTED = "worker_restarted"
"""Key of ``info`` with the reason why the worker of an environment was restarted."""


class Restarted(NamedTuple):
    """Returned instead of the answer of a worker that was lost and has been replaced."""

    why: str


class Workers:
    """A pool of workers with one environment each.

    Requests are sent to several workers at once, and the answers may arrive in any order. A lost worker is replaced
    with a warning, up to ``restarts`` times in total. After that, a lost worker raises ``WorkerError``, and the other
    workers are terminated.
    """

    def __init__(
        self,
        makes: Sequence[Callable[[], gym.Env]],
        starter: Starter,
        timeout: float | None = TIMEOUT,
        restarts: int = 0,
    ) -> None:
        """Starts all workers, and waits until their environments are made.

        Args:
            makes: functions that make one environment each. They are sent to the workers.
            starter: starts workers. It is closed with the pool.
            timeout: seconds to wait for the answers to a request. None waits without limit.
            restarts: maximum number of lost workers that are replaced.

        Raises:
            TypeError: if a function cannot be pickled.
            ValueError: if ``timeout`` or ``restarts`` is invalid.
            WorkerError: if an environment cannot be made.
        """
        check_options(timeout, restarts)
        for make in makes:
            check_sendable(make)
        self._makes, self._starter = list(makes), starter
        self.timeout = timeout
        self.restarts_left = self._restarts = restarts
        self._listener = Listener()
        self._look_at = 0.0
        """When it is checked next whether workers hang or are gone, in the time of ``time.monotonic``."""
        self.workers: list[Worker] = []
        self._finalizer = weakref.finalize(self, _end, self.workers, starter, self._listener)
        try:
            for number, make in enumerate(self._makes):
                self.workers.append(starter.start(number, make))
            self.descriptions = self._made(self.workers)
        except BaseException:
            self.end()
            raise

    @property
    def closed(self) -> bool:
        """Whether the workers were terminated."""
        return not self._finalizer.alive

    def _made(self, workers: Sequence[Worker]) -> list[WorkerDescription]:
        """Waits until environments are made, all at the same time, and returns their descriptions."""
        deadline = None if self.timeout is None else time.monotonic() + max(self.timeout, START_SECONDS)
        try:
            for worker in workers:
                worker.connect(deadline)
            answers = [worker.answer(deadline) for worker in workers]
        except Lost as lost:
            raise WorkerError(f"{lost}; what it printed says why. {self._starter.advice}") from None
        for worker, reply in zip(workers, answers, strict=True):
            if isinstance(reply, WorkerFailure):
                raise WorkerError(f"environment {worker.number} could not be made in a worker process:\n{reply.trace}")
        return answers

    def ask(self, requests: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Sends requests and returns the answers, both by the index of the environment. See :meth:`answers`."""
        self.send(requests)
        return self.answers(requests)

    def send(self, requests: Mapping[int, tuple[Any, ...]]) -> None:
        """Sends requests by the index of the environment.

        Answers to earlier requests that were not fetched, for example after Ctrl-C, are discarded.
        """
        if self.closed:
            raise WorkerError("the worker processes were ended; create the environments again")
        late = [number for number in requests if self.workers[number].asked is not None]
        if late:
            self.answers(late)
        for number, request in requests.items():
            self.workers[number].ask(*request)

    def answers(self, numbers: Iterable[int]) -> dict[int, Any]:
        """Waits for the answers to requests and returns them by the index of the environment.

        Each is the answer of the environment, or a :class:`~rejeu.envs.workers.process.WorkerFailure`. For a worker that was
        lost and replaced, it is :class:`Restarted`. Its environment is made, and must be reset.

        Raises:
            WorkerError: if a worker was lost and cannot be replaced. All workers are then terminated.
        """
        waiting, replies = {*numbers}, dict[int, Any]()
        while waiting:  # all answers, otherwise the next request would receive the remaining ones
            replies |= self._arrived(waiting)
            waiting -= replies.keys()
        return self._without_lost(dict(sorted(replies.items())))

    def _arrived(self, numbers: Collection[int]) -> dict[int, Any]:
        """Returns the answers that arrive within :data:`LOOK_SECONDS`, and :class:`Lost` for workers without one."""
        ready = self._listener.ready(self.workers, seconds_until(self._look_at, LOOK_SECONDS))
        replies = {number: self._answer(number) for number in ready if number in numbers}
        if ready and not replies:  # those that have ended while nothing was asked of them would be ready for ever
            time.sleep(IDLE_SECONDS)
        if time.monotonic() >= self._look_at:
            overdue = [number for number in numbers if number not in replies and self._is_overdue(number)]
            replies |= {number: self._answer(number, 0.0) for number in overdue}
            self._look_at = time.monotonic() + LOOK_SECONDS
        return replies

    def _is_overdue(self, number: int) -> bool:
        worker = self.workers[number]
        late = self.timeout is not None and time.monotonic() >= worker.asked_at + self.timeout
        return late or not worker.alive

    def _answer(self, number: int, deadline: float | None = None) -> Any:
        """Returns the answer of a worker, which has arrived if there is no deadline."""
        worker = self.workers[number]
        try:
            return worker.receive() if deadline is None else worker.answer(deadline)
        except Lost as lost:
            return lost

    def _without_lost(self, replies: dict[int, Any]) -> dict[int, Any]:
        lost = {number: reply for number, reply in replies.items() if isinstance(reply, Lost)}
        replaced = {number: self._replaced(number, reply) for number, reply in lost.items()}
        try:
            self._made([self.workers[number] for number in replaced])
        except BaseException:
            self.end()
            raise
        return replies | replaced

    def _replaced(self, number: int, lost: Lost) -> Restarted:
        """Starts a worker again. Raises ``WorkerError`` if no restarts are left."""
        worker = self.workers[number]
        why, advice = str(lost), "what it printed may say why"
        if worker.alive:
            why, advice = f"{why} for {self.timeout:g} seconds", "a longer worker_timeout gives it more"
            worker.end()
        if self.restarts_left == 0:
            self.end()
            spent = f", and {self._restarts} restarts are spent" if self._restarts else ""
            raise WorkerError(f"{why}{spent}; {advice}, and restart_workers=10 would restart it")
        self.restarts_left -= 1
        done = self._restarts - self.restarts_left
        warnings.warn(
            f"{why}; it is restarted ({done} of at most {self._restarts} times), and its episode counts as truncated",
            RuntimeWarning,
            stacklevel=2,
        )
        try:
            self.workers[number] = self._starter.start(number, self._makes[number])
        except BaseException:
            self.end()
            raise
        return Restarted(why)

    def close(self) -> None:
        """Closes the environments, and terminates workers that do not respond. Further calls do nothing."""
        if self.closed:
            return
        for worker in self.workers:
            if worker.asked is None:
                worker.ask("close")
        deadline = time.monotonic() + CLOSE_SECONDS
        for worker in self.workers:
            if worker.asked == "close":
                worker.join(max(deadline - time.monotonic(), 0.0))
        self.end()

    def end(self) -> None:
        """Terminates the workers immediately."""
        self._finalizer()


def _end(workers: Sequence[Worker], starter: Starter, listener: Listener) -> None:
    listener.close()
    for worker in workers:
        worker.stop()
    for worker in workers:
        worker.end()
    starter.close()


def check_options(timeout: float | None, restarts: int) -> None:
    """Raises ``ValueError`` unless ``timeout`` is positive seconds or None, and ``restarts`` a non-negative integer."""
    if timeout is not None and not (isinstance(timeout, int | float) and 0 < timeout < math.inf):
        raise ValueError(f"worker_timeout={timeout!r} must be a number of seconds above 0, or None to wait for ever")
    whole("restart_workers", restarts, least=0)


def check_sendable(make_one: Callable[[], gym.Env]) -> None:
    """Raises ``TypeError`` unless the function can be pickled and sent to another process."""
    try:
        ForkingPickler.dumps(CloudpickleWrapper(make_one))
    except Exception as error:  # pickling the objects that it refers to can raise anything
        raise TypeError(
            f"the function that makes environments is sent to worker processes, and cannot be pickled: {error}; let it "
            "make what it needs instead of referring to it, or use backend='gymnasium'"
        ) from error


START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"


class ProcessWorker(Worker):
    """A handle of a worker process on this machine."""

    def __init__(self, number: int, make: Callable[[], gym.Env], context: Any, handover: Handover) -> None:
        """Starts the process. ``handover`` is passed to :func:`rejeu.envs.workers.process.serve`."""
        pipe, theirs = context.Pipe()
        super().__init__(number, pipe)
        self._ended: str | None = None
        arguments = (theirs, CloudpickleWrapper(make), handover)
        self.process = context.Process(target=process.serve, args=arguments, daemon=True)
        with process.safe_path():
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
            self.process.kill()  # SIGTERM is ignored there

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
        names = {-sig: sig.name for sig in signal.Signals}
        self._ended = f"exit code {code}" + (f", {names[code]}" if code in names else "")
        if code is not None:
            process.close()
        return self._ended


class Processes(Starter):
    """Starts worker processes on this machine."""

    def __init__(
        self,
        start_method: str | None = None,
        handovers: Callable[[Any], Callable[[int], Handover]] | None = None,
        preload: str | None = None,
    ) -> None:
        """Prepares the start of processes.

        Args:
            start_method: start method of ``multiprocessing``. None uses :data:`START_METHOD`.
            handovers: takes the ``multiprocessing`` context and returns a function that returns the handover of each worker by
                its number. None: observations are sent with the dtypes of the space.
            preload: name of an additional module that the workers need.
        """
        start_method = START_METHOD if start_method is None else start_method
        self._context: Any = multiprocessing.get_context(start_method)
        if start_method == "forkserver":
            # Imported once, in the server, so that a worker starts in milliseconds. The import starts no threads.
            modules = [process.__name__, "rejeu.envs.workers.fork_server", *([] if preload is None else [preload])]
            self._context.set_forkserver_preload(modules)
        self._handover_of = (lambda number: process.as_declared) if handovers is None else handovers(self._context)

    def start(self, number: int, make: Callable[[], gym.Env]) -> ProcessWorker:
        return ProcessWorker(number, make, self._context, self._handover_of(number))

    def close(self) -> None:
        """Does nothing: the workers own all that was started."""

    advice = (
        "It runs the main script again from its beginning, so what starts workers must stand under "
        "`if __name__ == '__main__':`; backend='gymnasium' does without workers"
    )
