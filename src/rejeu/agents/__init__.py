"""Agents: environments, a learner and a buffer behind the methods of Stable-Baselines3."""

from rejeu.agents.agent import Agent
from rejeu.agents.off_policy import DDPG, DQN, IQL, IQN, QRDQN, SAC, TD3, TQC, CrossQ, OffPolicyAgent
from rejeu.agents.on_policy import A2C, ARS, PPO, PQN, TRPO, MaskablePPO, OnPolicyAgent, RecurrentPPO
from rejeu.agents.registry import AGENTS, agent_of_file, find_agent, load, modules_of, register
from rejeu.callbacks.base import Callback
from rejeu.validation import whole_seed

__all__ = [
    "A2C",
    "AGENTS",
    "ARS",
    "DDPG",
    "DQN",
    "IQL",
    "IQN",
    "PPO",
    "PQN",
    "QRDQN",
    "SAC",
    "TD3",
    "TQC",
    "TRPO",
    "Agent",
    "Callback",
    "CrossQ",
    "MaskablePPO",
    "OffPolicyAgent",
    "OnPolicyAgent",
    "RecurrentPPO",
    "agent_of_file",
    "find_agent",
    "load",
    "modules_of",
    "register",
    "whole_seed",
]
