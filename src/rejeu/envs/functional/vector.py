"""Many environments in JAX at once: as pure functions for training programs, and as a vector environment for the host.

Each environment has its own stream of random numbers. Environment ``i`` of ``reset_all(env, key, n)`` takes the stream
``fold_in(key, i)``, so its episodes do not depend on ``n`` or on the other environments.
"""

from __future__ import annotations

from copy import deepcopy
from functools import partial
from typing import Any

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rejeu.core import prng
from rejeu.core.spaces import cast, leaves
from rejeu.core.types import Action, Observation, PyTree
from rejeu.core.validation import whole
from rejeu.envs.base import Seed, Step, VectorEnv, checked_seed, success_of
from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv, of_two_goals
from rejeu.envs.functional.validation import check
from rejeu.envs.goals import GoalFunctions


class VectorState(eqx.Module):
    """The state of ``n`` environments."""

    keys: Array
    """The stream of random numbers of each environment, ``uint32 (n, 2)``."""
    counts: Array
    """How many keys were taken from each stream, ``int32 (n,)``."""
    env: Any
    """States of the environments, a pytree of arrays ``(n, ...)``."""
    obs: Observation
    """Their observations, a pytree of arrays ``(n, ...)``."""


def streams(key: Array, n: int) -> Array:
    """Returns the streams of ``n`` environments, ``uint32 (n, 2)``, from a typed PRNG key."""
    data = jax.random.key_data(key)
    return jax.vmap(lambda i: jax.random.key_data(prng.nth(data, i)))(jnp.arange(n, dtype=jnp.uint32))


def reset_all(env: FunctionalEnv, key: Array, n: int) -> VectorState:
    """Returns the state of ``n`` environments at the start of their first episodes. ``n`` must be static.

    >>> from rejeu.envs.functional import make
    >>> reset_all(make("jax/CartPole-v1"), jax.random.key(0), 3).obs.shape
    (3, 4)
    """
    return reset_streams(env, streams(key, n))


def reset_streams(env: FunctionalEnv, keys: Array) -> VectorState:
    """Returns the state of one environment for each stream ``uint32 (n, 2)``; see :func:`streams`."""
    counts = jnp.zeros(len(keys), jnp.int32)
    state, obs = jax.vmap(env.reset)(_next_keys(keys, counts))
    return VectorState(keys, counts + 1, state, obs)


def step_all(
    env: FunctionalEnv, vstate: VectorState, action: Array
) -> tuple[VectorState, Any, Array, Array, Array, Array | None]:
    """Steps every environment; resets none.

    Args:
        env: the environment.
        vstate: the state. Environments whose episode has ended must have been reset.
        action: in the environment's own range, ``(n, ...)``.

    Returns:
        The next state, the true successors, the rewards ``float (n,)``, ``terminated`` and ``truncated`` ``bool (n,)``, and
        whether the successors are successes, ``bool (n,)``; None if the environment does not define success.
    """
    keys = _next_keys(vstate.keys, vstate.counts)
    state, obs, reward, terminated, truncated = jax.vmap(env.step)(keys, vstate.env, action)
    after = VectorState(vstate.keys, vstate.counts + 1, state, obs)
    return after, obs, reward, terminated, truncated, jax.vmap(env.success)(state)


def reset_done(env: FunctionalEnv, vstate: VectorState, done: Array) -> tuple[VectorState, PyTree]:
    """Starts new episodes where ``done``, ``bool (n,)``; returns the state and the observations of all environments."""

    def fresh(vstate: VectorState) -> VectorState:
        state, obs = jax.vmap(env.reset)(_next_keys(vstate.keys, vstate.counts))
        return select(done, VectorState(vstate.keys, vstate.counts + 1, state, obs), vstate)

    vstate = jax.lax.cond(done.any(), fresh, lambda vstate: vstate, vstate)
    return vstate, vstate.obs


def select(mask: Array, new: PyTree, old: PyTree) -> PyTree:
    """Returns the rows of ``new`` where ``mask``, ``bool (n,)``, else those of ``old``, for pytrees of ``(n, ...)``."""
    return jax.tree.map(lambda a, b: jnp.where(jnp.expand_dims(mask, range(1, a.ndim)), a, b), new, old)


def _next_keys(keys: Array, counts: Array) -> Array:
    return jax.vmap(prng.nth)(keys, counts)


def split(env: FunctionalEnv) -> tuple[Any, Any]:
    """Returns the arrays of an environment, and the rest as a static argument that equal environments share."""
    arrays, static = eqx.partition(env, lambda leaf: isinstance(leaf, jax.Array | np.ndarray))
    leaves, tree = jax.tree.flatten(static)
    return arrays, (tuple(leaves), tree)


def joined(static: tuple[tuple[Any, ...], Any], arrays: PyTree) -> FunctionalEnv:
    """Returns the environment whose parts :func:`split` returned."""
    leaves, tree = static
    return eqx.combine(arrays, jax.tree.unflatten(tree, leaves))


@partial(jax.jit, static_argnums=0)
def _reset_streams(static: PyTree, arrays: PyTree, keys: Array) -> VectorState:
    return reset_streams(joined(static, arrays), keys)


@partial(jax.jit, static_argnums=0)
def _step(static: PyTree, arrays: PyTree, vstate: VectorState, action: Action, active: Any) -> Any:
    after, _, reward, terminated, truncated, success = step_all(joined(static, arrays), vstate, action)
    if active is not None:
        after = select(active, after, vstate)
        reward = jnp.where(active, reward, jnp.zeros_like(reward))
        terminated, truncated = terminated & active, truncated & active
    return after, (after.obs, reward, terminated, truncated, success)


@partial(jax.jit, static_argnums=0)
def _reset_done(static: PyTree, arrays: PyTree, vstate: VectorState, done: Any) -> VectorState:
    return reset_done(joined(static, arrays), vstate, done)[0]


class JaxVector(VectorEnv):
    """Environments in JAX behind the interface of a vector environment, for loops and evaluation on the host.

    Args:
        env: the environment.
        n_envs: how many.
        seed: of the first reset. A number ``seed`` below 2**32 stands for ``reset_all(env, jax.random.key(seed), n_envs)``.
            With a sequence, environment i behaves as a single one with the i-th seed. None draws one.
        env_id: the id, by default the name of the class.
        reward_threshold: the return at which the environment counts as solved, None if there is none.

    Raises:
        ValueError: if ``n_envs`` is no positive whole number.
        BadEnvironmentError: if the environment cannot be compiled, or returns something else than it declares.

    >>> from rejeu.envs.functional import make
    >>> vector = JaxVector(make("jax/Pendulum-v1"), n_envs=4, seed=0)
    >>> obs = vector.reset()
    >>> vector.step(np.zeros((4, 1), np.float32)).reward.shape
    (4,)
    """

    backend = "jax"

    def __init__(
        self,
        env: FunctionalEnv,
        n_envs: int = 1,
        seed: Seed = None,
        *,
        env_id: str | None = None,
        reward_threshold: float | None = None,
    ) -> None:
        check(env)
        self.env = env
        self.n_envs = n_envs = whole("n_envs", n_envs, least=1)
        self.env_id = type(env).__name__ if env_id is None else env_id
        self.observation_space, self.action_space = deepcopy((env.observation_space, env.action_space))
        self._action_leaves = leaves(env.action_space)
        self.max_episode_steps = env.max_episode_steps
        self.reward_threshold = reward_threshold
        self.state: VectorState | None = None
        """The state of the environments; None before the first reset."""
        self._leaves = leaves(self.observation_space)
        self._arrays, self._static = split(env)
        self._seed = seed

    def reset(self, seed: Seed = None) -> Observation:
        seed = self._seed if seed is None else checked_seed(seed, self.n_envs)
        self._seed = None
        if seed is None and self.state is not None:
            return self.reset_done(np.ones(self.n_envs, bool))
        self.state = _reset_streams(self._static, self._arrays, streams_of(seed, self.n_envs))
        return self._observe()

    def _step_all(self, action: np.ndarray) -> Step:
        return self._step_some(action, None)

    def _step_some(self, action: np.ndarray, active: np.ndarray | None) -> Step:
        action = cast(self.action_space, self._action_leaves, action)
        self.state, results = _step(self._static, self._arrays, self._running(), action, active)
        obs, reward, terminated, truncated, success = jax.tree.map(np.asarray, results)
        obs = self._obs = cast(self.observation_space, self._leaves, obs)
        return Step(obs, np.asarray(reward, np.float32), terminated, truncated, success)

    def reset_done(self, done: np.ndarray) -> Observation:
        self.state = _reset_done(self._static, self._arrays, self._running(), np.asarray(done, bool))
        return self._observe()

    def success(self, step: Step, env: int) -> float:
        return success_of({} if step.info is None else {"is_success": step.info[env]})

    def goals(self) -> GoalFunctions | None:
        return goal_functions(self.env)

    def snapshot(self) -> list[np.ndarray] | None:
        arrays = jax.tree.leaves(self.state)
        if not arrays or any(jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in arrays):
            return None
        return [np.asarray(leaf) for leaf in arrays]

    def restore(self, saved: Any, obs: Observation) -> list[int]:
        template = jax.eval_shape(lambda: reset_all(self.env, jax.random.key(0), self.n_envs))
        expected, tree = jax.tree.flatten(template)
        are_arrays = isinstance(saved, list) and all(isinstance(array, np.ndarray) for array in saved)
        if not are_arrays or [(a.shape, a.dtype) for a in saved] != [(leaf.shape, leaf.dtype) for leaf in expected]:
            raise ValueError(f"the snapshot is not of {self.n_envs} environments {self.env_id}")
        self.state = jax.tree.unflatten(tree, [jnp.asarray(array) for array in saved])
        self._obs, self._seed = obs, None
        return []

    def with_env(self, env: FunctionalEnv, seed: Seed = None) -> JaxVector:
        """Returns a vector of ``env`` instead, which replaces this one and has its seeds, or else ``seed``."""
        seed = seed if self._seed is None else self._seed
        vector = JaxVector(env, self.n_envs, seed, env_id=self.env_id, reward_threshold=self.reward_threshold)
        vector.seeds, vector.made_from = self.seeds, self.made_from
        return vector

    def state_of(self, i: int) -> Any:
        """Returns the state of environment ``i`` as NumPy arrays, None before the first reset."""
        return None if self.state is None else jax.tree.map(lambda leaf: np.asarray(leaf[i]), self.state.env)

    def close(self) -> None:
        """Does nothing: there is nothing to close."""

    def _running(self) -> VectorState:
        if self.state is None:
            raise gym.error.ResetNeeded("call reset() before step()")
        return self.state

    def _observe(self) -> Observation:
        self._obs = cast(self.observation_space, self._leaves, jax.tree.map(np.asarray, self._running().obs))
        return self._obs


def streams_of(seed: Seed, n: int) -> Array:
    """Returns the streams of ``n`` environments for a seed; see :class:`JaxVector`."""
    if seed is None or isinstance(seed, int):
        if seed is None or seed >= 2**32:  # of which JAX would ignore the upper bits
            seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
        return streams(jax.random.key(seed), n)
    return jnp.concatenate([streams(jax.random.key(env_seed), 1) for env_seed in seed])


def goal_functions(env: FunctionalEnv) -> GoalFunctions | None:
    """Returns the goal functions of an environment for the host, which take and return NumPy arrays; None without goals."""
    if not isinstance(env, GoalEnv):
        return None
    reward, terminated = (of_two_goals(jax.jit(f)) for f in (env.compute_reward, env.compute_terminated))
    goal = env.observation_space["achieved_goal"]  # type: ignore[index]
    is_judged = jax.eval_shape(terminated, goal.sample(), goal.sample()) is not None
    return GoalFunctions(
        lambda achieved, desired, infos=None: np.asarray(reward(achieved, desired), np.float32),
        (lambda achieved, desired, infos=None: np.asarray(terminated(achieved, desired), bool)) if is_judged else None,
    )
