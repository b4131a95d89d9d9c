"""Writes that may fail without ending training: reported with a warning, retried, and listed at the end."""

from __future__ import annotations

import math
import os
import time
import warnings
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

RETRY_SECONDS = 60.0
"""Seconds between two attempts at a write that failed."""
MAX_ROWS = 10_000
"""Upper limit on the rows of one table that wait to be written; beyond it the oldest are dropped."""


class Failure(NamedTuple):
    """A write that failed."""

    reason: str
    """The reason as text."""
    written: bool
    """Whether a later attempt succeeded."""


class FailedWrites:
    """The writes of a run that failed. Mutable; every agent has one, ``agent.failed_writes``.

    A full disk must not end a training run of days, so what ``learn`` writes goes through :meth:`attempt`. Only ``OSError`` is
    handled; every other exception is a defect and propagates.

    >>> import warnings
    >>> failed = FailedWrites()
    >>> def write():
    ...     raise OSError("No space left on device")
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("ignore")
    ...     failed.attempt("the table", write)
    False
    >>> failed.summary()
    'not written (No space left on device): the table'
    """

    def __init__(self) -> None:
        self.failures: dict[str, Failure] = {}
        """Failures of the last ``learn``, by name."""
        self._retries: dict[str, Callable[[], object]] = {}
        self._waiting: dict[str, deque[tuple[Any, ...]]] = {}
        self._dropped: dict[str, int] = {}
        self._retry_at = math.inf

    @property
    def complete(self) -> bool:
        """Whether everything has been written, possibly late."""
        return all(failure.written for failure in self.failures.values())

    def attempt(self, what: str, write: Callable[[], object], retry: bool = True) -> bool:
        """Calls ``write`` and returns whether it succeeded; if not, warns unless it failed before.

        Args:
            what: name of what is written; a later attempt with the same name replaces an earlier one.
            write: raises ``OSError`` if it fails, and may then be called again.
            retry: whether :meth:`retry` calls it again; False if the caller does.
        """
        try:
            write()
        except OSError as error:
            text = " ".join((error.strerror or str(error)).split())
            self._note(
                what,
                write if retry else None,
                os.strerror(error.errno) if error.errno else text,
                f"{what}: {text}; the rest continues and the write is retried",
            )
            return False
        self._retries.pop(what, None)
        if what in self.failures:
            self.failures[what] = self.failures[what]._replace(written=True)
        return True

    def put(self, what: str, write: Callable[..., object], *row: Any) -> None:
        """Writes a row after those of the same name that still wait, or queues it.

        Args:
            what: name of the table.
            write: takes ``row``; if it raises ``OSError``, it must not have written any part of it.
            row: the values.
        """
        rows = self._waiting.setdefault(what, deque())
        if len(rows) == MAX_ROWS:
            rows.popleft()
            self._dropped[what] = self._dropped.get(what, 0) + 1
        rows.append(row)
        self.attempt(what, partial(self._flush, what, write))

    def retry(self) -> bool:
        """Retries failed writes and returns whether everything has been written."""
        self._retry_at = math.inf
        for what, write in list(self._retries.items()):
            self.attempt(what, write)
        return self.complete

    def retry_if_due(self) -> None:
        """Calls :meth:`retry` if the last failure is ``RETRY_SECONDS`` old."""
        if time.monotonic() >= self._retry_at:
            self.retry()

    def forget_written(self) -> None:
        """Forgets failures that succeeded later."""
        self.failures = {what: failure for what, failure in self.failures.items() if not failure.written}

    def summary(self) -> str:
        """Returns the failures as text, empty if there were none."""
        parts = []
        for title, written in (("not written", False), ("written late", True)):
            by_reason: dict[str, list[str]] = {}
            for what, one in self.failures.items():
                if one.written == written:
                    by_reason.setdefault(one.reason, []).append(what)
            parts += [f"{title} ({reason}): {', '.join(names)}" for reason, names in by_reason.items()]
        return "; ".join(parts)

    def warn(self) -> None:
        """Warns of all failures, if there were any."""
        if text := self.summary():
            warnings.warn(text, UserWarning, stacklevel=2)

    def _flush(self, what: str, write: Callable[..., object]) -> None:
        rows = self._waiting[what]
        while rows:
            write(*rows[0])
            rows.popleft()
        if n := self._dropped.pop(what, 0):
            lost = f"the first {n:,} {what} that failed"
            self._note(lost, None, f"only {MAX_ROWS:,} wait", f"{lost} are not written: at most {MAX_ROWS:,} can wait")

    def _note(self, what: str, write: Callable[[], object] | None, reason: str, text: str) -> None:
        is_new = what not in self.failures or self.failures[what].written
        self.failures[what] = Failure(reason, written=False)
        if write is not None:
            self._retries[what] = write
            self._retry_at = min(self._retry_at, time.monotonic() + RETRY_SECONDS)
        if is_new:
            warnings.warn(text, UserWarning, stacklevel=3)
