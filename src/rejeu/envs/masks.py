"""Vectors of environments with action masks; :mod:`rejeu.envs.mask_wrapper` says how an environment gives its mask."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.core import Masked
from rejeu.envs.adapters import adapter_of
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.make import Backend, InProcess, Step, VectorEnv, check_workers, make_vector
from rejeu.envs.mask_wrapper import MASK, OBSERVATION, MaskInObservation, n_choices
from rejeu.envs.registry import maker
from rejeu.envs.seeds import Seed
from rejeu.envs.workers.pool import TIMEOUT
from rejeu.spaces import Leaf


@dataclass(frozen=True)
class MaskedMaker:
    """Makes an environment with its mask in the observation; can be sent to another process."""

    make: Callable[[], gym.Env]

    def __call__(self) -> gym.Env:
        """Returns a new environment."""
        return MaskInObservation(self.make())


class MaskedVector(VectorEnv):
    """A vector of environments whose observations are :class:`rejeu.core.Masked`."""

    def __init__(self, inner: VectorEnv) -> None:
        """Wraps a vector of :class:`MaskInObservation` environments."""
        space = inner.observation_space
        assert isinstance(space, spaces.Dict)
        self.inner = inner
        self.n_envs, self.backend, self.env_id = inner.n_envs, inner.backend, inner.env_id
        self.seeds = inner.seeds
        self.observation_space, self.action_space = space[OBSERVATION], inner.action_space
        self.max_episode_steps, self.reward_threshold = inner.max_episode_steps, inner.reward_threshold

    def reset(self, seed: Seed = None) -> Masked:
        return masked(self.inner.reset(seed))

    def _step_all(self, action: np.ndarray) -> Step:
        return self._shown(self.inner.step(action))

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        return self._shown(self.inner.step(action, active))

    def _shown(self, step: Step) -> Step:
        return step._replace(obs=masked(step.obs))

    def reset_done(self, done: np.ndarray) -> Masked:
        return masked(self.inner.reset_done(done))

    def success(self, step: Step, env: int) -> float:
        return self.inner.success(step, env)

    def goals(self) -> GoalFunctions | None:
        return None

    def snapshot(self) -> Any:
        return self.inner.snapshot()

    def restore(self, saved: Any, obs: Masked) -> list[int]:
        return self.inner.restore(saved, {OBSERVATION: obs.obs, MASK: obs.mask.astype(np.int8)})

    def identities(self) -> set[int]:
        return {id(self)} | self.inner.identities()

    def close(self) -> None:
        self.inner.close()


def masked(obs: dict[str, Any]) -> Masked:
    """Returns what :class:`MaskInObservation` shows as an observation with its mask, ``bool (n_envs, n)``."""
    return Masked(obs[OBSERVATION], obs[MASK].astype(bool))


def shown_to(agent: Any, env: gym.Env) -> gym.Env:
    """Returns an environment as an agent is to see it: with its masks, if the agent takes any."""
    return MaskInObservation(env) if getattr(agent, "takes_masks", False) else env


def split(observation: Any, masks: Any) -> tuple[Any, Any]:
    """Returns an observation and its mask, from what :class:`MaskInObservation` shows or from the two apart."""
    if isinstance(observation, Mapping) and {*observation} == {OBSERVATION, MASK}:
        return observation[OBSERVATION], observation[MASK] if masks is None else masks
    return observation, masks


def mask_leaf(action_space: spaces.Space, env_id: str) -> Leaf:
    """Returns the mask as one more array of an observation."""
    return Leaf(MASK, "binary", (n_choices(action_space, env_id),), "bool")


def make_masked(
    env: Any,
    n_envs: int = 1,
    backend: Backend = "auto",
    seed: Seed = None,
    *,
    worker_timeout: float | None = TIMEOUT,
    restart_workers: int = 0,
) -> MaskedVector:
    """Returns ``n_envs`` environments with their masks as one; arguments as for :func:`make_vector`.

    Raises:
        TypeError: for a vector environment whose single environments cannot be reached.
        ValueError: for worker options out of range, or ``restart_workers`` where there are no worker processes.
    """
    check_workers(env, backend, worker_timeout, restart_workers)
    if adapter_of(env) is not None:
        env = make_vector(env, seed=seed)
    if isinstance(env, MaskedVector):
        return env
    if isinstance(env, InProcess):
        return MaskedVector(env.handed_on(MaskInObservation, seed))
    if isinstance(env, VectorEnv | gym.vector.VectorEnv):
        raise TypeError(
            f"the masks of {type(env).__name__} cannot be reached; give the id, the environment, or a function that makes "
            "one, or rejeu.make_vector(function, n_envs, 'gymnasium')"
        )
    made_from: tuple[str, dict[str, Any]] | None = (env, {}) if isinstance(env, str) else None
    if isinstance(env, str):
        env = maker(env)
    if isinstance(env, gym.Env):
        return MaskedVector(make_vector(MaskInObservation(env), n_envs, seed=seed))
    if not callable(env):
        raise TypeError(f"env must be an id, an environment or a function that makes one, got {type(env).__name__}")
    chosen: Backend = "gymnasium" if backend in ("auto", "envpool") else backend
    vector = make_vector(
        MaskedMaker(env), n_envs, chosen, seed, worker_timeout=worker_timeout, restart_workers=restart_workers
    )
    masked = MaskedVector(vector)
    masked.made_from = made_from
    return masked
