"""Buffers of experience with Stable-Baselines3's constructors and methods, in NumPy.

They are for scripts that store and sample transitions themselves, and what ``model.replay_buffer`` and
``model.rollout_buffer`` return. Agents learn from :mod:`rejeu.buffers`, which store each observation once. ``to_torch``
returns NumPy arrays.
"""

from __future__ import annotations

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from gymnasium import spaces

from rejeu.buffers.ring import LAST, TERMINATED
from rejeu.sb3.common.preprocessing import get_action_dim, get_obs_shape
from rejeu.sb3.common.type_aliases import (
    DictReplayBufferSamples,
    DictRolloutBufferSamples,
    ReplayBufferSamples,
    RolloutBufferSamples,
)
from rejeu.sb3.common.utils import Tensor, get_device
from rejeu.sb3.common.vec_env.base_vec_env import TIME_LIMIT_TRUNCATED

__all__ = [
    "BaseBuffer",
    "DictReplayBuffer",
    "DictRolloutBuffer",
    "HerReplayBuffer",
    "NStepReplayBuffer",
    "ReplayBuffer",
    "RolloutBuffer",
]


def by_leaf(function: Callable[..., Any], *observations: Any) -> Any:
    """Returns a function of arrays applied to observations, key by key where they are dicts."""
    if isinstance(observations[0], dict):
        return {key: by_leaf(function, *(one[key] for one in observations)) for key in observations[0]}
    return function(*observations)


class BaseBuffer(ABC):
    """Rows of ``n_envs`` steps each. Abstract.

    Args:
        buffer_size: number of steps, over all environments for a replay buffer.
        observation_space: Dict or not.
        action_space: space of the actions.
        device: accepted; arrays are NumPy's.
        n_envs: number of environments.
    """

    observations: Any
    actions: np.ndarray
    rewards: np.ndarray

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: Any = "auto",
        n_envs: int = 1,
    ) -> None:
        self.buffer_size, self.n_envs, self.device = buffer_size, n_envs, get_device(device)
        self.observation_space, self.action_space = observation_space, action_space
        self.obs_shape, self.action_dim = get_obs_shape(observation_space), get_action_dim(action_space)
        self.pos, self.full = 0, False

    @abstractmethod
    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> Any:
        """Returns the rows of these indices."""

    def _empty_obs(self) -> Any:
        lead = (self.buffer_size, self.n_envs)
        make = lambda shape, space: np.zeros((*lead, *shape), space.dtype)  # noqa: E731
        space = self.observation_space
        return by_leaf(make, self.obs_shape, dict(space.spaces) if isinstance(space, spaces.Dict) else space)

    def _put(self, store: Any, obs: Any) -> None:
        def write(array: np.ndarray, part: Any) -> None:
            array[self.pos] = np.array(part).reshape(array.shape[1:])

        by_leaf(write, store, obs)

    def size(self) -> int:
        """Returns the number of rows that hold steps."""
        return self.buffer_size if self.full else self.pos

    def add(self, *args: Any, **kwargs: Any) -> None:
        """Adds one step of every environment."""
        raise NotImplementedError

    def extend(self, *args: Any, **kwargs: Any) -> None:
        """Adds several rows, with the arguments of :meth:`add` and a leading axis."""
        for row in zip(*args, strict=True):
            self.add(*row)

    def reset(self) -> None:
        """Empties the buffer."""
        self.pos, self.full = 0, False

    def sample(self, batch_size: int, env: Any = None) -> Any:
        """Returns ``batch_size`` rows drawn with replacement; a ``VecNormalize`` as ``env`` scales them."""
        return self._get_samples(np.random.randint(0, self.size(), batch_size), env)  # noqa: NPY002 - as scripts seed it

    def to_torch(self, array: Any, copy: bool = True) -> Tensor:
        """Returns a NumPy array with the methods of tensors."""
        return Tensor.of(np.array(array) if copy else array)

    @staticmethod
    def swap_and_flatten(arr: np.ndarray) -> np.ndarray:
        """Returns ``(n_steps, n_envs, ...)`` as ``(n_envs * n_steps, ...)``."""
        arr = arr[..., None] if arr.ndim < 3 else arr
        return arr.swapaxes(0, 1).reshape(-1, *arr.shape[2:])

    @staticmethod
    def _normalize_obs(obs: Any, env: Any = None) -> Any:
        return obs if env is None else by_leaf(Tensor.of, env.normalize_obs(obs))

    @staticmethod
    def _normalize_reward(reward: np.ndarray, env: Any = None) -> np.ndarray:
        return reward if env is None else env.normalize_reward(reward).astype(np.float32)


class ReplayBuffer(BaseBuffer):
    """A replay buffer with one-step transitions.

    Args:
        buffer_size: number of steps, over all environments.
        observation_space: space of the observations.
        action_space: space of the actions.
        device: accepted.
        n_envs: number of environments.
        optimize_memory_usage: accepted without effect.
        handle_timeout_termination: do not count the ends by a time limit as terminal.
    """

    core: Any = None
    """The buffer of an agent that this one shows; None for a buffer of its own."""
    agent: Any = None
    """That agent."""
    SHOWN = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: Any = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
    ) -> None:
        super().__init__(max(buffer_size // n_envs, 1), observation_space, action_space, device, n_envs)
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.observations, self.next_observations = self._empty_obs(), self._empty_obs()
        lead = (self.buffer_size, n_envs)
        self.actions = np.zeros((*lead, self.action_dim), self._maybe_cast_dtype(action_space.dtype))
        self.rewards, self.dones, self.timeouts = (np.zeros(lead, np.float32) for _ in range(3))

    @classmethod
    def of(cls, agent: Any) -> Any:
        """Returns the replay buffer of an agent as one of this class; arrays are copied when they are asked for."""
        core = agent.run.replay
        buffer = cls.__new__(cls)
        ring = core.ring
        BaseBuffer.__init__(buffer, ring.rows, agent.observation_space, agent.action_space, agent.device, ring.n_envs)
        buffer.core, buffer.agent, buffer.device = core, agent, agent.device
        buffer.optimize_memory_usage, buffer.handle_timeout_termination = False, True
        buffer.pos = int(ring.n_steps.min())
        buffer.full = bool((ring.head >= ring.rows).all())
        return buffer

    def __getattr__(self, name: str) -> Any:
        if name not in self.SHOWN or self.core is None:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        ring, n = self.core.ring, self.pos
        times = [np.arange(ring.oldest()[env], ring.head[env]) for env in range(ring.n_envs)]
        kept = [t[ring.kind[ring.index(np.full(len(t), env), t)] != LAST][-n:] for env, t in enumerate(times)]
        time = np.stack(kept, axis=1).ravel() if n else np.zeros(0, int)
        envs = np.tile(np.arange(ring.n_envs), n)
        following = ring.index(envs, time + 1)
        step, obs = ring.read(ring.index(envs, time))
        shaped = lambda array: np.array(array).reshape(n, ring.n_envs, *array.shape[1:])  # noqa: E731
        tree = lambda leaves: ring.tree([shaped(leaf) for leaf in leaves])  # noqa: E731
        terminated = ring.kind[ring.index(envs, time)] == TERMINATED
        ended = terminated | (ring.kind[following] == LAST)
        self.observations, self.next_observations = tree(obs), tree(ring.read(following)[1])
        self.actions, self.rewards = shaped(step["action"]), shaped(step["reward"])
        self.dones, self.timeouts = shaped(ended.astype(np.float32)), shaped((ended & ~terminated).astype(np.float32))
        return self.__dict__[name]

    def __deepcopy__(self, memo: Any) -> Any:
        """Returns an independent copy, which shows no agent's buffer."""
        new = self.__class__.__new__(self.__class__)
        shown = {name: getattr(self, name) for name in self.SHOWN}
        others = {key: value for key, value in vars(self).items() if key not in ("core", "agent", "env")}
        new.__dict__.update(copy.deepcopy(others | shown, memo))
        if "env" in vars(self):
            new.__dict__["env"] = self.__dict__["env"]
        if self.core is not None:
            new.buffer_size = max(new.pos, 1)
            new.pos, new.full = 0, new.size() > 0
        return new

    def add(
        self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray, infos: Any
    ) -> None:
        """Adds one step of every environment.

        Args:
            obs: observations before the step, ``(n_envs, ...)``.
            next_obs: those after it, the final ones where an episode ended.
            action: ``(n_envs, action_dim)``, in [-1, 1] for an agent's buffer.
            reward: ``(n_envs,)``.
            done: whether an episode ended, ``(n_envs,)``.
            infos: one dict for each environment; ``TimeLimit.truncated`` says whether only a time limit ended it.
        """
        timeouts = np.array([bool(info.get(TIME_LIMIT_TRUNCATED, False)) for info in infos])
        if self.core is not None:
            self._add_to_core(obs, next_obs, action, reward, np.asarray(done, bool) & ~timeouts)
            return
        self._put(self.observations, obs)
        self._put(self.next_observations, next_obs)
        self.actions[self.pos] = np.array(action).reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos], self.dones[self.pos] = reward, done
        self.timeouts[self.pos] = timeouts if self.handle_timeout_termination else 0.0
        self.pos += 1
        if self.pos == self.buffer_size:
            self.full, self.pos = True, 0

    def _add_to_core(self, obs: Any, next_obs: Any, action: Any, reward: Any, terminated: np.ndarray) -> None:
        """Adds a step to the buffer of the agent, whose running episodes end."""
        ring = self.core.ring
        kind = type(self.core)  # whose methods take what is given, also where an agent's are those of Scaled
        kind.begin(self.core, obs)
        actions = np.asarray(action, ring.action.dtype).reshape(ring.n_envs, *ring.action.shape[1:])
        kind.add(self.core, actions, np.asarray(reward, np.float32), terminated, next_obs)
        for name in self.SHOWN:
            self.__dict__.pop(name, None)
        self.pos = int(ring.n_steps.min())
        self.agent.abandon_episodes()

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> ReplayBufferSamples:
        envs = np.random.randint(0, self.n_envs, len(batch_inds))  # noqa: NPY002
        return self._samples(batch_inds, envs, batch_inds, env)

    def _samples(self, first: np.ndarray, envs: np.ndarray, last: np.ndarray, env: Any) -> ReplayBufferSamples:
        """Returns transitions from the rows ``first`` to the rows ``last``, with the rewards of ``first``."""
        pick = lambda array, rows: by_leaf(lambda leaf: self.to_torch(leaf[rows, envs]), array)  # noqa: E731
        terminal = self.dones[last, envs] * (1 - self.timeouts[last, envs])
        kind = DictReplayBufferSamples if isinstance(self.observations, dict) else ReplayBufferSamples
        return kind(
            self._normalize_obs(pick(self.observations, first), env),
            self.to_torch(self.actions[first, envs]).reshape(len(first), -1),
            self._normalize_obs(pick(self.next_observations, last), env),
            self.to_torch(np.reshape(terminal, (-1, 1))),
            self.to_torch(self._normalize_reward(np.reshape(self.rewards[first, envs], (-1, 1)), env)),
        )

    @staticmethod
    def _maybe_cast_dtype(dtype: Any) -> Any:
        return np.float32 if dtype == np.float64 else dtype


class DictReplayBuffer(ReplayBuffer):
    """A replay buffer for Dict observations."""


class NStepReplayBuffer(ReplayBuffer):
    """A replay buffer with n-step returns.

    Args:
        args: those of :class:`ReplayBuffer`.
        n_steps: number of rewards that are summed.
        gamma: discount factor.
        kwargs: those of :class:`ReplayBuffer`.
    """

    def __init__(self, *args: Any, n_steps: int = 3, gamma: float = 0.99, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.n_steps, self.gamma = n_steps, gamma

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> ReplayBufferSamples:
        envs = np.random.randint(0, self.n_envs, len(batch_inds))  # noqa: NPY002
        rows = (batch_inds[:, None] + np.arange(self.n_steps)) % self.buffer_size
        ends = (self.dones[rows, envs[:, None]] + self.timeouts[rows, envs[:, None]]) > 0
        ends |= rows == (self.pos - 1) % self.buffer_size  # what follows the newest row is the oldest
        steps = np.where(ends.any(axis=1), ends.argmax(axis=1) + 1, self.n_steps)
        rewards = self._normalize_reward(self.rewards[rows, envs[:, None]], env)
        weights = self.gamma ** np.arange(self.n_steps) * (np.arange(self.n_steps) < steps[:, None])
        samples = self._samples(batch_inds, envs, rows[np.arange(len(rows)), steps - 1], env)
        return samples._replace(
            rewards=self.to_torch(np.sum(rewards * weights, axis=1, keepdims=True, dtype=np.float32)),
            discounts=self.to_torch((self.gamma**steps).astype(np.float32).reshape(-1, 1)),
        )


class HerReplayBuffer(ReplayBuffer):
    """A replay buffer that gives most sampled transitions a goal that was reached later (hindsight experience replay).

    Args:
        buffer_size: number of steps, over all environments.
        observation_space: Dict with ``observation``, ``achieved_goal`` and ``desired_goal``.
        action_space: space of the actions.
        env: a vector environment whose ``compute_reward`` gives the rewards.
        device: accepted.
        n_envs: number of environments.
        optimize_memory_usage: accepted without effect.
        handle_timeout_termination: do not count the ends by a time limit as terminal.
        n_sampled_goal: transitions with a new goal for each one without.
        goal_selection_strategy: ``"future"``, ``"final"`` or ``"episode"``.
        copy_info_dict: pass ``compute_reward`` the infos of the steps instead of empty ones.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        env: Any,
        device: Any = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_sampled_goal: int = 4,
        goal_selection_strategy: Any = "future",
        copy_info_dict: bool = False,
    ) -> None:
        flags = (optimize_memory_usage, handle_timeout_termination)
        super().__init__(buffer_size, observation_space, action_space, device, n_envs, *flags)
        self.env, self.n_sampled_goal, self.copy_info_dict = env, n_sampled_goal, copy_info_dict
        self.goal_selection_strategy = getattr(goal_selection_strategy, "value", goal_selection_strategy)
        self.her_ratio = n_sampled_goal / (n_sampled_goal + 1)
        self.infos = np.array([[{} for _ in range(n_envs)] for _ in range(self.buffer_size)])
        self.ep_start, self.ep_length = (np.zeros((self.buffer_size, n_envs), np.int64) for _ in range(2))
        self._current_ep_start = np.zeros(n_envs, np.int64)

    def set_env(self, env: Any) -> None:
        """Sets the environment whose rewards are used."""
        self.env = env

    def add(
        self, obs: Any, next_obs: Any, action: np.ndarray, reward: np.ndarray, done: np.ndarray, infos: Any
    ) -> None:
        """Adds one step of every environment; see :meth:`ReplayBuffer.add`."""
        if self.core is None:
            for env in np.flatnonzero(self.ep_length[self.pos]):  # an episode that is overwritten cannot be drawn
                self._set_length(env, self.ep_start[self.pos, env], self.ep_length[self.pos, env], 0)
            self.ep_start[self.pos] = self._current_ep_start
            if self.copy_info_dict:
                self.infos[self.pos] = infos
        super().add(obs, next_obs, action, reward, done, infos)
        if self.core is None:
            for env in np.flatnonzero(done):
                self._end_episode(env)

    def _set_length(self, env: Any, start: Any, length: Any, value: int) -> None:
        self.ep_length[np.arange(start, start + length) % self.buffer_size, env] = value

    def _end_episode(self, env: Any) -> None:
        start = self._current_ep_start[env]
        length = (self.pos - start) % self.buffer_size or self.buffer_size
        self._set_length(env, start, length, length)
        self._current_ep_start[env] = self.pos

    def truncate_last_trajectory(self) -> None:
        """Ends the running episodes, so that they can be drawn; warns if there are any."""
        running = np.flatnonzero(self._current_ep_start != self.pos)
        if len(running):
            warnings.warn("The last trajectory in the replay buffer will be truncated.", UserWarning, stacklevel=2)
        for env in running:
            self.dones[self.pos - 1, env] = True
            self.timeouts[self.pos - 1, env] = float(self.handle_timeout_termination)
            self._end_episode(env)

    def sample(self, batch_size: int, env: Any = None) -> ReplayBufferSamples:
        """Returns transitions of finished episodes, drawn with replacement.

        Raises:
            RuntimeError: if no episode has ended.
        """
        rows, envs = np.nonzero(self.ep_length > 0)
        if not len(rows):
            raise RuntimeError("no episode has ended, so there is none to draw from; take more steps first")
        drawn = np.random.randint(0, len(rows), batch_size)  # noqa: NPY002
        rows, envs = rows[drawn], envs[drawn]
        samples = self._samples(rows, envs, rows, None)
        n = int(self.her_ratio * batch_size)
        observations, following = samples.observations, samples.next_observations
        goals = self._sample_goals(rows[:n], envs[:n])
        observations["desired_goal"][:n] = goals
        following["desired_goal"][:n] = goals
        rewards = samples.rewards
        if n:
            infos: Any = self.infos[rows[:n], envs[:n]] if self.copy_info_dict else [{} for _ in range(n)]
            reached = following["achieved_goal"][:n]
            computed = self.env.env_method("compute_reward", reached, goals, infos, indices=[0])[0]
            rewards[:n] = np.asarray(computed, np.float32).reshape(-1, 1)
        return samples._replace(
            observations=self._normalize_obs(observations, env),
            next_observations=self._normalize_obs(following, env),
            rewards=self._normalize_reward(rewards, env),
        )

    def _sample_goals(self, rows: np.ndarray, envs: np.ndarray) -> np.ndarray:
        """Returns the goals that were achieved in the rows that the strategy chooses."""
        start, length = self.ep_start[rows, envs], self.ep_length[rows, envs]
        since = (rows - start) % self.buffer_size
        first = {"future": since, "final": length - 1, "episode": np.zeros_like(since)}[self.goal_selection_strategy]
        chosen = np.random.randint(first, length)  # noqa: NPY002
        return self.next_observations["achieved_goal"][(start + chosen) % self.buffer_size, envs].copy()


class RolloutBuffer(BaseBuffer):
    """The steps of one rollout, with their advantages.

    Args:
        buffer_size: steps of each environment.
        observation_space: space of the observations.
        action_space: space of the actions.
        device: accepted.
        gae_lambda: lambda of generalized advantage estimation (arXiv 1506.02438).
        gamma: discount factor.
        n_envs: number of environments.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: Any = "auto",
        gae_lambda: float = 1,
        gamma: float = 0.99,
        n_envs: int = 1,
    ) -> None:
        super().__init__(buffer_size, observation_space, action_space, device, n_envs)
        self.gae_lambda, self.gamma = gae_lambda, gamma
        self.reset()

    def reset(self) -> None:
        """Empties the buffer."""
        super().reset()
        lead = (self.buffer_size, self.n_envs)
        self.observations = self._empty_obs()
        self.actions = np.zeros((*lead, self.action_dim), self.action_space.dtype)
        self.rewards, self.episode_starts, self.values, self.log_probs, self.advantages, self.returns = (
            np.zeros(lead, np.float32) for _ in range(6)
        )

    def add(
        self, obs: Any, action: np.ndarray, reward: np.ndarray, episode_start: np.ndarray, value: Any, log_prob: Any
    ) -> None:
        """Adds one step of every environment; ``episode_start`` says whether an episode begins with it."""
        self._put(self.observations, obs)
        self.actions[self.pos] = np.array(action).reshape(self.n_envs, self.action_dim)
        self.rewards[self.pos], self.episode_starts[self.pos] = reward, episode_start
        self.values[self.pos], self.log_probs[self.pos] = np.ravel(value), np.ravel(log_prob)
        self.pos += 1
        self.full = self.pos == self.buffer_size

    def compute_returns_and_advantage(self, last_values: Any, dones: np.ndarray) -> None:
        """Computes ``advantages`` by GAE, and ``returns``: the advantages plus the values.

        Args:
            last_values: values of the observations after the last step, ``(n_envs,)``.
            dones: whether an episode ended with the last step, ``(n_envs,)``.
        """
        continues = np.concatenate([1.0 - self.episode_starts[1:], 1.0 - np.asarray(dones, np.float32)[None]])
        values = np.concatenate([self.values, np.ravel(last_values).astype(np.float32)[None]])
        advantage = np.zeros(self.n_envs)
        for t in reversed(range(self.buffer_size)):
            error = self.rewards[t] + self.gamma * continues[t] * values[t + 1] - values[t]
            advantage = error + self.gamma * self.gae_lambda * continues[t] * advantage
            self.advantages[t] = advantage
        self.returns = self.advantages + self.values

    def get(self, batch_size: int | None = None) -> Iterator[RolloutBufferSamples]:
        """Yields minibatches in random order; None for one of all steps.

        Raises:
            AssertionError: if the buffer is not full.
        """
        if not self.full:
            raise AssertionError(f"the rollout has {self.pos} of {self.buffer_size} steps")
        order = np.random.permutation(self.buffer_size * self.n_envs)  # noqa: NPY002
        for start in range(0, len(order), batch_size or len(order)):
            yield self._get_samples(order[start : start + (batch_size or len(order))])

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> RolloutBufferSamples:
        flat = lambda array: by_leaf(lambda leaf: self.to_torch(self.swap_and_flatten(leaf)[batch_inds]), array)  # noqa: E731
        parts = (self.values, self.log_probs, self.advantages, self.returns)
        kind = DictRolloutBufferSamples if isinstance(self.observations, dict) else RolloutBufferSamples
        return kind(
            flat(self.observations), flat(self.actions).astype(np.float32), *(flat(part).reshape(-1) for part in parts)
        )


class DictRolloutBuffer(RolloutBuffer):
    """A rollout buffer for Dict observations."""
