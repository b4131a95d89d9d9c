"""Processes that train for another process, such as the runs of a sweep.

The supervisor sets the environment variable :data:`LOCK` and keeps the standard input of the process open. The process holds
the lock as long as it lives. When its standard input ends, because the supervisor asks it to stop or has died, it stops as
after SIGTERM: with a checkpoint. This needs no signals, so it works on every system.
"""

from __future__ import annotations

import _thread
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

LOCK = "REJEU_SUPERVISED"
"""Environment variable with the path of the lock."""
PATIENCE = 60.0
"""Seconds to wait for the lock, which an earlier process of the run may still hold."""
GRACE = 300.0
"""Seconds after which a process that does not stop is ended."""
TAKEN = 75
"""Exit status if another process holds the lock all the time."""


@contextmanager
def by_parent() -> Iterator[None]:
    """Context of a process that another one supervises; without the environment variable it does nothing."""
    path = os.environ.pop(LOCK, None)
    if path is None:
        yield
        return
    threading.Thread(target=stop_at_end, args=(detached_input(),), daemon=True).start()
    from filelock import FileLock, Timeout

    lock = FileLock(path)
    try:
        lock.acquire(timeout=PATIENCE)
    except Timeout:
        print(f"rejeu: another process of this run holds {path}", flush=True)
        raise SystemExit(TAKEN) from None
    try:
        yield
    finally:
        lock.release()


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
