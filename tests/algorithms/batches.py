"""Spaces and random batches of transitions, for tests of losses and updates."""

from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np

from rejeu.core.algorithm import Clock, Transition

OBS_DIM, ACTION_DIM, N_ACTIONS = 3, 2, 4
OBS_SPACE = gym.spaces.Box(-5.0, 5.0, (OBS_DIM,), np.float32)
BOX = gym.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
DISCRETE = gym.spaces.Discrete(N_ACTIONS, start=5)
CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.5))


def box_batch(seed: int, size: int) -> Transition:
    """Returns transitions with actions in [-1, 1]; the MDP terminated in every third."""
    rng = np.random.default_rng(seed)
    obs, action, reward = normal(rng, size, OBS_DIM), np.tanh(normal(rng, size, ACTION_DIM)), normal(rng, size)
    return Transition(obs, action, reward, normal(rng, size, OBS_DIM), discounts(size))


def with_next_action(batch: Transition, seed: int) -> Transition:
    """Returns transitions with next actions, which every fourth does not have."""
    rng = np.random.default_rng(seed + 1000)
    action = np.tanh(normal(rng, *batch.action.shape))
    return batch._replace(next_action=np.where(np.arange(len(action))[:, None] % 4 == 1, np.float32(np.nan), action))


def discrete_batch(seed: int, size: int) -> Transition:
    """Returns transitions with every action equally often; the MDP terminated in every third."""
    rng = np.random.default_rng(seed)
    action = rng.permutation(np.arange(size) % N_ACTIONS).astype(np.int32)
    obs, reward = normal(rng, size, OBS_DIM), normal(rng, size)
    return Transition(obs, action, reward, normal(rng, size, OBS_DIM), discounts(size))


def normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Returns standard normal numbers, ``float32``."""
    return rng.normal(size=shape).astype(np.float32)


def discounts(size: int) -> np.ndarray:
    """Returns 0.9, and 0 for every third transition."""
    return np.where(np.arange(size) % 3 == 0, 0.0, 0.9).astype(np.float32)


def noise_of(key: Any, size: int) -> np.ndarray:
    """Returns the standard normal numbers that JAX draws for the actions of a batch."""
    return np.float64(jax.random.normal(key, (size, ACTION_DIM), jnp.float32))
