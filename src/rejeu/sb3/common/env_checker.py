"""The environment checker."""

from rejeu.envs.checker import check_env

__all__ = ["check_env"]
