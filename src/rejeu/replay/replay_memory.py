"""A replay memory for custom training loops: ``push``, ``sample``, ``len``."""

from __future__ import annotations

import gymnasium as gym
import jax
import numpy as np

from rejeu.core import spaces
from rejeu.core.algorithm import Transition
from rejeu.core.types import Action, Observation
from rejeu.core.validation import number, whole
from rejeu.replay.ring import check_memory


class ReplayMemory:
    """Stores the latest ``capacity`` transitions and samples batches uniformly, with replacement.

    The agents use :class:`rejeu.ReplayBuffer`, which stores each observation once and keeps track of episodes. This
    class takes single transitions from any source.

    Args:
        capacity: maximum number of transitions. The oldest are overwritten.
        observation_space: the observation space, with any nesting of Dict and Tuple.
        action_space: a Box or Discrete space.
        gamma: discount factor per step, in [0, 1].
        seed: seed of the sampling. None draws a seed.

    Raises:
        MemoryError: if the memory of the machine is too small. The message states the sizes.

    >>> space = gym.spaces.Box(-1.0, 1.0, (2,))
    >>> memory = ReplayMemory(1000, space, gym.spaces.Discrete(3), gamma=0.5, seed=0)
    >>> memory.push([0.0, 0.5], 2, 1.0, [0.5, 0.5], terminated=False)
    >>> len(memory)
    1
    >>> batch = memory.sample(4)
    >>> batch.obs.shape, batch.action.tolist(), batch.discount.tolist()
    ((4, 2), [2, 2, 2, 2], [0.5, 0.5, 0.5, 0.5])
    """

    def __init__(
        self,
        capacity: int,
        observation_space: gym.Space,
        action_space: gym.Space,
        gamma: float = 0.99,
        seed: int | None = None,
    ) -> None:
        self.capacity = whole("capacity", capacity, least=1)
        self.gamma = number("gamma", gamma, least=0, most=1)
        self.observation_space, self.action_space = observation_space, action_space
        if not isinstance(action_space, gym.spaces.Box | gym.spaces.Discrete):
            raise ValueError(f"a replay memory takes Box and Discrete actions, got {action_space}")
        self._leaves = spaces.leaves(observation_space)
        action = spaces.random_action(action_space, 1, np.random.default_rng(0))
        row = 2 * sum(leaf.nbytes for leaf in self._leaves) + action.nbytes + 8
        check_memory(row * self.capacity, self.capacity, "capacity")
        zeros = [[np.zeros((self.capacity, *leaf.shape), leaf.dtype) for leaf in self._leaves] for _ in range(2)]
        self._obs, self._next_obs = zeros
        self._action = np.zeros((self.capacity, *action.shape[1:]), action.dtype)
        self._reward, self._discount = np.zeros((2, self.capacity), np.float32)
        self._rng = np.random.default_rng(seed)
        self._n_pushed = 0

    def __len__(self) -> int:
        """Number of stored transitions, at most ``capacity``."""
        return min(self._n_pushed, self.capacity)

    def __repr__(self) -> str:
        return f"<ReplayMemory: {len(self):,} of {self.capacity:,} transitions>"

    def push(self, obs: Observation, action: Action, reward: float, next_obs: Observation, terminated: bool) -> None:
        """Adds one transition, and overwrites the oldest if the memory is full.

        Args:
            obs: the observation before the step.
            action: the action, in the range of the action space.
            reward: the reward of the step.
            next_obs: the observation after the step, including the final observation of an episode.
            terminated: whether a terminal state of the MDP was reached: ``terminated`` of Gymnasium's ``step``. It is
                False if the episode was only truncated. Algorithms then bootstrap from ``next_obs``.

        Raises:
            ValueError: if an observation or the action does not match its space, or the reward is not finite.
        """
        before, after = self._parts(obs, "obs"), self._parts(next_obs, "next_obs")
        action_array = np.asarray(action)
        if action_array.shape != (self.action_space.shape or ()):
            raise ValueError(f"action has the shape {action_array.shape}, expected {self.action_space.shape or ()}")
        if isinstance(self.action_space, gym.spaces.Discrete):
            spaces.check_env_actions(self.action_space, action_array, "push")
        if not np.isfinite(action_array).all() or not abs(reward) <= np.finfo(np.float32).max:
            raise ValueError(f"action={action!r} and reward={reward!r} must be finite as float32")
        if not all(np.isfinite(array).all() for array in (*before, *after)):
            raise ValueError("obs and next_obs must be finite")
        i = self._n_pushed % self.capacity
        for stores, parts in ((self._obs, before), (self._next_obs, after)):
            for store, array in zip(stores, parts, strict=True):
                store[i] = array
        self._action[i] = spaces.unscale_action(self.action_space, action_array[None])[0]
        self._reward[i] = reward
        self._discount[i] = 0.0 if terminated else self.gamma
        self._n_pushed += 1

    def sample(self, batch_size: int) -> Transition:
        """Returns a batch of transitions as NumPy arrays, in the form that the losses of :mod:`rejeu.algorithms` take.

        ``obs`` and ``next_obs`` have leaves ``(batch, ...)``. ``action`` is ``(batch, action_dim)`` in [-1, 1] for Box
        spaces, and ``int32 (batch,)`` starting at 0 for Discrete spaces. ``reward`` is ``(batch,)``. ``discount``,
        ``(batch,)``, is 0 for terminated transitions and ``gamma`` for others. :func:`rejeu.core.spaces.scale_action`
        converts such actions to the range of the action space.

        Raises:
            ValueError: if the memory is empty.
        """
        if not len(self):
            raise ValueError("the memory is empty; push transitions first")
        index = self._rng.integers(len(self), size=whole("batch_size", batch_size, least=1))
        return Transition(
            self._tree(self._obs, index),
            self._action[index],
            self._reward[index],
            self._tree(self._next_obs, index),
            self._discount[index],
        )

    def _tree(self, stores: list[np.ndarray], index: np.ndarray) -> Observation:
        return jax.tree.unflatten(spaces.structure(self.observation_space), [store[index] for store in stores])

    def _parts(self, obs: Observation, name: str) -> list[np.ndarray]:
        """Returns the arrays of an observation.

        Raises:
            ValueError: if the observation does not match the space.
        """
        try:
            parts = jax.tree.leaves(spaces.plain(self.observation_space, obs), is_leaf=lambda x: isinstance(x, list))
            arrays = [np.asarray(value) for value in parts]
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"{name} is no observation of {self.observation_space}: {error}") from None
        shapes = [array.shape for array in arrays]
        if shapes != [leaf.shape for leaf in self._leaves]:
            raise ValueError(
                f"{name} has the shapes {shapes}, expected {[leaf.shape for leaf in self._leaves]} of {self.observation_space}"
            )
        return arrays
