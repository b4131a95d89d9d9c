"""Stable-Baselines3's API at its own module paths.

To port a script, replace ``stable_baselines3`` by ``rejeu.sb3`` in its imports. Names that rejeu does not have cannot be
imported. The algorithms of sb3-contrib (``QRDQN``, ``TQC``, ``CrossQ``, ``RecurrentPPO``, ``MaskablePPO``) are included.

>>> from rejeu.sb3 import SAC, HerReplayBuffer
>>> from rejeu.sb3.common.env_util import make_vec_env

A function given as a schedule is called with the remaining progress here, from 1 to 0, and elsewhere with the progress.
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rejeu.buffers.hindsight import HerReplayBuffer
    from rejeu.sb3.algorithms import A2C, DDPG, DQN, PPO, QRDQN, SAC, TD3, TQC, CrossQ, MaskablePPO, RecurrentPPO

__all__ = [
    "A2C",
    "DDPG",
    "DQN",
    "PPO",
    "QRDQN",
    "SAC",
    "TD3",
    "TQC",
    "CrossQ",
    "HerReplayBuffer",
    "MaskablePPO",
    "RecurrentPPO",
]


def __getattr__(name: str) -> Any:
    """Imports an algorithm when it is first used, so that worker processes need not."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = "rejeu.buffers.hindsight" if name == "HerReplayBuffer" else "rejeu.sb3.algorithms"
    return getattr(importlib.import_module(module), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def alias(module: str, *names: str) -> None:
    """Makes a module known as submodules of itself too, where Stable-Baselines3 has a package of small modules."""
    for name in names:
        sys.modules[f"{module}.{name}"] = sys.modules[module]
        setattr(sys.modules[module], name, sys.modules[module])
