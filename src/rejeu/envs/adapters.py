"""Registration of other kinds of vector environments.

The agents step a :class:`rejeu.envs.base.VectorEnv`. A package with vector environments of another kind registers how they
are converted, as :mod:`rejeu.sb3` does for Stable-Baselines3's ``VecEnv``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

Adapter = Callable[[Any, Any], Any]
"""Converts an object and a seed to a :class:`rejeu.envs.base.VectorEnv`. The object has an attribute ``num_envs``."""
View = Callable[[Any], Any]
"""Converts a :class:`rejeu.envs.base.VectorEnv` to a ``VecEnv``."""

_adapters: dict[type, Adapter] = {}
_views: list[View] = []


def register_adapter(kind: type, adapter: Adapter) -> None:
    """Lets :func:`rejeu.make_vector`, and so the agents, accept instances of a class."""
    _adapters[kind] = adapter


def adapter_of(env: Any) -> Adapter | None:
    """Returns the adapter for an object, or None if none is registered for its class."""
    return next((adapter for kind, adapter in _adapters.items() if isinstance(env, kind)), None)


def register_vec_env_view(view: View) -> None:
    """Sets the function that :meth:`Agent.get_env` converts the agent's environments with."""
    _views[:] = [view]


def vec_env_view(vector: Any) -> Any:
    """Returns a vector environment as a ``VecEnv`` with automatic resets."""
    if not _views:
        importlib.import_module("rejeu.sb3.common.vec_env")  # the package that registers one
    (view,) = _views
    return view(vector)
