"""Action masks: which actions an environment allows, passed along with its observations.

An environment returns the mask in ``info["action_mask"]``, at reset and at every step, or by a method ``action_masks()``; one
in JAX has a method ``action_mask``. The mask is an array of booleans or of zeros and ones: one for each action of a Discrete
space, one for each option of every choice of a MultiDiscrete space, one for each bit of a MultiBinary space that may be 1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, SupportsFloat

import equinox as eqx
import gymnasium as gym
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.algorithm import Masked
from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import Leaf
from rejeu.core.types import Action, AnyArray, Info, Observation, PyTree, Settings
from rejeu.envs import functional, snapshot
from rejeu.envs.base import Seed, Step, VectorEnv
from rejeu.envs.envpool import EnvPool
from rejeu.envs.functional.protocol import FunctionalEnv
from rejeu.envs.functional.vector import JaxVector, goal_functions
from rejeu.envs.goals import GoalFunctions, attribute
from rejeu.envs.in_process import InProcess
from rejeu.envs.make import Backend, WorkerOptions, adapter_of, check_workers, make_vector
from rejeu.envs.registry import maker
from rejeu.envs.validation import id_of
from rejeu.envs.workers.pool import TIMEOUT

OBSERVATION, MASK = "observation", "action_mask"
"""Keys of the observations of :class:`MaskInObservation`."""
METHOD = "action_masks"
NO_MASKS = (
    'does not return action masks; put info["action_mask"] into what reset and step return, or define action_masks()'
)


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
    raise ValueError(
        f"masks need Discrete, MultiDiscrete or MultiBinary actions; {env_id} has {space}: leave action_masks out"
    )


class MaskInObservation(gym.Wrapper[Any, Any, Any, Any]):
    """A wrapper that adds the mask to the observations: a Dict of ``observation`` and ``action_mask``."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self._n = n_choices(env.action_space, id_of(env))
        self.observation_space = spaces.Dict({OBSERVATION: env.observation_space, MASK: spaces.MultiBinary(self._n)})

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        obs, info = self.env.reset(seed=seed, options=options)
        return {OBSERVATION: obs, MASK: self._mask(info, False)}, info

    def step(self, action: Action) -> tuple[Observation, SupportsFloat, bool, bool, Info]:
        obs, reward, terminated, truncated, info = self.env.step(action)
        mask = self._mask(info, terminated or truncated)
        return {OBSERVATION: obs, MASK: mask}, reward, terminated, truncated, info

    def _mask(self, info: Info, over: bool) -> np.ndarray:
        if not isinstance(info, dict):  # reported by the vector, with the number of the environment
            return np.zeros(self._n, np.int8)
        method = None if MASK in info else attribute(self.env, METHOD)
        if MASK not in info and method is None:
            raise BadEnvironmentError(f"{id_of(self.env)} {NO_MASKS}")
        mask = info[MASK] if method is None else method()  # an AttributeError in it is the environment's own
        return flat_mask(mask, self.action_space, id_of(self.env), over)


def flat_mask(mask: AnyArray, space: spaces.Space, env_id: str, over: bool) -> np.ndarray:
    """Returns the mask that an environment gave, an array or a list of arrays, as ``int8 (n_choices,)``.

    Raises:
        BadEnvironmentError: if it has another length or, unless the episode is ``over``, allows no action.
    """
    n = n_choices(space, env_id)
    masks = mask if isinstance(mask, list | tuple) else [mask]
    mask = np.concatenate([np.asarray(choices).ravel() for choices in masks]).astype(np.int8)
    if mask.shape != (n,):
        raise BadEnvironmentError(f"{env_id} gave a mask of {mask.size} entries, expected {n} for {space}")
    sizes = space.nvec.ravel() if isinstance(space, spaces.MultiDiscrete) else [n]
    is_some_allowed = all(choices.any() for choices in np.split(mask, np.cumsum(sizes)[:-1]))
    if not (over or is_some_allowed or isinstance(space, spaces.MultiBinary)):
        raise BadEnvironmentError(f"{env_id} allows no action: its mask is {mask.tolist()}")
    return mask


def sampled(env: gym.Env, info: object) -> Any:
    """Returns a random action, among those that the environment allows if ``info`` or ``action_masks()`` says so.

    Raises:
        BadEnvironmentError: if its mask is invalid.
    """
    space, method = env.action_space, attribute(env, METHOD)
    env_mask = info[MASK] if isinstance(info, dict) and MASK in info else method() if callable(method) else None
    if env_mask is None or not isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return space.sample()
    mask = flat_mask(env_mask, space, id_of(env), over=False)
    if not isinstance(space, spaces.MultiDiscrete):
        return space.sample() * mask.reshape(space.shape) if space.shape else space.sample(mask=mask)
    masks = np.split(mask, np.cumsum(space.nvec.ravel())[:-1])
    action = np.reshape([space.np_random.choice(np.flatnonzero(choices)) for choices in masks], space.shape)
    return (action + space.start).astype(space.dtype)


snapshot.REMEMBERED[MaskInObservation] = {}


def with_mask(make: Callable[[], gym.Env]) -> gym.Env:
    """Returns a new environment with its mask in the observation."""
    return MaskInObservation(make())


class MaskedVector(VectorEnv):
    """A vector environment whose observations are :class:`rejeu.core.algorithm.Masked`.

    Args:
        inner: a vector of :class:`MaskInObservation` environments; with ``asks``, of any environments.
        asks: whether masks come from the infos, or from the method ``action_masks`` of environments that may run in worker
            processes. Where an episode ended, every action counts as allowed if the info has no mask, because the environment
            may have begun the next one.
    """

    def __init__(self, inner: VectorEnv, asks: bool = False) -> None:
        self.inner = inner
        self.n_envs, self.backend, self.env_id = inner.n_envs, inner.backend, inner.env_id
        self.seeds, self.made_from = inner.seeds, inner.made_from
        self.venv, self.wrapped_by, self.vec_normalize = inner.venv, inner.wrapped_by, inner.vec_normalize
        self.observation_space, self.action_space = inner.observation_space, inner.action_space
        self.max_episode_steps, self.reward_threshold = inner.max_episode_steps, inner.reward_threshold
        self._mask = np.ones((self.n_envs, n_choices(self.action_space, self.env_id)), bool) if asks else None
        if not asks:
            assert isinstance(inner.observation_space, spaces.Dict)
            self.observation_space = inner.observation_space[OBSERVATION]

    def reset(self, seed: Seed = None) -> Masked:
        return self._masked(self.inner.reset(seed), np.arange(self.n_envs))

    def _step_all(self, action: np.ndarray) -> Step:
        return self._after(self.inner.step(action), np.arange(self.n_envs))

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        return self._after(self.inner.step(action, active), np.flatnonzero(active))

    def _after(self, step: Step, indices: np.ndarray) -> Step:
        return step._replace(obs=self._masked(step.obs, indices, step.terminated | step.truncated))

    def reset_done(self, done: np.ndarray) -> Masked:
        return self._masked(self.inner.reset_done(done), np.flatnonzero(done))

    def _masked(self, obs: Observation, indices: np.ndarray, over: np.ndarray | None = None) -> Masked:
        """Returns observations with their masks, of which those of ``indices`` are new; ``over`` is None after a reset."""
        if self._mask is None:
            return masked(obs)
        infos, ended = self.inner.infos(begun=over is None), np.zeros(self.n_envs, bool) if over is None else over
        asked = [i for i in indices.tolist() if MASK not in infos[i] and not ended[i]]
        try:
            called = self.inner.call(METHOD) if asked else []
        except AttributeError as error:
            raise BadEnvironmentError(f"{self.env_id} {NO_MASKS}") from error
        for i in indices.tolist():
            mask = called[i] if i in asked else infos[i].get(MASK)
            self._mask[i] = True if mask is None else flat_mask(mask, self.action_space, self.env_id, ended[i])
        return Masked(obs, self._mask.copy())

    def success(self, step: Step, env: int) -> float:
        return self.inner.success(step, env)

    def goals(self) -> GoalFunctions | None:
        if isinstance(self.inner, JaxVector) and isinstance(self.inner.env, FunctionalMask):
            return goal_functions(self.inner.env.env)
        return self.inner.goals()

    @property
    def must_reset(self) -> bool:
        return self.inner.must_reset

    def record(self) -> None:
        self.inner.record()

    def snapshot(self) -> Any:
        return self.inner.snapshot()

    def restore(self, saved: object, obs: Masked) -> list[int]:
        if self._mask is None:
            return self.inner.restore(saved, {OBSERVATION: obs.obs, MASK: obs.mask.astype(np.int8)})
        self._mask[:] = obs.mask
        return self.inner.restore(saved, obs.obs)

    def identities(self) -> set[int]:
        return {id(self)} | self.inner.identities()

    def close(self) -> None:
        self.inner.close()


def masked(obs: dict[str, Observation]) -> Masked:
    """Returns observations of :class:`MaskInObservation` with their masks, ``bool (n_envs, n)``."""
    return Masked(obs[OBSERVATION], obs[MASK].astype(bool))


def for_agent(agent: Any, env: gym.Env) -> gym.Env:
    """Returns an environment with masks in its observations if the agent uses masks, else the environment itself."""
    return MaskInObservation(env) if getattr(agent, "takes_masks", False) else env


def split(observation: Observation, masks: AnyArray) -> tuple[Any, Any]:
    """Returns an observation and its mask, from both in one as environments with masks show them, or from the two apart."""
    if isinstance(observation, Masked):
        return observation.obs, observation.mask if masks is None else masks
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
        TypeError: for EnvPool, whose single environments cannot be accessed.
        ValueError: for worker options out of range, or ``restart_workers`` where there are no worker processes.
    """
    check_workers(env, n_envs, backend, WorkerOptions(worker_timeout, restart_workers))
    if adapter_of(env) is not None or isinstance(env, gym.Env | gym.vector.VectorEnv):
        env = make_vector(env, n_envs, seed=seed)
    if isinstance(env, MaskedVector):
        return env
    if isinstance(env, FunctionalEnv) or backend == "jax" or (backend == "auto" and functional.is_functional(env)):
        env = make_vector(env, n_envs, "jax", seed)
    if isinstance(env, JaxVector):
        n = n_choices(env.action_space, env.env_id)
        return MaskedVector(env.with_env(FunctionalMask(env.env, n), seed))
    if isinstance(env, InProcess):
        return MaskedVector(env.with_wrapper(MaskInObservation, seed))
    if isinstance(env, EnvPool):
        raise TypeError(
            "the masks of EnvPool cannot be accessed; give the id, the environment, or a function that makes one, or "
            "rejeu.make_vector(function, n_envs, 'gymnasium')"
        )
    if isinstance(env, VectorEnv):
        return MaskedVector(env, asks=True)
    made_from: tuple[str, Settings] | None = (env, {}) if isinstance(env, str) else None
    if isinstance(env, str):
        env = maker(env)
    if not callable(env):
        raise TypeError(f"env must be an id, an environment or a function that makes one, got {type(env).__name__}")
    backend = "gymnasium" if backend in ("auto", "envpool") else backend
    make = partial(with_mask, env)
    vector = make_vector(make, n_envs, backend, seed, worker_timeout=worker_timeout, restart_workers=restart_workers)
    vector.made_from = made_from
    return MaskedVector(vector)


class FunctionalMask(FunctionalEnv):
    """An environment in JAX whose observations are dicts of ``observation`` and ``action_mask``, ``int8 (n_choices,)``.

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
        return spaces.Dict({OBSERVATION: self.env.observation_space, MASK: spaces.MultiBinary(self.n_choices)})

    @property
    def action_space(self) -> spaces.Space:
        return self.env.action_space

    def reset(self, key: Array) -> tuple[PyTree, PyTree]:
        state, obs = self.env.reset(key)
        return state, self._observe(state, obs)

    def step(self, key: Array, state: PyTree, action: Array) -> tuple[PyTree, PyTree, Array, Array, Array]:
        state, obs, *result = self.env.step(key, state, action)
        return state, self._observe(state, obs), *result

    def success(self, state: PyTree) -> Array | None:
        return self.env.success(state)

    def _observe(self, state: PyTree, obs: Observation) -> dict[str, Observation]:
        mask = self.env.action_mask(state)
        if mask is None or mask.shape != (self.n_choices,):
            shape = "None" if mask is None else f"the shape {mask.shape}"
            raise BadEnvironmentError(
                f"{type(self.env).__name__}.action_mask returned {shape}, expected a mask of the shape ({self.n_choices},)"
            )
        return {OBSERVATION: obs, MASK: mask.astype(jnp.int8)}
