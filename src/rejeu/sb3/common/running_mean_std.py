"""Running mean and variance."""

from __future__ import annotations

import copy

from gymnasium.wrappers import utils


class RunningMeanStd(utils.RunningMeanStd):
    """Running mean and variance of each component, ``float64``.

    Moments are merged as in Chan, Golub and LeVeque 1983, "Algorithms for Computing the Sample Variance". As in
    Stable-Baselines3, the count starts at 1e-4 with mean 0 and variance 1.

    Args:
        epsilon: initial count.
        shape: shape of one value.

    >>> import numpy as np
    >>> moments = RunningMeanStd(shape=())
    >>> moments.update(np.array([1.0, 3.0]))
    >>> round(float(moments.mean), 3), round(float(moments.var), 3)
    (2.0, 1.0)
    """

    def copy(self) -> RunningMeanStd:
        """Returns an independent copy."""
        return copy.deepcopy(self)

    def combine(self, other: RunningMeanStd) -> None:
        """Adds the values of other moments."""
        self.update_from_moments(other.mean, other.var, other.count)
