"""Environments as pure functions of JAX, which a training program can contain.

:class:`FunctionalEnv` is the interface, :func:`make` makes an environment by its id, such as ``jax/CartPole-v1``, and
:func:`register` adds one. :mod:`rejeu.envs.functional.vector` steps many at once.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv
    from rejeu.envs.functional.registry import make, register

_MODULES = {"FunctionalEnv": "protocol", "GoalEnv": "protocol", "make": "registry", "register": "registry"}

__all__ = ["FunctionalEnv", "GoalEnv", "make", "register"]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Imports a name when it is first used, so that registering environments alone does not import JAX."""
        if name not in _MODULES:
            raise AttributeError(f"module 'rejeu.envs.functional' has no attribute {name!r}")
        return getattr(importlib.import_module(f"rejeu.envs.functional.{_MODULES[name]}"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
