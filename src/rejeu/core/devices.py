"""Devices by name: the one that an agent computes on, all that share several runs, and the memory that they have free."""

from __future__ import annotations

import functools
from contextlib import AbstractContextManager, nullcontext

import jax

from rejeu.core import xla
from rejeu.core.hardware import free_memory

NAMES = ("auto", "cpu", "gpu")
"""``auto`` is JAX's default device: the first GPU if there is one that JAX supports, else the CPU."""
SYNONYMS = {"cuda": "gpu", "cuda:0": "gpu"}
"""Names of Stable-Baselines3."""
INSTALL = 'pip install "jax[cuda13]"'
"""The command that brings JAX for NVIDIA GPUs; ``cuda12`` is for older drivers."""


def named(device: object, option: str = "device") -> str:
    """Returns the name of a device among ``NAMES``; ``"cuda"`` and PyTorch's devices are accepted.

    Raises:
        ValueError: if there is no such name.

    >>> named("auto"), named("cuda")
    ('auto', 'gpu')
    """
    name = str(device)
    name = SYNONYMS.get(name, name)
    if name not in NAMES:
        raise ValueError(f"{option}={device!r} must be 'auto', 'cpu' or 'gpu'; JAX has {present()}")
    return name


def present() -> str:
    """Returns the devices that JAX has, in words."""
    counts: dict[str, int] = {}
    for platform in ("gpu", "tpu", "cpu"):
        try:
            counts[platform] = len(jax.local_devices(backend=platform))
        except RuntimeError:
            continue
    return " and ".join(f"{n} {platform.upper()} device{'s' * (n > 1)}" for platform, n in counts.items())


@functools.cache
def find(name: str) -> jax.Device | None:
    """Returns the first device of a kind; None for ``"auto"``. JAX must have been started as it is to be.

    Raises:
        ValueError: if JAX has none, with what it has and how to get one.
    """
    return None if name == "auto" else local(name)[0]


def local(name: str) -> list[jax.Device]:
    """Returns all devices of a kind; for ``"auto"`` those like JAX's default device, or only that one if the user set it.

    Raises:
        ValueError: if JAX has none, with what it has and how to get one.
    """
    if name == "auto":
        default = jax.config.jax_default_device  # type: ignore[attr-defined]
        return jax.local_devices() if default is None else [default] if not isinstance(default, str) else local(default)
    try:
        return jax.local_devices(backend=name)
    except RuntimeError:
        raise ValueError(
            f"device={name!r}: JAX has no such device here, only {present()}; for an NVIDIA GPU install JAX with CUDA "
            f"({INSTALL}), or take device='auto'"
        ) from None


def chosen(name: str) -> AbstractContextManager[object]:
    """Returns a context in which JAX computes on a device, if that is not its default device already.

    Raises:
        ValueError: if JAX has no such device.
    """
    device = find(name)
    return nullcontext() if device is None or device == local("auto")[0] else jax.default_device(device)


def start_with(option: str, device: str) -> None:
    """Checks the device of a command. If it is the CPU, JAX starts no other, which keeps its memory for other programs.

    Raises:
        ValueError: if there is no such name, given by ``option``.
    """
    if named(device, option) == "cpu" and not xla.is_running():
        jax.config.update("jax_platforms", "cpu")


def room(device: jax.Device) -> int | None:
    """Returns the bytes of memory that a device has free; None if it does not say."""
    if device.platform == "cpu":
        return free_memory()
    stats = device.memory_stats() or {}
    return stats["bytes_limit"] - stats["bytes_in_use"] if {"bytes_limit", "bytes_in_use"} <= stats.keys() else None
