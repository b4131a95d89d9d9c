"""What Stable-Baselines3 shipped wrong and mended later, by its changelog, where no test of a part has it already."""

from __future__ import annotations

import gc
import tracemalloc
from types import SimpleNamespace

import gymnasium as gym
import jax
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import rejeu
from rejeu.agents import training
from rejeu.core import checkpoint
from rejeu.envs.make import InProcess
from tests.environments import Counter
from tests.helpers import small_sac
from tests.tiers import exhaustive

NEVER = 10**6


# Hindsight.


class Pilgrim(gym.Env):
    """Episodes of 10 steps that each have a number of their own; what is achieved is (that number, the time)."""

    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)
    observation_space = gym.spaces.Dict(
        {key: gym.spaces.Box(-np.inf, np.inf, (2,)) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def __init__(self, first: int) -> None:
        self.number = first - 1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.number, self.time = self.number + 1, 0
        return self.see(), {}

    def step(self, action):
        self.time += 1
        return self.see(), 0.0, False, self.time == 10, {}

    def see(self):
        where = np.float32([self.number, self.time])
        return {"observation": where, "achieved_goal": where, "desired_goal": np.full(2, -1.0, np.float32)}

    def compute_reward(self, achieved, desired, info):
        return np.zeros(np.shape(achieved)[:-1], np.float32)


def test_an_episode_cut_short_by_saving_is_not_joined_to_the_next(tmp_path):
    """Saved after 4 steps of its second episode, the buffer goes on in an agent that is within its own episode 100."""
    settings = {"replay_buffer_class": rejeu.HerReplayBuffer, "learning_starts": NEVER}
    path = small_sac(Pilgrim(0), **settings).learn(14).save_replay_buffer(tmp_path / "buffer")
    agent = small_sac(Pilgrim(100), **settings).learn(6)
    agent.load_replay_buffer(path)
    agent.learn(13)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (2000,))
    obs, following, goal = (
        leaf.astype(int)
        for leaf in (batch.obs["observation"], batch.next_obs["observation"], batch.obs["desired_goal"])
    )
    kept = {(0, t) for t in range(10)} | {(1, t) for t in range(4)} | {(101, t) for t in range(10)}
    assert set(map(tuple, obs.tolist())) == kept | {(102, t) for t in range(3)}
    np.testing.assert_array_equal(following, obs + np.array([0, 1]))
    relabelled = goal[:, 0] >= 0
    assert relabelled.sum() == 1600
    np.testing.assert_array_equal(goal[relabelled, 0], obs[relabelled, 0])
    assert (goal[relabelled, 1] > obs[relabelled, 1]).all()
    assert set(goal[relabelled][obs[relabelled, 0] == 1, 1].tolist()) == {1, 2, 3, 4}
    np.testing.assert_array_equal(batch.discount, np.float32(0.99))


# Final observations.


def doubled(lengths):
    return lambda: gym.wrappers.TransformObservation(Counter(lengths), lambda obs: 2 * obs, Counter.observation_space)


def in_process():
    return InProcess([doubled((3,))(), doubled((2, 4))()], seed=0)


def inside(mode):
    return lambda: SyncVectorEnv([doubled((3,)), doubled((2, 4))], autoreset_mode=mode)


def outside(mode):
    def make():
        plain = SyncVectorEnv([lambda: Counter((3,)), lambda: Counter((2, 4))], autoreset_mode=mode)
        return gym.wrappers.vector.TransformObservation(plain, lambda obs: 2 * obs, plain.observation_space)

    return make


@pytest.mark.parametrize(
    "make",
    [
        in_process,
        *(inside(mode) for mode in AutoresetMode),
        outside(AutoresetMode.NEXT_STEP),
        outside(AutoresetMode.DISABLED),
    ],
)
def test_wrappers_change_final_observations_like_all_others(make):
    """The wrapper doubles (episode, time, a number drawn once an episode), so all successors are 2 later in time."""
    agent = small_sac(make(), learning_starts=NEVER).learn(30)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (400,))
    np.testing.assert_array_equal(batch.next_obs - batch.obs, np.tile(np.float32([0.0, 2.0, 0.0]), (400, 1)))
    assert set(batch.next_obs[:, 1].tolist()) == {2.0, 4.0, 6.0, 8.0}
    np.testing.assert_array_equal(batch.reward, 50 * batch.obs[:, 0] + batch.obs[:, 1] / 2)


# Targets.


# Dtypes.


# Files.


@pytest.mark.slow
def test_a_file_of_more_than_4_gigabytes_comes_back(tmp_path):
    array = np.zeros(2**32 + 16, np.uint8)
    array[[0, 2**31, 2**32, -1]] = [1, 2, 3, 4]
    path = checkpoint.write(tmp_path / "large", "replay", {"obs": array, "tail": np.arange(3.0)}, {})
    assert path.stat().st_size > 2**32
    _, arrays = checkpoint.read(path, "replay")
    path.unlink()
    assert arrays["obs"].shape == array.shape
    np.testing.assert_array_equal(arrays["obs"][[0, 1, 2**31, 2**32, -1]], [1, 0, 2, 3, 4])
    np.testing.assert_array_equal(arrays["tail"], [0.0, 1.0, 2.0])


# Memory.


@exhaustive
def test_loading_a_hundred_times_keeps_no_memory(tmp_path):
    agent = small_sac(Counter((5,)), learning_starts=NEVER, buffer_size=3000).learn(3000)
    model, buffer = agent.save(tmp_path / "model"), agent.save_replay_buffer(tmp_path / "buffer")

    def load(times):
        for _ in range(times):
            agent.set_parameters(model)
            agent.load_replay_buffer(buffer)

    load(3)
    n_arrays = len(jax.live_arrays())
    tracemalloc.start()
    try:
        load(5)
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        load(100)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert len(jax.live_arrays()) <= n_arrays
    assert grown < 3 * buffer.stat().st_size


# Logging.


@pytest.mark.parametrize(
    ("env_id", "n_envs", "share", "hints"),
    [
        ("CartPole-v1", 1, 0.96, True),
        ("CartPole-v1", 4, 0.96, False),
        ("CartPole-v1", 1, 0.5, False),
        ("Own", 1, 0.96, False),
    ],
)
def test_a_run_that_waits_for_one_environment_names_the_call_that_makes_eight(env_id, n_envs, share, hints, recwarn):
    seconds = {"env": 20 * share, "replay": 0.0, "update": 20 * (1 - share), "total": 20.0}
    run = SimpleNamespace(env=SimpleNamespace(env_id=env_id, n_envs=n_envs), seconds=seconds)
    training.hint_at_more_environments(SimpleNamespace(run=run, steps_per_second=37.0))
    assert ["rejeu.make_vector('CartPole-v1', n_envs=8)" in str(one.message) for one in recwarn] == [True] * hints
