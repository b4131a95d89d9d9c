"""The names of policies, and which observations each is for."""

from __future__ import annotations

import gymnasium as gym

from rejeu import spaces

POLICIES = ("MlpPolicy", "MultiInputPolicy", "CnnPolicy")


def check_policy(policy: str, space: gym.Space) -> None:
    """Raises ``ValueError`` if there is no such policy, or if it is not for observations of ``space``."""
    if policy not in POLICIES:
        raise ValueError(f"policy={policy!r} must be one of {', '.join(POLICIES)}")
    is_dict = isinstance(space, gym.spaces.Dict)
    if policy == "MlpPolicy" and is_dict:
        raise ValueError("policy='MlpPolicy' does not fit a Dict observation; use 'MultiInputPolicy'")
    if policy == "MultiInputPolicy" and not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        raise ValueError(f"policy='MultiInputPolicy' needs a Dict or Tuple observation, got {space}; use 'MlpPolicy'")
    if policy == "CnnPolicy" and not any(leaf.kind == "image" for leaf in spaces.leaves(space)):
        raise ValueError(f"policy='CnnPolicy' needs a uint8 image observation, got {space}; use 'MlpPolicy'")
