"""How each classic control task of Gymnasium is compared with its counterpart in JAX."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import jax.numpy as jnp
import numpy as np

from rejeu.envs.functional import FunctionalEnv, acrobot, cart_pole, mountain_car, pendulum
from tests.envs.functional.peers import Difference, Recorded, compare, play


class Case(NamedTuple):
    env_id: str
    """Gymnasium's id; ours has ``jax/`` before it."""
    env: FunctionalEnv
    low: list[float]
    """States are drawn from this box, which contains states at which episodes end."""
    high: list[float]
    make_state: Callable[[np.ndarray], Any]
    physics: Callable[[Any], Any]
    rounding: float = 1e-12
    """Largest difference of states in double precision."""


def times(states: np.ndarray) -> np.ndarray:
    return np.zeros(len(states), np.int32)


CASES = [
    Case(
        "CartPole-v1",
        cart_pole.CartPole(),
        [-2.5, -3.0, -0.23, -3.0],
        [2.5, 3.0, 0.23, 3.0],
        lambda s: cart_pole.State(s, times(s)),
        lambda s: s.physics,
    ),
    Case(
        "Pendulum-v1",
        pendulum.Pendulum(),
        [-8.0, -8.0],
        [8.0, 8.0],
        lambda s: pendulum.State(s[:, 0], s[:, 1], times(s)),
        lambda s: jnp.stack([s.angle, s.velocity], axis=1),
    ),
    Case(
        "MountainCar-v0",
        mountain_car.MountainCar(),
        [-1.2, -0.07],
        [0.6, 0.07],
        lambda s: mountain_car.State(s[:, 0], s[:, 1], times(s)),
        lambda s: jnp.stack([s.position, s.velocity], axis=1),
    ),
    Case(
        "MountainCarContinuous-v0",
        mountain_car.MountainCarContinuous(),
        [-1.2, -0.07],
        [0.6, 0.07],
        lambda s: mountain_car.State(s[:, 0], s[:, 1], times(s)),
        lambda s: jnp.stack([s.position, s.velocity], axis=1),
        1e-7,  # Gymnasium rounds this state to float32
    ),
    Case(
        "Acrobot-v1",
        acrobot.Acrobot(),
        [-np.pi, -np.pi, -np.pi, -2 * np.pi],  # faster, Gymnasium's integration amplifies rounding a thousand times
        [np.pi, np.pi, np.pi, 2 * np.pi],
        lambda s: acrobot.State(s, times(s)),
        lambda s: s.physics,
    ),
]


def put(env: Any, state: np.ndarray) -> None:
    env.state = state.copy()
    if hasattr(env, "steps_beyond_terminated"):
        env.steps_beyond_terminated = None


def record(case: Case, n: int) -> Recorded:
    """Returns ``n`` steps of Gymnasium's environment: half from random states, half of episodes."""
    env = gym.make(case.env_id).unwrapped
    rng = np.random.default_rng(0)
    env.action_space.seed(0)
    actions = np.array([env.action_space.sample() for _ in range(n)])
    if actions.dtype == np.float32:
        actions = actions.astype(np.float64)  # or Gymnasium computes with float32 here and there
    states = rng.uniform(case.low, case.high, (n, len(case.low)))
    env.reset(seed=0)
    for i in range(n // 2):
        states[i] = env.state
        if env.step(actions[i])[2] or i % 200 == 199:
            env.reset()
    return play(env, states, actions, put, lambda env: np.array(env.state))


def difference(case: Case, n: int, x64: bool) -> Difference:
    return compare(case.env, record(case, n), case.make_state, case.physics, x64)
