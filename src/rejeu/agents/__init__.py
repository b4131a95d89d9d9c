"""The agents, under Stable-Baselines3's names: what owns an environment, a learner and its experience."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rejeu.agents import model_files
from rejeu.agents.base import Agent, Callback, whole_seed
from rejeu.agents.off_policy import DDPG, DQN, QRDQN, SAC, TD3, TQC, CrossQ
from rejeu.agents.on_policy import A2C, PPO, MaskablePPO, RecurrentPPO
from rejeu.errors import CheckpointError
from rejeu.io import checkpoint

KINDS = (SAC, DDPG, TD3, DQN, QRDQN, TQC, CrossQ, PPO, A2C, RecurrentPPO, MaskablePPO)

AGENTS: dict[str, type[Agent]] = {agent.algorithm.Config.name: agent for agent in KINDS}
"""Every agent by the name of its algorithm."""


def load(path: str | Path, env: Any = None, **changes: Any) -> Agent:
    """Returns the agent of a model file or a run folder, whichever algorithm it is of; see :meth:`Agent.load`."""
    path = model_files.find(path)
    name = checkpoint.read_header(path, "agent").get("algorithm")
    if not isinstance(name, str) or name not in AGENTS:
        raise CheckpointError(f"{path} holds an agent of {str(name)[:40]!r}; this rejeu has {', '.join(AGENTS)}")
    return AGENTS[name].load(path, env, **changes)


__all__ = [
    "A2C",
    "AGENTS",
    "DDPG",
    "DQN",
    "PPO",
    "QRDQN",
    "SAC",
    "TD3",
    "TQC",
    "Agent",
    "Callback",
    "CrossQ",
    "MaskablePPO",
    "RecurrentPPO",
    "load",
    "whole_seed",
]
