"""The ball in JAX against ``rejeu/Ball-v0``."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.envs.functional import ball, make
from rejeu.teaching.ball import Ball as Reference


class Kicks:
    """Random numbers that were drawn elsewhere."""

    def __init__(self, kicks: np.ndarray) -> None:
        self.kicks = iter(kicks)

    def standard_normal(self, n: int) -> np.ndarray:
        return next(self.kicks)


@pytest.mark.parametrize("dimension", [1, 3])
def test_steps_equal_those_of_the_ball_on_the_host(dimension):
    n = 3_000
    rng = np.random.default_rng(0)
    positions = rng.uniform(-10, 10, (n, dimension))
    times = rng.choice([0, 7, 498, 499], n).astype(np.int32)
    actions = rng.uniform(-2.5, 2.5, (n, dimension))
    with jax.enable_x64(True):
        env = ball.Ball(dimension=dimension, sigma=0.7)
        keys = jax.random.split(jax.random.key(0), n)
        kicks = np.asarray(jax.vmap(lambda key: jax.random.normal(key, (dimension,)))(keys))
        states = ball.State(jnp.asarray(positions), jnp.asarray(times))
        after, *ours = jax.device_get(jax.jit(jax.vmap(env.step))(keys, states, jnp.asarray(actions)))
        success = np.asarray(jax.vmap(env.success)(jax.tree.map(jnp.asarray, after)))

    reference = Reference(dimension, sigma=0.7)
    reference.reset(seed=0)
    reference.np_random = Kicks(kicks)
    theirs = []
    for position, time, action in zip(positions, times, actions, strict=True):
        reference.position, reference.n_steps, reference.over = position.tolist(), int(time), False
        theirs.append((*reference.step(action), reference.position))
    obs, reward, terminated, truncated, info, position = zip(*theirs, strict=True)
    np.testing.assert_allclose(after.position, position, atol=1e-12)
    np.testing.assert_allclose(ours[0], obs, atol=1e-6)  # rounded to float32 on the host
    for mine, expected in zip(ours[1:], (reward, terminated, truncated), strict=True):
        np.testing.assert_array_equal(mine, expected)
    np.testing.assert_array_equal(success, [one.get("is_success", False) for one in info])
    assert np.sum(terminated) > 100
    assert np.sum(truncated) > 100


def test_the_first_position_is_uniform_in_the_reach_of_a_push():
    _, obs = jax.vmap(make("jax/Ball-v0").reset)(jax.random.split(jax.random.key(0), 2_000))
    assert obs.shape == (2_000, 2)
    assert -2 <= obs.min() < -1.98
    assert 1.98 < obs.max() <= 2
