"""A wrapper that reports NaN and infinity."""

from __future__ import annotations

import warnings

import numpy as np

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.types import Action, Observation
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv, VecEnvStepReturn, VecEnvWrapper, by_key


class NotFiniteError(BadEnvironmentError, ValueError):
    """Actions, observations or rewards contain NaN or infinity."""


class VecCheckNan(VecEnvWrapper):
    """Checks every action, observation and reward for NaN and infinity.

    Args:
        venv: the vector environment.
        raise_exception: raise :class:`BadEnvironmentError`, which is a ``ValueError`` too; False warns.
        warn_once: warn only the first time.
        check_inf: check for infinity too.
    """

    def __init__(
        self, venv: VecEnv, raise_exception: bool = False, warn_once: bool = True, check_inf: bool = True
    ) -> None:
        super().__init__(venv)
        self.raise_exception, self.warn_once, self.check_inf = raise_exception, warn_once, check_inf
        self._warned = False
        self._last_actions: Action = None
        """Actions of the last step, None after a reset."""

    def step_async(self, actions: Action) -> None:
        self._check(actions, "the actions")
        self._last_actions = actions
        self.venv.step_async(actions)

    def reset(self) -> Observation:
        obs = self.venv.reset()
        self._last_actions = None
        self._check(obs, "the observations of reset")
        return obs

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        self._check(obs, "the observations")
        self._check(rewards, "the rewards")
        return obs, rewards, dones, infos

    def _check(self, values: object, name: str) -> None:
        if self._warned and self.warn_once and not self.raise_exception:
            return
        for key, value in by_key(values).items():
            array = np.asarray(value)
            if array.dtype.kind != "f":
                continue
            bad = ~np.isfinite(array) if self.check_inf else np.isnan(array)
            if bad.any():
                where = tuple(int(i) for i in np.argwhere(bad)[0])
                is_after = self._last_actions is not None and name != "the actions"
                after = f" after the actions {self._last_actions}" if is_after else ""
                message = f"{name}{f' under {key!r}' * bool(key)} contain {array[where]} at {where}{after}"
                if self.raise_exception:
                    raise NotFiniteError(message)
                self._warned = True
                warnings.warn(message, UserWarning, stacklevel=3)
