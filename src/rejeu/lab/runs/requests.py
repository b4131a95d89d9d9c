"""Requests to a run while it trains, by files in its folder: to stop, and to show its current policy.

Files need no signals and no connection, so that it works on every system, for runs that were started anywhere.
"""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path

from rejeu.agents.agent import Agent
from rejeu.callbacks.base import TrainingCallback
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import atomic
from rejeu.core.interrupt import Interrupt
from rejeu.training.run import Progress

EVERY = 2.0
"""Seconds between two looks at the folder."""
STALE = 10.0
"""Seconds after which a request to show the policy is over, unless it was renewed."""
MOST_MODELS = 16
"""Most models of the course of training that are kept; of more every second one is dropped."""
MOST_ENTRIES = 1000
"""Most entries of the folder of models that are looked at."""
MODEL = re.compile(r"step_\d+\.safetensors")


def ask(path: Path) -> None:
    """Makes or renews a request, unless the folder cannot be written to, or was replaced by a link while it was shown."""
    with suppress(OSError):
        atomic.check_no_link(path.parent)
        atomic.touch(path)


def is_asked(path: Path) -> bool:
    """Returns whether a request was made or renewed a moment ago."""
    try:
        return -STALE < time.time() - path.stat().st_mtime < STALE
    except OSError:
        return False


def drop(*paths: Path) -> None:
    """Removes files as far as possible: requests, also those to an earlier process, before anything that takes time."""
    for path in paths:
        with suppress(OSError):
            path.unlink(missing_ok=True)


class Requests(TrainingCallback):
    """Callback that answers requests. Mutable. One to stop may come before training: see :func:`drop`."""

    def __init__(self, folder: RunFolder, stop: Interrupt) -> None:
        self.folder, self.stop = folder, stop
        self._next = 0.0

    def before_training(self, agent: Agent) -> None:
        """Removes what an earlier process has shown, and the mark of its pause."""
        drop(self.folder.watch, self.folder.live, self.folder.paused)

    def after_training(self, agent: Agent, error: BaseException | None) -> None:
        """Removes the files of requests and of what was shown."""
        drop(self.folder.stop, self.folder.watch, self.folder.live, self.folder.paused)

    def __call__(self, agent: Agent, progress: Progress) -> None:
        """Answers, at most every two seconds: writes the current model while it is watched; stops as Ctrl-C does."""
        now = time.monotonic()
        if now < self._next:
            return
        if self.folder.stop.is_file():
            self.stop.signal = signal.SIGINT
        if is_asked(self.folder.watch):
            show(agent, self.folder.live)
        self._next = now + EVERY


def show(agent: Agent, path: Path) -> None:
    """Writes the current model for those who watch, if that is possible; no error message names it as the last one."""
    saved = agent.last_saved
    with suppress(OSError):
        agent.snapshot(path)()
    agent.last_saved = saved


def keep_model(agent: Agent, folder: Path, step: int) -> None:
    """Writes the model of a step among those of the course of training; of too many every second one is removed."""
    show(agent, folder / f"step_{step:012}.safetensors")
    paths = models(folder)
    drop(*(paths[1::2] if len(paths) > MOST_MODELS else ()))  # where somebody reads one, Windows keeps it


def models(folder: Path) -> Sequence[Path]:
    """Returns the models of the course of training, oldest first."""
    try:
        with os.scandir(folder) as entries:  # the studio looks once a second
            names = sorted(entry.name for entry in islice(entries, MOST_ENTRIES))
    except OSError:
        return []
    return [folder / name for name in names if MODEL.fullmatch(name)]
