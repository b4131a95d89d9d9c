"""What is asked of a run by files in its folder: to stop, to show its policy; and the models that it keeps."""

import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import rejeu
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core.interrupt import Interrupt
from rejeu.lab.cli import main
from rejeu.lab.runs import requests, resume


@pytest.fixture
def asked(tmp_path):
    """A run folder, a request to stop, the callback, and the paths of the models that were written."""
    folder, stop, written = RunFolder(tmp_path), Interrupt(), []

    def snapshot(path):
        def write():
            written.append(path.name)
            agent.last_saved = path
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(b"")

        return write

    agent = SimpleNamespace(last_saved="before", snapshot=snapshot)
    callback = requests.Requests(folder, stop)
    callback.before_training(agent)
    return SimpleNamespace(folder=folder, stop=stop, written=written, agent=agent, callback=callback)


def test_the_model_is_written_only_while_somebody_watches_and_at_most_every_two_seconds(asked, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(requests.time, "monotonic", lambda: now[0])
    asked.callback(asked.agent, None)
    assert asked.written == []
    requests.ask(asked.folder.watch)
    for now[0] in (101.0, 102.0, 103.0, 104.0):
        asked.callback(asked.agent, None)
    assert asked.written == ["live.safetensors"] * 2
    old = time.time() - 2 * requests.STALE
    os.utime(asked.folder.watch, (old, old))
    now[0] = 106.0
    asked.callback(asked.agent, None)
    assert len(asked.written) == 2
    assert asked.agent.last_saved == "before"
    asked.callback.after_training(asked.agent, None)
    assert list(asked.folder.path.iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="links need rights on Windows")
def test_nothing_is_asked_through_a_folder_that_became_a_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run").symlink_to("elsewhere")
    requests.ask(RunFolder(tmp_path / "run").watch)
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_a_folder_named_stop_stops_nothing(asked):
    asked.folder.stop.mkdir()
    asked.callback(asked.agent, None)
    assert asked.stop.signal is None


def test_of_a_folder_of_many_models_so_many_are_listed_as_a_look_a_second_allows(tmp_path, monkeypatch):
    monkeypatch.setattr(requests, "MOST_ENTRIES", 5)
    for i in range(10):
        (tmp_path / f"step_{i:012}.safetensors").touch()
    assert len(requests.models(tmp_path)) == 5
    assert requests.models(tmp_path / "missing") == []


def test_a_request_to_stop_that_comes_while_a_run_starts_is_answered(asked):
    requests.ask(asked.folder.stop)
    asked.callback.before_training(asked.agent)
    asked.callback(asked.agent, None)
    assert asked.stop.signal == signal.SIGINT


def test_what_an_earlier_process_has_shown_is_not_shown_again(asked):
    for path in (asked.folder.live, asked.folder.watch, asked.folder.paused):
        requests.ask(path)
    asked.callback.before_training(asked.agent)
    assert list(asked.folder.path.iterdir()) == []


def test_a_request_to_stop_is_answered_as_ctrl_c(asked):
    asked.callback(asked.agent, None)
    requests.ask(asked.folder.stop)
    asked.callback(asked.agent, SimpleNamespace())  # less than two seconds later
    assert not asked.stop.requested
    asked.callback._next = 0.0
    asked.callback(asked.agent, None)
    assert asked.stop.signal == signal.SIGINT


def test_models_of_the_course_of_training_are_thinned(asked):
    for step in range(0, 40_000, 1000):
        requests.keep_model(asked.agent, asked.folder.models, step)
    kept = [int(path.stem.removeprefix("step_")) for path in requests.models(asked.folder.models)]
    assert len(kept) <= requests.MOST_MODELS
    assert (kept[0], kept[-1]) == (0, 39_000)
    assert kept == sorted(kept)


def test_a_model_that_somebody_reads_on_windows_does_not_stop_training(asked, monkeypatch):
    def held(path, missing_ok=False):
        raise PermissionError(13, "The process cannot access the file because it is being used by another process")

    monkeypatch.setattr(Path, "unlink", held)
    for step in range(0, 20_000, 1000):
        requests.keep_model(asked.agent, asked.folder.models, step)
    assert len(requests.models(asked.folder.models)) == 20


def test_a_full_disk_does_not_stop_training(asked, tmp_path):
    def full(path):
        def write():
            raise OSError(28, "No space left on device")

        return write

    asked.agent.snapshot = full
    requests.keep_model(asked.agent, asked.folder.models, 1000)
    requests.ask(asked.folder.watch)
    asked.callback(asked.agent, None)
    assert not asked.folder.live.exists()


def test_a_run_keeps_models_that_act_and_stops_when_it_is_asked(tmp_path, capsys, monkeypatch):
    out = tmp_path / "run"
    monkeypatch.setattr(requests, "EVERY", 0.0)
    keep = requests.keep_model

    def keep_and_ask(agent, folder, step):
        keep(agent, folder, step)
        if step >= 200:
            requests.ask(out / "stop")

    monkeypatch.setattr("rejeu.lab.runs.output.keep_model", keep_and_ask)
    argv = [
        "train",
        "CartPole-v1",
        "--algo",
        "PPO",
        "--steps",
        "2000",
        "--set",
        "n_steps=50",
        "--evaluate-every",
        "100",
    ]
    assert (
        main([*argv, "--evaluate-episodes", "1", "--no-report", "--no-video", "--out", str(out), "--seed", "0"]) == 130
    )
    first, second = requests.models(out / "models")
    assert second.name > first.name > "step_000000000100"
    assert first.name == f"step_{rejeu.load(first).num_timesteps:012}.safetensors"
    assert not {"stop", "watch", "live.safetensors"} & {path.name for path in out.iterdir()}
    assert "stopped by Ctrl-C; everything is saved" in capsys.readouterr().out


def test_a_request_to_an_earlier_process_is_dropped_when_a_run_is_resumed_and_one_to_this_process_is_not(
    tmp_path, capsys, monkeypatch
):
    out, options = tmp_path / "run", ["--no-report", "--no-video"]
    argv = [
        "train",
        "CartPole-v1",
        "--algo",
        "PPO",
        "--steps",
        "500",
        "--pause",
        "50",
        "--set",
        "n_steps=50",
        "--seed",
        "0",
    ]
    assert main([*argv, "--evaluate-episodes", "1", "--out", str(out), *options]) == 0
    requests.ask(out / "stop")
    assert main(["resume", str(out), "--steps", "100", *options]) == 0
    assert "paused" in capsys.readouterr().out
    made = resume.make_evaluation_env

    def make_and_ask(*arguments):
        requests.ask(out / "stop")
        return made(*arguments)

    monkeypatch.setattr(resume, "make_evaluation_env", make_and_ask)
    assert main(["resume", str(out), *options]) == 130
    assert "stopped by Ctrl-C; everything is saved" in capsys.readouterr().out
