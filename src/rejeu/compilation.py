"""XLA compilation: kept on disk between runs, and the seconds it took."""

from __future__ import annotations

import os

import jax
import platformdirs

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


def seconds() -> float:
    """Returns the seconds spent tracing and compiling since :func:`enable_cache` was first called."""
    return _seconds


def _listen(event: str, duration_secs: float, **_: str | int) -> None:
    global _seconds
    if event.startswith("/jax/core/compile/"):
        _seconds += duration_secs
