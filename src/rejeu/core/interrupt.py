"""Requests to stop training after the current step, and the end of the command ``rejeu``.

They come by Ctrl-C, SIGTERM and SIGHUP, and in a process that trains for another, such as a run of a sweep, from that
supervisor: it sets the environment variable :data:`SUPERVISED` and keeps the standard input of the process open. When this
ends, because the supervisor asks it to stop or has died, the process stops as after SIGTERM: with a checkpoint. This needs no
signals, so it works on every system.

A signal handler here only raises an exception if a second signal arrives. Python runs handlers between any two
instructions of the main thread, also inside callbacks of C libraries (JAX's garbage collection), which print and
discard exceptions. A handler therefore either records the signal, which other code then checks, or ends the process.
"""

from __future__ import annotations

import _thread
import errno
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, NoReturn

HANGUP: int | None = getattr(signal, "SIGHUP", None)
"""The signal of a closed terminal; None on Windows."""
NAMES: dict[int, str] = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
NAMES |= {} if HANGUP is None else {HANGUP: "SIGHUP"}
Handler = Callable[[int, FrameType | None], Any] | signal.Handlers

unfinished: set[Path] = set()
"""Temporary files, which :func:`leave` removes."""


class Stopped(KeyboardInterrupt):
    """Ctrl-C, SIGTERM or SIGHUP, raised where no operation is incomplete."""

    def __init__(self, number: int) -> None:
        super().__init__(NAMES[number])
        self.signal = number


active: list[Interrupt] = []
"""The contexts that are entered, outermost first."""


def requested() -> int | None:
    """Returns the signal that asked to stop, if a context of :class:`Interrupt` received one; else None."""
    return next((context.signal for context in active if context.signal is not None), None)


class Interrupt:
    """Context in which the first Ctrl-C, SIGTERM or SIGHUP sets ``requested``. A second signal takes effect immediately.

    A nested context passes signals on to the outer one, so both are set. Outside of the main thread, where Python does
    not allow signal handlers, it does nothing.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        """The first signal received."""
        self._previous: dict[int, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether a signal was received."""
        return self.signal is not None

    def __enter__(self) -> Interrupt:
        self._previous = install(self._handle)
        active.append(self)
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if number == HANGUP:
            detach()
        first = not self.requested
        if first:
            self.signal = number
        previous = self._previous.get(number)
        around = self._is_within(number)
        if callable(previous) and (around or not first):
            previous(number, frame)
        if not around and not first:
            raise KeyboardInterrupt

    def _is_within(self, number: int) -> bool:
        return isinstance(getattr(self._previous.get(number), "__self__", None), Interrupt)

    def check(self) -> None:
        """Raises :class:`Stopped` if a signal was received. In a nested context the outer one raises it instead."""
        if self.signal is not None and not self._is_within(self.signal):
            raise Stopped(self.signal)

    def __exit__(self, error_type: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        active.remove(self)
        restore(self._previous)


def detach() -> None:
    """Redirects outputs to a terminal that was closed to nowhere, because writing to it raises an error."""
    for handle in (1, 2):
        try:
            os.get_terminal_size(handle)
        except OSError as error:
            if error.errno == errno.EIO:
                os.dup2(os.open(os.devnull, os.O_WRONLY), handle)


def install(handler: Handler) -> dict[int, Any]:
    """Installs a handler for all signals and returns the previous handlers; none outside of the main thread.

    SIGHUP remains ignored if it is, as under ``nohup``.
    """
    if threading.current_thread() is not threading.main_thread():
        return {}
    numbers = [n for n in NAMES if n != HANGUP or signal.getsignal(n) != signal.SIG_IGN]
    return {number: signal.signal(number, handler) for number in numbers}


def disregard(number: int, frame: FrameType | None) -> None:
    """A handler that does nothing. Unlike ``SIG_IGN``, programs that the process starts do not inherit it."""


def restore(previous: dict[int, Any]) -> None:
    """Restores the handlers that :func:`install` returned."""
    for number, handler in previous.items():
        signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def leaving(text: str = "interrupted") -> Iterator[None]:
    """Context in which these signals, and :class:`Stopped`, end the process at once and print ``text``; see :func:`leave`."""
    previous = install(lambda number, frame: leave(number, text))
    try:
        yield
    except Stopped as error:
        leave(error.signal, text)
    finally:
        restore(previous)


def leave(number: int, text: str = "interrupted") -> NoReturn:
    """Ends the process with one line on standard error and the exit status that shells use: 130, 143 or 129.

    The stack is not unwound, so no code can catch the exit. Call it only where no operation is incomplete. Files are
    written to a temporary path and renamed; that of an unfinished file is removed. Worker processes exit when their pipe
    closes.
    """
    for path in tuple(unfinished):
        with suppress(OSError):
            path.unlink()
    show_cursor = b"\x1b[?25h" if os.isatty(2) else b""  # progress bars hide it
    with suppress(OSError):  # the reader may have closed the pipe
        os.write(2, show_cursor + f"rejeu: {text}\n".encode(errors="replace"))
    os._exit(128 + number)


def ignore() -> None:
    """Ignores further signals in the command ``rejeu``, which a signal has ended; otherwise does nothing.

    While Python shuts down it restores the default handlers, with which a second signal would change the exit status.
    """
    if is_command():
        install(signal.SIG_IGN)


def is_command() -> bool:
    """Returns whether this process is the command ``rejeu`` or ``python -m rejeu``, and not its worker process."""
    # It takes longer to import than all that is imported here.
    processes = sys.modules.get("multiprocessing.process")
    if not sys.argv or (processes is not None and processes.parent_process() is not None):
        return False
    if sys.argv[0] == "-m":  # Python has not found the module yet; its name is the word before the arguments
        return sys.orig_argv[-len(sys.argv)].removeprefix("-m") == "rejeu"
    path = Path(sys.argv[0])
    return path.name.lower() in ("rejeu", "rejeu.exe", "rejeu-script.py") or path.parts[-2:] == ("rejeu", "__main__.py")


SUPERVISED = "REJEU_SUPERVISED"
"""Environment variable of a process that another one supervises."""
GRACE = 300.0
"""Seconds after which a process that does not stop is ended."""
TAKEN = 75
"""Exit status of such a process if another one trains the same run."""


def program(*words: str) -> list[str]:
    """Returns the command line of a process of Python. Files of the current folder do not take the place of its modules."""
    return [sys.executable, "-P", *words]


def by_parent() -> None:
    """Lets a process end with the one that supervises it; without the environment variable it does nothing."""
    if os.environ.pop(SUPERVISED, None) is not None:
        threading.Thread(target=stop_at_end, args=(detached_input(),), daemon=True).start()


def detached_input() -> int:
    """Returns a copy of the standard input that worker processes do not inherit; they read from an empty one."""
    copy = os.dup(0)
    empty = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty, 0)
    os.close(empty)
    return copy


def stop_at_end(handle: int) -> None:
    """Reads until the end, then stops this process as after SIGTERM; ends it if that takes longer than :data:`GRACE`."""
    with suppress(OSError):
        while os.read(handle, 1024):
            pass
    _thread.interrupt_main(signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(128 + signal.SIGTERM)
