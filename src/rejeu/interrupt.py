"""Ctrl-C, SIGTERM and SIGHUP: requests to stop training after the current step, and the end of the command ``rejeu``.

A signal handler here only raises an exception if a second signal arrives. Python runs handlers between any two
instructions of the main thread, also inside callbacks of C libraries (JAX's garbage collection), which print and
discard exceptions. A handler therefore either records the signal, which other code then checks, or ends the process.
"""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import sys
import threading
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
    return next((one.signal for one in active if one.signal is not None), None)


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

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
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


def restore(previous: dict[int, Any]) -> None:
    """Restores the handlers that :func:`install` returned."""
    for number, handler in previous.items():
        signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def leaving(text: str = "interrupted") -> Iterator[None]:
    """Context in which these signals end the process immediately and print ``text``; see :func:`leave`."""
    previous = install(lambda number, frame: leave(number, text))
    try:
        yield
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
    if multiprocessing.parent_process() is not None or not sys.argv:
        return False
    if sys.argv[0] == "-m":  # Python has not found the module yet; its name is the word before the arguments
        return sys.orig_argv[-len(sys.argv)].removeprefix("-m") == "rejeu"
    path = Path(sys.argv[0])
    return path.name.lower() in ("rejeu", "rejeu.exe", "rejeu-script.py") or path.parts[-2:] == ("rejeu", "__main__.py")
