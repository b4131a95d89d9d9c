"""The replay memory for loops of one's own."""

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from tests.environments import Reach

LINE = gym.spaces.Box(-9.0, 9.0, (1,), np.float32)
CHOICES = gym.spaces.Discrete(3, start=5)


def memory(capacity=4, action_space=CHOICES, **settings):
    return rejeu.ReplayMemory(capacity, LINE, action_space, **{"gamma": 0.5, "seed": 0, **settings})


def push(memory, i, terminated=False):
    memory.push([float(i)], 5 + i % 3, 10.0 * i, [float(i + 1)], terminated)


def drawn(memory, n=200):
    """Returns the transitions of a large sample, each once, in order of their observations."""
    batch = memory.sample(n)
    rows = zip(batch.obs[:, 0], batch.action, batch.reward, batch.next_obs[:, 0], batch.discount, strict=True)
    return sorted({tuple(float(x) for x in row) for row in rows})


def test_what_was_pushed_is_drawn_with_its_own_reward_successor_and_end():
    kept = memory()
    for i in range(3):
        push(kept, i, terminated=i == 1)
    assert len(kept) == 3
    assert drawn(kept) == [(0.0, 0.0, 0.0, 1.0, 0.5), (1.0, 1.0, 10.0, 2.0, 0.0), (2.0, 2.0, 20.0, 3.0, 0.5)]


def test_the_oldest_give_way_and_exactly_the_newest_are_kept():
    kept = memory(capacity=4)
    for i in range(10):
        push(kept, i)
    assert len(kept) == 4
    assert [row[0] for row in drawn(kept)] == [6.0, 7.0, 8.0, 9.0]


def test_a_seed_repeats_the_draws():
    first, second = memory(seed=3), memory(seed=3)
    for i in range(4):
        push(first, i)
        push(second, i)
    np.testing.assert_array_equal(first.sample(50).obs, second.sample(50).obs)


def test_continuous_actions_come_back_as_algorithms_have_them():
    kept = memory(action_space=gym.spaces.Box(0.0, 4.0, (2,), np.float32))
    kept.push([0.0], [0.0, 3.0], 1.0, [0.0], False)
    batch = kept.sample(2)
    np.testing.assert_allclose(batch.action, [[-1.0, 0.5]] * 2)
    assert batch.action.dtype == batch.reward.dtype == batch.discount.dtype == np.float32


def test_observations_may_be_dicts():
    env = Reach()
    kept = rejeu.ReplayMemory(10, env.observation_space, env.action_space)
    obs, _ = env.reset(seed=0)
    next_obs, reward, terminated, *_ = env.step(np.ones(1, np.float32))
    kept.push(obs, np.ones(1), reward, next_obs, terminated)
    batch = kept.sample(3)
    for key in env.observation_space:
        np.testing.assert_array_equal(batch.next_obs[key], np.stack([next_obs[key]] * 3))


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda m: m.sample(2), "the memory is empty"),
        (lambda m: m.push([0.0, 1.0], 5, 0.0, [0.0], False), r"obs has the shapes \[\(2,\)\], expected \[\(1,\)\]"),
        (lambda m: m.push([0.0], 5, 0.0, None, True), "next_obs has the shapes"),
        (lambda m: m.push([0.0], 0, 0.0, [0.0], False), "push has actions from 0 to 0, expected Discrete"),
        (lambda m: m.push([0.0], [5], 0.0, [0.0], False), r"action has the shape \(1,\), expected \(\)"),
        (lambda m: m.push([0.0], 5, np.nan, [0.0], False), "must be finite"),
        (lambda m: memory(capacity=0), "capacity=0 must be a whole number of at least 1"),
        (lambda m: memory(action_space=gym.spaces.MultiBinary(2)), "takes Box and Discrete actions, got MultiBinary"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line_and_changes_nothing(act, message):
    kept = memory()
    with pytest.raises(ValueError, match=message) as caught:
        act(kept)
    assert "\n" not in str(caught.value)
    assert len(kept) == 0


def test_more_than_the_machine_holds_is_refused_with_what_fits():
    with pytest.raises(MemoryError, match=r"capacity=10+ takes .* GiB .*; try capacity=\d+"):
        memory(capacity=10**15)
