"""Monitor: its numbers, its file, its refusals; what it hides of the environment (nothing)."""

import csv
import json

import gymnasium as gym
import numpy as np
import pytest

from rejeu.sb3.common.monitor import Monitor, monitor_path


class Stairs(gym.Env):
    """Rewards 1, 2, 3; the third step ends the episode."""

    observation_space = gym.spaces.Box(0, 10, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None, height=None):
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        info = {"is_success": True, "note": "top"} if self.time == 3 else {}
        return np.zeros(1, np.float32), float(self.time), self.time == 3, False, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        return 42.0


def play(env, episodes=1, **kwargs):
    infos = []
    for _ in range(episodes):
        env.reset(**kwargs)
        infos += [env.step(0)[4] for _ in range(3)]
    return infos


def read(path):
    with path.open() as file:
        header = json.loads(file.readline().removeprefix("#"))
        return header, list(csv.DictReader(file))


def test_episode_is_in_the_info_of_its_last_step_only():
    infos = play(Monitor(Stairs()), 2)
    assert ["episode" in info for info in infos] == [False, False, True] * 2
    assert infos[2]["episode"]["r"] == 6
    assert infos[2]["episode"]["l"] == 3
    assert 0 <= infos[2]["episode"]["t"] <= infos[5]["episode"]["t"]


def test_totals_count_all_episodes():
    env = Monitor(Stairs())
    play(env, 2)
    env.reset()
    env.step(0)
    assert env.get_total_steps() == 7
    assert env.get_episode_rewards() == [6.0, 6.0]
    assert env.get_episode_lengths() == [3, 3]
    assert len(env.get_episode_times()) == 2


def test_a_given_up_episode_is_not_counted():
    env = Monitor(Stairs())
    env.reset()
    env.step(0)
    assert play(env)[2]["episode"]["r"] == 6
    assert env.get_episode_lengths() == [3]


def test_file_has_stable_baselines3_layout(tmp_path):
    # the bytes of Stable-Baselines3 2.9.2's Monitor on this environment, but for the times
    env = Monitor(Stairs(), tmp_path / "run", info_keywords=("is_success", "note"))
    play(env, 2)
    lines = (tmp_path / "run.monitor.csv").read_text().split("\n")
    assert lines[0].startswith('#{"t_start": ')
    assert lines[0].endswith(', "env_id": "None"}')
    assert lines[1].rstrip("\r") == "r,l,t,is_success,note"
    header, rows = read(tmp_path / "run.monitor.csv")
    assert header["t_start"] == env.t_start
    assert [(row["r"], row["l"], row["is_success"], row["note"]) for row in rows] == [("6.0", "3", "True", "top")] * 2


def test_reset_keywords_are_required_and_written(tmp_path):
    env = Monitor(Stairs(), tmp_path / "run", reset_keywords=("height",))
    with pytest.raises(ValueError, match="reset needs the argument 'height'"):
        env.reset()
    play(env, 1, height=3)
    assert read(tmp_path / "run.monitor.csv")[1][0]["height"] == "3"


def test_file_is_begun_anew_or_continued(tmp_path):
    for override, rows in ((False, 1), (False, 2), (True, 1)):
        play(Monitor(Stairs(), tmp_path / "run", override_existing=override))
        header, found = read(tmp_path / "run.monitor.csv")
        assert len(found) == rows
        assert "t_start" in header


def test_path_follows_stable_baselines3(tmp_path):
    assert monitor_path(tmp_path / "a") == tmp_path / "a.monitor.csv"
    assert monitor_path(tmp_path / "0.monitor.csv") == tmp_path / "0.monitor.csv"
    assert monitor_path(tmp_path) == tmp_path / "monitor.csv"


def test_step_needs_a_running_episode():
    env = Monitor(Stairs())
    with pytest.raises(RuntimeError, match=r"call reset"):
        env.step(0)
    play(env)
    with pytest.raises(RuntimeError, match=r"call reset"):
        env.step(0)


def test_early_reset_can_be_forbidden():
    env = Monitor(Stairs(), allow_early_resets=False)
    play(env)
    env.reset()
    with pytest.raises(RuntimeError, match="allow_early_resets=True"):
        env.reset()


def test_attributes_of_the_environment_stay_in_reach():
    env = Monitor(Stairs())
    assert env.get_wrapper_attr("compute_reward")(None, None, {}) == 42
    made = Monitor(gym.make("CartPole-v1"))
    assert made.spec.id == "CartPole-v1"
    assert made.observation_space == made.unwrapped.observation_space
    assert gym.make(made.spec).get_wrapper_attr("get_total_steps")() == 0
