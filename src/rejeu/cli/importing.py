"""Imports modules that the user names on the command line: of environments, wrappers and algorithms.

No name from a file gets here: see :mod:`rejeu.cli.environment`.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rejeu.envs.functional import REGISTRY
from rejeu.envs.registry import is_plain_id


def imports(typed: str) -> bool:
    """Returns whether naming an environment like this imports code."""
    return not is_plain_id(typed) or typed.endswith(".py")


def find_id(name: str) -> str:
    """Returns the id of an environment that was named on the command line; imports the module before a colon, or a file.

    Raises:
        ValueError: if the module does not register it.
        ImportError: if there is no such module.
    """
    import gymnasium as gym

    if not name.endswith(".py") and ":" not in name:
        if name not in gym.registry and Path(f"{name}.py").is_file():
            raise ValueError(f"no environment is called {name!r}; did you mean the file {name}.py?")
        return name
    before = set(gym.registry)
    if name.endswith(".py") or ".py:" in name:
        stem, _, env_id = name.rpartition(".py")
        env_id, source = env_id.removeprefix(":"), f"{stem}.py"
    else:
        source, _, env_id = name.partition(":")
    if not source:
        raise ValueError(f"{name!r} must be MODULE:ID, such as my_env:Walk-v0")
    module = import_source(source)
    new = set(gym.registry) - before
    new |= {key for key, spec in gym.registry.items() if module_of(spec.entry_point) == module.__name__}
    new |= {key for key, entry in REGISTRY.items() if getattr(entry.kind, "__module__", None) == module.__name__}
    if env_id in gym.registry:
        return env_id
    found = " and ".join(sorted(new))
    if not env_id and len(new) == 1:
        return found
    if not new:
        raise ValueError(
            f"{source} registers no environment; add gymnasium.register('Walk-v0', '{module.__name__}:Walk', "
            "max_episode_steps=...) to it, with the name of your class"
        )
    if not env_id:
        raise ValueError(f"{source} registers {found}; name one of them: {source}:{min(new)}")
    raise ValueError(f"{source} registers {found}, not {env_id!r}")


def module_of(entry_point: Any) -> str | None:
    """Returns the module of an environment's entry point: a class, a function, or ``MODULE:NAME``."""
    return entry_point.partition(":")[0] if isinstance(entry_point, str) else getattr(entry_point, "__module__", None)


def find_wrapper(name: str) -> Callable[[Any], Any]:
    """Returns the wrapper ``module:Class`` or ``file.py:Class``: anything that takes an environment.

    Raises:
        ValueError: if there is none.
        ImportError: if there is no such module.
    """
    source, colon, attribute = name.rpartition(":")
    if not colon or not source or not attribute:
        raise ValueError(f"--wrapper {name!r} must be MODULE:CLASS, such as gymnasium.wrappers:FlattenObservation")
    module = import_source(source)
    wrapper = getattr(module, attribute, None)
    if not callable(wrapper):
        raise ValueError(f"--wrapper {name!r}: {source} has no class or function {attribute!r}")
    return wrapper


def import_source(source: str) -> Any:
    """Returns the module of this name, or of a Python file whose name ends in ``.py``; see the two functions below.

    Raises:
        ImportError: if there is none, or if its code raises an error.
    """
    try:
        return import_file(Path(source)) if source.endswith(".py") else import_module(source)
    except (ImportError, FileNotFoundError):
        raise
    except Exception as error:
        raise ImportError(f"{source} cannot be imported: {type(error).__name__}: {error}") from error


def import_module(name: str) -> Any:
    """Returns a module, also of the current folder; installed ones come first.

    Raises:
        ImportError: if there is none.
    """
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())
    importlib.invalidate_caches()
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise
        raise ModuleNotFoundError(
            f"there is no module {name!r} in {os.getcwd()} or among the installed packages"
        ) from None


def import_file(path: Path) -> Any:
    """Returns the module of a Python file, under the file's name, so that worker processes can import it as well.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if another module has its name.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    importlib.invalidate_caches()
    module = importlib.import_module(path.stem)
    if Path(getattr(module, "__file__", None) or "").resolve() != path.resolve():
        raise ImportError(f"another module is called {path.stem}; rename {path}")
    return module
