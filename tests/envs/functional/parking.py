"""Steps of highway-env's parking-v0, with which the one in JAX is compared."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.envs.functional import parking
from rejeu.envs.registry import make_env
from tests.envs.functional.peers import Recorded

"""A state as numbers: x, y, heading, speed, crashed, impact (2), whether there is one, index of the goal."""

SPOTS = np.array([[x, 14.0 * side, side * np.pi / 2] for side in (1, -1) for x in range(-26, 27, 4)])
"""x, y and heading of the goals."""


def get(env: Any) -> np.ndarray:
    """Returns the state of parking-v0 as numbers."""
    car = env.vehicle
    impact = np.zeros(2) if car.impact is None else car.impact
    x, y = car.goal.position
    goal = np.hypot(SPOTS[:, 0] - x, SPOTS[:, 1] - y).argmin()
    return np.array([*car.position, car.heading, car.speed, car.crashed, *impact, car.impact is not None, goal])


def put(env: Any, state: np.ndarray) -> None:
    """Sets the state of parking-v0."""
    car = env.vehicle
    car.position, car.heading, car.speed = state[:2].copy(), float(state[2]), float(state[3])
    car.crashed = bool(state[4])
    car.impact = state[5:7].copy() if state[7] else None
    spot = SPOTS[int(state[8])]
    car.goal.position, car.goal.heading = spot[:2].copy(), float(spot[2])
    env.time = env.steps = 0


def random_state(rng: np.random.Generator, kind: str) -> np.ndarray:
    """Returns a state: anywhere in the lot, near its goal, near a wall, or nearly as fast as possible."""
    goal = rng.integers(len(SPOTS))
    x, y, heading = SPOTS[goal]
    if kind == "goal":
        place = [x + rng.normal(0, 0.6), y + rng.normal(0, 0.6), heading + rng.normal(0, 0.1), rng.normal(0, 1.5)]
    elif kind == "wall":
        angle = rng.uniform(-np.pi, np.pi)
        along, off = rng.uniform(-1, 1), rng.uniform(0.5, 4.0)
        ends = [[35 * along, 21 - off], [35 * along, off - 21], [35 - off, 21 * along], [off - 35, 21 * along]]
        place = [*ends[rng.integers(4)], angle, rng.uniform(-12, 12)]
    else:
        speed = rng.choice([-1, 1]) * rng.uniform(39, 40.4) if kind == "fast" else rng.uniform(-10, 10)
        place = [rng.uniform(-30, 30), rng.uniform(-17, 17), rng.uniform(-7, 7), speed]
    return np.array([*place, 0, 0, 0, 0, goal])


def record(n: int) -> tuple[Recorded, np.ndarray]:
    """Returns ``n`` steps of parking-v0 from random states and through episodes, and whether each was a success.

    Every third step starts from a new random state; the others continue, also where a collision is under way.
    """
    env: Any = make_env("parking-v0").unwrapped
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    rows = []
    over = True
    for i in range(n):
        if over or i % 3 == 0:
            put(env, random_state(rng, ["goal", "wall", "wall", "goal", "lot", "fast"][i // 3 % 6]))
        before, action = get(env), rng.uniform(-1.1, 1.1, 2)
        obs, reward, terminated, _, info = env.step(action)
        rows.append((before, action, get(env), flat(obs), reward, terminated, info["is_success"]))
        over = terminated
    *recorded, success = (np.array(column) for column in zip(*rows, strict=True))
    return Recorded(*recorded), success


def make_state(states: np.ndarray) -> parking.State:
    """Returns states of the environment in JAX."""
    goal, time = states[:, 8].astype(np.int32), np.arange(len(states), dtype=np.int32) % 500
    flags = states[:, [4, 7]].astype(bool).T
    return parking.State(states[:, :2], states[:, 2], states[:, 3], flags[0], states[:, 5:7], flags[1], goal, time)


def flat(obs: dict[str, np.ndarray]) -> np.ndarray:
    """Returns observation, achieved and desired goal as one array ``(..., 18)``."""
    return np.concatenate([obs[key] for key in ("observation", "achieved_goal", "desired_goal")], axis=-1)


def numbers(state: parking.State) -> np.ndarray:
    """Returns the numbers of states of the environment in JAX, as :func:`get` does."""
    impact = np.where(state.has_impact[:, None], state.impact, 0.0)
    columns = [state.position, state.heading, state.speed, state.crashed, impact, state.has_impact, state.goal]
    return np.concatenate([np.reshape(column, (len(state.goal), -1)) for column in columns], axis=1)


def restep(state: np.ndarray, action: np.ndarray, size: float, n: int) -> np.ndarray:
    """Returns the states after the step of parking-v0 from ``n`` states that differ from ``state`` by ``size``, ``(n, 9)``."""
    env: Any = make_env("parking-v0").unwrapped
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    found = []
    for _ in range(n):
        moved = state.copy()
        moved[:4] += size * rng.normal(size=4)
        put(env, moved)
        env.action_type.act(action)
        for _ in range(parking.N_FRAMES):
            env.road.act()
            env.road.step(parking.TIME_STEP)
        found.append(get(env))
    return np.array(found)


class Comparison(NamedTuple):
    """How far the environment in JAX is from the recorded steps: arrays with one value for each step."""

    state: np.ndarray
    """Largest absolute difference in the numbers of the state."""
    obs: np.ndarray
    """The same in the observation."""
    reward: np.ndarray
    wrong: np.ndarray
    """Whether termination or success differ."""
    after: np.ndarray
    """Our states after the steps, ``(n, 9)``."""


def compare(recorded: Recorded, success: np.ndarray, x64: bool) -> Comparison:
    """Compares the environment in JAX with recorded steps, computed in 64 or 32 bits."""
    with jax.enable_x64(x64):
        env = parking.Parking()
        state = jax.tree.map(jnp.asarray, make_state(recorded.state))
        step = jax.jit(jax.vmap(env.step, in_axes=(None, 0, 0)))
        after, obs, reward, terminated, truncated = step(jax.random.key(0), state, jnp.asarray(recorded.action))
        assert truncated.tolist() == [time % 500 == 499 for time in range(len(truncated))]
        ours = jax.device_get((after, flat(obs), reward, terminated, jax.vmap(env.success)(after)))
    after, obs, reward, terminated, succeeded = ours
    return Comparison(
        np.abs(numbers(after) - recorded.next_state).max(axis=1),
        np.abs(obs - recorded.obs).max(axis=1),
        np.abs(reward - recorded.reward),
        (terminated != recorded.terminated) | (succeeded != success),
        numbers(after),
    )


def is_unstable(recorded: Recorded, i: int, after: np.ndarray) -> bool:
    """Returns whether highway-env gives our result of step ``i`` when it starts 1e-9 away.

    A collision moves the vehicle until it just touches the wall. Where it touches a second wall then, rounding decides
    whether it collides again in the same step.
    """
    nearby = restep(recorded.state[i], recorded.action[i], 1e-9, 60)
    return bool((np.abs(nearby - after).max(axis=1) < 1e-5).any())
