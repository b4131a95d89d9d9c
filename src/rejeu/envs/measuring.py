"""Which backend is the fastest for an environment: measured once, kept in the user's cache folder, and said.

EnvPool's episodes are not Gymnasium's, so two runs with one seed are the same run only if both are stepped by the same
one of the two. A choice is therefore made once for an environment, a number of environments, the packages' versions and
a machine, and looked up ever after; where it cannot be kept, nothing is measured.
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import json
import math
import multiprocessing
import os
import platform
import random
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import platformdirs
from gymnasium.vector.utils import batch_space

from rejeu.envs.workers import pool

if TYPE_CHECKING:
    from rejeu.envs.base import VectorEnv

PREFERENCE = ("envpool", "gymnasium", "gymnasium-async")
"""What can be chosen; each against the one before only if it is faster by ``MARGIN``."""
MARGIN = 1.2
"""How many times faster a backend must be to be taken instead of one that is preferred."""
SLOW_STEP = 1e-3
"""Seconds that a step must take in this process for worker processes to be tried: starting them takes seconds."""
ROUNDS = 8
"""How often each backend is timed, in turn with the others; the median counts."""
ROUND_SECONDS = 0.008
"""Of timing one backend in a round, where its steps are not longer."""
MOST_SECONDS = 0.6
"""After which a backend of long steps is timed no further."""
CACHE = "REJEU_CACHE_DIR"
"""The environment variable that moves the folder in which choices are kept; empty, it turns measuring off."""
PACKAGES = ("rejeu", "gymnasium", "numpy", "envpool", "highway-env", "gymnasium-robotics", "box2d", "mujoco")
"""Those whose versions a choice is for."""

Make = Callable[[str, int], "VectorEnv"]
"""Makes so many environments on a backend, seeded."""


@dataclass(frozen=True)
class Choice:
    """A backend, and what it was chosen by."""

    backend: str
    measured: Mapping[str, float] = field(default_factory=dict)
    """Environment steps per second on each backend that was measured."""
    passed_over: Mapping[str, str] = field(default_factory=dict)
    """Why a backend could not be measured."""


def choose(
    make: Make, env_id: str, n_envs: int, env_kwargs: Mapping[str, Any], envpool_knows_it: Callable[[], bool]
) -> Choice:
    """Returns the fastest backend, by an earlier measurement or by one made now.

    Nothing is measured where there is nothing to choose between, or where the choice could not be kept; then it is
    EnvPool where that knows the environment, and this process elsewhere. Between this process and worker processes,
    which give the same episodes, the latter are tried only if a step here takes at least ``SLOW_STEP``.

    Args:
        make: makes environments of this kind.
        env_id: the id they are registered under.
        n_envs: how many there will be.
        env_kwargs: what they are made with.
        envpool_knows_it: says whether EnvPool is among the candidates; asked only if no choice is kept, since importing
            EnvPool takes half a second.
    """
    folder, key = cache_folder(), describe(env_id, n_envs, env_kwargs)
    several = n_envs > 1 and cores() > 1

    def find() -> Choice | None:
        here = ("envpool", "gymnasium") if envpool_knows_it() else ("gymnasium",)
        return fastest(measure(make, here, n_envs)) if len(here) > 1 or several else None

    choice = None
    if folder is not None and key is not None and env_kwargs.get("render_mode") is None:
        choice = remembered(folder, key, find)
    if folder is None or key is None or choice is None:
        return Choice("envpool" if envpool_knows_it() else "gymnasium")
    if not (several and choice.backend == "gymnasium" and choice.measured["gymnasium"] * SLOW_STEP < 1.0):
        return choice
    reason = why_no_workers()
    if reason is not None:
        return Choice(choice.backend, choice.measured, {**choice.passed_over, "gymnasium-async": reason})
    first, n_workers = choice, min(n_envs, cores())
    tried = remembered(
        folder, {**key, "first": asdict(first)}, lambda: fastest(measure(make, ("gymnasium-async",), n_workers), first)
    )
    return first if tried is None else tried


def fastest(found: Choice, beside: Choice | None = None) -> Choice | None:
    """Returns the choice by all that was measured: the preferred backend, or one that is ``MARGIN`` times as fast.

    None if nothing was.

    >>> fastest(Choice("", {"envpool": 100.0, "gymnasium": 119.0})).backend
    'envpool'
    >>> fastest(Choice("", {"envpool": 100.0, "gymnasium": 121.0})).backend
    'gymnasium'
    """
    measured = {**(beside.measured if beside else {}), **found.measured}
    passed_over = {**(beside.passed_over if beside else {}), **found.passed_over}
    best = ""
    for backend in PREFERENCE:
        if backend in measured and (not best or measured[backend] >= MARGIN * measured[best]):
            best = backend
    return Choice(best, measured, passed_over) if best else None


def measure(make: Make, backends: Sequence[str], n_envs: int) -> Choice:
    """Returns the steps per second on each backend, and why some could not be measured; the choice is left open.

    Fresh environments take random actions, with the resets that fall due, the backends in turn so that what else the
    machine does slows all of them; a few tenths of a second, longer only where single steps are. Environments that are
    slow to make are measured in this process by one of them.
    """
    timed: dict[str, _Timed] = {}
    passed_over: dict[str, str] = {}
    with undisturbed(), contextlib.ExitStack() as stack:

        def attempt(backend: str, act: Callable[[], Any]) -> None:
            try:
                act()
            except Exception as error:  # whatever a package or an environment raises: the others may still serve
                passed_over[backend] = f"{type(error).__name__}: {' '.join(str(error).split())}"
                timed.pop(backend, None)

        def begin(backend: str) -> None:
            began = time.perf_counter()
            timed[backend] = _Timed(stack, make, backend, 1 if backend == "gymnasium" else n_envs)
            if backend == "gymnasium" and n_envs > 1 and (time.perf_counter() - began) * n_envs < MOST_SECONDS / 2:
                timed[backend] = _Timed(stack, make, backend, n_envs)

        for backend in backends:
            attempt(backend, partial(begin, backend))
        for _ in range(ROUNDS):
            for backend, one in [*timed.items()]:
                attempt(backend, one.round)
    return Choice("", {backend: one.rate() for backend, one in timed.items()}, passed_over)


class _Timed:
    """Environments under measurement."""

    def __init__(self, stack: contextlib.ExitStack, make: Make, backend: str, n_envs: int) -> None:
        self.vector = make(backend, n_envs)
        stack.callback(self.vector.close)
        space = batch_space(copy.deepcopy(self.vector.action_space), n_envs)
        space.seed(0)
        self.actions = [space.sample() for _ in range(32)]
        self.taken = 0
        self.seconds: list[float] = []
        """Of a vector step, in each round."""
        self.vector.reset()
        seconds = self.walk(1)
        if seconds < ROUND_SECONDS:
            seconds = self.walk(5)  # the first may have had something to set up
        self.per_round = max(1, int(ROUND_SECONDS / seconds))

    def walk(self, n: int) -> float:
        """Takes ``n`` steps of all environments and returns the seconds of one."""
        began = time.perf_counter()
        for _ in range(n):
            step = self.vector.step(self.actions[self.taken % len(self.actions)])
            self.taken += 1
            done = step.terminated | step.truncated
            if done.any():
                self.vector.reset_done(done)
        return (time.perf_counter() - began) / n

    def round(self) -> None:
        """Takes the steps of one round, unless enough time has gone into this backend."""
        if not self.seconds or sum(self.seconds) * self.per_round < MOST_SECONDS:
            self.seconds.append(self.walk(self.per_round))

    def rate(self) -> float:
        """Returns the environment steps per second."""
        return self.vector.n_envs / statistics.median(self.seconds)


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Puts the global random generators back as they were, and keeps warnings for the environments that will be used."""
    python, legacy = random.getstate(), np.random.get_state()  # noqa: NPY002
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        random.setstate(python)
        np.random.set_state(legacy)  # noqa: NPY002


def why_no_workers() -> str | None:
    """Returns why worker processes cannot be tried, None if they can."""
    if multiprocessing.parent_process() is not None:
        return "this is itself a worker process"
    again = pool.main_runs_again()
    if again is None:
        return "it cannot be told whether workers could import the main script; this may be another thread"
    if again:
        return "the main script starts this outside of `if __name__ == '__main__':`, so workers cannot import it"
    return None


def describe(env_id: str, n_envs: int, env_kwargs: Mapping[str, Any]) -> dict[str, Any] | None:
    """Returns what a choice is for, as JSON has it; None if the arguments cannot be written as JSON."""
    key = {
        "env": env_id,
        "kwargs": dict(env_kwargs),
        "n_envs": n_envs,
        "cores": cores(),
        "machine": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": versions(),
    }
    try:
        return json.loads(json.dumps(key, allow_nan=False))
    except (TypeError, ValueError):
        return None


@cache
def versions() -> dict[str, str | None]:
    """Returns the versions of what a choice depends on, None for what is not installed."""
    found: dict[str, str | None] = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = None
    return found


def cores() -> int:
    """Returns how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def cache_folder() -> Path | None:
    """Returns where choices are kept, None if nowhere."""
    given = os.environ.get(CACHE)
    if given is None:
        return Path(platformdirs.user_cache_dir("rejeu", appauthor=False)) / "backends"
    return Path(given) / "backends" if given else None


def remembered(folder: Path, key: dict[str, Any], find: Callable[[], Choice | None]) -> Choice | None:
    """Returns the choice kept for ``key``, or the one that ``find`` finds and that is then kept.

    Of processes that look for one at the same time, the first to finish decides for all. None if nothing was found, or
    if it could not be kept.
    """
    name = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:20]
    path = folder / f"{name}.json"
    try:
        kept = read(path, key)
        if kept is not None:
            return kept
        folder.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=folder)
        try:
            with open(handle, "w", encoding="utf-8") as file:
                choice = find()
                if choice is None:
                    return None
                json.dump({"key": key, **asdict(choice)}, file, indent=1)
            try:
                os.link(temporary, path)
            except FileExistsError:
                pass
            except OSError:  # a file system without links, where the last to finish decides
                os.replace(temporary, path)
        finally:
            Path(temporary).unlink(missing_ok=True)
        return read(path, key)
    except OSError:
        return None


def read(path: Path, key: dict[str, Any]) -> Choice | None:
    """Returns the choice in a file, None if there is no such file; removes one that holds anything else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        measured = {str(name): float(rate) for name, rate in content["measured"].items()}
        passed_over = {str(name): str(reason) for name, reason in content["passed_over"].items()}
        right = content["key"] == key and content["backend"] in measured and set(measured) <= set(PREFERENCE)
        if right and all(math.isfinite(rate) and rate > 0.0 for rate in measured.values()):
            return Choice(content["backend"], measured, passed_over)
    except FileNotFoundError:
        return None
    except (ValueError, TypeError, KeyError, AttributeError):
        pass
    path.unlink(missing_ok=True)
    return None


def sentence(vector: VectorEnv) -> str:
    """Returns the backend of environments and what it was chosen by, as in ``envpool (61,000 steps/s; gymnasium 5,200)``."""
    rates = dict(vector.measured)
    text = vector.backend
    if text in rates:
        others = "".join(f"; {name} {rate:,.0f}" for name, rate in rates.items() if name != text)
        text += f" ({rates[text]:,.0f} steps/s{others})"
    return text + "".join(f"; not {name}: {reason}" for name, reason in vector.passed_over.items())
