"""rejeu: reinforcement learning with hindsight replay, compiled with JAX, for any Gymnasium environment.

>>> import rejeu
>>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=50, seed=0).learn(100)
>>> agent.num_timesteps
100
"""

from rejeu.core import interrupt

if interrupt.is_command():  # which ends with one line until it listens, so that this is before all other imports
    interrupt.install(lambda number, frame: interrupt.leave(number))

import ast
import importlib
import importlib.util
from pathlib import Path
from typing import Any

from rejeu.algorithms.catalog import CATALOG

if not interrupt.is_command():  # which imports them when it makes an environment
    importlib.import_module("rejeu.envs")  # registers rejeu's environments

__version__ = "0.1.0"

_STUB = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
_MODULES = {
    alias.name: str(node.module) for node in _STUB.body if isinstance(node, ast.ImportFrom) for alias in node.names
}
_MODULES |= dict.fromkeys(CATALOG, _MODULES.pop("*"))
"""The module that defines each public name."""

__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    """Imports a public name or a submodule when it is first used (PEP 562)."""
    if name in _MODULES:
        value = getattr(__import__(_MODULES[name], fromlist=[name]), name)  # a submodule too
    elif name.isidentifier() and not name.startswith("_") and importlib.util.find_spec(f"rejeu.{name}") is not None:
        value = importlib.import_module(f"rejeu.{name}")
    else:
        hint = importlib.import_module("rejeu.core.validation").nearest(name, __all__, "dir(rejeu) lists them")
        raise AttributeError(f"module 'rejeu' has no attribute {name!r}; {hint}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
