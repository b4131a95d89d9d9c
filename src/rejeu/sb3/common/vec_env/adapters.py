"""Conversion between Stable-Baselines3's vector environments and rejeu's.

Agents step a :class:`rejeu.envs.base.VectorEnv`, which never resets by itself. Importing this module registers the
conversion in both directions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from numpy.typing import DTypeLike

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import leaves, plain
from rejeu.core.types import Action, Info, Observation
from rejeu.envs import goals as goals_module, validation
from rejeu.envs.base import Seed, Step, VectorEnv, step_whole, success_of
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.in_process import InProcess
from rejeu.envs.make import register_adapter
from rejeu.sb3.common.vec_env.base_vec_env import (
    TERMINAL_OBSERVATION,
    TIME_LIMIT_TRUNCATED,
    SingleEnvs,
    VecEnv,
    VecEnvIndices,
    VecEnvStepReturn,
    VecEnvWrapper,
    is_wrapped,
)
from rejeu.sb3.common.vec_env.dummy_vec_env import DummyVecEnv
from rejeu.sb3.common.vec_env.vec_normalize import unwrap_vec_normalize


def to_vector(venv: VecEnv, seed: Seed = None) -> VectorEnv:
    """Returns a ``VecEnv`` as a vector environment without automatic resets.

    The environments of a plain :class:`DummyVecEnv` are stepped directly, which is fastest. Wrappers, other classes and
    subclasses are stepped as they are.
    """
    if isinstance(venv, AutoResetView):
        return venv.vector
    if type(venv) is DummyVecEnv:
        return InProcess(venv.envs, seed, venv)
    return VecEnvAdapter(venv, seed)


def to_vec_env(vector: VectorEnv) -> VecEnv:
    """Returns a ``VecEnv`` of the environments of a vector environment, to be stepped by hand."""
    return dummy_vec_env(vector.envs) if isinstance(vector, InProcess) else AutoResetView(vector)


def dummy_vec_env(envs: Sequence[gym.Env]) -> DummyVecEnv:
    """Returns a ``DummyVecEnv`` of existing environments."""
    remaining = iter(envs)
    return DummyVecEnv([lambda: next(remaining)] * len(envs))


def identities(venv: VecEnv) -> set[int]:
    """Returns the ids of a vector environment and of the environments in it, as :meth:`VectorEnv.identities` does."""
    if isinstance(venv, AutoResetView):
        return {id(venv)} | venv.vector.identities()
    inner = venv.unwrapped
    return {id(inner)} | {id(env.unwrapped) for env in (inner.envs if isinstance(inner, DummyVecEnv) else ())}


class VecEnvAdapter(VectorEnv):
    """A ``VecEnv`` without its automatic resets: the true next observations are read from the infos.

    Args:
        venv: the vector environment, with its wrappers.
        seed: seed of the first reset.
    """

    venv: VecEnv

    def __init__(self, venv: VecEnv, seed: Seed = None) -> None:
        self.venv = venv
        self.n_envs = venv.num_envs
        self.observation_space, self.action_space = venv.observation_space, venv.action_space
        self.backend = "gymnasium"
        self.env_id = type(venv.unwrapped).__name__
        if (spec := _first_attr(venv, "spec")) is not None:
            self.env_id, self.max_episode_steps = spec.id, spec.max_episode_steps
            self.reward_threshold = spec.reward_threshold
        self.wrapped_by = type(venv).__name__ if isinstance(venv, VecEnvWrapper) else None
        self.vec_normalize = unwrap_vec_normalize(venv)
        self.gives_originals = False
        """Whether the replay buffer stores what was not normalized: :meth:`original_obs` and :meth:`original_reward`."""
        self.n_steps = 0
        """Number of steps of the vector."""
        self._seed = None if seed is None else self._single_seed(seed)
        self._leaves = leaves(self.observation_space)
        self._after_reset: Any = None
        """Observations returned by the last step, including the first ones of new episodes."""
        self._desynced = np.zeros(self.n_envs, bool)
        """Environments that were stepped although they were not active, and have not been reset since."""

    def reset(self, seed: Seed = None) -> Observation:
        seed = self._seed if seed is None else seed
        self._seed = None
        if seed is not None:
            self.venv.seed(self._single_seed(seed))
        self._desynced = np.zeros(self.n_envs, bool)
        self._obs = self._after_reset = self._cast(self.venv.reset())
        return self._obs

    def _single_seed(self, seed: int | Sequence[int]) -> int:
        """Returns a seed that is a single number.

        Raises:
            ValueError: if it is a sequence.
        """
        if isinstance(seed, int):
            return seed
        raise ValueError(
            f"seed={seed}: {type(self.venv).__name__} takes a single seed and seeds its environments itself; give one "
            "number, or make the environments with rejeu.make_vector, which takes one seed for each"
        )

    def _step_all(self, action: np.ndarray) -> Step:
        self.n_steps += 1
        result = self.venv.step(action)
        if not isinstance(result, tuple) or len(result) != 4:
            raise self._bad(f"step returned {validation.describe_value(result)}, expected (obs, rewards, dones, infos)")
        returned, reward, dones, infos = result
        try:
            done = validation.to_vector("dones", dones, self.n_envs, bool)
            reward = validation.to_vector("rewards", reward, self.n_envs, np.float32)
        except BadEnvironmentError as error:
            raise self._bad(f"step returned {error}") from error.__cause__
        for i, info in enumerate(infos):
            if not isinstance(info, dict):
                raise self._bad(f"step returned infos[{i}]={info!r:.40}, expected a dict, for example {{}}")
        truncated = np.array([bool(info.get(TIME_LIMIT_TRUNCATED, False)) for info in infos]) & done
        obs = self._after_reset = self._cast(returned)
        returns = None
        if done.any():
            obs = jax.tree.map(np.copy, obs)
            returns = np.full(self.n_envs, np.nan)
            for i in np.flatnonzero(done).tolist():
                self._write_final(obs, i, infos[i])
                returns[i] = np.asarray(infos[i].get("episode", {}).get("r", np.nan)).item()
        self._obs = obs
        return Step(obs, reward, done & ~truncated, truncated, infos, returns)

    def _write_final(self, obs: Observation, i: int, info: Info) -> None:
        """Writes the final observation of environment ``i`` into a batch of observations."""
        if TERMINAL_OBSERVATION not in info:
            raise BadEnvironmentError(
                f"an episode ended in environment {i} of {type(self.venv).__name__}, but infos[{i}] has no "
                f"{TERMINAL_OBSERVATION!r}; step_wait must store the last observation there before it resets the environment"
            )
        last = jax.tree.leaves(plain(self.observation_space, info[TERMINAL_OBSERVATION]))
        for store, leaf in zip(jax.tree.leaves(obs), last, strict=True):
            if np.shape(leaf) != store.shape[1:]:
                raise BadEnvironmentError(
                    f"infos[{i}][{TERMINAL_OBSERVATION!r}] has the shape {np.shape(leaf)}, but observations have "
                    f"{store.shape[1:]}; a wrapper that changes observations must also change it (outermost wrapper: "
                    f"{type(self.venv).__name__})"
                )
            store[i] = leaf

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        step = step_whole(self._step_all, self._obs, action, active)
        self._desynced |= ~active
        self._obs = step.obs
        return step

    def reset_done(self, done: np.ndarray) -> Observation:
        done = np.asarray(done, bool)
        if not (done & self._desynced).any():
            self._obs = self._after_reset
        elif done.all():
            self._obs = self.reset()
        else:
            raise ValueError(
                f"{type(self.venv).__name__} resets by itself and was stepped while some environments were inactive, so "
                "single environments cannot be reset; use rejeu.make_vector, or leave out n_episodes"
            )
        return self._obs

    def infos(self, begun: bool = False) -> list[Info]:
        return self.venv.reset_infos if begun else super().infos()

    def call(self, name: str) -> list[Any]:
        return self.venv.env_method(name)

    def success(self, step: Step, env: int) -> float:
        return success_of(step.info[env])

    def goals(self) -> GoalFunctions | None:
        if self.vec_normalize is not None and not self.gives_originals:
            raise ValueError(
                "hindsight replay computes rewards from goals, which VecNormalize normalizes; remove it and use the "
                "agent's option normalize=True"
            )
        reward = self._over_batches("compute_reward", np.float32)
        return None if reward is None else GoalFunctions(reward, self._over_batches("compute_terminated", np.bool_))

    def _over_batches(self, name: str, dtype: DTypeLike) -> Any:
        """Returns a method of the first environment as a function of batches, None if there is none."""
        if not self.venv.has_attr(name):
            return None
        compute = lambda achieved, desired, info: self.venv.env_method(name, achieved, desired, info, indices=[0])[0]  # noqa: E731
        return goals_module.over_batches(compute, dtype)

    def original_obs(self, final: bool) -> Observation:
        """Returns the observations of the last step as they were before ``VecNormalize``, the outermost wrapper.

        With ``final``, those where an episode ended are its last ones, else the first ones of the next.
        """
        assert self.vec_normalize is not None
        obs = jax.tree.map(np.copy, self._cast(self.vec_normalize.get_original_obs()))
        for i, last in self.vec_normalize.old_finals.items() if final else ():
            self._write_final(obs, i, {TERMINAL_OBSERVATION: last})
        return obs

    def identities(self) -> set[int]:
        return {id(self)} | identities(self.venv)

    def close(self) -> None:
        self.venv.close()

    def _cast(self, obs: Observation) -> Observation:
        try:
            return validation.to_batch(self.observation_space, self._leaves, self.n_envs, obs)
        except BadEnvironmentError as error:
            raise self._bad(f"it returned {error}") from error.__cause__

    def _bad(self, fault: str) -> BadEnvironmentError:
        return BadEnvironmentError(validation.with_location(self.env_id, None, self.n_steps, fault))


def _first_attr(venv: VecEnv, name: str) -> Any:
    """Returns an attribute of the first environment, or None."""
    try:
        attributes = venv.get_attr(name, [0])
    except (AttributeError, NotImplementedError):
        return None
    return attributes[0] if attributes else None


class AutoResetView(SingleEnvs):
    """A vector environment of rejeu as a ``VecEnv``, to be stepped by hand.

    It is used where single environments are not Python objects in this process, as with EnvPool.
    """

    def __init__(self, vector: VectorEnv) -> None:
        self.vector = vector
        super().__init__(vector.n_envs, vector.observation_space, vector.action_space)
        self._actions: Action = None

    def reset(self) -> Observation:
        seed = self._seeds[0]
        self._reset_seeds()
        return jax.tree.map(np.copy, self.vector.reset(seed))

    def step_async(self, actions: Action) -> None:
        self._actions = np.asarray(actions)

    def step_wait(self) -> VecEnvStepReturn:
        step = self.vector.step(self._actions)
        dones = step.terminated | step.truncated
        infos: list[Info] = []
        env_infos = self.vector.infos()
        for i in range(self.num_envs):
            info = dict(env_infos[i])
            info[TIME_LIMIT_TRUNCATED] = bool(step.truncated[i] and not step.terminated[i])
            success = self.vector.success(step, i)
            if not math.isnan(success):
                info["is_success"] = bool(success)
            if dones[i]:
                info[TERMINAL_OBSERVATION] = jax.tree.map(lambda leaf, i=i: np.copy(leaf[i]), step.obs)
            infos.append(info)
        obs = self.vector.reset_done(dones) if dones.any() else step.obs
        return jax.tree.map(np.copy, obs), step.reward, dones, infos

    def close(self) -> None:
        self.vector.close()

    def _call(self, indices: VecEnvIndices, function: Callable[..., Any], *arguments: object) -> list[Any]:
        if function is is_wrapped:
            return [False for _ in self._get_indices(indices)]
        raise AttributeError(
            f"single environments of {self.vector.env_id} on the backend {self.vector.backend} cannot be accessed; give the "
            "agent gymnasium.make(id) or make_vec_env(id) instead of an id"
        )


register_adapter(VecEnv, to_vector)
