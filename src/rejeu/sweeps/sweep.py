"""What :func:`rejeu.sweep` returns, under the name of earlier versions; see :mod:`rejeu.experiments.sweep`."""

from rejeu.experiments.sweep import SweepResult

__all__ = ["SweepResult"]
