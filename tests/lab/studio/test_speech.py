"""The language of the pages: all of their texts are in one table. No browser."""

import ast
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from fastapi import Request

from rejeu.core.language import SETTING, french
from rejeu.core.validation import field_docs
from rejeu.lab import studio as package
from rejeu.lab.reporting.report import sections
from rejeu.lab.reporting.rows import BEGINS
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.config import Topic, options
from rejeu.lab.studio import compare, new, run, runs, server
from rejeu.lab.studio.layout import asked_language
from rejeu.lab.studio.speech import say
from rejeu.logs import charts


def literals():
    """The texts that pages ask for in their language, as far as they stand in the source."""
    for path in Path(package.__file__).parent.glob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if (
                isinstance(call, ast.Call)
                and ast.unparse(call.func) == "say"
                and isinstance(call.args[0], ast.Constant)
            ):
                yield call.args[0].value


def labels():
    """The texts in tables, which pages ask for by a name."""
    yield from (
        *runs.GROUPINGS.values(),
        *runs.COLUMNS.values(),
        *runs.COLORS,
        *runs.COUNTS,
        BEGINS,
        "several environments",
    )
    yield from (title for _, title in runs.GALLERY.values())
    yield from (*run.AXES.values(), run.TITLE, *(column["label"] for column in run.EPISODES))
    yield from (
        sections.CURVES,
        sections.GOALS,
        sections.TIME,
        *sections.TITLES.values(),
        *charts.GROUPS,
        *charts.SHARES.values(),
    )
    yield from (text for names in compare.CHOICES.values() for text in names.values())
    yield from (*compare.CHOICES, *compare.SAVED.values(), *compare.BETTER, compare.INTERVALS, compare.PAIRS)
    yield from (page.title for page in server.PAGES)
    yield from map(str.capitalize, Topic)


def test_every_text_of_a_page_is_in_french_too():
    texts = {*literals(), *labels()}
    assert len(texts) > 100
    assert sorted(texts - french().keys()) == []


def test_the_form_of_a_new_run_is_in_french_too():
    docs = field_docs(Train)
    for option in options(Train):
        if option.field not in {*new.LEFT_OUT, "env", "algorithm"}:
            hint = new.in_form(docs.get(option.field, option.shown.help))
            assert {hint} <= french().keys()
            assert "--" not in hint


def test_a_text_in_french_has_no_values_but_those_of_the_english_one():
    for english, text in french().items():
        assert text.count("{") <= english.count("{"), english


@pytest.mark.parametrize(
    ("query", "cookie", "setting", "language"),
    [
        ("", "", "", "en"),
        ("", "", "fr", "fr"),
        ("", "fr", "en", "fr"),
        ("language=en", "fr", "fr", "en"),
        ("language=<script>", "x", "fr", "fr"),
    ],
)
def test_the_address_then_the_cookie_then_the_setting_say_the_language(monkeypatch, query, cookie, setting, language):
    monkeypatch.setenv(SETTING, setting)
    headers = [(b"cookie", f"rejeu_language={cookie}".encode())]
    request = Request({"type": "http", "path": "/", "headers": headers, "query_string": query.encode()})
    assert asked_language(request) == language
    assert say("step {}", 3) == {"fr": "pas 3"}.get(setting, "step 3")  # no page is built
