"""The language of the pages: all of their texts are in one table. No browser."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from fastapi import Request

from rejeu.core.language import NUMBER, SETTING, french, said
from rejeu.core.validation import field_docs
from rejeu.lab import studio as package
from rejeu.lab.reporting import run_list
from rejeu.lab.reporting.report import sections
from rejeu.lab.reporting.rows import BEGINS, RowReader
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.config import Topic, options
from rejeu.lab.studio import compare, new, run, runs, server
from rejeu.lab.studio.figures import TEXTS, in_language
from rejeu.lab.studio.layout import asked_language
from rejeu.lab.studio.speech import say
from rejeu.logs import charts
from rejeu.logs.tables import EMPTY
from tests.lab.reporting.report.folders import write


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
    yield from (*map(str.capitalize, Topic), *TEXTS)


def test_every_text_of_a_page_is_in_french_too():
    texts = {*literals(), *labels()}
    assert len(texts) > 100
    assert sorted(texts - french().keys()) == []


def texts_of(chart):
    """The texts of a chart."""
    yield from (chart[axis] for axis in ("x", "y") if chart.get(axis))
    for series in chart.get("series", ()):
        yield from (series["name"], *series.get("text", ()))


def test_texts_with_numbers_of_reports_and_rows_are_in_french_too(tmp_path, monkeypatch):
    run_folder = write(tmp_path / "run", videos=False)
    with (run_folder / "goals.csv").open("w", encoding="utf-8") as file:
        file.write("step,success,goal_0,goal_1\n1000,1,0,0\n2000,0,1,1\n2000,1,1,1\n2000,0,0,1\n")
    summary = run_list.read(run_folder)
    parts = sections.build([summary], None)
    unevaluated = sections.build([replace(summary, evaluations=EMPTY)], None)
    shown = [text for page in (parts, unevaluated) for text in page.runs[0].facts]
    shown += [
        text
        for page in (parts, unevaluated)
        for tile in page.runs[0].tiles
        for text in (tile.title, tile.note, tile.more)
    ]
    shown += [entry.note for group in parts.runs[0].groups if group.title == sections.GOALS for entry in group.charts]
    shown += [entry.title for group in parts.runs[0].groups for entry in group.charts if not entry.title.islower()]
    shown += [text for chart in parts.data["charts"].values() for text in texts_of(chart)]
    (row,) = RowReader(tmp_path).read()
    for running in (replace(row, steps_asked=9_000), replace(row, seconds_left=9.5), replace(row, seconds_left=80.0)):
        shown += [runs.line(running)[cell] for cell in ("steps", "rate", "more")]
    words = {text for text in shown if re.search("[a-z]{2}", text)}
    assert {"{} to {}, {} success", "{} episodes", "sometimes ({})"} <= {NUMBER.sub("{}", text) for text in words}
    assert sorted(text for text in words if said(text, language="fr") == text) == []
    monkeypatch.setenv(SETTING, "fr")
    translated = in_language(parts.data["charts"]["run0-return"])
    assert translated["names"]["environment steps"] == "pas d'environnement"
    assert "moyenne de 12 épisodes" in [series["name"] for series in translated["series"]]


@pytest.mark.parametrize(
    ("english", "french_text"),
    [
        ("seed -3", "graine -3"),
        ("steps", "pas"),
        ("CartPole-v1 episodes", "CartPole-v1 episodes"),
        ("return {} · step 3", "return {} · step 3"),  # of a file, which may contain braces
        ("{0} 1", "{0} 1"),
    ],
)
def test_numbers_in_a_text_stay_as_they_are(english, french_text):
    assert said(english, language="fr") == french_text
    assert said(english, language="en") == english


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
