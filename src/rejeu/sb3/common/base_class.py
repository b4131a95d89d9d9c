"""The base classes of the algorithms."""

from typing import Any

from rejeu.agents import (
    Agent as BaseAlgorithm,
    OffPolicyAgent as OffPolicyAlgorithm,
    OnPolicyAgent as OnPolicyAlgorithm,
)
from rejeu.envs.registry import make_env
from rejeu.sb3.modules import passes_on


def maybe_make_env(env: Any, verbose: int = 0) -> Any:
    """Returns an environment as it is, and one of an id."""
    return make_env(env, render_mode="rgb_array") if isinstance(env, str) else env


passes_on(__name__)
