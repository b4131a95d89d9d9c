"""The base classes of the algorithms."""

from rejeu.agents import Agent as BaseAlgorithm, OffPolicyAgent, OnPolicyAgent
from rejeu.sb3 import define

__all__ = ["BaseAlgorithm"]
define("rejeu.sb3.common.on_policy_algorithm", {"OnPolicyAlgorithm": OnPolicyAgent})
define("rejeu.sb3.common.off_policy_algorithm", {"OffPolicyAlgorithm": OffPolicyAgent})
