"""Run folders as records: complete, partial, damaged and hostile ones."""

import json
import os
import shlex
import sys

import numpy as np
import pytest
from filelock import FileLock

from rejeu.agents import BUILT_IN
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.lab.runs import config
from rejeu.lab.runs.read import Remarks, best_row, default_hyperparameters, read_run

CONFIG = {
    "env": "CartPole-v1",
    "algorithm": "DQN",
    "preset": False,
    "hyperparameters": {"gamma": 0.9, "batch_size": 32, "policy_kwargs": {"net_arch": [64, 64]}},
    "seed": 3,
    "n_envs": 2,
    "backend": "gymnasium",
    "steps": 100,
    "minutes": None,
    "evaluate_every": 50,
    "evaluate_episodes": 5,
    "env_argument": "CartPole-v1",
    "env_kwargs": {"sutton_barto_reward": True},
    "versions": {"python": "3.11.7", "envpool": None},
}
DEEP = b'{"env": "E", "hyperparameters": ' + b'{"a": ' * 400 + b"1" + b"}" * 401
EPISODES = "step,env,return,length,success,seconds\r\n40,0,20.0,20,nan,0.5\r\n100,1,30.5,30,nan,1.25\r\n"
EVALUATIONS = "step,seconds,success_rate,mean_return\r\n100,0.7,nan,25.0\r\n"
METRICS = "step,rollout/ep_rew_mean,train/loss\r\n50,20.0,\r\n90,21.0,0.5\r\n"


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    (path / "config.json").write_text(json.dumps(CONFIG), encoding="utf-8")
    for name, content in (("episodes", EPISODES), ("evaluations", EVALUATIONS), ("metrics", METRICS)):
        (path / f"{name}.csv").write_bytes(content.encode())
    (path / "agent.safetensors").write_bytes(b"")
    return path


def test_complete_run(folder):
    run = read_run(folder)
    config = run.config
    assert (run.name, config.algorithm, config.env, config.seed, config.n_envs) == ("run", "DQN", "CartPole-v1", 3, 2)
    assert (run.state, run.steps, config.steps, run.seconds) == ("finished", 100, 100, 1.25)
    np.testing.assert_array_equal(run.episodes.column("step"), [40, 100])
    np.testing.assert_array_equal(run.episodes.column("return"), [20.0, 30.5])
    np.testing.assert_array_equal(run.metrics.column("train/loss"), [np.nan, 0.5])
    np.testing.assert_array_equal(run.evaluations.column("mean_return"), [25.0])
    assert run.versions == {"python": "3.11.7"}
    assert run.notes == ()
    (folder / "evaluations.csv").unlink()
    assert read_run(folder).steps == 100


def test_changed_hyperparameters_and_command(folder):
    run = read_run(folder)
    assert run.changed == {"gamma": (0.9, 0.99), "policy_kwargs.net_arch": ([64, 64], None)}
    assert run.command == (
        "rejeu train CartPole-v1 --env-kwargs sutton_barto_reward=true --algo DQN --steps 100 --envs 2 "
        "--backend gymnasium --seed 3 --evaluate-every 50 --evaluate-episodes 5 --set gamma=0.9 batch_size=32 "
        "'policy_kwargs.net_arch=[64, 64]'"
    )  # the default batch_size too, since the preset has another


def test_command_has_wrappers_nulls_and_long_values(folder):
    noise = {"noise": "normal", "mean": [0.0] * 100, "sigma": [0.1] * 100}
    content = {
        **CONFIG,
        "env": "Walk-v0",
        "env_argument": "my_env:Walk-v0",
        "wrappers": ["my_env:Shaped", "a b"],
        "hyperparameters": {"target_kl": 0.5, "max_grad_norm": None, "action_noise": noise},
    }
    (folder / "config.json").write_text(json.dumps(content), encoding="utf-8")
    words = shlex.split(read_run(folder).command)
    assert words[:3] == ["rejeu", "train", "my_env:Walk-v0"]
    assert [words[i + 1] for i, word in enumerate(words) if word == "--wrapper"] == ["my_env:Shaped", "a b"]
    given = config.merged(config.assigned(words[words.index("--set") + 1 :]), {})
    assert (given["max_grad_norm"], given["action_noise"]) == (None, noise)


def test_the_best_evaluation_has_the_highest_success_rate_and_then_the_highest_return(folder):
    rows = [
        "step,success_rate,mean_return",
        "10,0.5,9",
        "20,0.75,1",
        "30,0.75,2",
        "40,0.75,nan",
        "50,nan,10",
        "60,0.25,8",
    ]
    (folder / "evaluations.csv").write_text("\n".join([*rows, ""]), encoding="utf-8")
    assert best_row(read_run(folder).evaluations) == 2
    (folder / "evaluations.csv").write_text("step,success_rate,mean_return\n10,0,1\n20,nan,9\n", encoding="utf-8")
    assert best_row(read_run(folder).evaluations) == 0
    (folder / "evaluations.csv").write_text("step,mean_return\n10,1\n20,3\n30,2\n", encoding="utf-8")
    assert best_row(read_run(folder).evaluations) == 1


def test_a_run_of_minutes_is_finished_when_nearly_all_of_them_are_over(folder):
    for seconds, state in ((1.27, "finished"), (1.30, "interrupted")):  # it trained for 1.25 s
        (folder / "config.json").write_text(json.dumps({**CONFIG, "steps": None, "minutes": seconds / 60}))
        assert read_run(folder).state == state


def test_interrupted_and_crashed_run(folder):
    (folder / "config.json").write_text(json.dumps({**CONFIG, "steps": 500}), encoding="utf-8")
    assert read_run(folder).state == "interrupted"
    (folder / "paused").touch()
    assert read_run(folder).state == "paused"
    (folder / "agent.safetensors").unlink()
    assert read_run(folder).state == "crashed"


def test_steps_without_an_episode_are_those_of_the_newest_checkpoint(folder):
    for name in ("episodes", "evaluations", "metrics"):
        (folder / f"{name}.csv").write_bytes(b"step\n")
    (folder / "checkpoints").mkdir()
    for step in (0, 60):
        (folder / "checkpoints" / f"run_{step:012d}.safetensors").touch()
    assert (read_run(folder).steps, read_run(folder).state) == (60, "interrupted")


def test_running_run_by_its_lock(folder):
    (folder / "checkpoints").mkdir()
    with FileLock(folder / "checkpoints" / "lock"):
        assert read_run(folder).state == "running"
    assert read_run(folder).state == "finished"


def test_crash_before_the_first_row(folder):
    for name in ("episodes.csv", "evaluations.csv", "agent.safetensors"):
        (folder / name).unlink()
    (folder / "metrics.csv").write_bytes(b"")
    (folder / "checkpoints").mkdir()
    with FileLock(folder / "checkpoints" / "lock"):
        assert (read_run(folder).state, read_run(folder).notes) == ("running", ())
    run = read_run(folder)
    assert (run.state, run.steps, len(run.episodes), len(run.metrics)) == ("crashed", 0, 0, 0)
    assert run.notes == ("there is no episodes.csv", "metrics.csv is empty", "there is no evaluations.csv")


def test_truncated_and_damaged_rows_are_left_out(folder):
    content = EPISODES + "x,0,1,1,nan,1\r\n120,0\r\n-5,0,1,1,nan,1\r\n110,0,inf,5,1.0,2.0\r\n130,0,12"
    (folder / "episodes.csv").write_bytes(content.encode())
    run = read_run(folder)
    np.testing.assert_array_equal(run.episodes.column("step"), [40, 100, 110])
    np.testing.assert_array_equal(run.episodes.column("return"), [20.0, 30.5, np.nan])
    assert run.notes == (
        "the last row of episodes.csv is incomplete and was left out",
        "left out of episodes.csv: 1 damaged row",
        "2 rows without a valid step were left out",
    )


@pytest.mark.parametrize(
    "content",
    [b"\xff\xfe\x00", b"[" * 100_000, DEEP, b"[1]", b'{"env": 1e999}', b'{"a": 1, "a": 2}', b"x" * 2_000_000],
    ids=["not UTF-8", "deep", "a deep value", "no object", "huge number", "repeated name", "large"],
)
def test_damaged_config_becomes_a_note(folder, content):
    (folder / "config.json").write_bytes(content)
    run = read_run(folder)
    assert len(run.episodes) == 2
    assert run.notes[0].startswith("config.json is damaged: ")
    assert run.command == ""


def test_config_with_values_of_wrong_types(folder):
    bad = {"env": {"a": 1}, "algorithm": ["<script>"], "seed": "x", "steps": -1, "minutes": True, "hyperparameters": 3}
    (folder / "config.json").write_text(json.dumps(bad), encoding="utf-8")
    run = read_run(folder)
    assert (run.config.seed, run.config.steps, run.config.minutes, run.config.hyperparameters) == (None, None, None, {})
    assert run.config.algorithm == ""
    assert "config.json is damaged" in run.notes[0]


def test_tables_that_are_not_text(folder):
    (folder / "episodes.csv").write_bytes(b"\xff,\xfe\n\x00\x01,1\n" + bytes(range(256)))
    (folder / "metrics.csv").write_bytes(b"," * 100_000)
    run = read_run(folder)
    assert len(run.episodes) == 0
    assert len(run.metrics) == 0
    assert run.steps == 100


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights")
def test_links_out_of_the_folder_are_not_followed(folder, tmp_path):
    secret = tmp_path / "secret.mp4"
    secret.write_bytes(b"1")
    (tmp_path / "secret.csv").write_bytes(EPISODES.encode())
    (folder / "episodes.csv").unlink()
    (folder / "episodes.csv").symlink_to(tmp_path / "secret.csv")
    (folder / "video.mp4").symlink_to(secret)
    (folder / "videos").mkdir()
    (folder / "videos" / "step_1.mp4").write_bytes(b"1")
    (folder / "videos" / "step_2.mp4").symlink_to(secret)
    (folder / "films").symlink_to(tmp_path)
    run = read_run(folder)
    assert run.videos == (folder / "videos" / "step_1.mp4",)
    assert len(run.episodes) == 0
    assert "episodes.csv cannot be read: episodes.csv is not a regular file" in run.notes


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_named_pipe_does_not_block(folder):
    (folder / "metrics.csv").unlink()
    os.mkfifo(folder / "metrics.csv")
    assert "metrics.csv cannot be read: metrics.csv is not a regular file" in read_run(folder).notes


def test_folder_without_a_run(tmp_path):
    with pytest.raises(FileNotFoundError, match="is no run folder"):
        read_run(tmp_path)
    with pytest.raises(FileNotFoundError, match="there is no run folder"):
        read_run(tmp_path / "none")


def test_the_defaults_of_every_algorithm_are_known():
    assert [name for name in BUILT_IN if not default_hyperparameters(name)] == []


@pytest.mark.parametrize("content", [b"{", b"[]", b'{"note": 3}', b'{"tags": "x"}', b"\xff"])
def test_remarks_that_are_damaged_are_left_out(folder, content):
    (folder / "remarks.json").write_bytes(content)
    assert read_run(folder).remarks == Remarks()


def test_remarks_are_read_as_they_were_written_and_shortened(folder):
    remarks = Remarks("first\n<b>second</b>", ("paper", "é"))
    remarks.write(RunFolder(folder))
    assert read_run(folder).remarks == remarks
    Remarks("x" * 20_000, ("t" * 300,) * 50).write(RunFolder(folder))
    long = read_run(folder).remarks
    assert (len(long.note), len(long.tags)) == (10_000, 20)
