"""Policies; see :mod:`rejeu.sb3.policy`."""

from rejeu.sb3.modules import passes_on
from rejeu.sb3.policy import *  # noqa: F403

passes_on(__name__)
