"""Running mean and variance."""

from __future__ import annotations

import numpy as np


class RunningMeanStd:
    """Running mean and variance of each component, ``float64``.

    Moments are merged as in Chan, Golub and LeVeque 1983, "Algorithms for Computing the Sample Variance". As in
    Stable-Baselines3, the count starts at 1e-4 with mean 0 and variance 1.

    Args:
        epsilon: initial count.
        shape: shape of one value.

    >>> moments = RunningMeanStd(shape=())
    >>> moments.update(np.array([1.0, 3.0]))
    >>> round(float(moments.mean), 3), round(float(moments.var), 3)
    (2.0, 1.0)
    """

    def __init__(self, epsilon: float = 1e-4, shape: tuple[int, ...] = ()) -> None:
        self.mean, self.var = np.zeros(shape, np.float64), np.ones(shape, np.float64)
        self.count = epsilon

    def copy(self) -> RunningMeanStd:
        """Returns an independent copy."""
        new = RunningMeanStd(shape=self.mean.shape)
        new.mean, new.var, new.count = self.mean.copy(), self.var.copy(), float(self.count)
        return new

    def combine(self, other: RunningMeanStd) -> None:
        """Adds the values of other moments."""
        self.update_from_moments(other.mean, other.var, other.count)

    def update(self, arr: np.ndarray) -> None:
        """Adds a batch ``(batch, *shape)``."""
        self.update_from_moments(np.mean(arr, axis=0), np.var(arr, axis=0), arr.shape[0])

    def update_from_moments(self, batch_mean: np.ndarray, batch_var: np.ndarray, batch_count: float) -> None:
        """Adds ``batch_count`` values with the given mean and variance."""
        total = self.count + batch_count
        delta, share = batch_mean - self.mean, batch_count / total
        self.mean = self.mean + share * delta
        self.var = (1.0 - share) * self.var + share * batch_var + (1.0 - share) * share * np.square(delta)
        self.count = total
