"""An agent that acts for those who watch: which policy, from which seed, and what is said when it cannot. No browser."""

import json
import math
import os
import threading
import time
from contextlib import nullcontext

import gymnasium as gym
import numpy as np
import pytest
from filelock import FileLock

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

import rejeu
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.studio import player
from rejeu.lab.studio.player import BEST, GoalView, LiveEpisode, LivePlayer
from tests.lab.reporting.report.folders import write


@pytest.fixture(scope="module")
def agents():
    """Two agents with other weights, at other steps."""
    settings = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 10, "buffer_size": 200}
    return [rejeu.DQN("MlpPolicy", "CartPole-v1", seed=seed, **settings).learn(20 + seed) for seed in range(2)]


@pytest.fixture
def folder(tmp_path, agents):
    folder = RunFolder(write(tmp_path / "run", videos=False))
    agents[0].save(folder.agent)
    agents[1].save(folder.best)
    folder.models.mkdir()
    agents[1].save(folder.models / "step_000000000021.safetensors")
    return folder


@pytest.fixture
def watched(folder, monkeypatch):
    """A player, and the captions that it showed."""
    monkeypatch.setattr(player, "LEAST_FPS", 2000.0)
    monkeypatch.setattr(player, "REST", 0.3)
    monkeypatch.setattr(player, "RENEW", 0.05)
    shown = []
    one = LivePlayer(
        folder.path, RunOptions(), lambda pictures, captions: shown.append((pictures[0].shape, captions[0]))
    )
    yield one, shown
    one.close()


def locked(folder):
    """Returns the lock that the process of a run holds while it trains."""
    folder.checkpoints.mkdir(exist_ok=True)
    return FileLock(folder.lock)


def until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_last_policy_acts_then_the_one_that_is_chosen_from_its_seed(watched, agents, folder):
    one, shown = watched
    until(lambda: shown)
    assert shown[0][0] == (400, 600, 3)
    assert shown[0][1]["name"] == "the policy at step 20"
    for model in (BEST, "step_000000000021"):
        one.choose(model, 7)
        until(lambda model=model: one.episode.model == model and one.episode.is_over)
        episode = one.episode
        assert (episode.seed, episode.step) == (7, 21)
        expected = agents[1].evaluate(1, env="CartPole-v1", seed=7)
        assert sum(episode.rewards) == expected.mean_return
        assert len(episode.values) == len(episode.rewards)
    one.close()
    until(lambda: not one._thread.is_alive())


def test_new_weights_are_taken_while_the_run_trains(watched, agents, folder):
    _, shown = watched
    until(lambda: shown)
    agents[1].save(folder.live)
    until(lambda: shown[-1][1]["name"] == "the policy at step 21")


@pytest.mark.usefixtures("watched")
def test_nobody_is_asked_once_the_run_has_ended_and_no_request_is_left(folder):
    with locked(folder):
        until(lambda: folder.watch.exists())
    folder.watch.unlink()
    time.sleep(0.2)  # four looks for new weights
    assert not folder.watch.exists()


def test_what_cannot_be_shown_is_said_in_one_line(folder, monkeypatch):
    monkeypatch.setattr(player, "RENEW", 0.01)
    config = json.loads(folder.config.read_text())
    for change, problem in (
        ({"env": "my_env:Walk-v0"}, "no file may name what is imported"),
        ({"env": "NoSuch-v0"}, "NoSuch"),
        ({"env_argument": "my_env.py"}, "such as rejeu studio, and name it again: --env my_env.py"),
    ):
        folder.config.write_text(json.dumps({**config, **change}), encoding="utf-8")
        one = LivePlayer(folder.path, RunOptions(), lambda *_: None)
        until(lambda one=one: one.problem)
        one.close()
        assert problem in one.problem
        assert "\n" not in one.problem


def test_after_an_error_and_a_click_it_rests_between_two_attempts(folder, monkeypatch):
    attempts, read = [], player.read_folder
    monkeypatch.setattr(player, "RENEW", 0.1)
    monkeypatch.setattr(player, "read_folder", lambda one: attempts.append(None) or read(one))
    folder.config.write_text("{", encoding="utf-8")
    one = LivePlayer(folder.path, RunOptions(), lambda *_: None)
    until(lambda: one.problem)
    one.choose(BEST)
    time.sleep(0.35)
    one.close()
    assert len(attempts) <= 6  # the first, the one after the click, and one each 0.1 s
    until(lambda: not one._thread.is_alive())


def test_an_environment_of_any_speed_is_stepped_at_a_thousand_a_second(folder, monkeypatch):
    """A thread without a pause would keep the pages waiting."""
    waits, wait = [], threading.Event.wait
    monkeypatch.setattr(player, "playback_fps", lambda env: 1e12)
    monkeypatch.setattr(threading.Event, "wait", lambda event, time=None: waits.append(time) or wait(event, time))
    one = LivePlayer(folder.path, RunOptions(), lambda *_: None)
    until(lambda: one.complete is not None)
    one.close()
    assert any(time is not None and 1e-4 < time <= 1e-3 for time in waits)


def test_a_run_that_has_ended_without_a_model_does_not_promise_one(folder):
    for path in (folder.agent, folder.best, folder.models / "step_000000000021.safetensors"):
        path.unlink()
    for lock, text in (
        (locked(folder), "the first is shown when"),
        (nullcontext(), "the run has ended before it wrote one"),
    ):
        with lock:
            one = LivePlayer(folder.path, RunOptions(), lambda *_: None)
            until(lambda one=one: one.problem)
            one.close()
        assert text in one.problem


@pytest.mark.parametrize("error", [KeyError("palette"), RuntimeError("no display"), AttributeError("no screen")])
def test_an_environment_that_fails_to_render_is_said_in_one_line(folder, monkeypatch, error):
    def fail(env):
        raise error

    monkeypatch.setattr(player, "RENEW", 0.01)
    monkeypatch.setattr(player, "rgb_frame", fail)
    one = LivePlayer(folder.path, RunOptions(), lambda *_: None)
    until(lambda: one.problem)
    one.close()
    assert str(error) in one.problem


def test_the_return_that_follows_a_step_is_discounted():
    episode = LiveEpisode("current", 0, 0, rewards=[1.0, 2.0, 4.0])
    np.testing.assert_allclose(episode.to_go(0.5), [3.0, 4.0, 4.0])


@pytest.mark.skipif(not hasattr(os, "setpriority"), reason="threads have no priority here")
def test_it_yields_to_training(watched):
    one, shown = watched
    until(lambda: shown)
    assert os.getpriority(os.PRIO_PROCESS, one._thread.native_id) == min(
        os.getpriority(os.PRIO_PROCESS, 0) + player.NICE, 19
    )


def test_a_pause_waits_for_each_step(watched):
    one, shown = watched
    until(lambda: shown)
    one.is_paused = True
    one.choose(BEST, 3)
    until(lambda: one.episode.model == BEST and len(shown) > 1 and shown[-1][1]["bars"])
    for n in (1, 2):
        one.step()
        until(lambda n=n: len(one.episode.rewards) == n)
        time.sleep(2 * player.PAUSED)
        assert len(one.episode.rewards) == n
    assert [bar["name"] for bar in shown[-1][1]["bars"]] == ["left", "right"]
    one.is_paused = False
    until(lambda: one.episode.is_over or one.episode.seed != 3)


def test_slow_motion_takes_more_time_between_two_steps(folder, monkeypatch):
    waits, wait = [], threading.Event.wait
    monkeypatch.setattr(threading.Event, "wait", lambda event, time=None: waits.append(time) or wait(event, time))
    one = LivePlayer(folder.path, RunOptions(), lambda *_: None)
    one.speed = 0.1  # of the 50 steps a second of CartPole: one in 0.2 s
    until(lambda: any(time is not None and 0.1 < time <= 0.2 for time in waits))
    one.close()


@pytest.mark.parametrize("limit", [3, 500])
def test_an_episode_that_a_time_limit_cut_says_what_the_critic_still_expected(watched, folder, monkeypatch, limit):
    one, shown = watched
    monkeypatch.setattr(player, "for_agent", lambda agent, env: gym.wrappers.TimeLimit(env.unwrapped, limit))
    one.choose(BEST, 1)
    until(lambda: one.complete is not None and one.complete.seed == 1)
    episode = one.complete
    assert episode.is_cut is (limit == 3)
    assert math.isfinite(episode.expected) is (limit == 3)
    message = next(captions["message"] for _, captions in reversed(shown) if captions["message"])
    assert message == player.end_of(episode)


class Lots:
    """An environment whose goal has the seed as its first number."""

    def reset(self, seed):
        return {"desired_goal": np.array([seed, 5.0, 6.0, 7.0])}, {}


def test_the_seed_of_a_place_is_the_one_whose_goal_is_nearest():
    assert player.nearest_seed(Lots(), [7.4, 5.0, 6.0]) == 7
    assert player.nearest_seed(Lots(), [1e6, 5.0]) == player.SEEDS - 1


def test_a_map_of_goals_is_drawn_on_the_picture_or_has_their_names():
    chart = {"x": "", "y": "", "places": [{"goal": [1.0, 2.0]}], "series": [{"places": [0], "x": [1], "y": [2]}]}
    picture = np.zeros((20, 30, 3), np.uint8)
    camera = np.array([[10.0, 0, 0], [0, 5.0, 0], [0, 0, 1]])
    drawn = GoalView(["height", "angle"], camera, picture).draw(chart)
    assert (drawn["series"][0]["x"], drawn["series"][0]["y"], drawn["x_range"]) == ([10], [10], [0, 30])
    named = GoalView(["height", "angle"], None, picture).draw(chart)
    assert (named["x"], named["y"], named["series"]) == ("height", "angle", chart["series"])
