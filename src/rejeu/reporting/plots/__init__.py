"""Pictures, each a matplotlib figure that a notebook shows by itself.

They are drawn without a display and without matplotlib's global state. Every function takes ``path``, of a file to write,
and returns the figure.
"""

from rejeu.reporting.plots.evaluations import evaluation
from rejeu.reporting.plots.exploration import noise, repulsive_boundary, saturation
from rejeu.reporting.plots.learning import learning_curve
from rejeu.reporting.plots.trajectories import trajectory

__all__ = ["evaluation", "learning_curve", "noise", "repulsive_boundary", "saturation", "trajectory"]
