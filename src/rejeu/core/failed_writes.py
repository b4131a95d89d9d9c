"""Writes that may fail without ending training: reported with a warning, and listed at the end."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable


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
        self.failures: dict[str, str] = {}
        """The reasons of failures, by the name of what is not written, or not completely."""
        self._models: dict[str, Callable[[], object]] = {}

    @property
    def complete(self) -> bool:
        """Whether everything has been written."""
        return not self.failures

    def attempt(self, name: str, write: Callable[[], object], *, is_row: bool = False, is_model: bool = False) -> bool:
        """Calls ``write`` and returns whether it succeeded; if not, warns unless it failed before.

        Args:
            name: of what is written, such as a file.
            write: raises ``OSError`` if it fails.
            is_row: whether it adds to a file. Otherwise it writes all of it, which makes up for failures before.
            is_model: whether :meth:`retry` calls it again.
        """
        try:
            write()
        except OSError as error:
            text = " ".join((error.strerror or str(error)).split())
            if name not in self.failures:
                warnings.warn(f"{name}: {text}; it is not written, and the rest continues", UserWarning, stacklevel=2)
            self.failures[name] = os.strerror(error.errno) if error.errno else text
            if is_model:
                self._models[name] = write
            return False
        if not is_row:
            self.failures.pop(name, None)
            self._models.pop(name, None)
        return True

    def retry(self) -> None:
        """Tries again to write the models that failed."""
        for name, write in list(self._models.items()):
            self.attempt(name, write, is_model=True)

    def summary(self) -> str:
        """Returns the failures as text, empty if there were none."""
        names: dict[str, list[str]] = {}
        for name, reason in self.failures.items():
            names.setdefault(reason, []).append(name)
        return "; ".join(f"not written ({reason}): {', '.join(names[reason])}" for reason in names)
