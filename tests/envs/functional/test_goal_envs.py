"""Bit flipping and the point maze: steps, walls, goals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.envs.functional import make, point_maze
from rejeu.envs.functional.point_maze import LAYOUTS, RADIUS, PointMaze
from tests.bit_flipping import BitFlipping as Reference
from tests.tiers import only

KEY = jax.random.key(0)


def test_bit_flipping_equals_the_one_of_the_host():
    env, reference = make("jax/BitFlipping-v0", n_bits=4), Reference(4)
    rng = np.random.default_rng(0)
    step = jax.jit(env.step)
    ends = []
    for i in range(40):
        state, _ = env.reset(jax.random.key(i))
        reference.reset(seed=0)
        reference.state, reference.goal = np.array(state.bits), np.array(state.goal)
        for _ in range(4):
            action = int(rng.integers(4))
            state, obs, reward, terminated, truncated = step(KEY, state, action)
            theirs, *expected, info = reference.step(action)
            for key, value in theirs.items():
                np.testing.assert_array_equal(obs[key], value)
            assert [float(reward), bool(terminated), bool(truncated) and not terminated] == expected
            assert bool(env.success(state)) == info["is_success"]
            ends.append(bool(terminated))
            if terminated:
                break
    assert 3 < sum(ends) < 40


def test_the_limit_of_bit_flipping_is_the_number_of_bits():
    assert rejeu.make_vector("jax/BitFlipping-v0", 2, n_bits=15).max_episode_steps == 15
    assert make("jax/BitFlipping-v0", n_bits=15, max_episode_steps=20).max_episode_steps == 20


def test_goal_functions_judge_batches_of_any_shape():
    env = make("jax/BitFlipping-v0", n_bits=3)
    rng = np.random.default_rng(0)
    achieved, desired = rng.integers(0, 2, (2, 5, 6, 3), dtype=np.int8)
    same = (achieved == desired).all(axis=-1)
    np.testing.assert_array_equal(env.compute_reward(achieved, desired), same - 1.0)
    np.testing.assert_array_equal(env.compute_terminated(achieved, desired), same)
    goals = rejeu.make_vector(env, 2).goals()
    np.testing.assert_array_equal(goals.reward(achieved[0], desired[0]), same[0] - 1.0)
    np.testing.assert_array_equal(goals.terminated(achieved[0], desired[0]), same[0])


def overlaps_a_wall(env: PointMaze, position: np.ndarray) -> np.ndarray:
    """Returns whether the square of the point is partly in a wall, for positions ``(n, 2)``."""
    n_rows, n_columns = env.walls.shape
    corners = position[:, None] + RADIUS * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    column, row = np.floor(corners + np.array([n_columns, n_rows]) / 2).astype(int).transpose(2, 0, 1)
    return env.walls[row, column].any(axis=1)


@pytest.mark.parametrize("layout", only({"u"}, LAYOUTS))
def test_the_point_never_enters_a_wall_and_reaches_every_cell(layout):
    env = PointMaze(layout=layout, max_episode_steps=None)
    n = 256
    state, _ = jax.vmap(env.reset)(jax.random.split(KEY, n))
    assert not overlaps_a_wall(env, np.asarray(state.position)).any()
    assert not overlaps_a_wall(env, np.asarray(state.goal)).any()
    places = np.stack([state.position, state.goal]) + np.array(env.walls.shape[::-1]) / 2
    starts, goals = np.floor(places)
    assert (starts != goals).any(axis=1).all()
    assert 0.24 < np.abs(places % 1 - 0.5).max() <= point_maze.SPREAD + 1e-6
    if layout == "u":  # every start with every goal
        assert len(np.unique(np.concatenate([starts, goals], axis=1), axis=0)) == 7 * 6

    def turn(state, key):
        action = jnp.repeat(jax.random.uniform(key, (n // 2, 2), minval=-1.5, maxval=1.5), 2, axis=0)
        after, *_ = jax.vmap(env.step, (None, 0, 0))(key, state, action)
        return after, after

    keys = jnp.repeat(jax.random.split(KEY, 60), 6)  # pushes of half a second
    _, way = jax.jit(lambda state: jax.lax.scan(turn, state, keys))(state)
    positions = np.asarray(way.position).reshape(-1, 2)
    assert not overlaps_a_wall(env, positions).any()
    column, row = np.floor(positions + np.array(env.walls.shape[::-1]) / 2).astype(int).T
    visited = np.zeros_like(env.walls)
    visited[row, column] = True
    np.testing.assert_array_equal(visited, ~env.walls)
    assert np.abs(way.velocity).max() < point_maze.MAX_SPEED
    steps = np.abs(np.diff(np.asarray(way.position), axis=0)).max()
    assert steps < 0.5  # nothing is jumped over


def test_every_cell_of_a_maze_can_be_reached_from_every_other():
    for name in LAYOUTS:
        free = {tuple(cell) for cell in np.argwhere(~PointMaze(layout=name).walls)}
        found, border = set(), [min(free)]
        while border:
            row, column = border.pop()
            found.add((row, column))
            near = {(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)}
            border += (near & free) - found
        assert found == free, name


def test_a_wall_stops_the_point_and_lets_it_slide_along():
    env = PointMaze(layout="u")
    state, _ = env.reset(KEY)
    step = jax.jit(env.step)
    state = state._replace(position=jnp.array([-1.0, 1.0]), velocity=jnp.zeros(2), goal=jnp.array([1.0, -1.0]))
    for _ in range(10):
        state, obs, reward, terminated, _ = step(KEY, state, jnp.array([1.0, 1.0]))
    assert state.velocity[1] == 0.0  # at the upper wall
    np.testing.assert_allclose(state.position[1], 1.5 - RADIUS, atol=1e-3)
    assert state.position[0] > 0.5  # still moving to the right
    assert (float(reward), bool(terminated)) == (-1.0, False)
    np.testing.assert_array_equal(obs["achieved_goal"], state.position)


def test_the_goal_of_the_maze_ends_the_episode():
    env = PointMaze()
    state, _ = env.reset(KEY)
    for distance, reached in ((0.44, True), (0.46, False)):
        near = state._replace(position=state.goal + jnp.array([0.0, distance]), velocity=jnp.zeros(2))
        near, _, reward, terminated, truncated = env.step(KEY, near, jnp.zeros(2))
        assert (float(reward), bool(terminated), bool(truncated)) == (float(reached) - 1.0, reached, False)
        assert bool(env.success(near)) == reached
