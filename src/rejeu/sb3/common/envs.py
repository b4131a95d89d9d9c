"""Small environments for tests and examples."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from rejeu.core.types import Action, Info, Observation
from rejeu.sb3.modules import alias


class IdentityEnv(gym.Env):
    """The action must equal the observation, for a reward of 1; observations are random.

    Args:
        dim: number of values of a Discrete space; None with ``space``.
        space: space of observations and actions; None with ``dim``.
        ep_length: steps of an episode.
    """

    def __init__(self, dim: int | None = None, space: spaces.Space | None = None, ep_length: int = 100) -> None:
        if space is not None and dim is not None:
            raise ValueError(f"dim={dim} and space={space}: give one of the two")
        self.action_space = self.observation_space = space or spaces.Discrete(dim or 1)
        self.ep_length, self.current_step, self.num_resets = ep_length, 0, -1
        self.state: Any = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.current_step = 0
        self.num_resets += 1
        self.state = self.observation_space.sample()
        return self.state, {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, Info]:
        reward = self._get_reward(action)
        self.state = self.observation_space.sample()
        self.current_step += 1
        return self.state, reward, False, self.current_step >= self.ep_length, {}

    def _get_reward(self, action: Action) -> float:
        return float(np.all(self.state == action))

    def render(self) -> None:
        """Does nothing."""


class IdentityEnvBox(IdentityEnv):
    """Numbers in ``[low, high]``, which the action must meet within ``eps``."""

    def __init__(self, low: float = -1.0, high: float = 1.0, eps: float = 0.05, ep_length: int = 100) -> None:
        super().__init__(space=spaces.Box(low=low, high=high, shape=(1,), dtype=np.float32), ep_length=ep_length)
        self.eps = eps

    def _get_reward(self, action: Action) -> float:
        return float(np.all(np.abs(self.state - action) <= self.eps))


class IdentityEnvMultiDiscrete(IdentityEnv):
    """Two numbers below ``dim``, which the action must equal."""

    def __init__(self, dim: int = 1, ep_length: int = 100) -> None:
        super().__init__(space=spaces.MultiDiscrete([dim, dim]), ep_length=ep_length)


class IdentityEnvMultiBinary(IdentityEnv):
    """Bits, ``dim`` of them, which the action must equal."""

    def __init__(self, dim: int = 1, ep_length: int = 100) -> None:
        super().__init__(space=spaces.MultiBinary(dim), ep_length=ep_length)


class FakeImageEnv(IdentityEnv):
    """Random images, of episodes of ten steps and without rewards, for tests of convolutions.

    Args:
        action_dim: number of Discrete actions.
        screen_height: in pixels.
        screen_width: in pixels.
        n_channels: number of channels.
        discrete: Discrete actions; False: five in [-1, 1].
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
        super().__init__(space=spaces.Box(0, 255, shape, np.uint8), ep_length=10)
        self.action_space = spaces.Discrete(action_dim) if discrete else spaces.Box(-1, 1, (5,), np.float32)

    def _get_reward(self, action: Action) -> float:
        return 0.0


class BitFlippingEnv(gym.Env):
    """Bits are flipped one a step until all are 1; the reward is 0 then and -1 before. A goal environment.

    Its goal is always the same; ``jax/BitFlipping-v0`` is the environment of the paper, with random goals.

    Args:
        n_bits: number of bits.
        continuous: one action in [-1, 1] for each bit, which flips it if it is positive.
        max_steps: steps of an episode; None: ``n_bits``.
    """

    def __init__(self, n_bits: int = 10, continuous: bool = False, max_steps: int | None = None) -> None:
        keys = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict({key: spaces.MultiBinary(n_bits) for key in keys})
        self.action_space = spaces.Box(-1, 1, (n_bits,), np.float32) if continuous else spaces.Discrete(n_bits)
        self.continuous, self.max_steps = continuous, n_bits if max_steps is None else max_steps
        self.state, self.desired_goal = np.zeros(n_bits, np.int8), np.ones(n_bits, np.int8)
        self.current_step = 0

    def _observation(self) -> dict[str, np.ndarray]:
        return {"observation": self.state, "achieved_goal": self.state, "desired_goal": self.desired_goal}

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        super().reset(seed=seed)
        self.current_step = 0
        self.state = self.np_random.integers(0, 2, len(self.state), np.int8)
        return self._observation(), {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, Info]:
        flipped = np.asarray(action) > 0 if self.continuous else np.arange(len(self.state)) == action
        self.state = self.state ^ flipped.astype(np.int8)
        self.current_step += 1
        reward = float(np.asarray(self.compute_reward(self.state, self.desired_goal, None)).item())
        ends = reward == 0.0, self.current_step >= self.max_steps
        return self._observation(), reward, *ends, {"is_success": ends[0]}

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
        parts: Any = {"vec": spaces.Box(0, 1, (5,), np.float64), "img": spaces.Box(0, 255, shape, np.uint8)}
        self.observation_space = spaces.Dict(parts)
        self.observation_space.seed(0)
        self.cells = [self.observation_space.sample() for _ in range(num_col * num_row)]
        self.num_col, self.random_start, self.discrete_actions = num_col, random_start, discrete_actions
        self.state, self.count, self.max_count = 0, 0, 100

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
        super().reset(seed=seed)
        self.count, self.state = 0, int(self.np_random.integers(len(self.cells) - 1)) if self.random_start else 0
        return dict(self.cells[self.state]), {}

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, Info]:
        move = int(action) if self.discrete_actions else int(np.argmax(action))
        size = len(self.cells) // self.num_col, self.num_col
        cell = np.add(divmod(self.state, self.num_col), ((0, -1), (1, 0), (0, 1), (-1, 0))[move])
        self.state = int(np.ravel_multi_index((cell[0], cell[1]), size, mode="clip"))
        self.count += 1
        arrived = self.state == len(self.cells) - 1
        ends = arrived, self.count > self.max_count
        return dict(self.cells[self.state]), 1.0 if arrived else -0.1, *ends, {"got_to_end": arrived}

    def render(self) -> None:
        """Prints the number of the cell."""
        print(self.state)


alias(__name__, "bit_flipping_env", "identity_env", "multi_input_envs")
