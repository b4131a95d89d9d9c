"""The replay buffer on the device returns the batches of the replay buffer on the host."""

import itertools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.core import spaces
from rejeu.core.prng import below
from rejeu.core.schedules import Linear
from rejeu.envs.functional.protocol import of_two_goals
from rejeu.envs.functional.vector import goal_functions
from rejeu.replay import device_priorities
from rejeu.replay.device import DeviceReplay, download, upload
from rejeu.replay.hindsight import HerReplayBuffer, HindsightConfig, relabeled_positions
from rejeu.replay.prioritized import Priorities, PriorityConfig
from rejeu.replay.ring import Ring
from rejeu.replay.uniform import ReplayBuffer
from rejeu.training.compiled.off_policy import draws
from tests.jax_environments import Reach
from tests.replay.test_hindsight import last_three_episodes, nearby
from tests.tiers import only, only_tuples
from tests.training.compiled.same_draws import use_same_draws

ROWS, N_ENVS, BATCH = 23, 3, 40
LENGTHS = (7, 30, 3)
"""Steps of the episodes of each environment; the second is longer than the ring."""


def ring_of(n_envs: int) -> Ring:
    """Returns an empty ring with all counters."""
    space = Reach().observation_space
    leaves, structure = spaces.leaves(space), spaces.structure(space)
    return Ring(ROWS * n_envs, n_envs, leaves, structure, (1,), np.float32, counters=("since_start", "until_end"))


def observations(rng: np.random.Generator, n: int) -> dict[str, np.ndarray]:
    """Returns random observations on the grid of ``Reach``."""
    return {key: np.round(rng.uniform(-9, 9, (n, 1))).astype(np.float32) / 4 for key in Reach().observation_space}


def steps(n_envs: int, n: int) -> list[Any]:
    """Returns the steps of episodes that end by both flags: action, reward, terminated, successor, ended, first obs."""
    rng, time = np.random.default_rng(1), np.zeros(n_envs, int)
    found = []
    for _ in range(n):
        time += 1
        ended = time == np.array(LENGTHS[:n_envs])
        time[ended] = 0
        action = rng.uniform(-1, 1, (n_envs, 1)).astype(np.float32)
        reward = rng.normal(size=n_envs).astype(np.float32)
        found.append((action, reward, ended & (rng.random(n_envs) < 0.5), observations(rng, n_envs), ended,
                      observations(rng, n_envs)))  # fmt: skip
    return found


def filled(n_envs: int, n: int) -> Ring:
    """Returns a ring after ``n`` steps of every environment."""
    ring = ring_of(n_envs)
    ring.begin(observations(np.random.default_rng(0), n_envs))
    for action, reward, terminated, next_obs, ended, first in steps(n_envs, n):
        ring.add(action, reward, terminated, next_obs)
        if ended.any():
            ring.begin(first, np.flatnonzero(ended))
    return ring


def device_replay(n_envs: int, **settings: Any) -> DeviceReplay:
    """Returns how batches of the ring are drawn on the device."""
    structure = spaces.structure(Reach().observation_space)
    return DeviceReplay(ROWS, n_envs, structure, 0.9, BATCH, achieved=0, desired=1, **settings)


def assert_same_batches(replay: DeviceReplay, buffer: Any, stops: bool, exact: bool) -> None:
    """Asserts that device and host return equal batches for equal random numbers."""
    env, key = Reach(stops=stops), jnp.array([3, 4], jnp.uint32)
    ring = upload(replay, buffer.ring)
    if buffer.priorities is not None:
        ring = ring._replace(priorities=device_priorities.upload(buffer.priorities, [], 1, BATCH))
    reward, terminated = of_two_goals(env.compute_reward), of_two_goals(env.compute_terminated) if stops else None
    for step in range(3):
        run = SimpleNamespace(replay=buffer, key=key, step=step, rng=None)
        progress = step / 2
        batch, rows = jax.jit(lambda ring, key, progress: replay.draw(ring, key, progress, reward, terminated))(
            ring, jax.random.fold_in(draws(key, jnp.uint32(step)), 1), jnp.float32(progress)
        )
        use_same_draws(run)
        expected, drawn = run.replay.draw(run.rng, (BATCH,), progress)
        if buffer.priorities is not None:
            np.testing.assert_array_equal(rows.position, drawn.position)
            np.testing.assert_array_equal(rows.time, drawn.time)
        del buffer.draw
        if isinstance(buffer, HerReplayBuffer):
            del buffer.goal_index, buffer.chosen_by
        for one, two in zip(jax.tree.leaves(batch), jax.tree.leaves(expected), strict=True):
            assert one.dtype == two.dtype
            np.testing.assert_allclose(one, two, rtol=0, atol=0 if exact else 1e-6)


@pytest.mark.parametrize("n_steps", only([3], [1, 3]))
@pytest.mark.parametrize(("n_envs", "n"), only_tuples([(1, 15), (3, 100)], [(1, 15), (3, 15), (3, 100)]))
def test_uniform_batches_equal_those_of_the_host(n_envs: int, n: int, n_steps: int) -> None:
    buffer = ReplayBuffer(filled(n_envs, n), 0.9, n_steps, each_reward=True)
    assert_same_batches(device_replay(n_envs, n_steps=n_steps, each_reward=True), buffer, False, n_steps == 1)


@pytest.mark.parametrize(
    "strategy",
    [
        "future",
        nearby,
        last_three_episodes,
        {"future": 2, "desired": 1},
        *(
            pytest.param(name, marks=pytest.mark.exhaustive)
            for name in ("closest", "next_future", "final", "episode", "random")
        ),
    ],
)
@pytest.mark.parametrize(
    ("n", "n_steps", "stops"),
    only_tuples([(100, 3, True)], [(15, 1, False), (100, 1, True), (100, 3, True)]),
    ids=["running", "overwritten", "n-step"],
)
def test_hindsight_batches_equal_those_of_the_host(strategy: Any, n: int, n_steps: int, stops: bool) -> None:
    config = HindsightConfig(n_sampled_goal=4, goal_selection_strategy=strategy)
    goals = goal_functions(Reach(stops=stops))
    assert goals is not None
    buffer = HerReplayBuffer(filled(N_ENVS, n), 0.9, config, goals, n_steps)
    replay = device_replay(N_ENVS, n_steps=n_steps, strategy=config.goal_selection_strategy)
    assert_same_batches(replay, buffer, stops, n_steps == 1)


@pytest.mark.parametrize("chosen", [lambda steps: steps.last[:, None], lambda steps: steps.last + 0.5])
def test_times_that_the_host_refuses_are_refused_on_the_device(chosen: Any) -> None:
    goals = goal_functions(Reach(stops=False))
    assert goals is not None
    buffer = HerReplayBuffer(filled(N_ENVS, 100), 0.9, HindsightConfig(), goals)
    with pytest.raises(
        ValueError, match=r"must return whole numbers, times that are stored.*it returned (int32|float32)"
    ):
        assert_same_batches(device_replay(N_ENVS, strategy=chosen), buffer, False, True)


def prioritized(ring: Ring) -> Priorities:
    """Returns priorities of the steps of a ring, some of which were drawn before."""
    priorities = Priorities(ring, PriorityConfig(beta=Linear(0.4, 1.0)))
    priorities.restore()
    rng = np.random.default_rng(2)
    for _ in range(3):
        _, _, drawn = priorities.draw(rng, BATCH, 0.0)
        priorities.update([(drawn, rng.exponential(size=BATCH))])
    return priorities


@pytest.mark.parametrize("n_steps", only([3], [1, 3]))
@pytest.mark.parametrize(("n_envs", "n"), only_tuples([(3, 100)], [(1, 15), (3, 100)]))
def test_batches_by_priority_equal_those_of_the_host(n_envs: int, n: int, n_steps: int) -> None:
    ring = filled(n_envs, n)
    buffer = ReplayBuffer(ring, 0.9, n_steps, prioritized(ring))
    replay = device_replay(n_envs, n_steps=n_steps, priorities=buffer.priorities.config)
    assert_same_batches(replay, buffer, False, False)


@pytest.mark.parametrize("n", only([60], [5, 60]))
def test_priorities_of_new_steps_equal_those_of_the_host(n: int) -> None:
    ring = ring_of(N_ENVS)
    buffer = ReplayBuffer(ring, 0.9, 1, Priorities(ring, PriorityConfig()))
    buffer.begin(observations(np.random.default_rng(0), N_ENVS))
    buffer.priorities.largest = 3.0
    replay = device_replay(N_ENVS, priorities=buffer.priorities.config)
    on_device = upload(replay, ring)._replace(priorities=device_priorities.upload(buffer.priorities, [], 1, BATCH))

    @jax.jit
    def write(on_device: Any, step: Any, is_stored: Any) -> Any:
        action, reward, terminated, next_obs, ended, first = step
        on_device = replay.add(on_device, action, reward, terminated, next_obs, is_stored)
        return replay.begin(on_device, first, ended)

    for i, (action, reward, terminated, next_obs, ended, first) in enumerate(steps(N_ENVS, n)):
        is_stored = i % 7 > 0
        on_device = write(on_device, (action, reward, terminated, next_obs, ended, first), np.bool_(is_stored))
        if is_stored:
            buffer.add(action, reward, terminated, next_obs)
        if ended.any():
            buffer.begin(first, np.flatnonzero(ended))
        values = buffer.priorities.tree[np.arange(ROWS * N_ENVS)]
        np.testing.assert_array_equal(on_device.priorities.values[: len(values)], values)
        assert int(on_device.priorities.n_steps) == len(ring)
    np.testing.assert_allclose(on_device.priorities.sums.sum(), buffer.priorities.tree.total)


@pytest.mark.parametrize("n", only([60], [5, 60]))
def test_writing_on_the_device_equals_writing_on_the_host(n: int) -> None:
    replay, ring = device_replay(N_ENVS, strategy="future"), ring_of(N_ENVS)
    ring.begin(observations(np.random.default_rng(0), N_ENVS))
    on_device = upload(replay, ring)

    @jax.jit
    def write(on_device: Any, step: Any) -> Any:
        action, reward, terminated, next_obs, ended, first = step
        on_device = replay.add(on_device, action, reward, terminated, next_obs, jnp.bool(True))
        return replay.begin(on_device, first, ended)

    for step in steps(N_ENVS, n):
        on_device = write(on_device, step)
    host = filled(N_ENVS, n)
    expected = upload(replay, host)
    for name in ("obs", "action", "reward", "kind", "head"):
        for one, two in zip(*(jax.tree.leaves(getattr(x, name)) for x in (on_device, expected)), strict=True):
            np.testing.assert_array_equal(one, two, err_msg=name)
    env, time = np.concatenate([np.full(host.head[i] - host.oldest()[i] + 1, i) for i in range(N_ENVS)]), np.concatenate(
        [np.arange(host.oldest()[i], host.head[i] + 1) for i in range(N_ENVS)]
    )  # fmt: skip
    for table in ("begins", "ends"):  # episodes are numbered otherwise after a reset of the numbers
        one, two = (
            np.asarray(getattr(x, table))[env * ROWS + np.asarray(x.episode)[host.index(env, time)] % ROWS]
            for x in (on_device, expected)
        )
        if table == "begins":
            one, two = (np.maximum(x, host.oldest()[env]) for x in (one, two))
        np.testing.assert_array_equal(one, two, err_msg=table)


@pytest.mark.parametrize("n", only([60], [5, 60]))
def test_rows_of_the_device_are_copied_to_the_host_with_their_counters(n: int) -> None:
    ring, expected = filled(N_ENVS, 1), filled(N_ENVS, n)
    download(ring, upload(device_replay(N_ENVS, strategy="future"), expected))
    for name in ("head", "n_steps"):
        np.testing.assert_array_equal(getattr(ring, name), getattr(expected, name), err_msg=name)
    for env in range(N_ENVS):
        times = np.arange(expected.oldest()[env], expected.head[env] + 1)
        index, age = expected.index(np.full(len(times), env), times), times - times[0]
        for name in ("obs.0", "action", "reward", "until_end"):
            np.testing.assert_array_equal(ring.records[name][index], expected.records[name][index], err_msg=name)
        since_start = np.minimum(expected.since_start[index], age)  # of an episode whose beginning was overwritten
        np.testing.assert_array_equal(ring.since_start[index], since_start)
        np.testing.assert_array_equal(ring.kind[index], expected.kind[index])


def test_as_many_transitions_are_relabeled_as_on_the_host_for_any_size_of_a_batch() -> None:
    """The first ``k / (k + 1)``, rounded down: of 3 at ``k = 1`` one."""
    for n, k in itertools.product(range(1, 40), range(6)):
        wanted = sum((k + 1) * i <= k * n for i in range(1, n + 1))
        assert relabeled_positions((n,), k) == slice(wanted)
        assert DeviceReplay(ROWS, N_ENVS, None, 0.9, n, n_sampled_goal=k).n_relabeled == wanted


def test_whole_numbers_from_random_bits_equal_64_bit_arithmetic() -> None:
    rng = np.random.default_rng(0)
    bits = rng.integers(2**32, size=1000, dtype=np.uint32)
    n = rng.integers(1, 2**31 - 1, size=1000)
    np.testing.assert_array_equal(
        below(jnp.asarray(bits), jnp.asarray(n)), (bits.astype(object) * n.astype(object)) >> 32
    )
