"""Registration of other kinds of vector environments.

The agents step a :class:`rejeu.envs.base.VectorEnv`. A package with vector environments of another kind registers how they
are converted, as :mod:`rejeu.sb3` does for Stable-Baselines3's ``VecEnv``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Adapter = Callable[[Any, Any], Any]
"""Converts an object and a seed to a :class:`rejeu.envs.base.VectorEnv`. The object has an attribute ``num_envs``."""

_adapters: dict[type, Adapter] = {}


def register_adapter(kind: type, adapter: Adapter) -> None:
    """Lets :func:`rejeu.make_vector`, and so the agents, accept instances of a class."""
    _adapters[kind] = adapter


def adapter_of(env: Any) -> Adapter | None:
    """Returns the adapter for an object, or None if none is registered for its class."""
    return next((adapter for kind, adapter in _adapters.items() if isinstance(env, kind)), None)
