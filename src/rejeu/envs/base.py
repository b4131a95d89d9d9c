"""The interface of vector environments, which all backends implement, and their seeds.

The contract hides nothing: after a step the observation is the true successor, also where the episode ended, and ended
environments stay ended until :meth:`VectorEnv.reset_done` is called.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import limited
from rejeu.core.types import Info, Observation, PyTree
from rejeu.envs.goals import GoalFunctions

Seed = int | Sequence[int] | None
"""A number ``seed``, so that environment i is seeded with ``seed + i``; one number for each environment; or None."""
SEEDS_END = 2**31 - 1
"""Exclusive upper bound of the seeds of single environments, because EnvPool uses 31 bits."""
OF_ENVIRONMENTS = 0x454E
"""Added to the seed of a run, so that the seeds of its environments differ from all others."""


def checked_seed(seed: object, n_envs: int) -> Seed:
    """Validates a seed for ``n_envs`` environments and returns it, a sequence as a tuple of ints.

    Raises:
        ValueError: if a number is negative, or a sequence does not contain one integer from 0 to 2**31 - 2 for each
            environment.
    """
    if seed is None:
        return None
    if isinstance(seed, int | np.integer) and seed >= 0:
        return int(seed)
    seeds = np.asarray(seed)
    if seeds.shape != (n_envs,):
        raise ValueError(
            f"seed={seed!r} must be a whole number from 0, or a sequence of {n_envs}, one for each environment"
        )
    if seeds.dtype.kind not in "iu" or seeds.min() < 0 or seeds.max() >= SEEDS_END:
        raise ValueError(f"seed={seed!r} must have whole numbers from 0 to 2**31 - 2")
    return tuple(seeds.tolist())


def seed_of_run(seed: int) -> int:
    """Returns the seed of a run's environments, from 0 to 2**31 - 1, for the seed of the run.

    Environment i takes the i-th number after it. Without this, runs with the seeds 0 and 1 would share all their
    environments but one.
    """
    return int(np.random.SeedSequence([seed, OF_ENVIRONMENTS]).generate_state(1)[0] >> 1)


def each_seed(seed: Seed, n_envs: int) -> list[int | None]:
    """Returns the seed of each environment.

    >>> each_seed(5, 3), each_seed((7, 7, 1), 3), each_seed(None, 2)
    ([5, 6, 7], [7, 7, 1], [None, None])
    """
    if seed is None:
        return [None] * n_envs
    return [seed + i for i in range(n_envs)] if isinstance(seed, int) else list(seed)


SUCCESS_KEYS = ("is_success", "success")
"""Keys of an info that say whether the goal was reached, in order of precedence."""


class Step(NamedTuple):
    """The result of one step of all environments."""

    obs: Observation
    """True successors, a pytree of arrays ``(n_envs, ...)``; valid until the next call."""
    reward: np.ndarray
    """``float32 (n_envs,)``."""
    terminated: np.ndarray
    """Whether the MDP ended, ``bool (n_envs,)``."""
    truncated: np.ndarray
    """Whether a time limit ended the episode, ``bool (n_envs,)``."""
    info: Any
    """The backend's own info; read it with :meth:`VectorEnv.success`."""
    returns: np.ndarray | None = None
    """The return of each episode that ended, ``(n_envs,)``, as recorded by a ``Monitor`` inside wrappers that change rewards;
    NaN elsewhere. None if the sum of the rewards is the return."""

    def return_of(self, env: int, total: float) -> float:
        """Returns the return of the episode that ended in environment ``env`` with the sum of rewards ``total``."""
        counted = math.nan if self.returns is None else float(self.returns[env])
        return float(total) if math.isnan(counted) else counted


class VectorEnv(ABC):
    """``n_envs`` environments of one kind."""

    n_envs: int
    observation_space: gym.Space
    """Of one environment."""
    action_space: gym.Space
    """Of one environment; see :meth:`limit_actions`."""
    own_action_space: gym.Space | None = None
    """The environment's own if ``action_space`` is a part of it, else None."""
    backend: str
    """Name of the backend."""
    env_id: str
    """The id of the environments, or the name of their class."""
    made_from: tuple[str, Mapping[str, Any]] | None = None
    """The id and keyword arguments given to :func:`make_vector`; None if it was given something else."""
    max_episode_steps: int | None = None
    """The time limit, None if unknown."""
    reward_threshold: float | None = None
    """The return at which the environment counts as solved, None if it declares none."""
    venv: Any = None
    """The vector environment with automatic resets that this was made from, or that was made of it; None if there is none."""
    wrapped_by: str | None = None
    """Name of the outermost wrapper around the whole vector, if there is one."""
    vec_normalize: Any = None
    """The wrapper that normalizes what the vector returns by running statistics, if there is one."""
    info: Any = None
    """The info of the last step, as :attr:`Step.info`."""
    _obs: Any
    """The observations returned last."""

    seeds: Seed = None
    """One seed for each environment, which a run uses instead of its own seed; None if there are none."""

    def limit_actions(self, share: float) -> None:
        """Makes ``action_space`` the middle ``share`` of the environment's own range, whatever share it was before.

        Raises:
            ValueError: if the actions are not a Box with finite bounds.
        """
        self.own_action_space = self.action_space if self.own_action_space is None else self.own_action_space
        self.action_space = limited(self.own_action_space, share)

    @abstractmethod
    def reset(self, seed: Seed = None) -> Observation:
        """Resets every environment and returns the observations ``(n_envs, ...)``.

        Args:
            seed: a number, after which environment i takes the i-th, or a sequence of one number for each. None lets the
                random numbers continue, at first from the seed that the environments were made with.
        """

    def step(self, action: np.ndarray, active: np.ndarray | None = None) -> Step:
        """Steps every environment, or only the ``active`` ones.

        Inactive environments keep their observation, get the reward 0 and do not end. A Gymnasium vector environment can only
        be stepped as a whole, so there they move on unseen; on any backend, reset them before they are stepped again.

        Args:
            action: in the environment's own range, ``(n_envs, ...)``; the rows of inactive environments are ignored.
            active: ``bool (n_envs,)``; None for all.

        Raises:
            ValueError: if ``active`` is no such array, or leaves out every environment.

        >>> from rejeu.envs.make import make_vector
        >>> vector = make_vector("Pendulum-v1", 2, "gymnasium", seed=0)
        >>> obs = vector.reset().copy()
        >>> step = vector.step(np.ones((2, 1)), active=np.array([True, False]))
        >>> (step.obs == obs).all(axis=1).tolist(), (step.reward == 0.0).tolist()
        ([False, True], [False, True])
        """
        if active is not None:
            self._check_active(active)
        step = self._step_all(action) if active is None or active.all() else self._step_some(action, active)
        self.info = step.info
        return step

    def _check_active(self, active: np.ndarray) -> None:
        if not isinstance(active, np.ndarray) or active.dtype != bool or active.shape != (self.n_envs,):
            raise ValueError(f"active={active!r} must be a bool array of shape ({self.n_envs},), or None for all")
        if not active.any():
            raise ValueError("active leaves out every environment, so there is nothing to step")

    @abstractmethod
    def _step_all(self, action: np.ndarray) -> Step:
        """Steps every environment."""

    @abstractmethod
    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        """Steps those that are ``active``, which are neither none nor all."""

    @abstractmethod
    def reset_done(self, done: np.ndarray) -> Observation:
        """Starts new episodes where ``done``, ``bool (n_envs,)``; returns the observations of all environments."""

    @abstractmethod
    def success(self, step: Step, env: int) -> float:
        """Returns 1.0 if environment ``env`` reached its goal in ``step``, 0.0 if not, NaN if unknown."""

    def judge(self, step: Step, env: int, episode_return: float, threshold: float | None) -> float:
        """Returns 1.0 if the episode of environment ``env`` that ended in ``step`` succeeded, 0.0 if not.

        Where the environment does not say so itself, an episode succeeds whose return is at least ``threshold``, or the
        environment's own reward threshold if that is None; NaN where there is neither.
        """
        threshold = self.reward_threshold if threshold is None else threshold
        return success_by(self.success(step, env), episode_return, threshold)

    @abstractmethod
    def goals(self) -> GoalFunctions | None:
        """Returns the goal functions, or None for environments without goals."""

    def infos(self, begun: bool = False) -> list[Info]:
        """Returns the info of each environment: that of its last step, or with ``begun`` of its last reset."""
        return each_info(self.info, self.n_envs, begun)

    def call(self, name: str) -> list[Any]:
        """Returns the result of a method without arguments in each environment, also in worker processes.

        Raises:
            AttributeError: if there is no such method, or the environments cannot be accessed.
        """
        raise AttributeError(f"single environments of the {self.backend} backend cannot be accessed")

    def identities(self) -> set[int]:
        """Returns the ids of the vector and, where they are known, of the environments in it.

        Two vectors share environments if these sets intersect.
        """
        return {id(self)}

    @property
    def must_reset(self) -> bool:
        """Whether the next call must be :meth:`reset`; an agent begins new episodes then."""
        return False

    def record(self) -> None:  # noqa: B027
        """Prepares for :meth:`snapshot`, where that takes more than the environments; called before checkpoints are made."""

    def snapshot(self) -> Any:
        """Returns the state of the running environments as plain data (see :mod:`rejeu.core.records`).

        None where the backend or an environment does not offer it.
        """
        return None

    def restore(self, saved: object, obs: Observation) -> list[int]:
        """Restores what :meth:`snapshot` returned, into environments of the same kind.

        Args:
            saved: the snapshot.
            obs: the observations at that moment, a pytree of arrays ``(n_envs, ...)``.

        Returns:
            Which environments must be reset before they can be stepped, as far as they say so.

        Raises:
            ValueError: if the snapshot is damaged or of other environments.
            DivergedError: if the environments do not repeat what was recorded, or cannot put their state back.
        """
        raise ValueError(f"there is no snapshot of environments of the {self.backend} backend")

    @abstractmethod
    def close(self) -> None:
        """Closes the environments."""

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self.n_envs} x {self.env_id}, backend {self.backend!r}>"


def describe_spec(env: gym.Env | gym.vector.VectorEnv) -> tuple[str, int | None, float | None]:
    """Returns id or name of the class, time limit and reward threshold of an environment or a vector of Gymnasium."""
    if env.spec is None:
        return type(env.unwrapped).__name__, None, None
    limit = env.spec.max_episode_steps
    if limit is None and env.spec.id.startswith("parking-"):  # which ends its episodes itself, after so many seconds
        config = env.unwrapped.config  # type: ignore[union-attr]
        limit = round(config["duration"] * config["policy_frequency"])
    elif limit is None and isinstance(declared := getattr(env.unwrapped, "max_episode_steps", None), int):
        limit = declared
    return env.spec.id, limit, env.spec.reward_threshold


def each_info(info: Any, n_envs: int, begun: bool = False) -> list[Info]:
    """Returns the info of each environment, of a list or of Gymnasium's dict of arrays; empty ones of anything else.

    With ``begun`` it is that of the reset, where an environment was reset in the same step.

    >>> each_info({"x": np.array([1, 0]), "_x": np.array([True, False])}, 2)
    [{'x': np.int64(1)}, {}]
    """
    if isinstance(info, list):
        return info
    infos: list[Info] = [{} for _ in range(n_envs)]
    for key, values in info.items() if isinstance(info, dict) else ():
        each = each_info(values, n_envs) if isinstance(values, dict) else values
        if not key.startswith("_") and np.shape(each)[:1] == (n_envs,):
            for i in np.flatnonzero(info.get(f"_{key}", np.ones(n_envs))).tolist():
                infos[i][key] = each[i]
    return infos if begun else [each.get("final_info", each) for each in infos]


def success_by(reported: float, episode_return: float, threshold: float | None) -> float:
    """Returns whether an episode succeeded: as ``reported`` by the environment, or by its return if that is NaN.

    >>> success_by(0.0, 500.0, 475.0), success_by(math.nan, 500.0, 475.0), success_by(math.nan, 500.0, None)
    (0.0, 1.0, nan)
    """
    return reported if threshold is None or not math.isnan(reported) else float(episode_return >= threshold)


def success_of(info: Info) -> float:
    """Returns whether ``is_success`` or ``success`` in an info is true, or all its numbers are at least 1: 1.0 or 0.0.

    NaN without either, and where it is no number: then nothing is known.

    Raises:
        BadEnvironmentError: if the info is not a dict.
    """
    if not isinstance(info, dict):
        raise BadEnvironmentError(f"step returned the info {info!r:.80}, expected a dict; return {{}} to say nothing")
    value = np.asarray(info.get("is_success", info.get("success")))
    return float((value >= 1).all()) if value.dtype.kind in "biuf" and not np.isnan(value).any() else math.nan


def step_whole(step_all: Callable[[np.ndarray], Step], before: PyTree, action: np.ndarray, active: np.ndarray) -> Step:
    """Steps environments that can only be stepped together, and returns the step of the ``active`` ones.

    The others get an action of one that is active, and keep their observations ``before``, ``(n_envs, ...)``.
    """
    of_active = lambda leaf: np.where(active.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, leaf[np.argmax(active)])  # noqa: E731
    unchanged = jax.tree.map(lambda leaf: leaf[~active], before)
    step = step_all(jax.tree.map(of_active, action))
    reward = np.where(active, step.reward, np.float32(0.0))
    flags = {"terminated": step.terminated & active, "truncated": step.truncated & active}
    return step._replace(obs=with_rows(step.obs, ~active, unchanged), reward=reward, **flags)


def with_rows(batch: PyTree, rows: np.ndarray, values: PyTree) -> PyTree:
    """Returns a copy of a batch of arrays whose ``rows``, indices or a mask, are ``values``."""
    batch = jax.tree.map(np.copy, batch)
    for array, array_values in zip(jax.tree.leaves(batch), jax.tree.leaves(values), strict=True):
        array[rows] = array_values
    return batch
