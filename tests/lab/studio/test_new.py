"""The form of a new run: what it becomes on the command line, and mistakes. No browser and no server."""

import asyncio
import os
import shlex
from dataclasses import fields, replace
from pathlib import Path, PureWindowsPath
from types import SimpleNamespace

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from fastapi import Request

from rejeu.agents import presets
from rejeu.lab.reporting.rows import nothing
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.config import options
from rejeu.lab.studio import new, processes
from rejeu.lab.studio.layout import completed
from rejeu.lab.studio.new import (
    LEFT_OUT,
    command,
    command_text,
    lead_to,
    new_folder,
    prefilled,
    preset_texts,
    problem_of,
    require_known,
)
from rejeu.lab.studio.state import Studio, is_below
from tests.lab.reporting.report.folders import write

OPTIONS = {one.field: one for one in options(Train)}


def test_texts_become_the_words_of_the_command_line_and_its_values():
    texts = {
        "env": "CartPole-v1",
        "algorithm": "PPO",
        "steps": "1e4",
        "hyperparameters": 'gamma=0.9 "policy_kwargs.net_arch=[8, 8]"',
        "wrappers": "a:B c:D",
        "log": "json tensorboard",
        "no_video": True,
        "no_report": False,
        "minutes": "",
        "out": "mine",
    }
    words, arguments = command(texts, Studio(Path("runs")))
    assert (words[0], arguments.env, arguments.algorithm) == ("train", "CartPole-v1", "PPO")
    assert (arguments.steps, arguments.minutes, arguments.wrappers) == (10_000, None, ("a:B", "c:D"))
    assert arguments.hyperparameters == {"gamma": 0.9, "policy_kwargs.net_arch": [8, 8]}
    assert (arguments.log, arguments.no_video, arguments.no_report) == (("json", "tensorboard"), True, False)
    assert arguments.out == Path("runs") / "mine"
    assert command({"env": "a/b-v0"}, Studio(Path("x")))[1].out.parent == Path("x")


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ({}, "choose an environment"),
        ({"env": "A-v0", "steps": "0"}, "--steps=0 must be"),
        ({"env": "A-v0", "steps": "1", "minutes": "1"}, "exclude each other"),
        ({"env": "A-v0", "hyperparameters": "gamma"}, "must be name=value"),
        ({"env": "A-v0", "hyperparameters": '"'}, "No closing quotation"),
        ({"env": "A-v0", "out": "../elsewhere"}, "must be a name of a folder below"),
        ({"env": "A-v0", "out": "/elsewhere"}, "must be a name of a folder below"),
        ({"env": "--json"}, "needs a value|no option|begins with a dash"),
    ],
)
def test_a_mistake_is_one_line(texts, message):
    with pytest.raises(ValueError, match=message) as raised:
        command(texts, Studio(Path("runs")))
    assert "\n" not in str(raised.value)


def test_an_unknown_environment_is_refused_at_once_with_similar_ones():
    with pytest.raises(ValueError, match="no environment is called 'CartPoole-v1'; did you mean CartPole-v1"):
        require_known(Train(env="CartPoole-v1"))
    for known in ({"env": "Acrobot-v1"}, {"env": "my_env:Any-v0"}, {"env": "Any-v0", "imports": ("my_env",)}):
        require_known(Train(**known))


@pytest.mark.parametrize(
    ("query", "env_id"),
    [
        ("env=CartPole-v1", "CartPole-v1"),
        ("env=evil.py", None),
        ("env=evil:Walk-v0", None),
        ("env=//host/evil", None),
        ("", None),
    ],
)
def test_an_address_puts_no_environment_into_the_form_that_a_click_would_import(query, env_id):
    assert prefilled(Request({"type": "http", "query_string": query.encode()})) == env_id


def test_a_field_says_what_is_wrong_while_it_is_filled():
    assert problem_of(OPTIONS["seed"], "x") == "seed 'x' must be a whole number"
    assert [problem_of(OPTIONS["seed"], text) for text in ("", None, "3")] == [None] * 3


def test_the_form_shows_the_values_of_the_preset_and_the_command_that_does_the_same():
    texts = preset_texts({"env": "CartPole-v1", "algorithm": ""})
    preset = presets.find("CartPole-v1")
    assert (texts["algorithm"], texts["steps"]) == (preset.algorithm, str(preset.total_steps))
    assert (
        dict(word.split("=", 1) for word in shlex.split(texts["hyperparameters"])).keys()
        == preset.hyperparameters.keys()
    )
    assert {*preset_texts({"env": "my_env.py"}).values()} == {""}
    assert {*preset_texts({"env": None}).values()} == {""}
    studio = Studio(Path("runs"))
    filled = {"env": "CartPole-v1", "hyperparameters": "gamma=0.9 net_arch=[8,8]", "out": "mine", "no_video": True}
    text = command_text(filled, studio)
    assert shlex.split(text) == ["rejeu", *command(filled, studio)[0]]
    assert command_text({"env": "CartPole-v1", "seed": "x"}, studio) == "seed 'x' must be a whole number"


@pytest.mark.parametrize(
    ("typed", "env_id"),
    [("CartPole", "CartPole-v1"), ("LUNARLANDER-v", "LunarLander-v3"), ("Walk-v0", "Walk-v0"), ("", "")],
)
def test_the_beginning_of_an_id_is_completed(typed, env_id):
    assert completed(typed, ["CartPole-v1", "LunarLander-v3"]) == env_id


def test_every_option_is_in_the_form_but_those_for_windows_and_programs():
    assert {one.name for one in fields(Train)} - OPTIONS.keys() == {"env_argument", "origin", "policy"}
    assert OPTIONS.keys() >= LEFT_OUT


@pytest.mark.parametrize(
    "name",
    [
        "", ".", "..", "../a", "/a", "a/../../b", "a\\b", "D:a", "a:b", ".hidden", "a/.b", "-a", " a", "a ", "a.", "a/b./c",
        "con", "Con.txt", "a/NUL", "com1", "lpt9.x", "a?", "a*", "a\nb", "a\0", "a" * 201, "é" * 101, "a/b/c/d", "videos",
        "a/checkpoints", "a\udcffb", "<b>",
    ],
)  # fmt: skip
def test_a_name_that_some_system_or_the_list_of_runs_does_not_take_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="must be a name") as raised:
        new_folder(Studio(tmp_path), name)
    assert str(raised.value).isprintable()


def test_usual_names_are_taken_and_the_default_one_is_not_hidden(tmp_path):
    for name in ("sac-1", "group/sac 1 (new)", "a/b/c", "été", "console", "1", "a" * 200):
        assert new_folder(Studio(tmp_path), name) == tmp_path / name
    for env in ("./my_env.py", "../envs/my_env.py", "/" + "long/" * 60 + "my_env.py", "my_env:Walk-v0"):
        out = command({"env": env}, Studio(tmp_path))[1].out
        assert out.parent == tmp_path
        assert out.name[0].isalnum()


def test_a_run_does_not_begin_in_a_folder_that_exists_or_inside_a_run_or_a_file(tmp_path):
    write(tmp_path / "old", videos=False)
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "nowhere")
    studio = Studio(tmp_path)
    for name in ("old", "file", "empty", "link"):
        with pytest.raises(ValueError, match="exists; name another"):
            command({"env": "CartPole-v1", "out": name}, studio)
    for name in ("old/new", "old/a/new", "file/new"):
        with pytest.raises(ValueError, match="which is a run or a file; name another"):
            new_folder(studio, name)
    with pytest.raises(ValueError, match="which is a run or a file; name another"):
        new_folder(Studio(tmp_path / "old"), "new")


class Beginning:
    """A process that begins a run in a folder, as the studio looks at it: ``looks`` are called one by one."""

    def __init__(self, *looks, status=0):
        self.looks, self.returncode, self.status = [*looks], None, status
        self.terminate = lambda: self.looks.clear()

    def poll(self):
        if self.looks:
            self.looks.pop(0)()
        else:
            self.returncode = self.status
        return self.returncode


@pytest.fixture
def page(monkeypatch):
    """Where a page has led, the buttons that were on it, and the processes that were started."""
    seen = SimpleNamespace(addresses=[], buttons=[], started=[])

    def action(text, icon, on_click):
        seen.buttons.append(SimpleNamespace(press=on_click, is_there=True))
        seen.buttons[-1].delete = lambda button=seen.buttons[-1]: setattr(button, "is_there", False)
        return seen.buttons[-1]

    monkeypatch.setattr(new, "LOOK", 0.0)
    monkeypatch.setattr(new, "action", action)
    monkeypatch.setattr(new.ui.navigate, "to", seen.addresses.append)
    return seen


def test_two_starts_with_the_same_name_begin_one_run_and_the_log_of_it_is_not_touched(tmp_path, page, monkeypatch):
    studio, words = Studio(tmp_path), ["train", "CartPole-v1", "--out", str(tmp_path / "mine")]
    monkeypatch.setattr(
        processes.subprocess, "Popen", lambda command, **_: page.started.append(command) or Beginning(*[bool] * 9)
    )
    processes.start(words, tmp_path / "mine")
    log = processes.log_of(tmp_path / "mine")
    log.write_text("of the first", encoding="utf-8")
    for others in (words, [*words, "--seed", "1"], ["branch", "runs/a", *words[2:]]):
        with pytest.raises(ValueError, match="is under way for mine"):
            asyncio.run(lead_to(studio, others, tmp_path / "mine", str))
    processes.STARTED.clear()
    write(tmp_path / "mine", videos=False)
    with pytest.raises(ValueError, match="exists; name another"):
        asyncio.run(lead_to(studio, words, tmp_path / "mine", str))
    assert len(page.started) == 1
    assert log.read_text(encoding="utf-8") == "of the first"
    assert page.addresses == []


def test_a_run_that_is_over_before_it_was_read_has_its_page_and_one_of_a_removed_folder_does_not_lead_to_it(
    tmp_path, page, monkeypatch
):
    studio, path = Studio(tmp_path), tmp_path / "mine"
    row = replace(nothing(path, "unread"), run="mine", state="gone")
    studio.rows = [row]
    process = Beginning(lambda: None, lambda: write(path, videos=False))
    monkeypatch.setattr(processes, "start", lambda *_: process)

    async def follow():
        leading = asyncio.create_task(lead_to(studio, ["train"], path, str))
        while process.returncode is None:
            await asyncio.sleep(0)
        assert page.addresses == []
        studio.rows = [replace(row, state="finished")]
        return await leading

    assert asyncio.run(follow()) == ""
    assert page.addresses == ["/run?run=mine"]
    assert [button.is_there for button in page.buttons] == [False]


def test_a_run_can_be_stopped_before_it_has_a_folder(tmp_path, page, monkeypatch):
    process = Beginning(lambda: page.buttons[0].press(), *[lambda: None] * 100, status=-15)
    monkeypatch.setattr(processes, "start", lambda *_: process)
    said = asyncio.run(lead_to(Studio(tmp_path), ["train"], tmp_path / "mine", str))
    assert said == "rejeu train ended with exit status -15"
    assert (page.addresses, [button.is_there for button in page.buttons]) == ([], [False])


@pytest.mark.skipif(os.name != "posix", reason="a signal ends it")
def test_a_check_that_does_not_end_can_be_stopped(tmp_path, page, monkeypatch):
    started = processes.subprocess.Popen
    monkeypatch.setattr(new.subprocess, "Popen", lambda command, **settings: started(["sleep", "60"], **settings))

    async def check():
        checking = asyncio.create_task(new.check(SimpleNamespace(environment_words=lambda: [])))
        while not page.buttons:
            await asyncio.sleep(0.01)
        page.buttons[0].press()
        return await checking

    assert asyncio.run(check()) == (-15, "rejeu check ended with exit status -15")


@pytest.mark.parametrize(
    "name", [r"\evil", "/evil", "D:evil", r"D:\evil", r"\\host\share", r"..\evil", "a/../../evil", "", "."]
)
def test_a_name_does_not_lead_out_of_the_folder_on_windows(name):
    assert not is_below(PureWindowsPath(name))


@pytest.mark.skipif(os.name != "posix", reason="links need rights on Windows")
def test_a_link_in_the_folder_does_not_lead_out_of_it(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "away").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="is not in the folder of the studio"):
        Studio(tmp_path / "runs").below("away/run")
    assert Studio(tmp_path / "runs").below("group/run") == tmp_path / "runs" / "group" / "run"
