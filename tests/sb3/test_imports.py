"""Stable-Baselines3's module paths and its self-resetting vector environments."""

import importlib
import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.logs.video import record_video
from rejeu.sb3.common.vec_env import DummyVecEnv, VecVideoRecorder
from tests.logs.test_video import Lamp, decode
from tests.tiers import exhaustive


@exhaustive
def test_an_agent_is_recorded_on_an_environment_like_its_own(tmp_path):
    """highway-env's observations are an OrderedDict; the agent was made with a configuration of its own."""
    import highway_env  # noqa: F401

    env = gym.make("parking-v0", config={"screen_width": 300, "screen_height": 200})
    agent = rejeu.SAC("MultiInputPolicy", env, policy_kwargs={"net_arch": [8]}, seed=0)
    frames = decode(record_video(agent, tmp_path / "own", max_steps=3, seed=0)).frames
    assert frames.shape == (4, 200, 300, 3)
    assert frames.std() > 10


def test_the_core_does_not_import_rejeu_sb3_and_get_env_still_returns_a_vec_env():
    script = """
import sys, rejeu
agent = rejeu.DQN("MlpPolicy", rejeu.make_vector("CartPole-v1", backend="gymnasium"), policy_kwargs={"net_arch": [4]})
assert not [name for name in sys.modules if name.startswith("rejeu.sb3")]
print(type(agent.get_env()).__name__)
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ran.stdout == "DummyVecEnv\n", ran.stderr


def test_the_modules_of_the_base_classes_can_be_imported_before_any_other():
    script = """
from rejeu.sb3.common.off_policy_algorithm import *
from rejeu.sb3.common.on_policy_algorithm import OnPolicyAlgorithm
from rejeu.sb3 import PPO, SAC
assert issubclass(SAC, OffPolicyAlgorithm) and issubclass(PPO, OnPolicyAlgorithm)
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


def test_what_is_missing_cannot_be_imported():
    with pytest.raises(ImportError, match="NoSuchAlgorithm"):
        exec("from rejeu.sb3 import NoSuchAlgorithm")
    for path in ("sb3.common.distributions", "sb3.common.save_util", "sb3_contrib.common.maskable.distributions"):
        with pytest.raises(ModuleNotFoundError, match=path):
            importlib.import_module(f"rejeu.{path}")


class Corridor(gym.Env):
    """Ends by itself after ``end`` steps, or by a time limit after ``limit``; one array is reused for observations."""

    metadata = {"render_modes": []}
    action_space = gym.spaces.Discrete(2)
    observation_space = gym.spaces.Dict(
        {"where": gym.spaces.Box(0, 99, (1,), np.float32), "kind": gym.spaces.Discrete(5), "pair": gym.spaces.Tuple(())}
    )

    def __init__(self, end=99, limit=99):
        self.end, self.limit = end, limit
        self.calls = []
        self.where = np.zeros(1, np.float32)

    def observe(self):
        self.where[0] = self.time
        return {"where": self.where, "kind": self.time % 5, "pair": ()}

    def reset(self, *, seed=None, options=None):
        self.calls.append((seed, options))
        self.time = 0
        return self.observe(), {"calls": len(self.calls)}

    def step(self, action):
        self.time += 1
        return self.observe(), 10.0 * action, self.time == self.end, self.time == self.limit, {"time": self.time}

    def double(self, number):
        return 2 * number + self.end


def test_observations_have_a_leading_axis_and_their_own_memory():
    env = DummyVecEnv([Corridor, Corridor])
    first = env.reset()
    assert set(first) == {"where", "kind", "pair"}
    assert first["where"].shape == (2, 1)
    assert first["kind"].shape == (2,)
    second, rewards, dones, infos = env.step(np.array([0, 1]))
    np.testing.assert_array_equal(first["where"], [[0], [0]])
    np.testing.assert_array_equal(second["where"], [[1], [1]])
    np.testing.assert_array_equal(rewards, np.array([0, 10], np.float32))
    assert (rewards.dtype, dones.dtype, dones.tolist()) == (np.float32, bool, [False, False])
    assert [info["time"] for info in infos] == [1, 1]


def test_an_ended_environment_is_reset_within_the_step():
    env = DummyVecEnv([lambda: Corridor(end=2), Corridor])
    env.reset()
    env.step([0, 0])
    obs, _, dones, infos = env.step([0, 0])
    assert dones.tolist() == [True, False]
    np.testing.assert_array_equal(obs["where"], [[0], [2]])
    np.testing.assert_array_equal(infos[0]["terminal_observation"]["where"], [2])
    assert "terminal_observation" not in infos[1]
    assert env.reset_infos == [{"calls": 2}, {"calls": 1}]


@pytest.mark.parametrize(("end", "limit", "expected"), [(1, 99, False), (99, 1, True), (1, 1, False), (99, 99, False)])
def test_time_limit_is_told_from_termination(end, limit, expected):
    env = DummyVecEnv([lambda: Corridor(end, limit)])
    env.reset()
    assert env.step([0])[3][0]["TimeLimit.truncated"] is expected


def test_seeds_and_options_are_of_the_next_reset_only():
    env = DummyVecEnv([Corridor, Corridor])
    assert env.seed(5) == [5, 6]
    env.set_options({"a": 1})
    env.reset()
    env.reset()
    assert [e.calls for e in env.envs] == [[(5, {"a": 1}), (None, None)], [(6, {"a": 1}), (None, None)]]


def test_attributes_and_methods_are_reached_through_wrappers():
    wrapped = [lambda: gym.wrappers.TimeLimit(Corridor(end=3), 7), lambda: gym.wrappers.TimeLimit(Corridor(end=4), 7)]
    env = DummyVecEnv(wrapped)
    assert env.get_attr("end") == [3, 4]
    assert env.get_attr("end", 1) == [4]
    env.set_attr("end", 8, indices=[0])
    assert [e.unwrapped.end for e in env.envs] == [8, 4]
    assert env.env_method("double", 1, indices=[1, 0]) == [6, 10]
    assert env.env_is_wrapped(gym.wrappers.TimeLimit) == [True, True]
    assert env.env_is_wrapped(gym.wrappers.ClipAction) == [False, False]
    assert env.has_attr("end")
    assert not env.has_attr("begin")


def test_functions_must_be_functions_and_make_new_environments():
    one = Corridor()
    with pytest.raises(ValueError, match="the same environment"):
        DummyVecEnv([lambda: one, lambda: one])
    with pytest.raises(TypeError, match=r"DummyVecEnv\(\[lambda: "):
        DummyVecEnv([one])
    with pytest.raises(ValueError, match="empty"):
        DummyVecEnv([])
    with pytest.raises(ValueError, match="1 actions for 2 environments"):
        DummyVecEnv([Corridor, Corridor]).step([0])


def lamps(n):
    return DummyVecEnv([lambda: Lamp("rgb_array")] * n)


def test_recordings_begin_at_the_trigger_and_are_named_by_their_steps(tmp_path):
    env = VecVideoRecorder(lamps(1), tmp_path, lambda step: step in (0, 5), video_length=3, name_prefix="v")
    env.reset()
    assert env.recording
    for _ in range(7):
        env.step(np.zeros((1, 1)))
    assert env.recording
    env.close()
    # the lamp's grey value is 40 t and its episodes have 4 steps; the second recording is ended early by close
    assert sorted(os.listdir(tmp_path)) == ["v-step-0-to-step-3.mp4", "v-step-5-to-step-8.mp4"]
    for name, grey in (("v-step-0-to-step-3.mp4", [0, 40, 80, 120]), ("v-step-5-to-step-8.mp4", [40, 80, 120])):
        found = decode(tmp_path / name)
        np.testing.assert_allclose(found.frames[:, :33, :51].mean((1, 2, 3)), grey, atol=4)
        assert found.fps == 8


def test_several_environments_are_shown_side_by_side(tmp_path):
    env = VecVideoRecorder(lamps(3), tmp_path, lambda step: step == 0, video_length=1)
    env.reset()
    env.step(np.zeros((3, 1)))
    env.close()
    assert decode(tmp_path / "rl-video-step-0-to-step-1.mp4").frames.shape == (2, 66, 102, 3)


def test_recorder_hands_on_what_it_does_not_do_itself(tmp_path):
    env = VecVideoRecorder(lamps(2), tmp_path, lambda step: False)
    assert env.num_envs == 2
    assert env.get_attr("closed") == [False, False]
    assert env.seed(3) == [3, 4]
    env.reset()
    assert env.render().shape == (66, 51, 3)
    assert rejeu.make_vector(env).venv is env
    env.close()
    assert env.get_attr("closed") == [True, True]
    assert os.listdir(tmp_path) == []


def test_an_error_while_recording_leaves_no_file(tmp_path):
    env = VecVideoRecorder(lamps(1), tmp_path, lambda step: step == 0)
    env.reset()
    env.venv.envs[0].render = lambda: None
    with pytest.raises(ValueError, match="returned None"):
        env.step(np.zeros((1, 1)))
    assert not env.recording
    assert os.listdir(tmp_path) == []
