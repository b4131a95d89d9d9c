"""Stable-Baselines3's API at its own module paths.

To port a script, replace ``stable_baselines3`` by ``rejeu.sb3`` in its imports. Names that rejeu does not have cannot be
imported. The algorithms of sb3-contrib (``QRDQN``, ``TQC``, ``CrossQ``, ``RecurrentPPO``, ``MaskablePPO``) are included.

>>> from rejeu.sb3 import SAC, HerReplayBuffer
>>> from rejeu.sb3.common.env_util import make_vec_env
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rejeu.agents import A2C, DDPG, DQN, PPO, QRDQN, SAC, TD3, TQC, CrossQ, MaskablePPO, RecurrentPPO
    from rejeu.buffers.hindsight import HerReplayBuffer

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
    module = "rejeu.buffers.hindsight" if name == "HerReplayBuffer" else "rejeu.agents"
    return getattr(importlib.import_module(module), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
