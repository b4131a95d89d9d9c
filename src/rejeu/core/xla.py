"""Settings of XLA: the compilation cache, the number of threads, and marks for its CPU compiler."""

from __future__ import annotations

import functools
import math
import os
import time
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, TypeVar, cast

import jax
import numpy as np
import platformdirs
from jax import Array
from jax.experimental.xla_metadata import set_xla_metadata

from rejeu.core.hardware import cores

THREADS = "NPROC"
"""Environment variable with the size of XLA's CPU thread pool."""
LITTLE_WORK = 2**23
"""Multiplications in the largest layer of an update up to which one thread is faster than two. Measured on 2 cores: with
two threads a step of DDPG with batches of 128 and layers 128-128 takes 1.5 times as long; with one thread batches of 256 and
layers 256-256 take 1.2 times as long."""

RUN_ONCE: dict[str, bool | int] = {"xla_backend_optimization_level": 0}
"""XLA's options for functions that run once: compiling takes a quarter of the time."""
if jax.__version_info__ < (0, 11, 1):  # later versions do not have it, and end the program if XLA_FLAGS does
    RUN_ONCE["xla_cpu_use_fusion_emitters"] = False

F = TypeVar("F", bound=Callable[..., Any])

OUTLINED = {"inlineable": "false"}
"""Attributes of a call that XLA does not inline."""
ONE_KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}
"""Attributes of a call that XLA compiles to one kernel."""
SMALL = 2**19
"""Maximum number of input elements of such a call; one kernel runs in one thread."""

SPLIT = 2**16
"""Most elements of a result for which XLA does not split an operation between threads. Inside of one kernel it cannot, and
fails to compile a concatenation ("Invalid LLVM IR", jaxlib 0.10.2); programs in the cache hide it."""

on_compile: Callable[[str, float], Any] = lambda event, seconds: None  # noqa: E731
"""Called with the name of each event of JAX's compiler and its seconds; the progress bar replaces it while it is shown."""

_n_runs = 1
"""How many runs the function that is traced computes at once."""
_seconds = 0.0
_threads: int | None = None


def enable_cache() -> None:
    """Turns on JAX's persistent compilation cache in the user's cache folder, unless one is set.

    The environment variable ``JAX_COMPILATION_CACHE_DIR`` moves it; an empty value turns the cache off.
    """
    _start_listening()
    unset = jax.config.jax_compilation_cache_dir is None  # type: ignore[attr-defined]
    if unset and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", platformdirs.user_cache_dir("rejeu", appauthor=False))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def start_device(n_threads: int) -> None:
    """Starts JAX's device, on a CPU with ``n_threads`` threads.

    The number is fixed when the device starts, once in a process. It is not changed if the program has used JAX before or
    ``NPROC`` is set.
    """
    global _threads
    if _threads is not None:
        return
    if is_running() or THREADS in os.environ:
        setting = os.environ.get(THREADS, "")
        _threads = int(setting) if setting.isdecimal() and int(setting) > 0 else cores()
        return
    _threads = n_threads
    os.environ[THREADS] = str(n_threads)
    try:
        jax.local_devices()
    finally:
        del os.environ[THREADS]


def threads() -> int:
    """Returns the number of threads of JAX's CPU device, on which the last bits of sums in large layers depend."""
    return cores() if _threads is None else _threads


def is_running() -> bool:
    """Returns whether the program has started JAX's device."""
    try:
        from jax._src.xla_bridge import backends_are_initialized  # there is no public way to ask
    except ImportError:
        return False
    return backends_are_initialized()


def platform() -> str:
    """Returns the kind of the device on which JAX computes here: ``"cpu"``, ``"gpu"`` or another."""
    device = jax.config.jax_default_device  # type: ignore[attr-defined]
    return jax.default_backend() if device is None else getattr(device, "platform", device)


def run_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Returns ``function`` compiled for a single call, with the usual options if XLA does not know the quick ones."""
    quick = jax.jit(function, compiler_options=RUN_ONCE)

    def call(*arguments: object) -> Any:
        try:
            return quick(*arguments)
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            return jax.jit(function)(*arguments)

    return call


def outlined(function: F) -> F:
    """Returns ``function`` such that XLA on a CPU does not inline it into a compiled program.

    For the large steps of an update. XLA on a CPU runs a program kernel by kernel, in the order in which their inputs are
    ready. If more than eight are ready, it gives half of them to another thread, and so to another core with cold caches: an
    update of DDPG (layers 128-128, batches of 128) took 1.3 times as long. A function that is not inlined only counts its
    own kernels. Arguments are pytrees; leaves that are not arrays are constants.
    """
    return _marked(function, OUTLINED, math.inf)


def one_kernel(function: F, concatenates: int = 0) -> F:
    """Returns ``function`` such that XLA on a CPU compiles each call of it to one kernel.

    For cheap functions of many small arrays, such as an optimizer's step, which would be one kernel for each array (see
    :func:`outlined`). Matrix products are slow in it. ``concatenates`` is the number of elements of the largest array that
    the function makes of others.
    """
    return _marked(function, ONE_KERNEL, SMALL, concatenates)


def for_runs(function: Callable[..., Any], n: int) -> Callable[..., Any]:
    """Returns ``function``, which ``jax.vmap`` is going to compute for ``n`` runs at once."""

    @functools.wraps(function)
    def call(*arguments: object) -> Any:
        global _n_runs
        before, _n_runs = _n_runs, n
        try:
            return function(*arguments)
        finally:
            _n_runs = before

    return call


def _marked(function: F, marks: dict[str, str], limit: float, concatenates: int = 0) -> F:
    """Returns ``function`` as a call with these attributes, if its inputs have at most ``limit`` elements."""

    @functools.wraps(function)
    def call(*arguments: object, **keywords: Any) -> Any:
        leaves, structure = jax.tree.flatten((arguments, keywords))
        where = [i for i, leaf in enumerate(leaves) if isinstance(leaf, jax.Array | np.ndarray)]
        is_split = concatenates * _n_runs > SPLIT and threads() > 1
        if platform() != "cpu" or is_split or sum(leaves[i].size for i in where) > limit:
            return function(*arguments, **keywords)

        def of_arrays(*arrays: Array) -> Any:
            complete = list(leaves)
            for i, array in zip(where, arrays, strict=True):
                complete[i] = array
            with set_xla_metadata(**dict.fromkeys(marks)):  # marks the call, not the operations inside
                arguments, keywords = jax.tree.unflatten(structure, complete)
                with jax.disable_jit() if marks is ONE_KERNEL and _n_runs > 1 else nullcontext():  # XLA splits calls
                    return function(*arguments, **keywords)

        of_arrays.__name__ = getattr(function, "__name__", of_arrays.__name__)  # a profile shows it
        with set_xla_metadata(**marks):
            return jax.jit(of_arrays)(*[leaves[i] for i in where])

    return cast(F, call)


def seconds() -> float:
    """Returns the seconds spent tracing and compiling since :func:`enable_cache` was first called."""
    return _seconds


def clock() -> float:
    """Returns the time in seconds, as ``time.perf_counter``, without that of tracing and compiling functions."""
    return time.perf_counter() - _seconds


def _listen(event: str, duration_secs: float, **_: str | int) -> None:
    global _seconds
    if event.startswith("/jax/core/compile/"):
        _seconds += duration_secs
        on_compile(event, duration_secs)


_start_listening = functools.cache(lambda: jax.monitoring.register_event_duration_secs_listener(_listen))
