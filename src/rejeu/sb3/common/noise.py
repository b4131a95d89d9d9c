"""Action noise."""

from __future__ import annotations

import copy
from collections.abc import Iterable

import numpy as np

from rejeu.exploration.noise import ActionNoise, NormalActionNoise, OrnsteinUhlenbeckActionNoise


class VectorizedActionNoise:
    """One process of noise for each of several environments, called by hand.

    Agents keep a process for each environment themselves: given to one, it means its ``base_noise``.

    Args:
        base_noise: noise that is copied for each environment.
        n_envs: number of environments.
    """

    def __init__(self, base_noise: ActionNoise, n_envs: int) -> None:
        if not isinstance(n_envs, int) or n_envs <= 0:
            raise ValueError(f"n_envs={n_envs!r} must be a number of environments, at least 1")
        if base_noise is None:
            raise ValueError("base_noise=None: give an instance of ActionNoise")
        if not isinstance(base_noise, ActionNoise):
            raise TypeError(f"base_noise={base_noise!r} must be an instance of ActionNoise")
        self.n_envs, self.base_noise = n_envs, base_noise
        self.noises = [copy.deepcopy(base_noise) for _ in range(n_envs)]

    def reset(self, indices: Iterable[int] | None = None) -> None:
        """Resets the processes of some environments, or of all."""
        for i in range(self.n_envs) if indices is None else indices:
            self.noises[i].reset()

    def __call__(self) -> np.ndarray:
        """Returns the noise of the next step, ``(n_envs, action_dim)``."""
        return np.stack([noise() for noise in self.noises])
