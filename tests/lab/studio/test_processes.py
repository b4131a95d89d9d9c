"""Commands that the studio starts. No browser and no server."""

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

import rejeu
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import interrupt
from rejeu.lab.cli.resume import run_resume
from rejeu.lab.runs import requests
from rejeu.lab.runs.arguments import Resume
from rejeu.lab.studio import processes, run
from rejeu.lab.studio.state import Studio


def test_a_command_that_is_under_way_is_not_started_again(tmp_path):
    words = ["runs", str(tmp_path)]
    process = processes.start(words, tmp_path / "mine")
    try:
        with pytest.raises(ValueError, match="rejeu runs is under way for mine; wait until it has ended"):
            processes.start(words, tmp_path / "mine")
    finally:
        process.kill()
        process.wait(30)


def test_a_command_that_fails_says_why_and_its_button_can_be_pressed_again(tmp_path, monkeypatch):
    said, looks, presses = [], [], []
    button = SimpleNamespace(disable=lambda: presses.append("off"), enable=lambda: presses.append("on"))
    timer = SimpleNamespace(cancel=lambda: looks.append(None))
    monkeypatch.setattr(run.ui, "notify", lambda text, **_: said.append(text))
    monkeypatch.setattr(run.ui, "timer", lambda _, look: looks.append(look) or timer)
    process = SimpleNamespace(returncode=None)
    process.poll = lambda: process.returncode
    monkeypatch.setattr(processes, "start", lambda words, path: process)
    processes.log_of(tmp_path / "mine").parent.mkdir()
    processes.log_of(tmp_path / "mine").write_text("loading\nrejeu: error: no checkpoint\n", encoding="utf-8")
    page = SimpleNamespace(path=tmp_path / "mine", name="mine", studio=Studio(tmp_path))
    run.command(button, "resume", page, "It continues.")
    looks[0]()
    assert (presses, said) == (["off"], ["It continues."])
    process.returncode = 2
    looks[0]()
    assert presses == ["off", "on"]
    assert said[1:] == ["rejeu: error: no checkpoint"]
    assert looks[1:] == [None]


@pytest.mark.skipif(os.name != "posix", reason="links need rights on Windows")
@pytest.mark.parametrize("name", [".studio", ".studio/mine.log", "mine/stop", "mine/watch"])
def test_the_studio_writes_through_no_link_of_a_folder_of_runs(tmp_path, monkeypatch, name):
    profile, linked = tmp_path / "home" / "profile", tmp_path / "runs" / name
    profile.parent.mkdir()
    profile.write_text("export PATH\n", encoding="utf-8")
    os.utime(profile, (0, 0))
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    linked.parent.mkdir(exist_ok=True)
    linked.symlink_to(profile if "/" in name else profile.parent, target_is_directory="/" not in name)
    said = []
    monkeypatch.setattr(run.ui, "notify", lambda text, **_: said.append(text))
    folder, button = RunFolder(tmp_path / "runs" / "mine"), SimpleNamespace(disable=None)
    if name.startswith("mine"):
        requests.ask(linked)
        run.stop(button, RunFolder(folder.path)) if name == "mine/stop" else said.append("is a symbolic link")
    else:
        page = SimpleNamespace(path=folder.path, name="mine", studio=SimpleNamespace(words=lambda name: []))
        run.command(button, "runs", page, "")
    assert "is a symbolic link" in said[0]
    assert profile.stat().st_mtime == 0
    assert [one.name for one in profile.parent.iterdir()] == ["profile"]


@pytest.mark.skipif(os.name != "posix", reason="links need rights on Windows")
@pytest.mark.parametrize(
    "name", ["checkpoints", "checkpoints/lock", "models", "videos", "wandb", ".sweep", "a/config.json"]
)
def test_a_folder_with_a_link_is_not_resumed(tmp_path, name):
    (tmp_path / "run" / name).parent.mkdir(parents=True)
    (tmp_path / "run" / name).symlink_to(tmp_path / "home")
    for kind in ("config.json", "sweep.json", "study.json"):
        (tmp_path / "run" / kind).write_text("{}", encoding="utf-8")
    with pytest.raises(OSError, match=f"{name} is a symbolic link; remove it"):
        run_resume(Resume(run=tmp_path / "run"))
    assert not (tmp_path / "home").exists()


def test_every_process_of_python_leaves_out_the_current_folder():
    """Else a file random.py there would take the place of the module."""
    assert interrupt.program("-m", "rejeu") == [sys.executable, "-P", "-m", "rejeu"]
    source = Path(rejeu.__file__).parent
    named = {path.name for path in source.rglob("*.py") if "sys.executable" in path.read_text(encoding="utf-8")}
    assert named == {"interrupt.py"}


def test_files_of_the_current_folder_take_no_place_of_modules(tmp_path, monkeypatch):
    for name in ("random", "socket", "rejeu"):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w')\nraise ImportError", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    process = processes.start(["status", "nowhere"], tmp_path / "mine")
    assert process.wait(60) == 2
    assert "there is no run folder nowhere" in processes.read_log(tmp_path / "mine")
    assert not (tmp_path / "ran").exists()
