"""Stable-Baselines3's API at its own module paths.

To port a script, replace ``stable_baselines3`` by ``rejeu.sb3`` in its imports. Names that rejeu does not have cannot be
imported. The algorithms of sb3-contrib (``QRDQN``, ``TQC``, ``CrossQ``, ``TRPO``, ``ARS``, ``RecurrentPPO``, ``MaskablePPO``)
are included.

>>> from rejeu.sb3 import SAC, HerReplayBuffer
>>> from rejeu.sb3.common.env_util import make_vec_env

A function given as a schedule is called with the remaining progress here, from 1 to 0, and elsewhere with the progress.
"""

import importlib
from typing import TYPE_CHECKING, Any

from rejeu.algorithms.catalog import CATALOG
from rejeu.core.validation import nearest
from rejeu.sb3.modules import alias, define

if TYPE_CHECKING:
    from rejeu.agents.zip_files import load_zip
    from rejeu.sb3.algorithms import A2C, DDPG, DQN, PPO, QRDQN, SAC, TD3, TQC, CrossQ, MaskablePPO, RecurrentPPO
    from rejeu.sb3.common.buffers import HerReplayBuffer
    from rejeu.sb3.common.utils import get_system_info

ELSEWHERE = {
    "HerReplayBuffer": "rejeu.sb3.common.buffers",
    "get_system_info": "rejeu.sb3.common.utils",
    "load_zip": "rejeu.agents.zip_files",
}
__all__ = [*(name for name, entry in CATALOG.items() if entry.original), *ELSEWHERE]


class HER:
    """The name of an algorithm that became a replay buffer."""

    def __init__(self, *args: object, **kwargs: Any) -> None:
        raise ImportError(
            "HER is a replay buffer: SAC(..., replay_buffer_class=HerReplayBuffer); see the documentation"
        )

    load = __init__


def __getattr__(name: str) -> Any:
    """Imports an algorithm when it is first used, so that worker processes need not."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; {nearest(name, __all__)}")
    return getattr(importlib.import_module(ELSEWHERE.get(name, "rejeu.sb3.algorithms")), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


POLICIES = ("CnnPolicy", "MlpPolicy", "MultiInputPolicy", "Actor", "DQNPolicy", "QNetwork", "SACPolicy", "TD3Policy")
for _name, _entry in CATALOG.items():
    _package, _, _last = _entry.original.partition(".")
    if _package == "stable_baselines3":
        define(f"{__name__}.{_last}", {}, _name, *POLICIES)
        alias(f"{__name__}.{_last}", _last, "policies")
define(f"{__name__}.her", {}, "HerReplayBuffer", "GoalSelectionStrategy", "KEY_TO_GOAL_STRATEGY")
alias(f"{__name__}.her", "goal_selection_strategy", "her_replay_buffer")
