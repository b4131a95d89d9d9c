import io
import math
import time
from collections import deque
from types import SimpleNamespace

import gymnasium as gym
import jax
import numpy as np
import pytest
from rich.console import Console

import rejeu
from rejeu.callbacks import (
    Evaluate,
    ProgressBar,
    RecordVideo,
    stop_on_return,
    stop_on_success,
)
from rejeu.callbacks.base import crossed
from rejeu.callbacks.evaluate import merit
from rejeu.core.failed_writes import FailedWrites
from rejeu.logs.evaluation import Evaluation
from rejeu.logs.history import History
from rejeu.logs.logging import Logger
from rejeu.training.run import Episode, Progress
from tests.environments import Counter
from tests.helpers import small_sac

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [8]}, "batch_size": 8, "buffer_size": 1000, "learning_starts": 10_000}


def evaluation(returns, successes=None):
    n = len(returns)
    successes = [math.nan] * n if successes is None else successes
    return Evaluation(np.array(returns, float), np.full(n, 10), np.array(successes, float))


def pendulum(n_envs=1, seed=0):
    return rejeu.SAC("MlpPolicy", rejeu.make_vector("Pendulum-v1", n_envs, "gymnasium", seed), seed=seed, **SMALL)


def scripted_agent(evaluations):
    """An agent whose evaluations are given, and which remembers what was saved."""
    remaining = deque(evaluations)
    saved = []
    agent = SimpleNamespace(run=SimpleNamespace(env=None), n_envs=1, saved=saved, remember_best=lambda score, by: True)
    agent.failed_writes, agent.snapshot = FailedWrites(), lambda path: lambda: saved.append(path)
    agent.logger = Logger()
    agent.evaluate = lambda episodes, env, seed: remaining.popleft()
    return agent


def finished(returns, successes=None):
    """An agent with such episodes behind it, and the progress of the turn in which the last one ended."""
    successes = [math.nan] * len(returns) if successes is None else successes
    rows = [Episode(10 * i, 0, r, 10, s, 0.1 * i) for i, (r, s) in enumerate(zip(returns, successes, strict=True))]
    return SimpleNamespace(history=History(rows)), Progress(10 * len(rows), rows[-1:], None)


def test_return_decides_where_success_is_equal_or_unknown():
    assert merit(evaluation([-50, -50], [1, 1])) > merit(evaluation([-1, -1], [1, 0]))
    assert merit(evaluation([2, 2], [1, 0])) > merit(evaluation([1, 1], [0, 1]))
    assert merit(evaluation([2, 2])) > merit(evaluation([1, 1]))
    assert merit(evaluation([1, 1], [0, 0])) > merit(evaluation([2, 2]))  # of which nothing is known
    assert merit(evaluation([1, 1])) == merit(evaluation([1, 1]))


def test_evaluate_saves_only_when_the_best_so_far_is_beaten(tmp_path):
    agent = scripted_agent([evaluation([1], [0]), evaluation([0], [1]), evaluation([9], [0]), evaluation([0.5], [1])])
    evaluate = Evaluate("Pendulum-v1", 10, episodes=1, best_path=tmp_path / "best.safetensors", seed=0)
    saved_after = [len(agent.saved) for step in (10, 20, 30, 40) if evaluate.run(agent, step)]
    evaluate.close()
    assert saved_after == [1, 2, 2, 3]
    assert evaluate.best.step == 40


def test_of_equal_evaluations_the_first_is_the_best():
    agent = scripted_agent([evaluation([1]), evaluation([1])])
    evaluate = Evaluate("Pendulum-v1", 10, episodes=1, seed=0)
    best = [evaluate.best.step for step in (10, 20) if evaluate.run(agent, step)]
    evaluate.close()
    assert best == [10, 10]


def test_an_evaluation_of_nan_is_worse_than_any_other():
    agent = scripted_agent([evaluation([math.nan]), evaluation([-5]), evaluation([math.nan]), evaluation([-6])])
    evaluate = Evaluate("Pendulum-v1", 10, episodes=1, seed=0)
    best = [evaluate.best.step for step in (10, 20, 30, 40) if evaluate.run(agent, step)]
    evaluate.close()
    assert best == [10, 20, 20, 20]


@pytest.mark.parametrize("best", [None, 0, 1, 2])
def test_a_resumed_evaluation_has_the_same_results_and_the_same_best_one(best):
    one, other = (Evaluate("Pendulum-v1", 10, episodes=1, seed=0) for _ in range(2))
    returns = [] if best is None else [9.0 if i == best else float(i) for i in range(3)]
    agent = scripted_agent([evaluation([value]) for value in returns])
    for i in range(len(returns)):
        one.run(agent, 10 * i)
    other.load_state_dict(one.state_dict())
    for callback in (one, other):
        callback.close()
        assert [(step, result.returns.tolist()) for step, result in callback.results] == [
            (10 * i, [value]) for i, value in enumerate(returns)
        ]
        assert (None if callback.best is None else callback.best.step) == (None if best is None else 10 * best)


def test_a_resumed_evaluation_knows_how_many_episodes_were_cut_off():
    one, other = (Evaluate("Pendulum-v1", 10, episodes=1, seed=0) for _ in range(2))
    one.run(scripted_agent([Evaluation(np.ones(2), np.ones(2, int), np.full(2, math.nan), cut=1)]), 10)
    state = one.state_dict()
    other.load_state_dict(state)
    assert [result.evaluation.cut for result in other.results] == [1]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_evaluate_counts_environment_steps_whatever_the_number_of_environments(n_envs):
    evaluate = Evaluate("Pendulum-v1", every=10, episodes=1, seed=0)
    pendulum(n_envs).learn(30, evaluate)
    evaluate.close()
    assert [step for step, _ in evaluate.results] == {1: [10, 20, 30], 3: [12, 21, 30]}[n_envs]


def test_evaluate_refuses_the_environments_of_training():
    env = gym.make("Pendulum-v1")
    agent = rejeu.SAC("MlpPolicy", env, seed=0, **SMALL)
    with pytest.raises(ValueError, match="trains on"):
        agent.learn(10, Evaluate(env, every=5, episodes=1))


def test_evaluate_leaves_open_the_environment_that_it_was_given():
    env = rejeu.make_vector("Pendulum-v1", 1, "gymnasium", 0)
    evaluate = Evaluate(env, every=5, episodes=1)
    evaluate.close()
    env.reset()


def test_the_saved_best_model_acts_as_the_agent_did_then(tmp_path):
    evaluate = Evaluate("Pendulum-v1", every=20, episodes=1, best_path=tmp_path / "best.safetensors", seed=0)
    agent = pendulum().learn(20, evaluate)
    evaluate.close()
    obs = np.array([1.0, 0.0, 0.5], np.float32)
    loaded = rejeu.load(tmp_path / "best.safetensors")
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], agent.predict(obs, deterministic=True)[0])


def test_crossed_sees_a_multiple_that_a_step_jumps_over():
    assert crossed(8, 16, 10)
    assert not crossed(10, 18, 10)
    assert not crossed(0, 9, 10)


def test_stop_on_return_waits_for_enough_episodes():
    stop = stop_on_return(5, episodes=2)
    assert stop(*finished([10])) is True
    assert stop(*finished([1, 4])) is True
    assert stop(*finished([0, 4, 6])) is False


def test_stop_on_success_counts_the_last_episodes():
    stop = stop_on_success(0.75, episodes=4)
    assert stop(*finished([0] * 5, [0, 1, 1, 1, 0])) is False
    assert stop(*finished([0] * 5, [1, 1, 1, 0, 0])) is True
    assert stop(*finished([0] * 5, [1, 1, math.nan, 0, 1])) is True
    assert stop(*finished([0] * 5, [1, 1, math.nan, 1, 1])) is False  # of the three where it is known
    assert stop_on_success(0.0, episodes=1)(*finished([0])) is True  # unknown


NO_TIME = dict.fromkeys(("env", "replay", "update", "total"), 0.0)


def shown(n_steps, seconds, steps, console, spent=lambda step: NO_TIME):
    bar = ProgressBar(n_steps, seconds, console)
    agent = SimpleNamespace(n_envs=1, ep_info_buffer=[{"r": -3.0}], ep_success_buffer=[1.0, 0.0], seconds=NO_TIME)
    for step in steps:
        agent.seconds = spent(step)
        bar(agent, Progress(step, [], None))
    bar.close()
    return console.file.getvalue()


def test_progress_bar_prints_a_line_every_ten_seconds_without_a_terminal(monkeypatch):
    ticks = iter(range(0, 1000, 3))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(ticks)))
    text = shown(20, None, range(1, 21), Console(file=io.StringIO(), force_terminal=False, width=200))
    lines = text.splitlines()
    assert [line.split("/20")[0].split()[-1] for line in lines] == ["5", "9", "13", "17", "20"]
    assert "0/s" in lines[0]


def test_time_left_counts_an_evaluation_once_and_not_for_each_of_the_next_steps(monkeypatch):
    ticks = iter([0.0, *range(1, 50), 110.0])  # step 50 comes after an evaluation of a minute
    monkeypatch.setattr("time.perf_counter", lambda: float(next(ticks)))
    text = shown(100, None, range(1, 51), Console(file=io.StringIO(), force_terminal=False, width=200))
    assert text.splitlines()[-1].split(" · ")[-1] == "1 min 50 s left"


def test_progress_bar_draws_a_bar_on_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=True, width=100, _environ={"TERM": "xterm"})
    text = shown(100, None, range(1, 101), console)
    assert "█" in text
    assert "100%" in text


@pytest.mark.parametrize("is_terminal", [False, True])
def test_progress_bar_says_that_a_large_function_is_compiled(is_terminal):
    console = Console(file=io.StringIO(), force_terminal=is_terminal, width=100, _environ={"TERM": "xterm"})
    bar = ProgressBar(100, None, console)
    trace = lambda seconds: jax.monitoring.record_event_duration_secs("/jax/core/compile/jaxpr_trace_duration", seconds)  # noqa: E731
    bar.before_training(SimpleNamespace(run=SimpleNamespace(step=0)))
    trace(0.01)
    assert "compiling" not in console.file.getvalue()
    trace(1.0)
    assert "compiling" in console.file.getvalue()
    bar.close()
    console.file.truncate(0)
    trace(1.0)
    assert "compiling" not in console.file.getvalue()


def steps_that_grow_slower(step):
    """Of each of the first 20 steps' seconds the environment takes all, of each later one's the update three quarters."""
    early, late = min(step, 20), max(step - 20, 0)
    return {"env": early + 0.1 * late, "replay": 0.05 * late, "update": 0.75 * late, "total": float(step)}


def test_progress_bar_says_what_the_time_went_into_lately(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])

    def spent(step):
        clock[0] = float(step)
        return steps_that_grow_slower(step)

    console = Console(file=io.StringIO(), force_terminal=False, width=200)
    lines = shown(60, None, range(1, 61), console, spent).splitlines()
    assert lines[0].endswith("env 100% · buffer 0% · update 0% · rest 0%")
    assert lines[-1].endswith("env 10% · buffer 5% · update 75% · rest 10%")


def test_shares_of_time_are_rows_of_statistics_and_sum_to_one():
    rows = []
    sink = SimpleNamespace(write=lambda step, metrics: rows.append(metrics), close=lambda: None)
    pendulum().learn(450, sinks=[sink], log_interval=1)
    assert len(rows) == 2
    for row in rows:
        shares = [row[f"time/{part}_share"] for part in ("env", "replay", "update", "rest")]
        assert sum(shares) == pytest.approx(1.0)
        assert all(0.0 < share < 1.0 for share in shares)


def test_progress_bar_counts_time_where_only_time_ends_the_run():
    console = Console(file=io.StringIO(), force_terminal=False, width=200)
    text = shown(None, 1e6, range(1, 5), console)
    assert text.startswith("  0%  4 steps")
    assert "277 h 46 min left" in text


def test_progress_bar_costs_microseconds_between_refreshes():
    bar = ProgressBar(10**9, None, Console(file=io.StringIO(), force_terminal=False))
    agent = SimpleNamespace(n_envs=1, ep_info_buffer=[], ep_success_buffer=[], seconds=NO_TIME)
    turns = [Progress(step, [], None) for step in range(1, 10_001)]
    began = time.perf_counter()
    for turn in turns:
        bar(agent, turn)
    assert time.perf_counter() - began < 0.1  # 10 us a call; it takes well below 1


def test_videos_by_steps_do_not_change_training(tmp_path):
    env = lambda: Pictured(Counter((5,)))  # noqa: E731
    video = RecordVideo(tmp_path / "videos", 20, env=env)
    filmed, other = small_sac(Counter((5,))), small_sac(Counter((5,)))
    filmed.learn(45, video)
    other.learn(45)
    assert [path.name for path in video.paths] == ["step_000000020.mp4", "step_000000040.mp4"]
    assert all(path.stat().st_size > 0 for path in video.paths)
    for name, array in other.get_parameters().items():
        np.testing.assert_array_equal(array, filmed.get_parameters()[name])


def test_videos_by_episodes(tmp_path):
    video = RecordVideo(tmp_path, every_episodes=3, env=lambda: Pictured(Counter((5,))))
    small_sac(Counter((5,))).learn(40, video)  # 8 episodes of 5 steps
    assert [path.name for path in video.paths] == ["step_000000015.mp4", "step_000000030.mp4"]


@pytest.mark.parametrize("settings", [{}, {"every": 5, "every_episodes": 2}])
def test_videos_need_exactly_one_frequency(settings, tmp_path):
    with pytest.raises(ValueError, match="give one of every="):
        RecordVideo(tmp_path, **settings)


class Pictured(gym.Wrapper):
    """An environment that can be filmed."""

    @property
    def render_mode(self):
        return "rgb_array"

    def render(self):
        return np.zeros((32, 32, 3), np.uint8)
