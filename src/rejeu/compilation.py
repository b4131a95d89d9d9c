"""What surrounds XLA: compiled programs kept on disk, the seconds that compiling took, the number of threads."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import jax
import platformdirs

THREADS = "NPROC"
"""The environment variable that XLA takes the size of its CPU thread pool from."""
LITTLE_WORK = 2**23
"""Multiplications in the largest layer of an update up to which a second thread costs more than it brings. Measured on
2 cores: batches of 128 through 128-128 gain a fifth from one thread, batches of 256 through 256-256 lose a fifth."""

RUN_ONCE = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
"""XLA's options for what runs once only: it takes a quarter of the time to compile."""

_seconds = 0.0
_listening = False


def enable_cache() -> None:
    """Turns on JAX's persistent compilation cache in the user's cache folder, unless one is set already.

    The environment variable ``JAX_COMPILATION_CACHE_DIR`` moves it; set to an empty text, it turns it off.
    """
    global _listening
    if not _listening:
        _listening = True
        jax.monitoring.register_event_duration_secs_listener(_listen)
    unset = jax.config.jax_compilation_cache_dir is None  # type: ignore[attr-defined]
    if unset and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", platformdirs.user_cache_dir("rejeu", appauthor=False))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def start_device(work: float) -> None:
    """Starts JAX's device, with a single thread on a CPU if ``work``, in multiplications of a layer, is little.

    The number of threads is chosen once in a process, when the device starts; where the program has used JAX before or
    ``NPROC`` is set, nothing is chosen here.
    """
    if THREADS in os.environ or work > LITTLE_WORK:
        return
    os.environ[THREADS] = "1"
    try:
        jax.local_devices()
    finally:
        del os.environ[THREADS]


def run_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``function`` compiled for a single call; by the usual options where another XLA does not know these."""
    quick = jax.jit(function, compiler_options=RUN_ONCE)

    def call(*arguments: Any) -> Any:
        try:
            return quick(*arguments)
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            return jax.jit(function)(*arguments)

    return call


def seconds() -> float:
    """Returns the seconds spent tracing and compiling since :func:`enable_cache` was first called."""
    return _seconds


def _listen(event: str, duration_secs: float, **_: str | int) -> None:
    global _seconds
    if event.startswith("/jax/core/compile/"):
        _seconds += duration_secs
