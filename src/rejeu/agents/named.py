"""The agents of the catalog by their names, such as ``SAC``. Type checkers and editors read ``named.pyi``."""

from __future__ import annotations

from rejeu.agents.agent import Agent
from rejeu.agents.off_policy import OffPolicyAgent
from rejeu.agents.on_policy import OnPolicyAgent
from rejeu.algorithms.catalog import CATALOG, Entry

__all__ = [*CATALOG]


def agent_of(entry: Entry) -> type[Agent]:
    """Returns the class of agents of an algorithm."""
    base = OnPolicyAgent if entry.kind == "rollout" else OffPolicyAgent
    return type(entry.name, (base,), {"__doc__": entry.summary, "__module__": __name__, "algorithm": entry})


BUILT_IN = {name: agent_of(entry) for name, entry in CATALOG.items()}
globals().update(BUILT_IN)
