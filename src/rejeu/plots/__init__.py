"""Pictures, each a matplotlib figure that a notebook shows by itself.

They are drawn without a display and without matplotlib's global state. Every function takes ``path``, of a file to write,
and returns the figure.
"""

from rejeu.plots.learning import learning_curve

__all__ = ["learning_curve"]
