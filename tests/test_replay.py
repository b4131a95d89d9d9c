"""The ring and the plain replay buffer against a brute-force list of episodes."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import stats

from rejeu.replay.prioritized import Priorities, PriorityConfig
from rejeu.replay.ring import check_memory
from rejeu.replay.uniform import ReplayBuffer
from tests.replay_model import Model, Turn, make_ring, observe, play, turns

GAMMA = 0.9


@st.composite
def histories(draw):
    n_envs = draw(st.integers(1, 4))
    rows = draw(st.integers(2, 12))
    return n_envs, rows, draw(turns(n_envs))


def filled(n_envs, rows, history, n_steps=1, priorities=False):
    ring = make_ring(rows * n_envs, n_envs)
    replay = ReplayBuffer(ring, GAMMA, n_steps, Priorities(ring, PriorityConfig()) if priorities else None)
    model = Model(n_envs, rows)
    play(replay, model, history)
    return replay, model


def check_observation(obs, row, env, place):
    expected = observe(env + 1, [place] * (env + 1))
    np.testing.assert_array_equal(obs["where"][row], expected["where"][env])
    np.testing.assert_array_equal(obs["more"][0][row], expected["more"][0][env])
    np.testing.assert_array_equal(obs["more"][1][row], expected["more"][1][env])


@settings(max_examples=150)
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
    replay, model = filled(n_envs, rows, history)
    arrays = {name: array.copy() for name, array in replay.arrays().items()}
    other = ReplayBuffer(make_ring(rows * n_envs, n_envs), GAMMA)
    other.restore(arrays)
    assert other.size() == replay.size()
    for buffer in (replay, other):
        again = Model(n_envs, rows)
        again.frames = [list(frames) for frames in model.frames]
        fitted = [Turn(*([(values * n_envs)[:n_envs] for values in (t.stepping, t.ends, t.restarting)])) for t in more]
        play(buffer, again, fitted, seed=5)
    if replay.size():
        one, two = (buffer.sample(np.random.default_rng(3), (2, 16)) for buffer in (replay, other))
        jax.tree.map(np.testing.assert_array_equal, one, two)
    for name, array in replay.arrays().items():
        np.testing.assert_array_equal(array, other.arrays()[name], err_msg=name)


NO_END = Turn([True] * 2, ["no"] * 2, [False] * 2)


def test_steps_are_drawn_uniformly_over_uneven_environments_and_short_episodes():
    """Environment 1 has a third of the steps and many final rows; Pearson's chi-square at the 0.1 % level."""
    history = [Turn([True, i % 3 == 0], ["no", "truncated" if i % 6 == 0 else "no"], [False, False]) for i in range(60)]
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


def test_sampling_is_decided_by_the_generator_alone():
    replay, _ = filled(2, 8, [NO_END] * 6)
    one, two = (replay.sample(np.random.default_rng(4), (9,)) for _ in range(2))
    np.testing.assert_array_equal(one.obs["where"], two.obs["where"])


def test_a_sample_does_not_change_when_the_ring_goes_on():
    replay, model = filled(2, 4, [NO_END] * 6)
    batch = replay.sample(np.random.default_rng(0), (32,))
    before = batch.obs["where"].copy(), batch.next_obs["where"].copy()
    play(replay, model, [NO_END] * 6)
    np.testing.assert_array_equal(batch.obs["where"], before[0])
    np.testing.assert_array_equal(batch.next_obs["where"], before[1])


def test_a_time_limit_bootstraps_and_a_termination_does_not():
    for end, discount in (("truncated", GAMMA), ("terminated", 0.0)):
        replay, _ = filled(1, 4, [Turn([True], [end], [False])])
        batch = replay.sample(np.random.default_rng(0), (4,))
        np.testing.assert_array_equal(batch.discount, np.full(4, discount, np.float32))
        np.testing.assert_array_equal(batch.next_obs["where"], [[0, 1]] * 4)


def test_an_empty_buffer_says_that_it_is_empty():
    with pytest.raises(ValueError, match="replay buffer is empty: take some environment steps"):
        filled(2, 4, [])[0].sample(np.random.default_rng(0), (1,))


def test_capacity_is_shared_among_environments():
    ring = make_ring(10, 3)
    assert ring.rows == 3
    needed = sum(a.nbytes for a in (*ring.obs, ring.action, ring.reward, ring.kind)) + 9 * 8
    assert needed <= ring.nbytes < needed + 9 * 8, "a row takes what it holds, and less than 8 bytes of alignment"


def test_memory_beyond_the_machine_is_refused_with_the_numbers():
    with pytest.raises(MemoryError, match=r"buffer_size=1000 takes .* GiB .* machine has .* GiB; try buffer_size=\d+"):
        check_memory(2**60, 1000)


# Files of buffers.


@pytest.fixture
def arrays():
    return {name: array.copy() for name, array in filled(2, 6, [NO_END] * 8)[0].arrays().items()}


def test_arrays_leave_out_rows_that_were_never_written():
    ring_arrays = filled(2, 100, [NO_END] * 3)[0].arrays()
    assert ring_arrays["obs.where"].shape == (2, 4, 2)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda a: a.pop("reward"), "differ in the arrays reward"),
        (lambda a: a.update(extra=np.zeros(1)), "differ in the arrays extra"),
        (lambda a: a.update(head=np.zeros(3, np.int64), n_steps=np.zeros(3, np.int64)), "of 3 environments .* has 2"),
        (lambda a: a.update(head=a["head"].astype(np.int32)), "counters are damaged"),
        (lambda a: a.update(head=a["head"] * 0 - 2), "counters are damaged"),
        (lambda a: a.update(n_steps=a["n_steps"] + 1), "counters are damaged"),
        (lambda a: a.update(kind=np.full_like(a["kind"], 2)), "counters are damaged"),
        (lambda a: a.update(kind=np.full_like(a["kind"], 3)), "counters are damaged"),
        (lambda a: a.update(since_start=a["since_start"] - 100), "counters are damaged"),
        (lambda a: a.update(until_end=a["until_end"] + 1000), "counters are damaged"),
        (lambda a: a.update(reward=a["reward"].astype(np.float64)), r"reward .* float64.* expects float32"),
        (lambda a: a.update({"obs.where": a["obs.where"][:, :, :1]}), "another environment or buffer_size"),
        (lambda a: a.update(head=a["head"] + 2**62), "counters are damaged"),
    ],
)
def test_a_damaged_file_of_a_buffer_changes_nothing(arrays, damage, words):
    replay, _ = filled(2, 6, [NO_END] * 5)
    before = {name: array.copy() for name, array in replay.arrays().items()}
    damage(arrays)
    with pytest.raises(ValueError, match=words):
        replay.restore(arrays)
    for name, array in replay.arrays().items():
        np.testing.assert_array_equal(array, before[name])


@settings(max_examples=150)
@given(case=histories(), cuts=st.lists(st.integers(0, 40), max_size=4), priorities=st.booleans())
def test_rows_written_bit_by_bit_make_the_same_ring(case, cuts, priorities):
    n_envs, rows, history = case
    replay, parts, heads = None, [], np.full(n_envs, -1, np.int64)
    for cut in sorted({min(cut, len(history)) for cut in (*cuts, len(history))}):
        replay, _ = filled(n_envs, rows, history[:cut], priorities=priorities)  # the same up to there, whatever follows
        parts.append({key: np.copy(value) for key, value in replay.ring.rows_since(heads).items()})
        heads = replay.ring.head.copy()
    other = make_ring(rows * n_envs, n_envs)
    other.put_rows(parts)
    expected, found = replay.ring.arrays(), other.arrays()
    kept = [replay.ring.index(np.full(k, e), replay.ring.head[e] - np.arange(k)) for e, k in enumerate(counts(replay))]
    for key in expected:
        if key in ("head", "n_steps"):
            np.testing.assert_array_equal(found[key], expected[key])
    for store, own in zip((*other.obs, other.records), (*replay.ring.obs, replay.ring.records), strict=True):
        np.testing.assert_array_equal(store[np.concatenate(kept)], own[np.concatenate(kept)])
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
