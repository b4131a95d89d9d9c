"""Environments in worker processes: started safely beside JAX, waited for no longer than is said, started anew if asked.

A process that uses JAX has threads, and forking it is unsafe, so workers are forked from a server that has none (Linux) or
started anew (elsewhere). Both run the main script again, up to its ``if __name__ == "__main__":``.
"""

from __future__ import annotations

import ast
import linecache
import math
import multiprocessing
import signal
import sys
import time
import warnings
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from multiprocessing.reduction import ForkingPickler
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium.vector.utils import CloudpickleWrapper

from rejeu.envs.workers import process
from rejeu.envs.workers.process import Description, Failure
from rejeu.errors import WorkerError

START_METHOD = "forkserver" if sys.platform == "linux" else "spawn"
TIMEOUT = 300.0
"""Seconds that a worker has for a step or a reset, unless said otherwise."""
START_SECONDS = 600.0
"""How long a worker has to make its environment, where there is a time-out at all."""
CLOSE_SECONDS = 5.0
"""How long the processes have to end before they are ended."""
RESTARTED = "worker_restarted"
"""Where an info says why the worker of an environment was started anew."""


class Restarted(NamedTuple):
    """Stands for the answer of a worker that was lost and has been replaced."""

    why: str


class Lost(Exception):
    """A worker process ended by itself, or gave no answer in time; the message says which of them, and at what."""


class Worker:
    """A process with one environment in it, as this process sees it."""

    def __init__(self, number: int, make: Callable[[], gym.Env], context: Any, *shared: Any) -> None:
        """Starts the process; ``shared`` is handed to :func:`rejeu.envs.workers.process.serve`."""
        self.number = number
        self.asked: str | None = "make"
        """What it has not yet answered; None if nothing."""
        self._ended: str | None = None
        self.pipe, theirs = context.Pipe()
        arguments = (theirs, CloudpickleWrapper(make), number, *(shared or (None,)))
        self.process = context.Process(target=process.serve, args=arguments, daemon=True)
        self.process.start()
        theirs.close()

    def ask(self, request: str, *arguments: Any) -> None:
        """Sends a request, whose answer is to be fetched."""
        self.asked = arguments[0].__name__.strip("_") if request == "call" else request
        process.send(self.pipe, (request, *arguments))

    def answer(self, deadline: float | None) -> Any:
        """Returns the answer, waiting for it until ``deadline`` (by ``time.monotonic``; None: for ever).

        Raises:
            Lost: if there is none.
            WorkerError: if it cannot be read here.
        """
        seconds = None if deadline is None else max(deadline - time.monotonic(), 0.0)
        try:
            if not self.pipe.poll(seconds):
                raise Lost(f"the worker process of environment {self.number} gave no answer to {self.asked!r}")
            answer = process.receive(self.pipe)
        except (EOFError, ConnectionError):
            where = f"at {self.asked!r}"
            raise Lost(
                f"the worker process of environment {self.number} ended by itself {where} ({self.end()})"
            ) from None
        except Lost:
            raise
        except Exception as error:  # whatever reading an object of a class that is not known here raises
            self.asked = None
            raise WorkerError(f"what environment {self.number} sent cannot be read in this process: {error}") from error
        self.asked = None
        return answer

    @property
    def alive(self) -> bool:
        """Whether the process is there."""
        return self._ended is None and self.process.is_alive()

    def end(self) -> str:
        """Ends the process, whatever it is doing, and returns what it ended with, in words."""
        if self._ended is not None:
            return self._ended
        self.pipe.close()
        process = self.process
        process.join(0.2)  # its pipe may close a moment before it is gone
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


class Workers:
    """One worker process for each environment; they are asked together and answer in any order.

    A worker that is lost costs ``WorkerError`` and the other processes are ended, or, as often as ``restarts`` allows, a
    warning, and it is replaced by a new one.
    """

    def __init__(
        self,
        makes: Sequence[Callable[[], gym.Env]],
        start_method: str | None = None,
        timeout: float | None = TIMEOUT,
        restarts: int = 0,
        shared: Callable[[Any], tuple[Any, ...]] = lambda context: (None,),
        preload: str | None = None,
    ) -> None:
        """Starts all of them, and waits until their environments are made.

        Args:
            makes: functions that each make an environment; they are sent to the workers.
            start_method: of ``multiprocessing``; None: :data:`START_METHOD`.
            timeout: seconds to wait for the answers to a request; None: for ever.
            restarts: how many lost workers are replaced.
            shared: given the context, returns what else each worker gets.
            preload: name of a further module that the workers need.

        Raises:
            TypeError: if a function cannot be sent.
            ValueError: for a bad number.
            WorkerError: if an environment cannot be made, or this cannot be called here.
        """
        check_options(timeout, restarts)
        for make in makes:
            check_sendable(make)
        start_method = START_METHOD if start_method is None else start_method
        if start_method != "fork" and main_runs_again():
            raise WorkerError(
                "worker processes run the main script again from its beginning, so what starts them must stand under "
                "`if __name__ == '__main__':`; put it there, or use backend='gymnasium'"
            )
        self._makes = list(makes)
        self._context: Any = multiprocessing.get_context(start_method)
        if start_method == "forkserver":
            # Imported once, in the server: a worker is then there in milliseconds. It starts no threads.
            self._context.set_forkserver_preload([process.__name__, *([] if preload is None else [preload])])
        self._shared = shared(self._context)
        self.timeout = timeout
        self.restarts_left = self._restarts = restarts
        self.workers: list[Worker] = []
        self._finalizer = weakref.finalize(self, _end, self.workers)
        try:
            for number in range(len(makes)):
                self.workers.append(self._start(number))
            self.descriptions = [self._made(worker) for worker in self.workers]
        except BaseException:
            self.end()
            raise

    @property
    def closed(self) -> bool:
        """Whether the processes were ended."""
        return not self._finalizer.alive

    def _start(self, number: int) -> Worker:
        return Worker(number, self._makes[number], self._context, *self._shared)

    def _made(self, worker: Worker) -> Description:
        """Waits for an environment to be made and returns what it is."""
        try:
            made = worker.answer(None if self.timeout is None else time.monotonic() + max(self.timeout, START_SECONDS))
        except Lost as lost:
            raise WorkerError(
                f"{lost}; what it printed says why. It runs the main script again, so that must be possible to import; "
                "backend='gymnasium' does without workers"
            ) from None
        if isinstance(made, Failure):
            raise WorkerError(f"environment {worker.number} could not be made in a worker process:\n{made.trace}")
        return made

    def ask(self, requests: Mapping[int, tuple[Any, ...]]) -> dict[int, Any]:
        """Sends requests by the number of the environment; returns the answers likewise, see :meth:`answers`."""
        self.send(requests)
        return self.answers(requests)

    def send(self, requests: Mapping[int, tuple[Any, ...]]) -> None:
        """Sends requests by the number of the environment; answers that nobody fetched, after Ctrl-C, are dropped."""
        if self.closed:
            raise WorkerError("the worker processes were ended; make the environments anew")
        late = [number for number in requests if self.workers[number].asked is not None]
        if late:
            self.answers(late)
        for number, request in requests.items():
            self.workers[number].ask(*request)

    def answers(self, numbers: Iterable[int]) -> dict[int, Any]:
        """Waits for the answers to requests and returns them: each what the environment said, or how it failed.

        A worker that was lost and could be replaced has answered :class:`Restarted`; its environment is made, and must be
        reset.

        Raises:
            WorkerError: if a worker was lost for good; then all are ended.
        """
        deadline = None if self.timeout is None else time.monotonic() + self.timeout
        found: dict[int, Any] = {}
        for number in numbers:  # all of them, or the next request would get the rest
            try:
                found[number] = self.workers[number].answer(deadline)
            except Lost as lost:
                found[number] = lost
        for number, answer in found.items():
            if isinstance(answer, Lost):
                found[number] = self._replaced(number, answer)
        return found

    def _replaced(self, number: int, lost: Lost) -> Restarted:
        """Starts a worker anew; raises if it may not be."""
        worker = self.workers[number]
        why, advice = str(lost), "what it printed may say why"
        if worker.alive:
            why, advice = f"{why} for {self.timeout:g} seconds", "a longer worker_timeout gives it more"
            worker.end()
        if self.restarts_left == 0:
            self.end()
            spent = f", and {self._restarts} restarts are spent" if self._restarts else ""
            raise WorkerError(f"{why}{spent}; {advice}, and restart_workers=10 would start it anew and go on")
        self.restarts_left -= 1
        done = self._restarts - self.restarts_left
        warnings.warn(
            f"{why}; it is started anew ({done} of at most {self._restarts} times), and its episode "
            "counts as truncated",
            RuntimeWarning,
            stacklevel=2,
        )
        self.workers[number] = self._start(number)
        try:
            self._made(self.workers[number])
        except BaseException:
            self.end()
            raise
        return Restarted(why)

    def close(self) -> None:
        """Asks the processes to close their environments, and ends those that do not; a second call does nothing."""
        if self.closed:
            return
        for worker in self.workers:
            if worker.asked is None:
                worker.ask("close")
        deadline = time.monotonic() + CLOSE_SECONDS
        for worker in self.workers:
            if worker.asked == "close":
                worker.process.join(max(deadline - time.monotonic(), 0.0))
        self.end()

    def end(self) -> None:
        """Ends the processes, whatever they are doing."""
        self._finalizer()


def _end(workers: Sequence[Worker]) -> None:
    for worker in workers:
        if worker.alive:
            worker.process.terminate()
    for worker in workers:
        worker.end()


def check_options(timeout: float | None, restarts: int) -> None:
    """Raises ``ValueError`` unless these are seconds to wait (None: for ever) and a number of restarts."""
    if timeout is not None and not (isinstance(timeout, int | float) and 0 < timeout < math.inf):
        raise ValueError(f"worker_timeout={timeout!r} must be a number of seconds above 0, or None to wait for ever")
    if isinstance(restarts, bool) or not isinstance(restarts, int) or restarts < 0:
        raise ValueError(f"restart_workers={restarts!r} must be a whole number of at least 0")


def check_sendable(make_one: Callable[[], gym.Env]) -> None:
    """Raises ``TypeError`` unless the function can be sent to another process."""
    try:
        ForkingPickler.dumps(CloudpickleWrapper(make_one))
    except Exception as error:  # whatever the things that it refers to raise
        raise TypeError(
            f"the function that makes environments is sent to worker processes, and cannot be pickled: {error}; let it "
            "make what it needs instead of referring to it, or use backend='gymnasium'"
        ) from error


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
