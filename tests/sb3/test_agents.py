"""What scripts expect of an agent: its environments, seeds, files and evaluation."""

from __future__ import annotations

import random

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.sb3 import A2C, SAC
from rejeu.sb3.common.monitor import Monitor

pytestmark = pytest.mark.usefixtures("learners_are_shared")

TINY = {"policy_kwargs": {"net_arch": [4]}}


def test_the_environments_of_an_id_have_the_methods_of_the_original():
    model = A2C("MlpPolicy", "CartPole-v1", n_steps=8, **TINY)
    env = model.env
    assert env is model.get_env()
    assert (env.num_envs, env.render_mode, env.env_is_wrapped(Monitor)) == (1, "rgb_array", [True])
    assert env.seed(3) == [3]
    assert env.reset().shape == (1, 4)
    obs, rewards, dones, infos = env.step([0])
    assert (obs.shape, rewards.shape, dones.shape, len(infos)) == ((1, 4), (1,), (1,), 1)
    assert env.render(mode="rgb_array").ndim == 3
    assert env.get_attr("gravity") == [9.8]
    env.set_attr("gravity", 5.0)
    assert env.env_method("get_wrapper_attr", "gravity") == [5.0]
    with pytest.raises(AttributeError, match="use set_env"):
        model.env = env


def test_a_seed_seeds_the_global_generators_too(tmp_path):
    def drawn(make):
        made = make()
        return made, random.random(), np.random.random()  # noqa: NPY002

    env = gym.make("CartPole-v1")
    model, *first = drawn(lambda: A2C("MlpPolicy", env, seed=7, **TINY))
    model.save(tmp_path / "m")
    assert drawn(lambda: A2C("MlpPolicy", env, seed=7, **TINY))[1:] == tuple(first)
    assert drawn(lambda: A2C.load(tmp_path / "m", seed=7))[1:] == tuple(first)
    assert drawn(lambda: A2C("MlpPolicy", env, **TINY))[1:] != tuple(first)


@pytest.mark.parametrize("name", ["save", "snapshot"])
def test_files_keep_where_statistics_go(tmp_path, name):
    model = A2C("MlpPolicy", gym.make("CartPole-v1"), verbose=1, tensorboard_log=tmp_path / "board", **TINY)
    model.save(tmp_path / "m.zip") if name == "save" else model.snapshot(tmp_path / "m.zip")()
    loaded = A2C.load(tmp_path / "m")
    assert (loaded.verbose, loaded.tensorboard_log, loaded.log) == (1, str(tmp_path / "board"), ("tensorboard",))
    changed = A2C.load(tmp_path / "m", verbose=0, tensorboard_log=None)
    assert (changed.verbose, changed.tensorboard_log, changed.log) == (0, None, ())
    model.save(tmp_path / "n", exclude=["verbose", "tensorboard_log"])
    assert (A2C.load(tmp_path / "n").verbose, A2C.load(tmp_path / "n").log) == (0, ())


@pytest.mark.parametrize("kind", [SAC, rejeu.SAC])
def test_an_empty_replay_buffer_does_not_replace_a_file(tmp_path, kind):
    model = kind("MlpPolicy", gym.make("Pendulum-v1"), learning_starts=100, buffer_size=50, **TINY)
    model.save(tmp_path / "m")
    model.learn(5).save_replay_buffer(tmp_path / "replay")
    for loaded in (kind.load(tmp_path / "m"), kind.load(tmp_path / "m", env=gym.make("Pendulum-v1"))):
        with pytest.raises(ValueError, match="replay buffer"):
            loaded.save_replay_buffer(tmp_path / "replay")
    loaded.load_replay_buffer(tmp_path / "replay")
    assert loaded.replay_buffer.size() == 5
