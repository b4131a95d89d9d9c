"""Batches are sent to compiled functions as the rows that they were read from, and mean the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from rejeu.buffers.prioritized import Priorities, PriorityConfig
from rejeu.buffers.ring import Ring
from rejeu.buffers.row_batch import RowBatch, jit_update, rows_of
from rejeu.buffers.uniform import ReplayBuffer
from rejeu.spaces import leaves, structure

GOALS = spaces.Dict(
    {
        "achieved_goal": spaces.Box(-1, 1, (2,), np.float32),
        "kind": spaces.Discrete(5),
        "observation": spaces.Box(-1, 1, (2, 3), np.float32),
    }
)
PLAIN = spaces.Box(-1, 1, (3,), np.float32)
IMAGES = spaces.Dict({"image": spaces.Box(0, 255, (4, 4, 1), np.uint8), "state": PLAIN})


def filled(space=GOALS, n_steps=1, with_priorities=False, action_shape=(2,), action_dtype=np.float32):
    """A buffer of 12 steps in each of two environments."""
    rng = np.random.default_rng(0)
    ring = Ring(24, 2, leaves(space), structure(space), action_shape, action_dtype)
    priorities = Priorities(ring, PriorityConfig()) if with_priorities else None
    buffer = ReplayBuffer(ring, 0.9, n_steps, priorities, each_reward=True)
    space.seed(0)

    def obs():
        one, other = space.sample(), space.sample()
        if isinstance(one, np.ndarray):
            return np.stack([one, other])
        return {name: np.stack([one[name], other[name]]) for name in one}

    buffer.begin(obs())
    for _ in range(10):
        action = rng.integers(0, 5, (2, *action_shape)).astype(action_dtype)
        buffer.add(action, rng.random(2).astype(np.float32), rng.random(2) < 0.1, obs())
    return buffer


@pytest.mark.parametrize("shape", [(6,), (3, 4)])
@pytest.mark.parametrize(
    "settings",
    [{}, {"n_steps": 3}, {"with_priorities": True}, {"action_shape": (), "action_dtype": np.int32}],
    ids=["one step", "three steps", "priorities", "discrete actions"],
)
def test_rows_taken_apart_are_the_batch(settings, shape):
    batch = filled(**settings).sample(np.random.default_rng(1), shape, 0.5)
    rows = rows_of(batch)
    assert isinstance(rows, RowBatch)
    assert len(jax.tree.leaves(rows)) < len(jax.tree.leaves(batch)) == len(batch.leaves)
    taken = jax.jit(RowBatch.transition)(rows)
    assert jax.tree.structure(tuple(taken)) == jax.tree.structure(tuple(batch))
    for expected, found in zip(jax.tree.leaves(batch), jax.tree.leaves(taken), strict=True):
        assert expected.dtype == found.dtype
        np.testing.assert_array_equal(expected, found)


@pytest.mark.parametrize("space", [PLAIN, IMAGES], ids=["a single array", "bytes"])
def test_other_batches_are_sent_as_they_are(space):
    batch = filled(space).sample(np.random.default_rng(1), (6,))
    assert rows_of(batch) is batch


def test_what_was_changed_in_a_batch_reaches_the_update():
    buffer = filled()
    total = jit_update(lambda state, batch, clock: (state, jnp.sum(batch.obs["achieved_goal"]) + jnp.sum(batch.reward)))

    def check(batch, as_rows):
        assert isinstance(rows_of(batch), RowBatch) is as_rows
        expected = np.sum(batch.obs["achieved_goal"]) + np.sum(batch.reward)
        np.testing.assert_allclose(total(jnp.zeros(1), batch, 0)[1], expected, rtol=1e-5)

    batch = buffer.sample(np.random.default_rng(1), (6,))
    check(batch, as_rows=True)
    batch.reward[:] = 7.0
    check(batch, as_rows=True)
    check(batch._replace(reward=batch.reward + 1), as_rows=False)
    batch.obs["achieved_goal"] = np.full((6, 2), 3.0, np.float32)
    check(batch, as_rows=False)
