"""A vector environment with automatic resets, wrappers included, as one without them: what agents step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from rejeu.envs import answers, faults, goals as goals_module
from rejeu.envs.auto_reset import AutoResetView, DummyVecEnv
from rejeu.envs.base import Step, VectorEnv, success_of
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.in_process import InProcess
from rejeu.envs.seeds import Seed
from rejeu.envs.vec_env import VecEnv, is_vecenv_wrapped
from rejeu.envs.vec_normalize import VecNormalize
from rejeu.errors import BadEnvironmentError
from rejeu.spaces import leaves, plain

TERMINAL = "terminal_observation"
"""Where an info has what an episode ended in."""
TIME_LIMIT = "TimeLimit.truncated"
"""Where an info says whether a time limit alone ended the episode."""


def without_resets(venv: VecEnv, seed: Seed = None) -> VectorEnv:
    """Returns the environments of a vector that resets itself.

    Those of a :class:`DummyVecEnv` itself are stepped directly, which costs least; wrappers, other classes and classes
    derived from it are stepped as they are.
    """
    if isinstance(venv, AutoResetView):
        return venv.vector
    if type(venv) is DummyVecEnv:
        return InProcess(venv.envs, seed, venv)
    return SelfResetting(venv, seed)


class SelfResetting(VectorEnv):
    """A vector environment with automatic resets, which are undone: successors are taken from the infos."""

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
        self.n_steps = 0
        """How often the vector was stepped."""
        self._seed = None if seed is None else self._one(seed)
        self._leaves = leaves(self.observation_space)
        self._after_reset: Any = None
        """The observations that the last step showed, new episodes' first ones included."""
        self._strayed = np.zeros(self.n_envs, bool)
        """Which have moved on unseen and were not reset since."""

    def reset(self, seed: Seed = None) -> Any:
        seed = self._seed if seed is None else seed
        self._seed = None
        if seed is not None:
            self.venv.seed(self._one(seed))
        self._strayed = np.zeros(self.n_envs, bool)
        self._obs = self._after_reset = self._cast(self.venv.reset())
        return self._obs

    def _one(self, seed: int | Sequence[int]) -> int:
        """Returns a seed that is one number.

        Raises:
            ValueError: if it is several.
        """
        if isinstance(seed, int):
            return seed
        raise ValueError(
            f"seed={seed}: {type(self.venv).__name__} takes one number and seeds its environments itself; give one number, "
            "or make the environments by rejeu.make_vector, which takes a seed for each"
        )

    def _step_all(self, action: np.ndarray) -> Step:
        self.n_steps += 1
        answer = self.venv.step(action)
        if not isinstance(answer, tuple) or len(answer) != 4:
            raise self._bad(f"step returned {faults.described(answer)}, expected (obs, rewards, dones, infos)")
        shown, reward, dones, infos = answer
        try:
            done = answers.for_each("dones", dones, self.n_envs, bool)
            reward = answers.for_each("rewards", reward, self.n_envs, np.float32)
        except BadEnvironmentError as error:
            raise self._bad(f"step returned {error}") from error.__cause__
        for i, info in enumerate(infos):
            if not isinstance(info, dict):
                raise self._bad(
                    f"step returned infos[{i}]={info!r:.40}, expected a dict; {{}} if there is nothing to say"
                )
        truncated = np.array([bool(info.get(TIME_LIMIT, False)) for info in infos]) & done
        obs = self._after_reset = self._cast(shown)
        returns = None
        if done.any():
            obs = jax.tree.map(np.copy, obs)
            returns = np.full(self.n_envs, np.nan)
            for i in np.flatnonzero(done).tolist():
                self._put(obs, i, infos[i])
                returns[i] = np.asarray(infos[i].get("episode", {}).get("r", np.nan)).item()
        self._obs = obs
        return Step(obs, reward, done & ~truncated, truncated, infos, returns)

    def _put(self, obs: Any, i: int, info: dict[str, Any]) -> None:
        """Puts what the episode of environment ``i`` ended in into a batch of observations."""
        if TERMINAL not in info:
            raise BadEnvironmentError(
                f"an episode ended in environment {i} of {type(self.venv).__name__}, and infos[{i}] has no {TERMINAL!r}; "
                "step_wait must put the last observation there before it resets the environment"
            )
        last = jax.tree.leaves(plain(self.observation_space, info[TERMINAL]))
        for store, part in zip(jax.tree.leaves(obs), last, strict=True):
            if np.shape(part) != store.shape[1:]:
                raise BadEnvironmentError(
                    f"infos[{i}][{TERMINAL!r}] has the shape {np.shape(part)}, and observations have {store.shape[1:]}; a "
                    f"wrapper that changes observations must change it too: is one of {type(self.venv).__name__}'s missing it?"
                )
            store[i] = part

    def _step_some(self, action: np.ndarray, active: np.ndarray) -> Step:
        rest = ~active
        before = jax.tree.map(lambda leaf: leaf[rest], self._obs)
        action = np.array(action)
        action[rest] = action[np.argmax(active)]  # the rows of those left out may hold anything, yet are stepped
        step = self._step_all(action)
        self._strayed |= rest
        self._obs = jax.tree.map(np.copy, step.obs)
        jax.tree.map(lambda whole, old: whole.__setitem__(rest, old), self._obs, before)
        return step._replace(
            obs=self._obs,
            reward=np.where(active, step.reward, np.float32(0.0)),
            terminated=step.terminated & active,
            truncated=step.truncated & active,
        )

    def reset_done(self, done: np.ndarray) -> Any:
        done = np.asarray(done, bool)
        if not (done & self._strayed).any():
            self._obs = self._after_reset
        elif done.all():
            self._obs = self.reset()
        else:
            raise ValueError(
                f"{type(self.venv).__name__} resets by itself and was stepped while some environments were left out, so "
                "those cannot begin anew one by one; use rejeu.make_vector, or leave n_episodes out"
            )
        self._strayed = self._strayed & ~done
        return self._obs

    def success(self, step: Step, env: int) -> float:
        return success_of(step.info[env])

    def goals(self) -> GoalFunctions | None:
        if is_vecenv_wrapped(self.venv, VecNormalize):
            raise ValueError(
                "hindsight computes rewards from goals, and VecNormalize shows scaled ones; leave it out and let the "
                "agent scale: normalize=True"
            )
        if not self.venv.has_attr("compute_reward"):
            return None
        return GoalFunctions(goals_module.over_batches(self._remote("compute_reward"), np.float32), self._terminated())

    def _terminated(self) -> Any:
        if not self.venv.has_attr("compute_terminated"):
            return None
        return goals_module.over_batches(self._remote("compute_terminated"), np.bool_)

    def _remote(self, name: str) -> Any:
        """Returns a method of the first environment, wherever that is, as a function."""
        return lambda achieved, desired, info: self.venv.env_method(name, achieved, desired, info, indices=[0])[0]

    def close(self) -> None:
        self.venv.close()

    def _cast(self, obs: Any) -> Any:
        try:
            return answers.batch(self.observation_space, self._leaves, self.n_envs, obs)
        except BadEnvironmentError as error:
            raise self._bad(f"it returned {error}") from error.__cause__

    def _bad(self, fault: str) -> BadEnvironmentError:
        return BadEnvironmentError(faults.blamed(self.env_id, None, self.n_steps, fault))


def _first_attr(venv: VecEnv, name: str) -> Any:
    """Returns an attribute of the first environment, None where the class does not say."""
    try:
        found = venv.get_attr(name, 0)
    except (AttributeError, NotImplementedError):
        return None
    return found[0] if found else None
