"""The catalog: every algorithm once (``catalog.toml``), with what the rest of the package needs to know of it.

Agents, public names, defaults, ``rejeu list`` and the names of :mod:`rejeu.sb3` derive from it. A new algorithm is a file
beside this one, an entry, a page and a test. Nothing is imported before :meth:`Entry.load`.

>>> CATALOG["TD3BC"].module, CATALOG["TD3BC"].kind
('td3_bc', 'offline')
"""

from __future__ import annotations

import importlib
import tomllib
from importlib import resources
from types import ModuleType
from typing import Literal, NamedTuple


class Entry(NamedTuple):
    """An algorithm."""

    name: str
    """As in ``rejeu.NAME`` and in files."""
    module: str
    """Its file or folder in ``rejeu.algorithms``, with ``Config`` and ``make``."""
    kind: Literal["replay", "rollout", "offline"]
    """The source of its batches: a replay buffer, rollouts of its policy, or recorded episodes."""
    summary: str
    """The first line of ``help(rejeu.NAME)``."""
    actor: str = ""
    """Where the network that acts is in its state; empty if it has a memory."""
    is_squashed: bool = False
    """Whether Box actions come through a hyperbolic tangent."""
    is_deterministic: bool = False
    """Whether the policy for Box actions does not explore by itself."""
    is_projected: bool = False
    """Whether the networks have normalized layers, whose weights are scaled after each step."""
    original: str = ""
    """The package of Stable-Baselines3 or its Contrib that has it; empty if neither does."""
    policy: str = ""
    """The class of its policies there, if they are none of on-policy algorithms."""
    zoo: str = ""
    """In folders of RL Zoo, if that is not the name in lowercase."""

    def load(self, agent: object = None, agent_class: type | None = None) -> ModuleType:
        """Imports the file of the algorithm. An entry that is an attribute of a class is read as this file."""
        return importlib.import_module(f"rejeu.algorithms.{self.module}")

    __get__ = load  # type: ignore[misc]


CATALOG = {
    name: Entry(name, **fields)
    for name, fields in tomllib.loads(
        (resources.files("rejeu.algorithms") / "catalog.toml").read_text(encoding="utf-8")
    ).items()
}
"""Every algorithm by its name, in the order of ``rejeu list --algorithms``."""
OFFLINE = next(name for name, entry in CATALOG.items() if entry.kind == "offline")
"""The first that learns from recorded episodes: the default of ``rejeu train --offline``."""
