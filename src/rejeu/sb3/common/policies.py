"""Policies; see :mod:`rejeu.sb3.policy`."""

from rejeu.sb3.policy import *  # noqa: F403
from rejeu.sb3.policy import __all__ as __all__
