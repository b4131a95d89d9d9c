"""Observations and rewards scaled by running statistics, outside the agent, as Stable-Baselines3's ``VecNormalize`` does.

It is for scripts that come from there: the agent learns on what it is shown, and whoever predicts must show it the same.
``normalize=True`` keeps the statistics inside the agent and its file (:mod:`rejeu.normalization`), so that nothing can be
forgotten; new code should use that.

Moments are merged as in Chan, Golub and LeVeque 1983, "Algorithms for Computing the Sample Variance"; the count begins
at 1e-4 with mean 0 and variance 1, as in Stable-Baselines3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from rejeu.envs.vec_env import StepResult, VecEnv, VecEnvWrapper, unwrap_vec_wrapper
from rejeu.errors import CheckpointError
from rejeu.io import checkpoint
from rejeu.validation import number

KIND = "vec_normalize"
"""What its files call themselves."""
FIRST_COUNT = 1e-4
"""How many values the mean 0 and the variance 1 at the beginning count for."""
NUMBERS = ("clip_obs", "clip_reward", "gamma", "epsilon")
MOST = dict.fromkeys(NUMBERS, math.inf) | {"gamma": 1.0}
BOUNDS = ("clip_obs", "clip_reward")
"""Which of them may be infinite, for no clipping; a file then has null, since JSON has no such number."""
SWITCHES = ("training", "norm_obs", "norm_reward")


class RunningMeanStd:
    """Mean and variance, by component, of values that come in batches; ``float64``.

    >>> moments = RunningMeanStd(shape=())
    >>> moments.update(np.array([1.0, 3.0]))
    >>> round(float(moments.mean), 3), round(float(moments.var), 3)
    (2.0, 1.0)
    """

    def __init__(self, epsilon: float = FIRST_COUNT, shape: tuple[int, ...] = ()) -> None:
        self.mean, self.var = np.zeros(shape, np.float64), np.ones(shape, np.float64)
        self.count = epsilon

    def copy(self) -> RunningMeanStd:
        """Returns moments of their own that are equal."""
        new = RunningMeanStd(shape=self.mean.shape)
        new.mean, new.var, new.count = self.mean.copy(), self.var.copy(), float(self.count)
        return new

    def combine(self, other: RunningMeanStd) -> None:
        """Takes in what other moments have seen."""
        self.update_from_moments(other.mean, other.var, other.count)

    def update(self, arr: np.ndarray) -> None:
        """Takes in a batch ``(batch, *shape)``."""
        self.update_from_moments(np.mean(arr, axis=0), np.var(arr, axis=0), arr.shape[0])

    def update_from_moments(self, batch_mean: np.ndarray, batch_var: np.ndarray, batch_count: float) -> None:
        """Takes in ``batch_count`` values of which mean and variance are known."""
        total = self.count + batch_count
        delta, share = batch_mean - self.mean, batch_count / total
        self.mean = self.mean + share * delta
        self.var = (1.0 - share) * self.var + share * batch_var + (1.0 - share) * share * np.square(delta)
        self.count = total


class VecNormalize(VecEnvWrapper):
    """Shows standardised observations, and rewards divided by the standard deviation of their discounted sum.

    ``clip((obs - mean) / sqrt(var + epsilon), -clip_obs, clip_obs)`` and ``clip(reward / sqrt(var + epsilon),
    -clip_reward, clip_reward)``; the statistics move while ``training`` is True. Learn and predict on the same: set
    ``training = norm_reward = False`` for testing.

    Args:
        venv: a vector environment with Box observations, or a Dict of them.
        training: whether the statistics take in what comes.
        norm_obs: whether observations are scaled.
        norm_reward: whether rewards are scaled.
        clip_obs: largest magnitude of a scaled observation; ``math.inf`` for any.
        clip_reward: largest magnitude of a scaled reward, likewise.
        gamma: discount of the sum of rewards; the agent's.
        epsilon: added to variances.
        norm_obs_keys: which parts of Dict observations are scaled; None for all.

    Raises:
        ValueError: if something that is not Box is to be scaled.

    >>> from rejeu.envs.make_vec_env import make_vec_env
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
            self._prepare(venv.observation_space)
        self.returns = np.zeros(self.num_envs)
        """The discounted sum of rewards that runs along with each environment."""
        self.old_obs: Any = None
        self.old_reward = np.zeros(self.num_envs, np.float32)

    def _prepare(self, space: spaces.Space) -> None:
        """Makes the moments of the observations and the space of the scaled ones."""
        if isinstance(space, spaces.Dict):
            keys = list(space.spaces) if self.norm_obs_keys is None else self.norm_obs_keys
            self.norm_obs_keys = keys
            for key in keys:
                if key not in space.spaces:
                    raise ValueError(f"norm_obs_keys has {key!r}, and the observations have {', '.join(space.spaces)}")
                _check_box(space[key], key)
            self.obs_rms = {key: RunningMeanStd(shape=space[key].shape or ()) for key in keys}
            scaled = {key: self._box(part) if key in keys else part for key, part in space.spaces.items()}
            self.observation_space = spaces.Dict(scaled)
            return
        if self.norm_obs_keys is not None:
            raise ValueError(f"norm_obs_keys={self.norm_obs_keys!r} needs Dict observations, got {space}")
        _check_box(space, None)
        self.obs_rms = RunningMeanStd(shape=space.shape or ())
        self.observation_space = self._box(space)

    def _box(self, space: spaces.Space) -> spaces.Box:
        return spaces.Box(-self.clip_obs, self.clip_obs, space.shape, np.float32)

    def set_venv(self, venv: VecEnv) -> None:
        """Puts the wrapper around another vector environment of the same spaces; the statistics stay.

        Raises:
            ValueError: if the spaces differ.
        """
        other = VecNormalize(venv, norm_obs=self.norm_obs, clip_obs=self.clip_obs, norm_obs_keys=self.norm_obs_keys)
        if other.observation_space != self.observation_space:
            raise ValueError(f"the environment has {venv.observation_space}, and these statistics are of another space")
        VecEnvWrapper.__init__(self, venv, other.observation_space)
        self.returns, self.old_reward = np.zeros(self.num_envs), np.zeros(self.num_envs, np.float32)

    def reset(self) -> Any:
        """Resets the environments and returns the scaled observations."""
        obs = self.venv.reset()
        self.old_obs, self.returns = obs, np.zeros(self.num_envs)
        self._see(obs)
        return self.normalize_obs(obs)

    def step_wait(self) -> StepResult:
        """Steps the environments and returns scaled observations and rewards, dones and infos.

        ``terminal_observation`` is scaled as well.
        """
        obs, rewards, dones, infos = self.venv.step_wait()
        self.old_obs, self.old_reward = obs, rewards
        self._see(obs)
        if self.training:
            self.returns = self.returns * self.gamma + rewards
            self.ret_rms.update(self.returns)
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"] = self.normalize_obs(info["terminal_observation"])
        self.returns[dones] = 0.0
        return self.normalize_obs(obs), self.normalize_reward(rewards), dones, infos

    def _see(self, obs: Any) -> None:
        if not (self.training and self.norm_obs):
            return
        if isinstance(self.obs_rms, dict):
            for key, moments in self.obs_rms.items():
                moments.update(obs[key])
        else:
            self.obs_rms.update(obs)

    def normalize_obs(self, obs: Any) -> Any:
        """Returns observations scaled by the present statistics, which do not move."""
        return self._mapped(obs, self._scale)

    def unnormalize_obs(self, obs: Any) -> Any:
        """Returns scaled observations as they were, up to what was clipped."""
        return self._mapped(obs, self._unscale)

    def normalize_reward(self, reward: np.ndarray) -> np.ndarray:
        """Returns rewards, ``float32``, scaled by the present statistics, which do not move."""
        if not self.norm_reward:
            return reward
        scaled = np.clip(reward / np.sqrt(self.ret_rms.var + self.epsilon), -self.clip_reward, self.clip_reward)
        return scaled.astype(np.float32)

    def unnormalize_reward(self, reward: np.ndarray) -> np.ndarray:
        """Returns scaled rewards as they were, up to what was clipped."""
        return reward * np.sqrt(self.ret_rms.var + self.epsilon) if self.norm_reward else reward

    def get_original_obs(self) -> Any:
        """Returns the observations of the last step or reset as the environments gave them."""
        return _copied(self.old_obs)

    def get_original_reward(self) -> np.ndarray:
        """Returns the rewards of the last step as the environments gave them."""
        return self.old_reward.copy()

    def _mapped(self, obs: Any, function: Any) -> Any:
        if not self.norm_obs:
            return obs
        if isinstance(self.obs_rms, dict):
            return {**obs, **{key: function(np.asarray(obs[key]), m) for key, m in self.obs_rms.items()}}
        return function(np.asarray(obs), self.obs_rms)

    def _scale(self, obs: np.ndarray, moments: RunningMeanStd) -> np.ndarray:
        z = (obs - moments.mean) / np.sqrt(moments.var + self.epsilon)
        return np.clip(z, -self.clip_obs, self.clip_obs).astype(np.float32)

    def _unscale(self, obs: np.ndarray, moments: RunningMeanStd) -> np.ndarray:
        return obs * np.sqrt(moments.var + self.epsilon) + moments.mean

    def statistics(self) -> dict[str, np.ndarray]:
        """Returns what has been seen, as arrays by name."""
        arrays = {f"returns.{name}": value for name, value in _arrays(self.ret_rms).items()}
        if isinstance(self.obs_rms, dict):
            arrays |= {f"obs.{i}.{n}": v for i, m in enumerate(self.obs_rms.values()) for n, v in _arrays(m).items()}
        elif self.obs_rms is not None:
            arrays |= {f"obs.{name}": value for name, value in _arrays(self.obs_rms).items()}
        return arrays

    def put_statistics(self, arrays: Mapping[str, np.ndarray], path: str | Path = "the statistics") -> None:
        """Puts back what :meth:`statistics` returned; ``path`` is where it is from, for messages.

        Raises:
            CheckpointError: if they are damaged, or of an environment with other observations.
        """
        left = dict(arrays)
        _restore(self.ret_rms, left, "returns", path)
        if isinstance(self.obs_rms, dict):
            for i, moments in enumerate(self.obs_rms.values()):
                _restore(moments, left, f"obs.{i}", path)
        elif self.obs_rms is not None:
            _restore(self.obs_rms, left, "obs", path)
        if left:
            raise CheckpointError(f"{path} has {checkpoint.shown(min(left))}, for which these settings have no use")

    def save(self, save_path: str | Path) -> Path:
        """Writes statistics and settings to one safetensors file and returns its path; the environments are not in it.

        ``.safetensors`` is added to a path without a suffix. Nothing in the file is code, whatever its suffix says.
        """
        arrays = self.statistics()
        header = {
            "settings": {key: _written(key, float(getattr(self, key))) for key in NUMBERS}
            | {key: bool(getattr(self, key)) for key in SWITCHES},
            "keys": None if not isinstance(self.obs_rms, dict) else list(self.obs_rms),
        }
        return checkpoint.write(save_path, KIND, arrays, header)

    @staticmethod
    def load(load_path: str | Path, venv: VecEnv) -> VecNormalize:
        """Returns what :meth:`save` wrote, around ``venv``.

        Raises:
            FileNotFoundError: if there is no such file.
            CheckpointError: if it is damaged, or of an environment with other observations.
        """
        with checkpoint.opened(load_path, KIND) as file:
            header = file.header
            try:
                settings = {key: _read(key, header["settings"][key]) for key in NUMBERS}
                switches = {key: _check_switch(key, header["settings"][key]) for key in SWITCHES}
                new = VecNormalize(venv, **switches, **settings, norm_obs_keys=_check_keys(header["keys"]))  # type: ignore[arg-type]
            except (LookupError, TypeError, ValueError) as error:
                raise CheckpointError(f"{load_path} does not fit {venv.observation_space}: {error}") from None
            _check_specs(file.specs, new.statistics(), load_path)
            new.put_statistics(file.read(), load_path)
        return new


def unwrap_vec_normalize(env: VecEnv) -> VecNormalize | None:
    """Returns the outermost ``VecNormalize`` around a vector environment, or None."""
    return unwrap_vec_wrapper(env, VecNormalize)


def sync_envs_normalization(env: VecEnv, eval_env: VecEnv) -> None:
    """Copies the statistics of each ``VecNormalize`` around ``env`` to its counterpart around ``eval_env``.

    Raises:
        ValueError: if ``eval_env`` is wrapped otherwise.
    """
    while isinstance(env, VecEnvWrapper):
        if not isinstance(eval_env, VecEnvWrapper) or isinstance(env, VecNormalize) != isinstance(
            eval_env, VecNormalize
        ):
            raise ValueError(
                f"the training environment is wrapped in {type(env).__name__} where the other has "
                f"{type(eval_env).__name__}; wrap both alike, the other with training=False"
            )
        if isinstance(env, VecNormalize) and isinstance(eval_env, VecNormalize):
            eval_env.obs_rms, eval_env.ret_rms = _copied(env.obs_rms), env.ret_rms.copy()
        env, eval_env = env.venv, eval_env.venv


def _arrays(moments: RunningMeanStd) -> dict[str, np.ndarray]:
    return {"mean": moments.mean, "var": moments.var, "count": np.array(moments.count, np.float64)}


def _check_specs(found: Mapping[str, Any], own: Mapping[str, Any], path: str | Path) -> None:
    """Raises ``CheckpointError`` unless both have the same names, shapes and dtypes."""
    forms = [{name: f"{one.dtype}{list(one.shape)}" for name, one in arrays.items()} for arrays in (found, own)]
    if differing := sorted(name for name in {*found, *own} if forms[0].get(name) != forms[1].get(name)):
        name = differing[0]
        raise CheckpointError(
            f"{path}: {checkpoint.shown(name)} is {checkpoint.shown(forms[0].get(name, 'missing'))}, expected "
            f"{forms[1].get(name, 'nothing of that name')}; it is of other observations or other settings"
        )


def _restore(moments: RunningMeanStd, arrays: dict[str, np.ndarray], name: str, path: str | Path) -> None:
    """Takes moments out of a file's arrays.

    Raises:
        CheckpointError: if they are not there, or not numbers that moments may be.
    """
    found = {}
    for part, shape in (("mean", moments.mean.shape), ("var", moments.mean.shape), ("count", ())):
        array = arrays.pop(f"{name}.{part}", None)
        if array is None or array.shape != shape or array.dtype != np.float64 or not np.isfinite(array).all():
            same = array is not None and array.shape == shape
            got = "nothing" if array is None else "other numbers" if same else f"the shape {array.shape}"
            raise CheckpointError(f"{path}: {name}.{part} has {got}, expected finite float64 of the shape {shape}")
        if part != "mean" and (array < 0).any():
            raise CheckpointError(f"{path}: {name}.{part} has negative numbers, which it cannot have")
        found[part] = array
    moments.mean, moments.var, moments.count = found["mean"], found["var"], float(found["count"])


def _written(key: str, value: float) -> float | None:
    return None if key in BOUNDS and value == math.inf else value


def _read(key: str, value: Any) -> float:
    return math.inf if key in BOUNDS and value is None else number(key, value, least=0, most=MOST[key])


def _check_keys(keys: Any) -> list[str] | None:
    if keys is not None and not (isinstance(keys, list) and all(isinstance(key, str) for key in keys)):
        raise ValueError(f"the keys are {str(keys)[:40]}, expected names or null")
    return keys


def _check_switch(key: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"{key}={str(value)[:40]} must be true or false")
    return value


def _check_box(space: spaces.Space, key: str | None) -> None:
    if not isinstance(space, spaces.Box):
        where = "" if key is None else f" under {key!r}"
        raise ValueError(
            f"VecNormalize scales Box observations, got {space}{where}; name those to scale with norm_obs_keys, or set "
            "norm_obs=False"
        )


def _copied(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _copied(part) for key, part in tree.items()}
    return None if tree is None else tree.copy()
