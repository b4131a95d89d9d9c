"""The sum tree on the device finds, changes and weighs as the one on the host."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.core.spaces import Leaf
from rejeu.replay import device_priorities
from rejeu.replay.device_priorities import NOWHERE, WIDTH, added_up, find
from rejeu.replay.prioritized import Draw, Priorities, PriorityConfig
from rejeu.replay.ring import Ring

BATCH = 8


def ring_of(n: int, head: int) -> Ring:
    """Returns the ring of one environment with ``n`` rows, and its newest row at the time ``head``."""
    ring = Ring(n, 1, (Leaf("", "continuous", (1,), "float32"),), jax.tree.structure(0), (1,), np.float32)
    ring.recount(np.array([head]))
    return ring


def priorities_of(values: np.ndarray, head: int = -1, **config: Any) -> Priorities:
    """Returns priorities of the rows of a ring, without a check that these are steps."""
    priorities = Priorities(ring_of(len(values), head), PriorityConfig(**config))
    priorities.load(values.astype(np.float64), 1.0)
    return priorities


def random_values(n: int, seed: int = 0) -> np.ndarray:
    """Returns priorities of which a tenth is 0."""
    rng = np.random.default_rng(seed)
    return np.where(rng.random(n) < 0.1, 0, rng.exponential(size=n)).astype(np.float32)


def on_device(priorities: Priorities, *td_errors: Any, most: int = 2) -> device_priorities.DevicePriorities:
    """Returns priorities on the device."""
    return device_priorities.upload(priorities, td_errors, most, BATCH)


@pytest.mark.parametrize("n", [3, WIDTH, 1_000, 40_000])
def test_steps_are_found_as_on_the_host(n: int) -> None:
    """40,000 rows are more than one group of blocks. Sums of 32 bits may lead to the next step in rare cases."""
    priorities = priorities_of(random_values(n))
    fraction = (np.random.default_rng(1).integers(2**24, size=2_000) / 2.0**24).astype(np.float32)
    found, total = jax.jit(find)(on_device(priorities), fraction)
    mass = (np.arange(2_000) + fraction.astype(np.float64)) * (priorities.tree.total / 2_000)
    assert (np.asarray(found) != priorities.tree.find(mass)).mean() <= (0 if n < 1_000 else 2e-3)
    assert (priorities.tree[np.asarray(found)] > 0).all()
    np.testing.assert_allclose(total, priorities.tree.total, rtol=1e-6)


@pytest.mark.parametrize("fraction", [0.0, 1.0, 2.0])
def test_a_mass_at_or_beyond_the_total_finds_a_positive_priority(fraction: float) -> None:
    values = np.zeros(300, np.float32)
    values[[130, 200]] = 0.1, 0.2
    found, _ = find(on_device(priorities_of(values)), jnp.full(1, fraction))
    assert found.tolist() == [130 if fraction == 0.0 else 200]


def test_changes_keep_the_sums_that_the_priorities_have() -> None:
    rng, n = np.random.default_rng(0), 20_000
    values = random_values(n)
    priorities = on_device(priorities_of(values))
    change = jax.jit(device_priorities.changed)
    for _ in range(20):
        index = rng.choice(n, 50, replace=False)
        index[:25] = np.unique(index[0] // WIDTH * WIDTH + np.arange(25)) % n  # many of one block
        index = np.unique(index)
        new = np.where(rng.random(len(index)) < 0.2, 0, rng.random(len(index))).astype(np.float32)
        values[index] = new
        padded = np.full(60, NOWHERE, np.int32)
        padded[: len(index)] = index
        priorities = change(priorities, jnp.asarray(padded), jnp.asarray(np.resize(new, 60)))
    np.testing.assert_array_equal(priorities.values[:n], values)
    assert int(priorities.n_steps) == np.count_nonzero(values)
    blocks = np.pad(values, (0, -n % WIDTH)).reshape(-1, WIDTH)
    np.testing.assert_array_equal(priorities.sums[: len(blocks)], added_up(blocks))  # bit for bit
    assert not priorities.sums[len(blocks) :].any()


@pytest.mark.parametrize("alpha", [0.6, 0.0])
def test_td_errors_set_priorities_as_on_the_host(alpha: float) -> None:
    """Of repeated steps the last counts; steps overwritten since, and NaN, are ignored."""
    values, rng = random_values(40), np.random.default_rng(3)
    priorities = priorities_of(values, head=100, alpha=alpha)
    td_errors = []
    for _ in range(3):
        time = rng.integers(55, 100, BATCH)
        time[:3] = time[3]
        td_error = rng.exponential(size=BATCH).astype(np.float32)
        td_error[[2, 5]] = np.nan, np.inf
        td_errors.append((Draw(time % 40, time, priorities.ring.version), td_error))
    ring = priorities.ring
    device = on_device(priorities, *td_errors, most=4)
    head, config = jnp.asarray(ring.head, jnp.int32), priorities.config
    for n in (0, 3):
        after = jax.jit(lambda device, n: device_priorities.updated(device, config, 40, head, n))(device, n)
        priorities.update(td_errors[:n])
        np.testing.assert_allclose(after.values[:40], priorities.tree[np.arange(40)], rtol=1e-6)
        np.testing.assert_allclose(after.largest, priorities.largest, rtol=1e-6)
        np.testing.assert_allclose(after.sums.sum(), priorities.tree.total, rtol=1e-6)


def test_td_errors_that_are_no_whole_batches_of_one_turn_do_not_fit() -> None:
    draw = lambda n: (Draw(np.zeros(n, np.int64), np.zeros(n, np.int64), 0), np.zeros(n))  # noqa: E731
    assert device_priorities.fit([draw(BATCH), draw(BATCH)], 2, BATCH)
    assert not device_priorities.fit([draw(3 * BATCH)], 2, BATCH)
    assert not device_priorities.fit([draw(BATCH // 2)], 2, BATCH)
