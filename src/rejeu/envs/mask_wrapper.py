"""Action masks: which actions an environment allows, carried beside its observations.

An environment says so in ``info["action_mask"]``, at reset and at every step, or by a method ``action_masks()``. The
mask is an array of bools or of zeros and ones: one for each action of a Discrete space, one for each possibility of every
choice of a MultiDiscrete space in a row, one for each bit of a MultiBinary space that may be 1.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.errors import BadEnvironmentError

OBSERVATION, MASK = "observation", "action_mask"
"""Keys under which :class:`MaskInObservation` puts the two."""


def n_choices(space: spaces.Space, env_id: str) -> int:
    """Returns the length of a mask for an action space.

    Raises:
        ValueError: for Box actions, which cannot be masked.
    """
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return int(space.nvec.sum())
    if isinstance(space, spaces.MultiBinary):
        return int(np.prod(space.shape, dtype=int))
    raise ValueError(f"masks need Discrete, MultiDiscrete or MultiBinary actions; {env_id} has {space}: use PPO")


class MaskInObservation(gym.Wrapper[Any, Any, Any, Any]):
    """An environment whose observations hold the mask: a Dict of ``observation`` and ``action_mask``."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._n = n_choices(env.action_space, describe(env))
        self.observation_space = spaces.Dict({OBSERVATION: env.observation_space, MASK: spaces.MultiBinary(self._n)})

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(seed=seed, options=options)
        return {OBSERVATION: obs, MASK: self._mask(info, False)}, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        mask = self._mask(info, terminated or truncated)
        return {OBSERVATION: obs, MASK: mask}, reward, terminated, truncated, info

    def _mask(self, info: dict[str, Any], over: bool) -> np.ndarray:
        if MASK in info:
            given = info[MASK]
        else:
            try:
                given = self.env.get_wrapper_attr("action_masks")()
            except AttributeError:
                raise BadEnvironmentError(
                    f'{describe(self.env)} says nowhere which actions are allowed; put info["action_mask"] into what '
                    "reset and step return, or add a method action_masks()"
                ) from None
        mask = (
            np.concatenate([np.asarray(part).ravel() for part in given]) if isinstance(given, list | tuple) else given
        )
        mask = np.asarray(mask).ravel().astype(np.int8)
        if mask.shape != (self._n,):
            raise BadEnvironmentError(
                f"{describe(self.env)} gave a mask of {mask.size} entries, expected {self._n} for {self.action_space}"
            )
        if not over:  # where an episode is over there may be nothing left to do, and nothing is done
            self._check_some_allowed(mask)
        return mask

    def _check_some_allowed(self, mask: np.ndarray) -> None:
        space = self.action_space
        if isinstance(space, spaces.MultiBinary):
            return
        sizes = space.nvec.ravel() if isinstance(space, spaces.MultiDiscrete) else [self._n]
        if not all(part.any() for part in np.split(mask, np.cumsum(sizes)[:-1])):
            raise BadEnvironmentError(f"{describe(self.env)} allows no action: its mask is {mask.tolist()}")


def describe(env: gym.Env) -> str:
    """Returns the id of an environment, or its class name."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
