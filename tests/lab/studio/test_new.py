"""The form of a new run: what it becomes on the command line, and mistakes. No browser and no server."""

from dataclasses import fields
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from fastapi import Request

from rejeu.lab.cli.commands import Train
from rejeu.lab.runs.config import options
from rejeu.lab.studio.new import LEFT_OUT, command, prefilled, problem_of, require_known

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
    words, arguments = command(texts, Path("runs"))
    assert (words[0], arguments.env, arguments.algorithm) == ("train", "CartPole-v1", "PPO")
    assert (arguments.steps, arguments.minutes, arguments.wrappers) == (10_000, None, ("a:B", "c:D"))
    assert arguments.hyperparameters == {"gamma": 0.9, "policy_kwargs.net_arch": [8, 8]}
    assert (arguments.log, arguments.no_video, arguments.no_report) == (("json", "tensorboard"), True, False)
    assert arguments.out == Path("runs") / "mine"
    assert command({"env": "a/b-v0"}, Path("x"))[1].out.parent == Path("x")


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
        command(texts, Path("runs"))
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
    assert problem_of(OPTIONS["seed"], "x") == "--seed 'x' must be a whole number"
    assert [problem_of(OPTIONS["seed"], text) for text in ("", None, "3")] == [None] * 3


def test_every_option_is_in_the_form_but_those_for_windows_and_programs():
    assert {one.name for one in fields(Train)} - OPTIONS.keys() == {"env_argument", "origin", "policy"}
    assert OPTIONS.keys() >= LEFT_OUT
