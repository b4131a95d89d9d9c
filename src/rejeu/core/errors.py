"""Exceptions of rejeu. All other errors are standard ones such as ``ValueError`` and ``TypeError``."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import metadata
from pathlib import Path

GRAPHICS = re.compile(r"lib(EGL|GL|OpenGL)\b")
"""Libraries of graphics, which slim systems lack."""


class MissingExtra(ImportError):
    """An optional package is not installed, or its import fails. The message says what to install."""

    def __init__(self, purpose: str, package: str, extra: str = "", error: Exception | None = None) -> None:
        if error is None or isinstance(error, ModuleNotFoundError):
            needed = f'"rejeu[{extra}]"' if extra else package
            super().__init__(f"{purpose} needs {package}, which is not installed; run: pip install {needed}")
        else:
            remedy = "; on Debian or Ubuntu, run: apt-get install libegl1 libgl1 libopengl0"
            remedy = remedy if GRAPHICS.search(str(error)) else ""
            super().__init__(f"{purpose} needs {package}, whose import fails: {error}{remedy}")


@contextmanager
def requires(purpose: str, package: str, extra: str = "") -> Iterator[None]:
    """Raises :class:`MissingExtra` with these arguments if an import inside fails."""
    try:
        yield
    except (ImportError, OSError) as error:
        raise MissingExtra(purpose, package, extra, error) from None


def installed(package: str) -> str | None:
    """Returns the version of a package, None if it is not installed."""
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


class CheckpointError(ValueError):
    """A file is invalid or does not match what is loaded. The message states the difference."""


class MissingObjectError(CheckpointError):
    """A file names an object of the user's own, such as a torso, which must be given to load it."""


class BadEnvironmentError(RuntimeError):
    """An environment returned invalid values, such as NaN or an observation of another shape."""


class DivergedError(RuntimeError):
    """Environments did not return to recorded episodes, so a run cannot be resumed in the middle of them."""


class NonFiniteError(RuntimeError):
    """Training stopped at a NaN or infinite value. The message states what, where and what to try."""

    def __init__(
        self, message: str, *, names: Sequence[str] = (), step: int = 0, n_updates: int = 0, batch: Path | None = None
    ) -> None:
        super().__init__(message)
        self.names = tuple(names)
        """Names of what is not finite: losses, and leaves of the state by dotted path."""
        self.step = step
        """Environment steps at the start of the update."""
        self.n_updates = n_updates
        """Total number of gradient steps before those of the error."""
        self.batch = batch
        """Path of the saved batches, None if there are none."""


class WorkerError(RuntimeError):
    """A worker process failed. The message contains its traceback, if there is one."""


class ClusterError(ConnectionError):
    """A Ray cluster cannot be reached, or a machine of it cannot be used. The message says why, on one line."""


class RunInUseError(RuntimeError):
    """Another process is training in the folder of this run."""


def expected_errors() -> tuple[type[Exception], ...]:
    """Returns the errors whose message is meant for the user; the others are bugs and keep their traceback."""
    import gymnasium  # takes longer than all that --help needs

    ours = (BadEnvironmentError, NonFiniteError, RunInUseError, WorkerError)
    return ValueError, TypeError, ImportError, OSError, MemoryError, *ours, gymnasium.error.Error


def one_line(error: Exception | Warning | str) -> str:
    r"""Returns an error's or a warning's message on one line and without colors, with its class if it has none or is a key.

    What would move the cursor of a terminal, or set its title, is escaped: names of files may hold anything.

    >>> one_line(ValueError("two\n  lines")), one_line(MemoryError()), one_line(KeyError("at"))
    ('two lines', 'MemoryError', "KeyError('at')")
    """
    text = repr(error) if isinstance(error, KeyError) else str(error)
    return printable(" ".join(re.sub(r"\x1b\[[\d;]*m", "", text).split())) or type(error).__name__


def printable(text: str) -> str:
    r"""Returns a text in which is escaped what is not printed, such as the codes that control a terminal.

    >>> print(printable("h\u00e9ros\x1b[2J\n"))
    héros\x1b[2J\n
    """
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)
