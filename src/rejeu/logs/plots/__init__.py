"""Matplotlib figures, drawn without a display and without pyplot.

Every function returns a figure, which notebooks display, and writes it to ``path`` if one is given.
"""

from rejeu.logs.plots.exploration import noise, repulsive_boundary, saturation
from rejeu.logs.plots.results import evaluation, learning_curve, trajectory

__all__ = ["evaluation", "learning_curve", "noise", "repulsive_boundary", "saturation", "trajectory"]
