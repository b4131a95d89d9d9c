"""Ctrl-C and SIGTERM: as requests to stop training after the step it is in, and as the end of the command ``rejeu``.

Nothing here raises an exception out of a signal handler unless a second signal asks for it: Python runs handlers between
any two instructions of the main thread, also inside callbacks of C libraries (JAX's garbage collection), which print and
drop an exception. A handler either records the signal, for code that looks at the record, or ends the process.
"""

from __future__ import annotations

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

SIGNALS = (signal.SIGINT, signal.SIGTERM)
NAMES: dict[int, str] = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
Handler = Callable[[int, FrameType | None], Any]


class Stopped(KeyboardInterrupt):
    """Ctrl-C or SIGTERM, raised where nothing is half done."""

    def __init__(self, number: int) -> None:
        super().__init__(NAMES[number])
        self.signal = number


class Interrupt:
    """While entered, the first Ctrl-C or SIGTERM sets ``requested``; the second acts at once.

    One entered within another passes signals on to it, so that both know. Outside the main thread, where Python allows
    no signal handlers, it does nothing.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        """Which of the two came first."""
        self._previous: dict[int, Any] = {}

    @property
    def requested(self) -> bool:
        """Whether one of them came."""
        return self.signal is not None

    def __enter__(self) -> Interrupt:
        self._previous = install(self._handle)
        return self

    def _handle(self, number: int, frame: FrameType | None) -> None:
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
        """Raises :class:`Stopped` if one of them came, unless this is entered within another, which then sees to it."""
        if self.signal is not None and not self._is_within(self.signal):
            raise Stopped(self.signal)

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        restore(self._previous)


def install(handler: Handler) -> dict[int, Any]:
    """Makes a function the handler of both signals and returns those before it; none outside of the main thread."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {number: signal.signal(number, handler) for number in SIGNALS}


def restore(previous: dict[int, Any]) -> None:
    """Puts back what :func:`install` returned."""
    for number, handler in previous.items():
        signal.signal(number, signal.SIG_DFL if handler is None else handler)


@contextmanager
def leaving(text: str = "interrupted") -> Iterator[None]:
    """While entered, Ctrl-C and SIGTERM end the process at once, with one line that says ``text``; see :func:`leave`."""
    previous = install(lambda number, frame: leave(number, text))
    try:
        yield
    finally:
        restore(previous)


def leave(number: int, text: str = "interrupted") -> NoReturn:
    """Ends the process with one line on standard error and the exit status that shells use: 130 or 143.

    Nothing is unwound, so that no code on the way can swallow it. Only where nothing is half done that matters: files are
    written beside their place and renamed, and worker processes end when their pipe closes.
    """
    show_cursor = b"\x1b[?25h" if os.isatty(2) else b""  # which a progress bar hides
    with suppress(OSError):  # nobody may be reading any more
        os.write(2, show_cursor + f"rejeu: {text}\n".encode(errors="replace"))
    os._exit(128 + number)


def is_command() -> bool:
    """Returns whether this process is the command ``rejeu``, or ``python -m rejeu``, and no worker process of it."""
    if multiprocessing.parent_process() is not None or not sys.argv:
        return False
    if sys.argv[0] == "-m":  # Python is still looking for the module, whose name is the word before the arguments
        return sys.orig_argv[-len(sys.argv)].removeprefix("-m") == "rejeu"
    return Path(sys.argv[0]).name.lower() in ("rejeu", "rejeu.exe", "rejeu-script.py")


def guard_imports() -> None:
    """Lets Ctrl-C and SIGTERM end the command ``rejeu`` with one line while it is still importing; else does nothing."""
    if is_command():
        install(lambda number, frame: leave(number))
