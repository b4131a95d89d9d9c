"""Settings and fixtures of all tests: JAX does not promote ranks, and compiled functions are cached on disk between runs.

Programs are compiled with little optimization, because compilation takes most of the time of the tests. This halves the
compilation time. ``XLA_FLAGS= pytest`` compiles them as users do.

Mixed dtypes also raise an error, but only around rejeu's own functions (``strict_dtypes``): Adam's bias correction in
optax raises a Python float to an int32 power, which JAX's strict mode does not allow.
"""

import ctypes
import gc
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, wraps
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "rejeu-test-cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")  # Ray then uses the loopback address only

import hypothesis
import jax
import pytest

from rejeu.core.errors import MissingExtra
from rejeu.core.xla import RUN_ONCE

hypothesis.settings.register_profile("rejeu", max_examples=50, derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("rejeu")
jax.config.update("jax_numpy_rank_promotion", "raise")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # set by shells for background jobs; subprocesses inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)


QUICK_TO_COMPILE = " ".join(
    f"--{name}={value}".lower() for name, value in {**RUN_ONCE, "xla_cpu_parallel_codegen_split_count": 1}.items()
)
STATUS = Path("/proc/self/status")
LARGE = 3 * 2**29
"""Bytes of memory after which compiled functions are dropped."""
MOST_MEMORY = 2**31
"""Bytes of memory that one process of tests may take."""
STEPS, EPISODES = 64, 25
"""Maximum number of training steps of an example. Restoring the best weights takes 20 finished episodes."""


def pytest_configure(config: pytest.Config) -> None:
    """Sets XLA's options before its first use. Slow tests train for minutes, so their programs are optimized."""
    if config.option.markexpr.startswith("not slow"):
        os.environ.setdefault("XLA_FLAGS", QUICK_TO_COMPILE)


@pytest.hookimpl(tryfirst=True)  # before pytest leaves out what is exhaustive
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks the dear tests, and gives learning runs and searches more time than other tests.

    Raises:
        pytest.UsageError: if all tests are collected, and a line of ``dear.txt`` is none of them. Files that are skipped as a
            whole, where a package is missing, do not count.
    """
    from tests.tiers import DEAR, exhaustive

    files = {item.nodeid.partition("::")[0] for item in items}
    unknown = {
        nodeid
        for nodeid in DEAR - {item.nodeid for item in items}
        if (file := nodeid.partition("::")[0]) in files or not (config.rootpath / file).is_file()
    }
    if unknown and not config.option.file_or_dir and not config.option.keyword:
        raise pytest.UsageError(f"tests/dear.txt names tests that do not exist: {sorted(unknown)[:5]}")
    for item in items:
        if item.nodeid in DEAR:
            item.add_marker(exhaustive)
        if item.get_closest_marker("slow") or item.get_closest_marker("exhaustive"):
            item.add_marker(pytest.mark.timeout(7200))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Collects garbage less often, and not among what was imported, because JAX keeps many objects."""
    gc.freeze()
    gc.set_threshold(50_000, 10, 10)


@cache
def is_envpool_importable() -> bool:
    """Returns whether a new process, in which no test has replaced anything, can import EnvPool."""
    return subprocess.run([sys.executable, "-c", "import envpool"], capture_output=True, check=False).returncode == 0


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> Iterator[None]:
    """Skips a test that asks for EnvPool itself in a system that cannot import it, such as one without libEGL.

    A test in a file that does not name EnvPool has no reason to need it, and fails.
    """
    try:
        return (yield)
    except MissingExtra as error:
        names_envpool = "envpool" in pyfuncitem.path.read_text(encoding="utf-8").lower()
        if "needs EnvPool" in str(error) and names_envpool and not is_envpool_importable():
            pytest.skip(str(error))
        raise


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skips a test marked with ``needs_envpool``, which fails without EnvPool in another way than by asking for it by name."""
    if item.get_closest_marker("needs_envpool"):
        from rejeu.envs.registry import import_envpool

        try:
            import_envpool()
        except MissingExtra as error:
            pytest.skip(str(error))


@pytest.fixture
def strict_dtypes() -> Iterator[None]:
    """JAX raises an error if two dtypes are mixed. For tests of functions that contain no optimizer."""
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(autouse=True)
def forget_registered() -> Iterator[None]:
    """Removes what a test registered, for example with a page of the docs: algorithms, presets, encoders and so on."""
    import rejeu
    from rejeu.agents import presets
    from rejeu.envs.functional import REGISTRY
    from rejeu.networks.layers import ENCODERS
    from rejeu.replay.hindsight import STRATEGIES

    registries: tuple[dict[str, Any], ...] = (rejeu.AGENTS, presets.registered, REGISTRY, STRATEGIES, ENCODERS)
    before = [dict(registry) for registry in registries]
    yield
    for registry, entries in zip(registries, before, strict=True):
        if registry != entries:
            registry.clear()
            registry.update(entries)


@pytest.fixture(scope="module")
def learners_are_shared() -> Iterator[None]:
    """All agents of the tests of a module share compiled functions (see ``sharing``)."""
    from tests.sharing import shared_learners

    with shared_learners():
        yield


@pytest.fixture
def untrained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ends commands before they train."""
    from rejeu.lab.runs.session import Session

    monkeypatch.setattr(Session, "run", lambda self, stop, stopwatch: (0, {}))


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shortens the training and the evaluations of an example."""
    from rejeu.agents import Agent

    learn, evaluate = Agent.learn, Agent.evaluate

    @wraps(learn)
    def learn_shortly(
        self: Agent,
        total_timesteps: int | None = None,
        *args: Any,
        episodes: Any = None,
        minutes: Any = None,
        **kw: Any,
    ) -> Agent:
        if minutes is not None or total_timesteps is not None:
            total_timesteps = min(total_timesteps or STEPS, STEPS)
        episodes = None if episodes is None else min(episodes, EPISODES)
        return learn(self, total_timesteps, *args, episodes=episodes, **kw)

    @wraps(evaluate)
    def evaluate_shortly(self: Agent, episodes: Any = None, *args: Any, minutes: Any = None, **kw: Any) -> Any:
        return evaluate(self, 2, *args, **kw)

    monkeypatch.setattr(Agent, "learn", learn_shortly)
    monkeypatch.setattr(Agent, "evaluate", evaluate_shortly)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Headless Chromium, if it and Playwright are installed. Its event loop ends with the module that asked for it."""
    driving = pytest.importorskip("playwright.sync_api", reason="needs playwright, which is in the extra test")
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        pytest.skip("needs Chromium; on Debian: apt-get install chromium")
    with driving.sync_playwright() as driver:
        quiet = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
        started = driver.chromium.launch(executable_path=chromium, args=quiet)
        yield started
        started.close()


def memory(field: str) -> int:
    """Returns a size of this process in bytes: ``VmRSS`` is what it takes, ``VmHWM`` the most that it took. 0 if unknown."""
    match = re.search(rf"^{field}:\s+(\d+) kB", STATUS.read_text() if STATUS.exists() else "", re.MULTILINE)
    return int(match[1]) * 1024 if match else 0


@pytest.fixture(autouse=True)
def memory_is_limited() -> Iterator[None]:
    """Drops compiled functions after a test if they have grown large, and fails the test that takes too much memory.

    They are compiled again from the cache on disk. The C library returns freed memory to the system only when asked.
    """
    before = memory("VmHWM")
    yield
    if memory("VmRSS") > LARGE:
        from tests.sharing import forget_learners

        forget_learners()
        jax.clear_caches()
        gc.collect()
        with suppress(AttributeError, OSError):  # another C library than GNU's
            ctypes.CDLL(None).malloc_trim(0)
    peak = memory("VmHWM")
    assert peak <= MOST_MEMORY or before > MOST_MEMORY, f"the tests of this process took {peak / 1e9:.1f} GB of memory"
