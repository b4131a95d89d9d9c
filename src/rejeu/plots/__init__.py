"""Pictures, each a matplotlib figure that a notebook shows by itself.

They are drawn without a display and without matplotlib's global state. Every function takes ``path``, of a file to write,
and returns the figure.
"""

from rejeu.plots.evaluations import evaluation
from rejeu.plots.exploration import noise, repulsive_boundary, saturation
from rejeu.plots.learning import learning_curve
from rejeu.plots.trajectories import trajectory

__all__ = ["evaluation", "learning_curve", "noise", "repulsive_boundary", "saturation", "trajectory"]
