"""Environments in worker processes, with timeouts and optional restarts.

A process that uses JAX has threads, so forking it is unsafe. On Linux, workers are forked from a server process without
threads. On other systems they are spawned. Both run the main script again, up to its ``if __name__ == "__main__":``.
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
"""Default timeout of a step or a reset, in seconds."""
START_SECONDS = 600.0
"""Minimum timeout for making an environment, in seconds. It does not apply if there is no timeout."""
CLOSE_SECONDS = 5.0
"""Seconds that the processes have to exit before they are terminated."""
RESTARTED = "worker_restarted"
"""Key of ``info`` with the reason why the worker of an environment was restarted."""


class Restarted(NamedTuple):
    """Returned instead of the answer of a worker that was lost and has been replaced."""

    why: str


class Lost(Exception):
    """A worker process exited unexpectedly or timed out. The message states which worker and which request."""


class Worker:
    """A handle of a worker process, which runs one environment."""

    def __init__(self, number: int, make: Callable[[], gym.Env], context: Any, *shared: Any) -> None:
        """Starts the process. ``shared`` is passed to :func:`rejeu.envs.workers.process.serve`."""
        self.number = number
        self.asked: str | None = "make"
        """The pending request, None if there is none."""
        self._ended: str | None = None
        self.pipe, theirs = context.Pipe()
        arguments = (theirs, CloudpickleWrapper(make), number, *(shared or (None,)))
        self.process = context.Process(target=process.serve, args=arguments, daemon=True)
        self.process.start()
        theirs.close()

    def ask(self, request: str, *arguments: Any) -> None:
        """Sends a request. The answer must be fetched with :meth:`answer`."""
        self.asked = arguments[0].__name__.strip("_") if request == "call" else request
        process.send(self.pipe, (request, *arguments))

    def answer(self, deadline: float | None) -> Any:
        """Waits for the answer and returns it.

        Args:
            deadline: in the time of ``time.monotonic``. None waits without limit.

        Raises:
            Lost: if there is no answer.
            WorkerError: if the answer cannot be unpickled in this process.
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
        except Exception as error:  # unpickling an object of an unknown class can raise anything
            self.asked = None
            raise WorkerError(f"what environment {self.number} sent cannot be read in this process: {error}") from error
        self.asked = None
        return answer

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._ended is None and self.process.is_alive()

    def end(self) -> str:
        """Terminates the process immediately, and returns its exit code as text."""
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


class Workers:
    """A pool of worker processes with one environment each.

    Requests are sent to several workers at once, and the answers may arrive in any order. A lost worker is replaced
    with a warning, up to ``restarts`` times in total. After that, a lost worker raises ``WorkerError``, and the other
    processes are terminated.
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
        """Starts all workers, and waits until their environments are made.

        Args:
            makes: functions that make one environment each. They are sent to the workers.
            start_method: start method of ``multiprocessing``. None uses :data:`START_METHOD`.
            timeout: seconds to wait for the answers to a request. None waits without limit.
            restarts: maximum number of lost workers that are replaced.
            shared: takes the ``multiprocessing`` context and returns further arguments of each worker.
            preload: name of an additional module that the workers need.

        Raises:
            TypeError: if a function cannot be pickled.
            ValueError: if ``timeout`` or ``restarts`` is invalid.
            WorkerError: if an environment cannot be made, or if the main script would start workers recursively.
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
            # Imported once, in the server, so that a worker starts in milliseconds. The import starts no threads.
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
        """Whether the processes were terminated."""
        return not self._finalizer.alive

    def _start(self, number: int) -> Worker:
        return Worker(number, self._makes[number], self._context, *self._shared)

    def _made(self, worker: Worker) -> Description:
        """Waits until an environment is made, and returns its description."""
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

        Each is the answer of the environment, or a :class:`~rejeu.envs.workers.process.Failure`. For a worker that was
        lost and replaced, it is :class:`Restarted`. Its environment is made, and must be reset.

        Raises:
            WorkerError: if a worker was lost and cannot be replaced. All workers are then terminated.
        """
        deadline = None if self.timeout is None else time.monotonic() + self.timeout
        found: dict[int, Any] = {}
        for number in numbers:  # all answers, otherwise the next request would receive the remaining ones
            try:
                found[number] = self.workers[number].answer(deadline)
            except Lost as lost:
                found[number] = lost
        for number, answer in found.items():
            if isinstance(answer, Lost):
                found[number] = self._replaced(number, answer)
        return found

    def _replaced(self, number: int, lost: Lost) -> Restarted:
        """Restarts a worker. Raises ``WorkerError`` if no restarts are left."""
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
        self.workers[number] = self._start(number)
        try:
            self._made(self.workers[number])
        except BaseException:
            self.end()
            raise
        return Restarted(why)

    def close(self) -> None:
        """Closes the environments, and terminates processes that do not respond. Further calls do nothing."""
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
        """Terminates the processes immediately."""
        self._finalizer()


def _end(workers: Sequence[Worker]) -> None:
    for worker in workers:
        if worker.alive:
            worker.process.terminate()
    for worker in workers:
        worker.end()


def check_options(timeout: float | None, restarts: int) -> None:
    """Raises ``ValueError`` unless ``timeout`` is positive seconds or None, and ``restarts`` a non-negative integer."""
    if timeout is not None and not (isinstance(timeout, int | float) and 0 < timeout < math.inf):
        raise ValueError(f"worker_timeout={timeout!r} must be a number of seconds above 0, or None to wait for ever")
    if isinstance(restarts, bool) or not isinstance(restarts, int) or restarts < 0:
        raise ValueError(f"restart_workers={restarts!r} must be a whole number of at least 0")


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
