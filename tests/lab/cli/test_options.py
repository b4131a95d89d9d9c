"""Every option of a command reaches what it is for. What would train, play or use the network is replaced and noted."""

import dataclasses
import importlib
import inspect
import json
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest

from rejeu import demonstrations
from rejeu.agents import zip_files
from rejeu.agents.together import sibling
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import checkpoint
from rejeu.core.interrupt import Interrupt
from rejeu.lab import hub
from rejeu.lab.cli import clone, compare, courses, main, models, sweep, tune
from rejeu.lab.experiments import study_plan
from rejeu.lab.reporting.report import write_report
from rejeu.lab.runs import begin, resume
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.config import DecidedRun, RunConfig, Task, write_task
from rejeu.lab.runs.environment import Environment
from rejeu.lab.runs.session import Session, TrainingLimits
from rejeu.logs.evaluation import Evaluation
from rejeu.teaching import play
from rejeu.teaching.courses.leaderboard import Leaderboard, Unranked

TYPED = "CartPole-v1"

pytestmark = pytest.mark.usefixtures("learners_are_shared")


@pytest.fixture
def spy(monkeypatch):
    """Replaces a function by one that notes its arguments by name; returns the list of its calls."""

    def replace(owner, name, result=None):
        calls, signature = [], inspect.signature(getattr(owner, name))
        rest = [one.name for one in signature.parameters.values() if one.kind is one.VAR_KEYWORD]

        def note(*args, **kwargs):
            given = signature.bind(*args, **kwargs).arguments
            calls.append({key: value for key, value in given.items() if key not in rest})
            for name in rest:
                calls[-1].update(given.get(name, {}))
            return result

        monkeypatch.setattr(owner, name, note)
        return calls

    return replace


def includes(calls, **expected):
    """Returns whether the last call had these arguments among others."""
    return {key: calls[-1].get(key) for key in expected} == expected


def test_evaluate(spy):
    agent, env = mock.Mock(), mock.Mock(backend="gymnasium")
    agent.evaluate.return_value = Evaluation(np.array([1.0]), np.array([5]), np.array([np.nan]))
    found, loaded = spy(models, "find_model", Path("model")), spy(models, "load", agent)
    made = spy(Environment, "vector", env)
    argv = ["evaluate", "run", "--env", TYPED, "--which", "last", "--device", "cpu", "--seed", "5"]
    argv += ["--backend", "gymnasium", "--success-threshold", "3"]
    assert main([*argv, "--episodes", "7"]) == 0
    assert includes(found, run=Path("run"), which="last")
    assert includes(loaded, path=Path("model"), device="cpu")
    assert includes(made, n_envs=7, backend="gymnasium", seed=5)
    agent.evaluate.assert_called_with(7, env=env, success_threshold=3.0, minutes=None)
    assert main([*argv, "--minutes", "2"]) == 0
    assert includes(made, n_envs=16)
    agent.evaluate.assert_called_with(None, env=env, success_threshold=3.0, minutes=2.0)
    assert main(argv) == 0
    agent.evaluate.assert_called_with(None, env=env, success_threshold=3.0, minutes=None)


def test_record(spy, tmp_path):
    found, recorded = spy(models, "find_model", tmp_path / "best.safetensors"), spy(models, "record_video", "v.mp4")
    spy(models, "load")
    argv = ["record", str(tmp_path), "--env", TYPED, "--episodes", "2", "--seed", "5", "--which", "last"]
    assert main([*argv, "--out", "v.mp4"]) == 0
    assert includes(found, which="last")
    assert includes(recorded, path=Path("v.mp4"), episodes=2, seed=5)
    assert main(argv) == 0
    assert includes(recorded, path=RunFolder(tmp_path).video)


def test_export(spy, tmp_path):
    found, exported = spy(models, "find_model", tmp_path / "best.safetensors"), spy(models, "export", mock.Mock())
    spy(models, "load", mock.Mock())
    argv = ["export", "run", "--env", TYPED, "--to", "c", "--noise", "--batch", "3", "--frame-stack", "4"]
    assert main([*argv, "--which", "last", "--out", str(tmp_path / "policy.h")]) == 0
    assert includes(found, which="last")
    assert includes(exported, path=tmp_path / "policy.h", to="c", noise=True, batch=3, frame_stack=4, source="run")


def game():
    return SimpleNamespace(players=[SimpleNamespace(name="you", scores=[1.0, 3.0], mean=2.0, best=3.0, recording=None)])


def test_watch_and_play(spy, capsys):
    found, watched, played = spy(models, "find_model"), spy(play, "watch", game()), spy(play, "play", game())
    spy(models, "load", "agent")
    spy(checkpoint, "read_header", {"env_id": TYPED})
    common = ["--seed", "5", "--fps", "20", "--episodes", "2", "--which", "last", "--json"]
    assert main(["watch", "run", "--env", TYPED, *common]) == 0
    assert includes(found, which="last")
    assert includes(watched, agent="agent", seed=5, fps=20.0, episodes=2)
    (player,) = json.loads(capsys.readouterr().out)["players"]
    assert player == {"name": "you", "episodes": 2, "mean": 2.0, "best": 3.0, "scores": [1.0, 3.0]}
    assert main(["play", TYPED, "--keys", "a=0", "--record", "shown", "--against", "other", *common]) == 0
    assert includes(found, run=Path("other"), which="last")
    assert includes(played, keys={"a": 0}, seed=5, fps=20.0, episodes=2, record=Path("shown"), against="agent")
    spy(checkpoint, "read_header", {"env_id": "Acrobot-v1"})
    assert main(["play", TYPED, "--against", "other"]) == 2


def test_import(spy, tmp_path):
    agent = mock.Mock(notes=[], num_timesteps=1, n_updates=1)
    loaded, found = (
        spy(zip_files, "load_zip", agent),
        spy(importlib.import_module("rejeu.agents.zoo"), "model_in", "zip"),
    )
    argv = ["import", str(tmp_path / "a.zip"), "--vecnormalize", "v.pkl", "--env", TYPED, "--set", "gamma=0.5"]
    assert main([*argv, "--out", str(tmp_path / "b")]) == 0
    assert includes(loaded, vecnormalize=Path("v.pkl"), gamma=0.5)
    assert loaded[-1]["env"].env_id == TYPED
    agent.save.assert_called_with(tmp_path / "b")
    assert main(["import", str(tmp_path / "a.zip"), "--vecnormalize", "none"]) == 0
    assert includes(loaded, env=None, vecnormalize=False)
    agent.save.assert_called_with(tmp_path / "a.safetensors")
    spy(importlib.import_module("rejeu.agents.zoo"), "model_in", tmp_path / "c.zip")
    assert main(["import", str(tmp_path), "--which", "best", "--out", str(tmp_path / "d")]) == 0
    assert includes(loaded, path=tmp_path / "c.zip")
    assert not found


@pytest.mark.parametrize("private", [True, False])
def test_push_and_pull(spy, tmp_path, private, capsys):
    pushed, pulled = spy(hub, "push", "address"), spy(hub, "pull", tmp_path)
    assert main(["push", "run", "me/model", *["--private"] * private]) == 0
    assert includes(pushed, source=Path("run"), repo="me/model", private=private)
    (tmp_path / "a.zip").touch()
    assert main(["pull", "me/model", "--out", "here"]) == 0
    assert includes(pulled, repo="me/model", out=Path("here"))
    assert f"rejeu import {tmp_path / 'a.zip'}" in capsys.readouterr().out


def test_class(spy, tmp_path):
    evaluated = spy(courses.leaderboard, "result_of", Unranked("it is no model"))
    board = spy(courses.leaderboard, "board_of", Leaderboard(TYPED, 7, (), (), "fr"))
    listed, vectors = spy(courses.leaderboard, "models", [Path("pupils/a")]), spy(Environment, "vector", mock.Mock())
    argv = ["class", "pupils", "--env", TYPED, "--episodes", "7", "--minutes", "2", "--seed", "5", "--language", "fr"]
    assert main([*argv, "--success-threshold", "3", "--out", str(tmp_path / "board.md")]) == 0
    assert includes(listed, folder=Path("pupils"))
    assert includes(vectors, n_envs=7, seed=5)
    assert includes(evaluated, name="a", env_id=TYPED, episodes=7, seconds=120.0, seed=5, success_threshold=3.0)
    assert includes(board, env_id=TYPED, episodes=7, language="fr")
    assert (tmp_path / "board.md").is_file()


def test_tune(spy):
    opened, completed = spy(tune.tuning, "open_study", "study"), spy(tune, "complete", (0, {}))
    planned = spy(tune.plans, "make", "plan")
    argv = ["tune", TYPED, "--algo", "ppo", "--envs", "3", "--backend", "gymnasium", "--set", "gamma=0.5", "--search"]
    argv += ["learning_rate=1e-5..1e-3", "--only", "learning_rate", "--measure", "success", "--evaluate-episodes", "6"]
    argv += ["--checkpoint-minutes", "2", "--seed", "5", "--workers", "4", "--trials", "9", "--steps", "50"]
    argv += ["--evaluate-every", "10", "--trial-seeds", "2", "--final-seeds", "8", "--pruner", "halving"]
    assert main([*argv, "--out", "study", "--env-kwargs", "render_mode=rgb_array"]) == 0
    given = {"algorithm": "PPO", "n_envs": 3, "backend": "gymnasium", "fixed": {"gamma": 0.5}}
    given |= {"only": ("learning_rate",), "measure": "success", "evaluate_episodes": 6, "checkpoint_minutes": 2.0}
    given |= {"seed": 5, "trials": 9, "steps": 50, "evaluate_every": 10, "trial_seeds": 2, "final_seeds": 8}
    given |= {"pruner": "halving", "env_kwargs": {"render_mode": "rgb_array"}, "env_argument": TYPED, "wrappers": ()}
    (call,) = planned
    assert {key: call[key] for key in given} == given
    assert call.keys() - given == {"env_id", "preset", "search"}
    assert call["search"].keys() == {"learning_rate"}
    assert includes(opened, plan="plan", folder=Path("study"))
    assert includes(completed, study="study", workers=4)


def test_sweep_and_its_resume(spy):
    prepared, completed = spy(sweep, "prepare", "folder"), spy(sweep, "complete", (0, {}))
    read = spy(sweep, "read_folder", "folder")
    assert main(["sweep", "plan.toml", "--out", "there", "--workers", "3", "--ray", "auto"]) == 0
    assert includes(prepared, plan=Path("plan.toml"), folder=Path("there"), workers=3, ray="auto")
    assert includes(completed, folder="folder", workers=3, ray="auto", retry=False)
    with mock.patch("rejeu.lab.cli.resume.is_sweep", return_value=True):
        argv = ["resume", "there", "--env", TYPED, "--env-kwargs", "g=2", "--workers", "3", "--ray", "auto"]
        assert main(argv) == 0
    assert read[-1]["typed"] == RunConfig(env=TYPED, env_kwargs={"g": 2})
    assert includes(completed, folder="folder", workers=3, ray="auto", retry=True)


def test_compare(spy, monkeypatch):
    compared, opened = spy(compare, "compare", result := mock.Mock(**{"to_dict.return_value": {}})), []
    monkeypatch.setattr("webbrowser.open", opened.append)
    result.save.return_value = [Path("page.html")]
    argv = ["compare", "a", "b", "--by", "env", "--x", "time", "--score", "evaluation", "--statistic", "median"]
    argv += ["--threshold", "3"]
    assert main([*argv, "--normalize", "range", "--out", "page.html", "--open", "--json"]) == 0
    expected = {"by": "env", "x": "time", "score": "evaluation", "statistic": "median", "threshold": 3.0}
    assert includes(compared, **expected, normalize="range")
    result.save.assert_called_with(Path("page.html"))
    assert opened[0].endswith("page.html")
    assert main([*argv, "--reference", "CartPole-v1=0,9", "--json"]) == 0
    assert includes(compared, **expected, normalize={"CartPole-v1": (0.0, 9.0)})


OPTIONS = ["--envs", "2", "--backend", "gymnasium", "--seed", "5", "--steps", "70", "--success-threshold", "3"]
OPTIONS += ["--video-every", "30", "--checkpoint-minutes", "7", "--evaluate-every", "40", "--evaluate-episodes", "6"]
OPTIONS += ["--log", "json", "--device", "cpu", "--pause", "20", "--env-kwargs", "render_mode=rgb_array"]
GIVEN = {"n_envs": 2, "backend": "gymnasium", "seed": 5, "steps": 70, "success_threshold": 3.0, "video_every": 30}
GIVEN |= {"checkpoint_minutes": 7.0, "evaluate_every": 40, "evaluate_episodes": 6, "device": "cpu"}
GIVEN |= {"algorithm": "DQN", "minutes": None, "env": TYPED, "env_kwargs": {"render_mode": "rgb_array"}}
SMALL = ["--set", "policy_kwargs.net_arch=[4]", "buffer_size=100"]


@pytest.fixture
def sessions(monkeypatch):
    """Sessions that would have trained."""
    found = []
    monkeypatch.setattr(Session, "run", lambda self, stop, watch: (found.append(self), (0, {}))[1])
    return found


def test_train(sessions, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    argv = ["train", TYPED, "--algo", "dqn", *OPTIONS, "--no-report", "--no-video", "--out", str(tmp_path / "run")]
    assert main([*argv, *SMALL]) == 0
    (session,) = sessions
    content = json.loads((tmp_path / "run" / "config.json").read_text(encoding="utf-8"))
    assert {key: content[key] for key in GIVEN} == GIVEN
    assert (content["log"], content["hyperparameters"]["policy_kwargs"]["net_arch"]) == (["json"], [4])
    assert session.limits == TrainingLimits(steps=70, pause_steps=20)
    assert (session.report, session.has_video, session.is_new) == (None, False, True)
    agent = session.agent
    assert (agent.seed, agent.device, agent.success_threshold, agent.n_envs) == (5, "cpu", 3.0, 2)
    assert (session.evaluation_env.n_envs, session.evaluation_env.backend, session.log_interval) == (6, "gymnasium", 8)
    evaluate, callbacks = session.callbacks(Interrupt())
    assert (evaluate.every, evaluate.episodes, evaluate.best_path) == (40, 6, session.folder.best)
    video, checkpoint = callbacks[-2:]
    assert (video.every, video.folder, checkpoint.minutes) == (30, session.folder.videos, 7.0)
    assert checkpoint.folder == session.folder.checkpoints
    with pytest.MonkeyPatch.context() as patch:  # another seed of the same command
        made, evaluated = [], []
        patch.setattr(Environment, "vector", lambda self, *given: made.append(given) or mock.Mock())
        patch.setattr(sweep, "make_evaluation_env", lambda config, made: evaluated.append(config.seed) or mock.Mock())
        siblings = mock.create_autospec(sibling)
        patch.setattr(sweep, "sibling", siblings)
        other = sweep.with_seed(session, 9, mock.MagicMock())
    assert (made, evaluated, other.config.seed) == ([(2, "gymnasium", 9)], [9], 9)
    assert siblings.call_args.args[2] == 9


def test_workers_and_datasets_of_train(spy):
    made, shown = spy(Environment, "vector"), Train(env=TYPED, offline=Path("shown"))
    given = Train(env=TYPED, n_envs=3, backend="gymnasium-async", restart_workers=2)
    environment = models.from_arguments(TYPED, given)
    begin.make_env(given, environment, None, 5)
    assert includes(made, n_envs=3, backend="gymnasium-async", seed=5)
    assert made[-1]["workers"].restart_workers == 2
    begin.make_env(dataclasses.replace(given, backend="ray", ray="auto", env_cpus=0.5), environment, None, 5)
    assert made[-1]["workers"].ray == {"address": "auto", "num_cpus": 0.5}
    given = begin.with_dataset(shown)
    assert (given.algorithm, given.offline) == ("IQL", None)
    assert given.hyperparameters == {"demonstrations": "shown", "offline": True}
    assert begin.with_dataset(dataclasses.replace(shown, preset="p.json")).algorithm is None
    assert begin.with_dataset(dataclasses.replace(shown, algorithm="SAC")).algorithm == "SAC"


def test_train_for_minutes_with_the_report_and_the_video(sessions, tmp_path):
    argv = ["train", TYPED, "--algo", "DQN", "--minutes", "2", "--seed", "5", "--checkpoint-minutes", "0"]
    assert main([*argv, "--backend", "gymnasium", "--out", str(tmp_path / "run"), *SMALL]) == 0
    settings = {"policy_kwargs.net_arch": [4], "buffer_size": 100}
    run = RunConfig(env=TYPED, algorithm="DQN", seed=6, backend="gymnasium", hyperparameters=settings)
    write_task(tmp_path / "task.json", Task(folder=str(tmp_path / "other"), run=run, no_video=True))
    assert main(["--task", str(tmp_path / "task.json")]) == 0
    session, other = sessions
    assert (other.config.seed, other.report, other.has_video) == (6, write_report, False)
    assert other.folder == RunFolder(tmp_path / "other")
    assert session.limits == TrainingLimits(minutes=2.0)
    assert session.report is write_report
    assert session.has_video
    assert session.config.checkpoint_minutes is None
    assert session.agent.seed == 5


def decided(**changes):
    """What a run folder says."""
    common = {"env": TYPED, "algorithm": "DQN", "policy": "MlpPolicy", "preset": True, "seed": 4}
    common |= {"n_envs": 2, "backend": "gymnasium", "steps": 100, "evaluate_every": 40, "evaluate_episodes": 6}
    return DecidedRun(**{**common, "device": "cpu", **changes})


def test_resume(spy, sessions, monkeypatch, tmp_path):
    agent = mock.Mock(**{"call.training_call.last_step": 100, "call.training_call.is_over.return_value": False})
    agent.run.step = 30
    kind = mock.Mock(**{"resume.return_value": agent})
    spy(resume, "read_folder", decided(hyperparameters={"policy_kwargs": {"net_arch": [4]}}))
    spy(resume, "agent_of_file", kind)
    written, made = spy(resume.configs_of_runs, "write"), spy(Environment, "vector", mock.Mock())
    monkeypatch.setattr(resume.configs, "to_json", lambda config: {"gamma": 0.5})
    argv = ["resume", str(tmp_path), "--restart-workers", "3", "--no-report", "--device", "cpu"]
    argv += ["--set", "gamma=0.5", "policy_kwargs.layer_norm=true"]
    assert main([*argv, "--steps", "20"]) == 0
    assert sessions[-1].limits == TrainingLimits(pause_steps=20)
    assert (sessions[-1].report, sessions[-1].has_video, sessions[-1].is_new) == (None, True, False)
    assert kind.resume.call_args.kwargs == {
        "device": "cpu",
        "gamma": 0.5,
        "policy_kwargs": {"net_arch": [4], "layer_norm": True},
    }
    assert kind.resume.call_args.args[0] == tmp_path / "checkpoints"
    training, evaluating = made
    assert (training["n_envs"], training["backend"], training["seed"]) == (2, "gymnasium", 4)
    assert training["workers"].restart_workers == 3
    assert evaluating["seed"] != 4
    assert written[-1]["config"].hyperparameters == {"gamma": 0.5}
    assert main([*argv, "--minutes", "2", "--no-video"]) == 0
    assert sessions[-1].limits == TrainingLimits(pause_minutes=2.0)
    assert not sessions[-1].has_video
    assert main([*argv, "--steps", "80"]) == 0  # beyond the goal
    assert sessions[-1].limits == TrainingLimits(steps=80)
    agent.call.training_call.is_over.return_value = True
    for words, limits in (
        (["--steps", "8"], TrainingLimits(steps=8)),
        (["--minutes", "2"], TrainingLimits(minutes=2.0)),
        (["--finish"], TrainingLimits()),
    ):
        assert main([*argv, *words]) == 0
        assert sessions[-1].limits == limits


def test_clone(spy, tmp_path):
    session = mock.MagicMock()
    session.in_new_folder.return_value = session
    session.config.seed = 5
    session.finish.return_value = (0, {})
    session.training.return_value.__enter__.return_value.evaluate.best = None
    shown = mock.MagicMock()
    read, begun = spy(demonstrations, "read", shown), spy(clone, "begin", session)
    cloned, offline, taught = (spy(demonstrations, name) for name in ("clone", "learn_offline", "dagger"))
    spy(demonstrations, "check"), spy(demonstrations, "keeping_policy")
    found = spy(models, "find_model", "model")
    spy(models, "load", agent := mock.Mock(**{"learner.algorithm.recall": None}))
    spy(checkpoint, "read_header", {"env_id": TYPED})
    argv = ["clone", "shown", "--env", TYPED, "--algo", "SAC", "--set", "gamma=0.5", "--updates", "7", "--seed", "5"]
    argv += ["--learning-rate", "0.1", "--evaluate-episodes", "6", "--device", "cpu", "--no-report", "--no-video"]
    with mock.patch.object(clone, "Checkpoint"):
        assert main([*argv, "--critic-updates", "3", "--out", str(tmp_path / "a")]) == 0
        assert includes(read, path=Path("shown"))
        task = begun[-1]["arguments"]
        named = ("env", "algorithm", "hyperparameters", "evaluate_episodes", "device", "no_report", "no_video", "seed")
        assert [getattr(task, name) for name in named] == [TYPED, "SAC", {"gamma": 0.5}, 6, "cpu", True, True, 5]
        assert includes(cloned, updates=7, learning_rate=0.1, seed=5)
        assert includes(offline, updates=3, keep_policy=True)
        assert not taught
        argv += ["--expert", "teacher", "--which", "last", "--rounds", "2", "--round-steps", "9"]
        assert main([*argv, "--out", str(tmp_path / "b")]) == 0
    assert includes(found, run=Path("teacher"), which="last")
    assert includes(taught, rounds=2, steps=9, updates=7, learning_rate=0.1, seed=5, takes_over=False)
    agent.predict.return_value = ("action", None)
    assert taught[-1]["expert"]("obs") == "action"
    agent.predict.assert_called_with("obs", deterministic=True)
    assert len(cloned) == len(offline) == 1
    spy(checkpoint, "read_header", {"env_id": "Acrobot-v1"})
    assert main([*argv, "--out", str(tmp_path / "c")]) == 2  # the expert plays another environment
    assert not (tmp_path / "c").exists()


def test_wrappers_are_applied_in_the_order_in_which_they_are_named():
    argv = ["gymnasium.wrappers:FlattenObservation", "gymnasium.wrappers:RecordEpisodeStatistics"]
    given = dataclasses.replace(RunConfig(env=TYPED), wrappers=tuple(argv))
    env = models.from_arguments(TYPED, given).make()
    assert isinstance(env, gym.wrappers.RecordEpisodeStatistics)
    assert isinstance(env.env, gym.wrappers.FlattenObservation)
    env.close()


def test_a_plan_of_a_study_keeps_every_option():
    given = {"trials": 9, "steps": 50, "n_envs": 3, "backend": "gymnasium", "evaluate_every": 10, "seed": 5}
    given |= {"evaluate_episodes": 6, "trial_seeds": 2, "final_seeds": 8, "pruner": "halving", "measure": "success"}
    given |= {"checkpoint_minutes": 2.0, "env_kwargs": {"g": 9.8}, "wrappers": ("a:B",), "env_argument": "my_env.py"}
    plan = study_plan.make("Pendulum-v1", "SAC", **given)
    kept = {**vars(plan.default), **vars(plan), "steps": plan.default.total_steps}
    assert {key: kept[key] for key in given} == given
    assert (plan.column, plan.run.env_kwargs, plan.run.wrappers) == ("success_rate", {"g": 9.8}, ("a:B",))
    assert plan.run.env_argument == "my_env.py"
    of_preset = {"env_id": "Pendulum-v1", "algorithm": "SAC", "hyperparameters": {"gamma": 0.5}, "source": "a test"}
    of_preset |= {"total_steps": 50, "n_envs": 3, "evaluate_every": 10, "evaluate_episodes": 6, "backend": "gymnasium"}
    preset = plan.preset({"gamma": 0.5}, "a test")
    assert {key: getattr(preset, key) for key in of_preset} == of_preset
