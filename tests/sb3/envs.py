"""Small environments for tests: what was observed is to be repeated, bits are to be flipped, images are random."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class IdentityEnv(gym.Env):
    """The action must equal the observation, for a reward of 1; observations are random.

    Args:
        dim: number of values of a Discrete space; None with ``space``.
        space: space of observations and actions; None with ``dim``.
        ep_length: steps of an episode.
    """

    def __init__(self, dim: int | None = None, space: spaces.Space | None = None, ep_length: int = 100) -> None:
        if space is None:
            space = spaces.Discrete(1 if dim is None else dim)
        elif dim is not None:
            raise ValueError(f"dim={dim} and space={space}: give one of the two")
        self.action_space = self.observation_space = space
        self.ep_length, self.current_step, self.num_resets = ep_length, 0, -1
        self.state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.action_space.seed(seed)
        self.current_step = 0
        self.num_resets += 1
        self.state = self.action_space.sample()
        return self.state, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = self._get_reward(action)
        self.state = self.action_space.sample()
        self.current_step += 1
        return self.state, reward, False, self.current_step >= self.ep_length, {}

    def _get_reward(self, action: Any) -> float:
        return float(np.all(self.state == action))

    def render(self) -> None:
        """Does nothing."""


class IdentityEnvBox(IdentityEnv):
    """The same with numbers in ``[low, high]``, which the action must meet within ``eps``."""

    def __init__(self, low: float = -1.0, high: float = 1.0, eps: float = 0.05, ep_length: int = 100) -> None:
        super().__init__(space=spaces.Box(low=low, high=high, shape=(1,), dtype=np.float32), ep_length=ep_length)
        self.eps = eps

    def _get_reward(self, action: np.ndarray) -> float:
        return float(np.all(np.abs(self.state - action) <= self.eps))


class InvalidActionEnvDiscrete(IdentityEnv):
    """An :class:`IdentityEnv` of ``dim`` choices, of which ``n_invalid_actions`` wrong ones are masked."""

    def __init__(self, dim: int, ep_length: int = 100, n_invalid_actions: int = 0) -> None:
        super().__init__(dim, ep_length=ep_length)
        self.n_invalid_actions = n_invalid_actions

    def action_masks(self) -> np.ndarray:
        """Returns which options are allowed, ``bool (dim,)``; the right one always is."""
        wrong = np.delete(np.arange(self.action_space.n), self.state)
        forbidden = np.random.default_rng().choice(wrong, self.n_invalid_actions, replace=False)
        return ~np.isin(np.arange(self.action_space.n), forbidden)


class FakeImageEnv(gym.Env):
    """Random images, for tests of convolutions.

    Args:
        action_dim: number of actions, or of their dimensions.
        screen_height: in pixels.
        screen_width: in pixels.
        n_channels: number of channels.
        discrete: Discrete actions; False: in [-1, 1].
        channel_first: put the channels first.
    """

    def __init__(
        self,
        action_dim: int = 6,
        screen_height: int = 84,
        screen_width: int = 84,
        n_channels: int = 1,
        discrete: bool = True,
        channel_first: bool = False,
    ) -> None:
        size = (screen_height, screen_width)
        shape = (n_channels, *size) if channel_first else (*size, n_channels)
        self.observation_space = spaces.Box(low=0, high=255, shape=shape, dtype=np.uint8)
        self.action_space = spaces.Discrete(action_dim) if discrete else spaces.Box(-1, 1, (5,), np.float32)
        self.ep_length, self.current_step = 10, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.current_step = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.current_step += 1
        return self.observation_space.sample(), 0.0, False, self.current_step >= self.ep_length, {}

    def render(self) -> None:
        """Does nothing."""


class BitFlippingEnv(gym.Env):
    """Bits are flipped one a step until all are 1; the reward is 0 then and -1 before. A goal environment.

    Args:
        n_bits: number of bits.
        continuous: one action in [-1, 1] for each bit, which flips it if it is positive.
        max_steps: steps of an episode; None: ``n_bits``.
    """

    def __init__(self, n_bits: int = 10, continuous: bool = False, max_steps: int | None = None) -> None:
        keys = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict(dict.fromkeys(keys, spaces.MultiBinary(n_bits)))
        self.action_space = spaces.Box(-1, 1, (n_bits,), np.float32) if continuous else spaces.Discrete(n_bits)
        self.continuous, self.max_steps = continuous, n_bits if max_steps is None else max_steps
        self.state = np.zeros(n_bits, np.int8)
        self.desired_goal = np.ones(n_bits, np.int8)
        self.current_step = 0

    def _observation(self) -> dict[str, Any]:
        bits = self.state.copy()
        return {"observation": bits, "achieved_goal": bits, "desired_goal": self.desired_goal.copy()}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.current_step = 0
        self.state = self.np_random.integers(0, 2, len(self.state)).astype(np.int8)
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        flipped = np.asarray(action) > 0 if self.continuous else int(action)
        self.state[flipped] = 1 - self.state[flipped]
        obs = self._observation()
        reward = float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], None))
        terminated = reward == 0
        self.current_step += 1
        return obs, reward, terminated, self.current_step >= self.max_steps, {"is_success": terminated}

    def compute_reward(self, achieved_goal: Any, desired_goal: Any, _info: Any) -> Any:
        """Returns 0 where the goals are equal and -1 elsewhere, for one pair of goals or a batch of them."""
        return -np.any(np.not_equal(achieved_goal, desired_goal), axis=-1).astype(np.float32)


class SimpleMultiObsEnv(gym.Env):
    """A walk through a grid to its last cell, which is observed as a vector and as an image, each at random for a cell.

    Args:
        num_col: columns of the grid.
        num_row: rows of the grid.
        random_start: begin anywhere.
        discrete_actions: left, down, right and up as numbers; False: as the largest of four numbers in [-1, 1].
        channel_last: put the channels of the image last.
    """

    def __init__(
        self,
        num_col: int = 4,
        num_row: int = 4,
        random_start: bool = True,
        discrete_actions: bool = True,
        channel_last: bool = True,
    ) -> None:
        shape = (64, 64, 1) if channel_last else (1, 64, 64)
        self.action_space = spaces.Discrete(4) if discrete_actions else spaces.Box(-1, 1, (4,), np.float32)
        self.observation_space = spaces.Dict(
            {"vec": spaces.Box(0, 1, (5,), np.float64), "img": spaces.Box(0, 255, shape, np.uint8)}
        )
        self.num_col, self.num_row, self.random_start = num_col, num_row, random_start
        self.discrete_actions = discrete_actions
        rng = np.random.default_rng(0)
        self.cells = [
            {"vec": rng.random(5), "img": rng.integers(0, 256, shape).astype(np.uint8)}
            for _ in range(num_col * num_row)
        ]
        self.state, self.count, self.max_count = 0, 0, 100

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.count = 0
        self.state = int(self.np_random.integers(0, len(self.cells) - 1)) if self.random_start else 0
        return dict(self.cells[self.state]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        move = int(action) if self.discrete_actions else int(np.argmax(action))
        row, column = divmod(self.state, self.num_col)
        down, right = ((0, -1), (1, 0), (0, 1), (-1, 0))[move]
        row, column = min(max(row + down, 0), self.num_row - 1), min(max(column + right, 0), self.num_col - 1)
        self.state = row * self.num_col + column
        self.count += 1
        arrived = self.state == len(self.cells) - 1
        info = {"got_to_end": arrived}
        return dict(self.cells[self.state]), 1.0 if arrived else -0.1, arrived, self.count > self.max_count, info

    def render(self) -> None:
        """Prints the number of the cell."""
        print(self.state)
