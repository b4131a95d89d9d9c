"""The ring and the plain replay buffer against a brute-force list of episodes."""

import gymnasium as gym
import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from rejeu.replay import ring_io
from rejeu.replay.prioritized import Priorities, PriorityConfig
from rejeu.replay.ring import COUNTERS
from rejeu.replay.uniform import ReplayBuffer
from tests.replay_model import Model, Turn, histories, make_ring, observe, play, turns

GAMMA = 0.9


def filled(n_envs, rows, history, n_steps=1, priorities=False, counters=()):
    ring = make_ring(rows * n_envs, n_envs, counters=counters)
    replay = ReplayBuffer(ring, GAMMA, n_steps, Priorities(ring, PriorityConfig()) if priorities else None)
    model = Model(n_envs, rows)
    play(replay, model, history)
    return replay, model


def kept_counters(ring):
    """By environment, of the rows kept in order: steps since the oldest of their episode, and steps until its end."""
    found = []
    for env in range(ring.n_envs):
        times = np.arange(ring.oldest()[env], ring.head[env] + 1)
        index = ring.index(np.full(len(times), env), times)
        found.append((np.minimum(ring.since_start[index], times - times[0]).tolist(), ring.until_end[index].tolist()))
    return found


def check_observation(obs, row, env, place):
    expected = observe(env + 1, [place] * (env + 1))
    np.testing.assert_array_equal(obs["where"][row], expected["where"][env])
    np.testing.assert_array_equal(obs["more"][0][row], expected["more"][0][env])
    np.testing.assert_array_equal(obs["more"][1][row], expected["more"][1][env])


@settings(max_examples=60)
@given(case=histories(), n_steps=st.integers(1, 5), priorities=st.booleans())
def test_samples_are_exactly_the_steps_that_are_kept(case, n_steps, priorities):
    replay, model = filled(*case, n_steps, priorities)
    steps = set(model.steps())
    assert replay.size() == len(steps)
    if not steps:
        return
    n = 60 * len(steps)  # the chance of missing one of them is below len(steps) * e^-60
    batch = replay.sample(np.random.default_rng(1), (n,))
    seen = set()
    for row in range(n):
        env, place = (int(x) for x in batch.obs["where"][row])
        assert (env, place) in steps
        if (env, place) in seen:
            continue
        seen.add((env, place))
        check_observation(batch.obs, row, env, place)
        reward, following, discount = model.n_step(env, place, n_steps, GAMMA)
        assert batch.action[row, 0] == np.float32(model.frames[env][place].step[0])
        assert batch.reward[row] == pytest.approx(reward, abs=1e-5)
        assert batch.discount[row] == pytest.approx(discount, abs=1e-6)
        check_observation(batch.next_obs, row, env, following)
        assert model.frames[env][following].episode == model.frames[env][place].episode
    assert seen == steps


@settings(max_examples=30)
@given(case=histories(), more=turns(2, 10))
def test_a_restored_buffer_samples_and_grows_like_the_original(case, more):
    n_envs, rows, history = case
    replay, model = filled(n_envs, rows, history, counters=COUNTERS)
    arrays = {name: array.copy() for name, array in replay.arrays().items()}
    other = ReplayBuffer(make_ring(rows * n_envs, n_envs, counters=COUNTERS), GAMMA)
    other.restore(arrays)
    assert other.size() == replay.size()
    assert kept_counters(other.ring) == kept_counters(replay.ring)
    for buffer in (replay, other):
        again = Model(n_envs, rows)
        again.frames = [list(frames) for frames in model.frames]
        fitted = [Turn(*([(values * n_envs)[:n_envs] for values in (t.ends, t.restarting)])) for t in more]
        play(buffer, again, fitted, seed=5)
    if replay.size():
        one, two = (buffer.sample(np.random.default_rng(3), (2, 16)) for buffer in (replay, other))
        jax.tree.map(np.testing.assert_array_equal, one, two)
    for name, array in replay.arrays().items():
        np.testing.assert_array_equal(array, other.arrays()[name], err_msg=name)
    assert kept_counters(other.ring) == kept_counters(replay.ring)


@settings(max_examples=50)
@given(case=histories())
def test_counters_are_those_of_the_episodes(case):
    replay, model = filled(*case, counters=COUNTERS)
    for env, (since_start, until_end) in enumerate(kept_counters(replay.ring)):
        episodes = [model.episode(env, place) for place in model.kept(env)]
        places = list(model.kept(env))
        assert since_start == [place - episode[0] for place, episode in zip(places, episodes, strict=True)]
        closed = [model.frames[env][episode[-1]].closed for episode in episodes]
        ends = [e[-1] if is_closed else place for place, e, is_closed in zip(places, episodes, closed, strict=True)]
        assert until_end == [end - place for place, end in zip(places, ends, strict=True)]


NO_END = Turn(["no"] * 2, [False] * 2)


def test_steps_are_drawn_uniformly_over_uneven_environments_and_short_episodes():
    """Every second row of environment 1 is a final one; Pearson's chi-square at the 0.1 % level."""
    history = [Turn(["no", "truncated"], [False, False])] * 60
    replay, model = filled(2, 70, history)
    steps = sorted(model.steps())
    assert {env for env, _ in steps} == {0, 1}
    batch = replay.sample(np.random.default_rng(0), (200 * len(steps),))
    where = [tuple(int(x) for x in row) for row in batch.obs["where"]]
    counts = [where.count(step) for step in steps]
    assert sum(counts) == len(where)
    assert stats.chisquare(counts).pvalue > 1e-3


def test_a_batch_has_the_shape_that_was_asked_for():
    replay, _ = filled(2, 8, [NO_END] * 4)
    batch = replay.sample(np.random.default_rng(0), (3, 5))
    assert batch.obs["where"].shape == (3, 5, 2)
    assert batch.next_obs["more"][1].shape == (3, 5, 1)
    assert batch.action.shape == (3, 5, 1)
    assert batch.reward.shape == batch.discount.shape == (3, 5)
    assert batch.reward.dtype == batch.discount.dtype == np.float32
    assert batch.obs["more"][0].dtype == np.int32
    assert batch.obs["more"][1].dtype == np.uint8


def test_a_sample_does_not_change_when_the_ring_goes_on():
    replay, model = filled(2, 4, [NO_END] * 6)
    batch = replay.sample(np.random.default_rng(0), (32,))
    before = batch.obs["where"].copy(), batch.next_obs["where"].copy()
    play(replay, model, [NO_END] * 6)
    np.testing.assert_array_equal(batch.obs["where"], before[0])
    np.testing.assert_array_equal(batch.next_obs["where"], before[1])


def test_an_empty_buffer_says_that_it_is_empty():
    with pytest.raises(ValueError, match="replay buffer is empty: take some environment steps"):
        filled(2, 4, [])[0].sample(np.random.default_rng(0), (1,))


def test_capacity_is_shared_among_environments():
    ring = make_ring(10, 3)
    assert ring.rows == 3
    needed = sum(a.nbytes for a in (*ring.obs, ring.action, ring.reward, ring.kind))
    assert needed <= ring.nbytes < needed + 9 * 4, "a row takes what it holds, and less than 4 bytes of alignment"


def test_priorities_take_sixteen_bytes_a_row_where_their_number_is_a_power_of_two():
    """A sum tree of float64 has twice as many nodes as leaves, and the next power of two of leaves."""
    ring = make_ring(1024, 4, gym.spaces.Box(-8, 8, (3,), np.float32))
    assert ring.nbytes == 1024 * 21
    assert Priorities(ring, PriorityConfig()).tree.nodes.nbytes == 1024 * 16
    assert Priorities(make_ring(1025, 1), PriorityConfig()).tree.nodes.nbytes == 2048 * 16


def test_small_numbers_leave_no_gaps_between_larger_ones():
    """9 and 7 bytes around two float32, which would take 12 and 8 in the order of the keys."""
    boxes = {"a": (9, np.uint8), "b": (2, np.float32), "c": (7, np.uint8)}
    space = gym.spaces.Dict({key: gym.spaces.Box(0, 255, (n,), dtype) for key, (n, dtype) in boxes.items()})
    assert make_ring(100, 1, space).nbytes == 100 * (9 + 2 * 4 + 7 + 4 + 4 + 1)


# Files of buffers.


@settings(max_examples=60)
@given(case=histories(), cuts=st.lists(st.integers(0, 40), max_size=4), priorities=st.booleans())
def test_rows_written_bit_by_bit_make_the_same_ring(case, cuts, priorities):
    n_envs, rows, history = case
    replay, parts, heads = None, [], np.full(n_envs, -1, np.int64)
    for cut in sorted({min(cut, len(history)) for cut in (*cuts, len(history))}):
        # The same up to there, whatever follows.
        replay, _ = filled(n_envs, rows, history[:cut], priorities=priorities, counters=COUNTERS)
        parts.append({key: np.copy(value) for key, value in ring_io.rows_since(replay.ring, heads).items()})
        heads = replay.ring.head.copy()
    other = make_ring(rows * n_envs, n_envs, counters=COUNTERS)
    ring_io.put_rows(other, parts)
    assert kept_counters(other) == kept_counters(replay.ring)
    expected, found = ring_io.arrays(replay.ring), ring_io.arrays(other)
    kept = [replay.ring.index(np.full(k, e), replay.ring.head[e] - np.arange(k)) for e, k in enumerate(counts(replay))]
    for key in expected:
        if key in ("head", "n_steps"):
            np.testing.assert_array_equal(found[key], expected[key])
    stores = ([*ring.obs, ring.action, ring.reward, ring.kind] for ring in (other, replay.ring))
    for one, two in zip(*stores, strict=True):
        np.testing.assert_array_equal(one[np.concatenate(kept)], two[np.concatenate(kept)])
    if priorities:
        again = Priorities(other, PriorityConfig())
        again.restore(replay.priorities.state())
        np.testing.assert_array_equal(again.tree.nodes, replay.priorities.tree.nodes)
        if len(replay.ring):
            one, two = (p.draw(np.random.default_rng(0), 5, 0.5) for p in (again, replay.priorities))
            np.testing.assert_array_equal(one[0], two[0])
            np.testing.assert_array_equal(one[1], two[1])


def counts(replay):
    """The rows kept of each environment."""
    return np.minimum(replay.ring.head + 1, replay.ring.rows).tolist()
