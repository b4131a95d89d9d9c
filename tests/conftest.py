"""What holds in every test: JAX refuses to broadcast ranks silently, and compiled functions are kept between runs.

Programs are compiled with little optimisation, which takes half as long and is most of what tests do; ``XLA_FLAGS= pytest``
compiles them as users do.

Mixed dtypes are refused as well, but only around our own functions (``strict_dtypes``): Adam's bias correction in optax
raises a Python float to an int32 power, which JAX's strict mode forbids.
"""

from __future__ import annotations

import gc
import os
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(tempfile.gettempdir()) / "rejeu-test-cache"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import hypothesis
import jax
import pytest

hypothesis.settings.register_profile("rejeu", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("rejeu")
jax.config.update("jax_numpy_rank_promotion", "raise")
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background of a shell; those whom tests start inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)


QUICK_TO_COMPILE = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"


def pytest_configure(config: pytest.Config) -> None:
    """Sets XLA's options before its first use; learning runs of minutes, marked slow, run longer than they compile."""
    if config.option.markexpr == "not slow":
        os.environ.setdefault("XLA_FLAGS", QUICK_TO_COMPILE)


@pytest.fixture
def strict_dtypes() -> Iterator[None]:
    """JAX raises wherever two dtypes meet; for tests of functions that hold no optimizer."""
    with jax.numpy_dtype_promotion("strict"):
        yield


@pytest.fixture(autouse=True, scope="module")
def compiled_functions_are_let_go() -> Iterator[None]:
    """Every compiled function is a few mappings of memory, of which Linux allows a process 65,530; JAX keeps them all."""
    yield
    jax.clear_caches()
    gc.collect()
