"""Runs on EnvPool: what was done to the environments is recorded, and replayed where a run is resumed."""

from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core.errors import DivergedError
from rejeu.envs import action_log
from rejeu.envs.action_log import ActionLog
from rejeu.envs.make import make_vector
from tests.tiers import only

pytest.importorskip("envpool", exc_type=ImportError)

SPACES = {
    "Discrete": gym.spaces.Discrete(3, start=2),
    "Box": gym.spaces.Box(-2.0, 2.0, (2,), np.float64),
    "MultiDiscrete": gym.spaces.MultiDiscrete([2, 5]),
    "MultiBinary": gym.spaces.MultiBinary(3),
}


def sampled(space, n):
    space.seed(0)
    return np.stack([space.sample() for _ in range(n)])


def fill(log, space, n_steps):
    """Records steps and resets of all environments and of some, and returns them."""
    done = []
    for i in range(n_steps):
        which = None if i % 3 else np.array([0, 2], np.int32)
        action = sampled(space, log.n_envs if which is None else 2)
        log.step(action, which)
        done.append((which, action))
        if i % 5 == 0:
            log.reset(which)
            done.append((which, None))
    return done


@pytest.mark.parametrize("name", SPACES)
def test_a_log_yields_the_operations_that_were_recorded(name):
    space = SPACES[name]
    log = ActionLog(3, space)
    done = fill(log, space, 40)
    saved = log.to_plain()
    again = list(ActionLog(3, space).operations(saved))
    assert len(again) == len(done) == len(saved["codes"])
    for (which, action), (expected_which, expected_action) in zip(again, done, strict=True):
        np.testing.assert_equal(which, expected_which)
        np.testing.assert_equal(action, expected_action)


@pytest.mark.parametrize(
    "damage",
    [
        {"codes": np.uint8([action_log.STEP, 9])},
        {"codes": np.uint8([action_log.STEP, action_log.STEP_SOME, action_log.RESET_SOME])},
        {"codes": np.uint8([action_log.STEP])},
        {"codes": np.uint8([action_log.STEP] * 3), "flags": np.zeros((0, 1), np.uint8)},
        {"codes": np.zeros((2, 1), np.uint8)},
        {"codes": np.zeros(10**7, np.uint8)},
        {"codes": "3"},
        {"flags": np.zeros((1, 2), np.uint8)},
        {"actions": np.int64([1])},
        {"actions": np.int64([1, 0, 1])},
        {"actions": np.int64([1, 7])},
        {"actions": np.float32([1, 0])},
    ],
    ids=[
        *("no operation", "an operation on nobody", "flags of nothing", "cut short", "axes", "too many", "no array"),
        *("other flags", "an action too few", "an action too many", "no action", "another dtype"),
    ],
)
def test_a_damaged_log_is_refused(damage):
    log = ActionLog(1, gym.spaces.Discrete(2))
    log.step(np.array([1]))
    log.step(np.array([0]), np.array([0]))
    assert len([*log.operations(log.to_plain())]) == 2
    with pytest.raises(ValueError, match="record of actions"):
        list(log.operations(log.to_plain() | damage))


def test_a_log_is_full_by_steps_or_by_bytes():
    few, wide = ActionLog(4, gym.spaces.Discrete(2), most_steps=8), gym.spaces.Box(-1, 1, (2**19,), np.float32)
    few.step(np.zeros(4))
    assert not few.is_full
    few.step(np.zeros(4))
    assert few.is_full
    log = ActionLog(2, wide)  # 2 MiB an action, so 8 of them are 16 MiB
    for _ in range(4):
        assert not log.is_full
        log.step(np.zeros((2, 2**19)))
    assert log.is_full


def test_episodes_of_a_pool_without_checkpoints_are_not_ended(monkeypatch):
    monkeypatch.setattr("rejeu.envs.envpool.MOST_STEPS", 10)
    with closing(make_vector("CartPole-v1", 2, "envpool", seed=3)) as env:
        env.reset()
        for _ in range(9):
            env.step(np.zeros(2, int))
            assert not env.must_reset
        assert env.snapshot() is None
        env.record()
        assert env.must_reset
        assert env.snapshot() is None
        env.reset()
        assert not env.must_reset
        assert env.snapshot()["codes"].tolist() == [action_log.RESET]


def test_a_full_log_begins_again_with_another_pool_whose_seed_follows(monkeypatch):
    monkeypatch.setattr("rejeu.envs.envpool.MOST_STEPS", 4)
    first = []
    for _ in range(2):
        with closing(make_vector("CartPole-v1", 2, "envpool", seed=3)) as env:
            env.record()
            before = env.reset().copy()
            for _ in range(2):
                assert not env.must_reset
                env.step(np.zeros(2, int))
            assert env.must_reset
            first.append(env.reset().copy())
            assert not env.must_reset
            assert (first[-1] != before).any()
    np.testing.assert_array_equal(*first)


@pytest.mark.parametrize("algorithm", only(["DQN"], ["DQN", "PPO"]))
def test_a_run_that_fills_its_log_can_be_resumed_before_and_after(algorithm, tmp_path, monkeypatch):
    monkeypatch.setattr("rejeu.envs.envpool.MOST_STEPS", 60)
    settings = {"policy_kwargs": {"net_arch": [8]}, "seed": 1}
    settings |= {"n_steps": 16, "batch_size": 16} if algorithm == "PPO" else {"learning_starts": 10, "batch_size": 8}
    kind = rejeu.AGENTS[algorithm]
    env = lambda: make_vector("CartPole-v1", 2, "envpool", seed=1)  # noqa: E731
    whole = kind("MlpPolicy", env(), **settings).learn(200, Checkpoint(tmp_path / "whole"))
    for cut in (61, 131):
        folder = tmp_path / str(cut)
        stop = lambda agent, turn, cut=cut: turn.step < cut  # noqa: E731
        kind("MlpPolicy", env(), **settings).learn(200, [stop, Checkpoint(folder)])
        again = kind.resume(folder, env())
        assert again.resumed.exact
        again.learn()
        np.testing.assert_equal(again.get_parameters(), whole.get_parameters())
        episodes = [[(e.step, e.episode_return) for e in agent.history.episodes] for agent in (again, whole)]
        assert episodes[0] == episodes[1]


def test_a_pool_that_does_not_repeat_its_episodes_begins_new_ones(tmp_path):
    env = lambda: make_vector("CartPole-v1", 2, "envpool", seed=1)  # noqa: E731
    with closing(env()) as one:
        one.record()
        obs = one.reset().copy()
        with pytest.raises(DivergedError, match="does not repeat"):
            one.restore(one.snapshot(), obs + 1.0)
    settings = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "batch_size": 8, "buffer_size": 200}
    stop = lambda agent, turn: turn.step < 40  # noqa: E731
    rejeu.DQN("MlpPolicy", env(), seed=1, **settings).learn(100, [stop, Checkpoint(tmp_path)])
    other = make_vector("CartPole-v1", 2, "envpool", seed=1)
    other._make = lambda seed: type(other)._make(other, seed + 1)  # another pool than the one that was recorded
    with pytest.warns(UserWarning, match="at the start of new episodes: CartPole-v1 on this EnvPool does not repeat"):
        again = rejeu.DQN.resume(tmp_path, other)
    assert not again.resumed.exact
    assert again.learn().num_timesteps == 100
