"""The rollout buffer of on-policy algorithms, with the steps since the last policy update."""

from __future__ import annotations

import math
from collections.abc import Mapping

import jax
import numpy as np
from numpy.typing import DTypeLike

from rejeu.core.algorithm import PyTree, Rollout
from rejeu.core.spaces import Leaf
from rejeu.replay.ring import check_memory


class RolloutBuffer:
    """The steps of all environments since the last policy update. Mutable: ``add`` writes in place."""

    def __init__(
        self,
        n_steps: int,
        n_envs: int,
        obs_leaves: tuple[Leaf, ...],
        obs_structure: PyTree,
        action_shape: tuple[int, ...],
        action_dtype: DTypeLike,
        gamma: float,
    ) -> None:
        """Allocates memory for ``n_steps`` steps of each environment.

        Raises:
            MemoryError: if the machine cannot hold them, with the numbers.
        """
        row = (
            2 * sum(leaf.nbytes for leaf in obs_leaves) + math.prod(action_shape) * np.dtype(action_dtype).itemsize + 14
        )
        check_memory(n_envs * row * n_steps, n_steps, "n_steps")
        self.n_steps, self.n_envs, self.gamma = n_steps, n_envs, gamma
        self.obs_leaves, self.obs_structure = obs_leaves, obs_structure
        shape = (n_steps, n_envs)
        make = lambda: [np.zeros((*shape, *leaf.shape), leaf.dtype) for leaf in obs_leaves]  # noqa: E731
        self.obs, self.next_obs = make(), make()
        self.action = np.zeros((*shape, *action_shape), action_dtype)
        self.reward = np.zeros(shape, np.float32)
        self.discount = np.zeros(shape, np.float32)
        self.ended = np.zeros(shape, bool)
        self.valid = np.zeros(shape, bool)
        self.running_return = np.zeros(shape, np.float32)
        self.started = np.zeros(n_envs, bool)
        """Whether an episode started with the first step, ``bool (n_envs,)``."""
        self.previously_started = self.started
        """``started`` of the rollout before."""
        self.carry: PyTree = ()
        """Recurrent state of the policy before the first step, with leaves ``(n_envs, ...)``."""
        self.length = 0
        """Number of steps of each environment in the buffer."""

    @property
    def nbytes(self) -> int:
        """Allocated memory in bytes."""
        return self.n_steps * sum(array[0].nbytes for array in self._stores().values())

    @property
    def full(self) -> bool:
        """Whether the buffer is full."""
        return self.length == self.n_steps

    def size(self) -> int:
        """Returns the number of valid steps, summed over the environments."""
        return int(self.valid[: self.length].sum())

    def set_gamma(self, gamma: float) -> None:
        """Sets the discount factor of the steps that are added from now on."""
        self.gamma = gamma

    def begin(self, carry: PyTree, started: np.ndarray) -> None:
        """Starts a new rollout, and discards the previous one.

        Args:
            carry: recurrent state of the policy before the first step.
            started: whether an episode starts with the first step, ``bool (n_envs,)``.
        """
        self.length = 0
        self.carry, self.previously_started, self.started = carry, self.started, started.copy()

    def observe(self, obs: PyTree) -> None:
        """Stores the observations ``(n_envs, ...)`` before the next step."""
        for store, leaf in zip(self.obs, jax.tree.leaves(obs), strict=True):
            store[self.length] = leaf

    def add(
        self,
        action: np.ndarray,
        reward: np.ndarray,
        terminated: np.ndarray,
        truncated: np.ndarray,
        next_obs: PyTree,
        running_return: np.ndarray | float = 0.0,
        valid: np.ndarray | bool = True,
    ) -> None:
        """Adds one step of every environment, ``(n_envs, ...)``. Steps that are not ``valid`` are ignored in training.

        The observations before the step must have been passed to :meth:`observe`.
        """
        t = self.length
        for store, leaf in zip(self.next_obs, jax.tree.leaves(next_obs), strict=True):
            store[t] = leaf
        self.action[t] = action
        self.reward[t] = reward
        self.discount[t] = np.where(terminated, 0.0, self.gamma)
        self.ended[t] = terminated | truncated
        self.valid[t] = valid
        self.running_return[t] = running_return
        self.length += 1

    def cut(self, envs: np.ndarray | bool = True) -> None:
        """Truncates the episodes of ``envs``, ``bool (n_envs,)``, at the latest step.

        The last observation does not become terminal: algorithms bootstrap from its value.
        """
        self.ended[self.length - 1] |= envs

    def rollout(self) -> Rollout:
        """Returns the rollout, padded to ``n_steps``. The arrays are views: use them before adding steps."""
        self.valid[self.length :] = False
        tree = lambda stores: jax.tree.unflatten(self.obs_structure, stores)  # noqa: E731
        return Rollout(
            tree(self.obs),
            self.action,
            self.reward,
            tree(self.next_obs),
            self.discount,
            self.ended,
            self.valid,
            self.running_return,
            self.started,
            self.carry,
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """Returns the stored steps as named arrays ``(steps, n_envs, ...)``."""
        return {name: array[: self.length] for name, array in self._stores().items()}

    def _stores(self) -> dict[str, np.ndarray]:
        stored = {f"obs.{i}": store for i, store in enumerate(self.obs)}
        stored |= {f"next_obs.{i}": store for i, store in enumerate(self.next_obs)}
        names = ("action", "reward", "discount", "ended", "valid", "running_return")
        return stored | {name: getattr(self, name) for name in names}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Restores the arrays of :meth:`arrays`.

        Raises:
            ValueError: if names, shapes or dtypes do not match this buffer, or if it would be full, which cannot happen
                between two steps. The buffer is then unchanged.
        """
        stores = self._stores()
        if {*stores} != {*arrays}:
            raise ValueError(f"the file and this buffer differ in the arrays {sorted({*stores} ^ {*arrays})}")
        n = len(arrays["reward"])
        for name, array in stores.items():
            saved = arrays[name]
            if saved.shape[1:] != array.shape[1:] or saved.dtype != array.dtype or len(saved) != n or n > self.n_steps:
                raise ValueError(
                    f"{name} in the file is {saved.dtype}{list(saved.shape)}, expected {array.dtype} and at most "
                    f"{list(array.shape)}"
                )
        if n == self.n_steps:
            raise ValueError(
                f"the rollout has {n} steps, and {self.n_steps} are learned from as soon as they are complete"
            )
        for name, array in stores.items():
            array[:n] = arrays[name]
        self.length = n
