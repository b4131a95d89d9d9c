"""Commands that the studio starts. No browser and no server."""

from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

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
