"""Action masks of environments in JAX, in their observations."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.errors import BadEnvironmentError


class MaskInObservation(FunctionalEnv):
    """An environment whose observations are dicts of ``observation`` and ``action_mask``, ``int8 (n_choices,)``.

    Raises:
        BadEnvironmentError: by ``reset`` and ``step``, if the environment has no masks.
    """

    env: FunctionalEnv
    n_choices: int = eqx.field(static=True)
    max_episode_steps: int | None = eqx.field(static=True)

    def __init__(self, env: FunctionalEnv, n_choices: int) -> None:
        self.env, self.n_choices, self.max_episode_steps = env, n_choices, env.max_episode_steps

    @property
    def observation_space(self) -> spaces.Dict:
        mask = spaces.MultiBinary(self.n_choices)
        return spaces.Dict({"observation": self.env.observation_space, "action_mask": mask})

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: Array) -> tuple[Any, Any]:
        state, obs = self.env.reset(key)
        return state, self._observe(state, obs)

    def step(self, key: Array, state: Any, action: Array) -> tuple[Any, Any, Array, Array, Array]:
        state, obs, *rest = self.env.step(key, state, action)
        return state, self._observe(state, obs), *rest

    def success(self, state: Any) -> Array | None:
        return self.env.success(state)

    def _observe(self, state: Any, obs: Any) -> dict[str, Any]:
        mask = self.env.action_mask(state)
        if mask is None or mask.shape != (self.n_choices,):
            shape = "None" if mask is None else f"the shape {mask.shape}"
            raise BadEnvironmentError(
                f"{type(self.env).__name__}.action_mask returned {shape}, expected a mask of the shape ({self.n_choices},)"
            )
        return {"observation": obs, "action_mask": mask.astype(jnp.int8)}
