"""A wrapper that normalizes observations and rewards by running statistics, as Stable-Baselines3's ``VecNormalize`` does.

The statistics are part of the environment, so they must be saved and loaded along with the agent. New code should use the
agents' option ``normalize=True`` (:mod:`rejeu.core.normalization`), which keeps the statistics in the agent and its model
file.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
import numpy as np
from gymnasium import spaces
from msgspec import Meta

from rejeu.checkpoints.pickled import array_of, explained, read_normalization
from rejeu.core import checkpoint
from rejeu.core.errors import CheckpointError
from rejeu.core.records import convert
from rejeu.core.types import Observation
from rejeu.sb3.common.running_mean_std import RunningMeanStd
from rejeu.sb3.common.vec_env.base_vec_env import (
    TERMINAL_OBSERVATION,
    VecEnv,
    VecEnvStepReturn,
    VecEnvWrapper,
    by_key,
    unwrap_vec_wrapper,
)
from rejeu.sb3.common.vec_env.vec_transpose import VecTransposeImage

KIND = "vec_normalize"
"""Kind of its files."""
PICKLES = (b"\x80\x02c", b"\x80\x03c", b"\x80\x04\x95", b"\x80\x05\x95")
"""How the files of Stable-Baselines3 begin."""
NonNegative = Annotated[float, Meta(ge=0, le=1e300)]


class Settings(msgspec.Struct):
    """The settings of a wrapper in the header of its file; null for infinity, which JSON does not have."""

    clip_obs: NonNegative | None
    clip_reward: NonNegative | None
    gamma: Annotated[float, Meta(ge=0, le=1)]
    epsilon: NonNegative
    training: bool
    norm_obs: bool
    norm_reward: bool


class Header(msgspec.Struct):
    """The header of a wrapper's file."""

    settings: Settings
    keys: list[str] | None
    """Keys of a Dict observation that are normalized."""


class VecNormalize(VecEnvWrapper):
    """Standardizes observations, and divides rewards by the standard deviation of their discounted sum.

    ``clip((obs - mean) / sqrt(var + epsilon), -clip_obs, clip_obs)`` and ``clip(reward / sqrt(var + epsilon),
    -clip_reward, clip_reward)``; the statistics are updated while ``training`` is True. Training and prediction need the same
    statistics; set ``training = norm_reward = False`` for evaluation.

    Args:
        venv: a vector environment with Box observations, or a Dict of them.
        training: whether to update the statistics.
        norm_obs: whether to normalize observations.
        norm_reward: whether to normalize rewards.
        clip_obs: largest magnitude of a normalized observation; ``math.inf`` for no limit.
        clip_reward: largest magnitude of a normalized reward; ``math.inf`` for no limit.
        gamma: discount factor of the sum of rewards; use the agent's.
        epsilon: added to variances.
        norm_obs_keys: keys of Dict observations to normalize; None for all.

    Raises:
        ValueError: if an observation to be normalized is not in a Box space.

    >>> from rejeu.sb3.common.env_util import make_vec_env
    >>> env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=4))
    >>> env.reset().shape, env.obs_rms.mean.shape
    ((4, 3), (3,))
    """

    def __init__(
        self,
        venv: VecEnv,
        training: bool = True,
        norm_obs: bool = True,
        norm_reward: bool = True,
        clip_obs: float = 10.0,
        clip_reward: float = 10.0,
        gamma: float = 0.99,
        epsilon: float = 1e-8,
        norm_obs_keys: Sequence[str] | None = None,
    ) -> None:
        super().__init__(venv)
        self.training, self.norm_obs, self.norm_reward = training, norm_obs, norm_reward
        self.clip_obs, self.clip_reward = clip_obs, clip_reward
        self.gamma, self.epsilon = gamma, epsilon
        self.norm_obs_keys = None if norm_obs_keys is None else list(norm_obs_keys)
        self.obs_rms: Any = None
        """Moments of the observations: a :class:`RunningMeanStd`, or a dict of them by key."""
        self.ret_rms = RunningMeanStd()
        """Moments of the discounted sum of rewards."""
        if norm_obs:
            self._init_observations(venv.observation_space)
        self.returns = np.zeros(self.num_envs)
        """Discounted sum of the rewards of each environment so far."""
        self.old_obs: Any = None
        self.old_reward = np.zeros(self.num_envs, np.float32)
        self.old_finals: dict[int, Any] = {}
        """Original final observations of the episodes that ended in the last step."""

    def _init_observations(self, space: spaces.Space) -> None:
        """Creates the moments of the observations and the space of the normalized observations."""
        is_dict = isinstance(space, spaces.Dict)
        if self.norm_obs_keys is not None and not is_dict:
            raise ValueError(
                f"norm_obs_keys={self.norm_obs_keys!r} is applicable only to Dict observations, got {space}"
            )
        parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
        keys = list(parts) if self.norm_obs_keys is None else self.norm_obs_keys
        for key in keys:
            if key not in parts:
                raise ValueError(
                    f"norm_obs_keys contains {key!r}, but the observations have the keys {', '.join(parts)}"
                )
            if not isinstance(parts[key], spaces.Box):
                where = f" under {key!r}" if key else ""
                raise ValueError(
                    f"VecNormalize only supports Box observations, got {parts[key]}{where}; explicitly pass the "
                    "observation keys to normalize as norm_obs_keys, or set norm_obs=False"
                )
        moments = {key: RunningMeanStd(shape=parts[key].shape or ()) for key in keys}
        box = partial(spaces.Box, -self.clip_obs, self.clip_obs, dtype=np.float32)
        normalized = {key: box(member.shape) if key in keys else member for key, member in parts.items()}
        self.norm_obs_keys = keys if is_dict else None
        self.obs_rms = moments if is_dict else moments[""]
        self.observation_space = spaces.Dict(normalized) if is_dict else normalized[""]

    def set_venv(self, venv: VecEnv) -> None:
        """Replaces the wrapped vector environment by another with the same spaces; keeps the statistics.

        Raises:
            ValueError: if the spaces differ.
        """
        view = VecNormalize(venv, norm_obs=self.norm_obs, clip_obs=self.clip_obs, norm_obs_keys=self.norm_obs_keys)
        if view.observation_space != self.observation_space:
            raise ValueError(
                f"the environment has the observation space {venv.observation_space}, which does not fit these statistics"
            )
        VecEnvWrapper.__init__(self, venv, view.observation_space)
        self.returns, self.old_reward = np.zeros(self.num_envs), np.zeros(self.num_envs, np.float32)

    def reset(self) -> Observation:
        obs = self.venv.reset()
        self.old_obs, self.returns = obs, np.zeros(self.num_envs)
        self._update(obs)
        return self.normalize_obs(obs)

    def step_wait(self) -> VecEnvStepReturn:
        """Steps the environments and returns normalized observations and rewards, dones and infos.

        ``terminal_observation`` is normalized too.
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        self.old_obs, self.old_reward = obs, rewards
        self._update(obs)
        if self.training:
            self._update_reward(rewards)
        self.old_finals = {
            i: infos[i][TERMINAL_OBSERVATION]
            for i in np.flatnonzero(dones).tolist()
            if TERMINAL_OBSERVATION in infos[i]
        }
        for i, final in self.old_finals.items():
            infos[i][TERMINAL_OBSERVATION] = self.normalize_obs(final)
        self.returns[dones] = 0.0
        return self.normalize_obs(obs), self.normalize_reward(rewards), dones, infos

    def _update_reward(self, reward: np.ndarray) -> None:
        self.returns = self.returns * self.gamma + reward
        self.ret_rms.update(self.returns)

    def _update(self, obs: Observation) -> None:
        if self.training and self.norm_obs:
            for key, moments in by_key(self.obs_rms).items():
                moments.update(by_key(obs)[key])

    def normalize_obs(self, obs: Observation) -> Any:
        """Returns normalized observations; does not update the statistics."""
        return self._map(obs, self._normalize_obs)

    def unnormalize_obs(self, obs: Observation) -> Any:
        """Returns the original observations, except where they were clipped."""
        return self._map(obs, self._unnormalize_obs)

    def normalize_reward(self, reward: np.ndarray) -> np.ndarray:
        """Returns normalized rewards, ``float32``; does not update the statistics."""
        if not self.norm_reward:
            return reward
        normalized = np.clip(reward / np.sqrt(self.ret_rms.var + self.epsilon), -self.clip_reward, self.clip_reward)
        return normalized.astype(np.float32)

    def unnormalize_reward(self, reward: np.ndarray) -> np.ndarray:
        """Returns the original rewards, except where they were clipped."""
        return reward * np.sqrt(self.ret_rms.var + self.epsilon) if self.norm_reward else reward

    def get_original_obs(self) -> Any:
        """Returns the original observations of the last step or reset."""
        return copy.deepcopy(self.old_obs)

    def get_original_reward(self) -> np.ndarray:
        """Returns the original rewards of the last step."""
        return self.old_reward.copy()

    def _map(self, obs: Observation, function: Any) -> Any:
        if not self.norm_obs:
            return obs
        parts = by_key(obs)
        mapped = {**parts, **{key: function(np.asarray(parts[key]), m) for key, m in by_key(self.obs_rms).items()}}
        return mapped.get("", mapped)

    def _normalize_obs(self, obs: np.ndarray, moments: RunningMeanStd) -> np.ndarray:
        z = (obs - moments.mean) / np.sqrt(moments.var + self.epsilon)
        return np.clip(z, -self.clip_obs, self.clip_obs).astype(np.float32)

    def _unnormalize_obs(self, obs: np.ndarray, moments: RunningMeanStd) -> np.ndarray:
        return obs * np.sqrt(moments.var + self.epsilon) + moments.mean

    def statistics(self) -> dict[str, np.ndarray]:
        """Returns the statistics as arrays by name."""
        fields = ("mean", "var", "count")
        return {
            f"{name}.{key}": np.array(getattr(m, key), np.float64)
            for name, m in self._moments().items()
            for key in fields
        }

    def put_statistics(self, arrays: Mapping[str, np.ndarray], path: str | Path = "the statistics") -> None:
        """Restores what :meth:`statistics` returned; ``path`` names the source in messages.

        Raises:
            CheckpointError: if the arrays are damaged or belong to other observations.
        """
        checkpoint.match(self.statistics(), arrays, path)
        for name, array in arrays.items():
            if not np.isfinite(array).all() or (not name.endswith(".mean") and (array < 0).any()):
                raise CheckpointError(f"{path}: {name} has negative values, or values that are not finite")
        for name, moments in self._moments().items():
            moments.mean, moments.var = arrays[f"{name}.mean"], arrays[f"{name}.var"]
            moments.count = float(arrays[f"{name}.count"])

    def _moments(self) -> dict[str, RunningMeanStd]:
        """Returns all moments by name."""
        if isinstance(self.obs_rms, dict):
            return {"returns": self.ret_rms} | {f"obs.{i}": moments for i, moments in enumerate(self.obs_rms.values())}
        return {"returns": self.ret_rms} | ({} if self.obs_rms is None else {"obs": self.obs_rms})

    def save(self, save_path: str | Path) -> Path:
        """Writes statistics and settings to a safetensors file, without the environments; returns its path.

        ``.safetensors`` is added to a path without a suffix.
        """
        arrays = self.statistics()
        header = {
            "settings": {key: _written(getattr(self, key)) for key in Settings.__struct_fields__},
            "keys": None if not isinstance(self.obs_rms, dict) else list(self.obs_rms),
        }
        return checkpoint.write(save_path, KIND, arrays, header)

    @classmethod
    def load(cls, load_path: str | Path, venv: VecEnv) -> Self:
        """Returns ``venv`` wrapped with the statistics and settings of a file written by :meth:`save`.

        A file of Stable-Baselines3 itself is read too, without executing its code.

        Raises:
            FileNotFoundError: if there is no such file.
            CheckpointError: if the file is damaged or belongs to other observations.
        """
        path = checkpoint.existing(load_path)
        with path.open("rb") as pickle_file:
            if pickle_file.read(3) in PICKLES:
                return cls.of_original(path, venv)
        with checkpoint.opened(load_path, KIND) as file:
            try:
                header = convert(file.header, Header)
                named = msgspec.structs.asdict(header.settings).items()
                settings: Any = {key: math.inf if value is None else value for key, value in named}
                new = cls(venv, **settings, norm_obs_keys=header.keys)
            except (LookupError, TypeError, ValueError) as error:
                raise CheckpointError(f"{load_path} does not fit {venv.observation_space}: {error}") from None
            checkpoint.match(new.statistics(), file.specs, load_path)
            new.put_statistics(file.read(), load_path)
        return new

    @classmethod
    def of_original(cls, path: Path, venv: VecEnv) -> Self:
        """Returns ``venv`` wrapped with the statistics and settings of a file of Stable-Baselines3 itself."""
        with explained(path):
            state = read_normalization(path)
            settings = {key: state[key] for key in Settings.__struct_fields__}
            new, arrays = cls(venv, **settings, norm_obs_keys=state.get("norm_obs_keys")), {}
            for name in new.statistics():
                moments_name, *index, field = name.split(".")
                moments = state["ret_rms" if moments_name == "returns" else "obs_rms"]
                moments = moments[[*new.obs_rms][int(index[0])]] if index else moments
                arrays[name] = np.asarray(array_of(moments.state[field]), np.float64)
            new.put_statistics(arrays, path)
        return new


def unwrap_vec_normalize(env: VecEnv) -> VecNormalize | None:
    """Returns the outermost ``VecNormalize`` of a vector environment, or None."""
    return unwrap_vec_wrapper(env, VecNormalize)


def sync_envs_normalization(env: VecEnv, eval_env: VecEnv) -> None:
    """Copies the statistics of each ``VecNormalize`` in ``env`` to its counterpart in ``eval_env``.

    Raises:
        ValueError: if ``eval_env`` is not wrapped in the same way.
    """
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecTransposeImage) and not isinstance(eval_env, VecTransposeImage):
            env = env.venv  # of ``get_env``
            continue
        if not isinstance(eval_env, VecEnvWrapper) or isinstance(env, VecNormalize) != isinstance(
            eval_env, VecNormalize
        ):
            raise ValueError(
                f"the training environment is wrapped in {type(env).__name__} where the other is "
                f"{type(eval_env).__name__}; wrap both in the same way, the other with training=False"
            )
        if isinstance(env, VecNormalize) and isinstance(eval_env, VecNormalize):
            eval_env.obs_rms, eval_env.ret_rms = copy.deepcopy(env.obs_rms), env.ret_rms.copy()
        env, eval_env = env.venv, eval_env.venv


def _written(value: float) -> float | bool | None:
    return None if value == math.inf else np.asarray(value).item()
