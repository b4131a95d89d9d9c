"""Modules without a file of their own, and the names that a module passes on from others, as in Stable-Baselines3."""

import importlib
import sys
from collections.abc import Mapping
from itertools import takewhile
from types import ModuleType
from typing import Any

HOMES = [
    f"rejeu.sb3.{home}"
    for home in (
        *("algorithms", "policy", "common.base_class", "common.buffers", "common.callbacks", "common.env_util"),
        *("common.evaluation", "common.logger", "common.monitor", "common.noise", "common.preprocessing"),
        *("common.running_mean_std", "common.torch_layers", "common.type_aliases", "common.utils", "common.vec_env"),
        "common.vec_env.base_vec_env",
    )
]
"""Modules whose names others pass on."""


def passes_on(path: str) -> None:
    """Makes the names of :data:`HOMES` importable from the module ``path`` too, each imported when it is used.

    Modules of the original pass on what they import, and scripts import it from there. Of two homes the one of the same
    package is preferred.
    """

    def passed_on(name: str) -> Any:
        nearest = sorted(HOMES, key=lambda home: -n_shared(home, path))
        for home in () if name.startswith("_") else nearest:
            names = vars(importlib.import_module(home))
            if home != path and name in names.get("__all__", names):
                return names[name]
        raise AttributeError(f"module {path!r} has no attribute {name!r}")

    sys.modules[path].__dict__["__getattr__"] = passed_on


def n_shared(path: str, second: str) -> int:
    """Returns how many packages two modules have in common."""
    pairs = zip(path.split("."), second.split("."), strict=False)
    return len([*takewhile(lambda pair: pair[0] == pair[1], pairs)])


def define(path: str, names: Mapping[str, object], *others: str) -> None:
    """Makes names importable from the module ``path``, which has no file of its own. Its parents must exist.

    Args:
        path: of the module.
        names: what it defines, by name.
        others: names of :data:`HOMES` that are public in it too.
    """
    module = ModuleType(path, f"Part of {path.split('.')[1]}'s API.")
    module.__dict__.update(names, __all__=[*names, *others], __path__=[])
    sys.modules[path] = module
    passes_on(path)
    parent, _, last = path.rpartition(".")
    setattr(sys.modules[parent], last, module)


def alias(module: str, *names: str) -> None:
    """Makes a module known as submodules of itself too, where Stable-Baselines3 has a package of small modules."""
    for name in names:
        sys.modules[f"{module}.{name}"] = sys.modules[module]
        setattr(sys.modules[module], name, sys.modules[module])
