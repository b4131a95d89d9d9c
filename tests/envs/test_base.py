"""Seeds, steps, infos and descriptions that all vectors share, and the wrappers for old environments."""

from __future__ import annotations

from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs import base
from rejeu.envs.wrappers import to_space
from tests.environments import Counter


def test_seeds_are_checked_up_to_their_bounds():
    assert base.checked_seed(None, 2) is None
    assert base.checked_seed(np.int64(2**40), 2) == 2**40  # one number is of the vector
    assert base.checked_seed(np.array([0, 2**31 - 2]), 2) == (0, 2**31 - 2)
    for wrong in ([0, 2**31 - 1], [0, -1], [0], [0.0, 1.0]):
        with pytest.raises(ValueError, match="seed"):
            base.checked_seed(wrong, 2)


def test_time_limits_terminate_and_ends_stay_ends():
    for ends in ("truncated", "terminated"):
        env = rejeu.TimeLimitTerminates(Counter((2,), ends))
        env.reset()
        assert [env.step(np.zeros(1))[2:4] for _ in range(2)] == [(False, False), (True, False)]


def test_an_old_environment_is_seeded_drawn_and_closed():
    calls = []
    old = SimpleNamespace(
        observation_space=SimpleNamespace(low=np.zeros(2), high=1.0, shape=(2,)),
        action_space=gym.spaces.Discrete(2),
        seed=lambda seed: calls.append(("seed", seed)),
        reset=lambda: [0, 1],
        render=lambda: "picture",
        close=lambda: calls.append("close"),
    )
    env = rejeu.OldEnvironment(old)
    env.reset(seed=3)
    obs, info = env.reset()
    assert (obs.dtype, obs.tolist(), info, env.render()) == (np.float32, [0, 1], {}, "picture")
    env.close()
    assert calls == [("seed", 3), "close"]
    del old.close
    env.close()
    assert env.observation_space == gym.spaces.Box(0, 1, (2,), np.float32)
    bytes_ = SimpleNamespace(low=np.zeros(3, np.uint8), high=np.full(3, 9, np.uint8), dtype=np.uint8)
    assert to_space(bytes_) == gym.spaces.Box(0, 9, (3,), np.uint8)
