"""The comparison of runs that were chosen in the table of runs, in headless Chromium."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from fastapi import Request

from rejeu.lab.reporting.rows import nothing
from rejeu.lab.studio.compare import MOST_DRAWN, choice_of, compared
from tests.lab.reporting.test_comparison import write_run
from tests.lab.studio.conftest import HOSTILE, check_widths, opened, serving
from tests.tiers import exhaustive


def test_rows_that_are_chosen_are_compared_in_groups(browser, common):
    with opened(browser, common) as page:
        page.wait_for_selector("text=runs, 0 running")
        for group in ("dqn (3)", "other (3)"):
            page.locator("tr", has_text=group).get_by_role("checkbox").click()
        page.get_by_role("button", name="Compare").click()
        page.wait_for_selector(".plot.js-plotly-plot >> nth=1")
        groups, settings, pairs = (page.locator("table").nth(i).locator("tbody tr").all_inner_texts() for i in range(3))
        assert [text.replace("\n", "").split("\t")[:4] for text in groups] == [
            [f"{HOSTILE} best", "CartPole-v1", "3", "21"],
            ["DQN", "CartPole-v1", "3", "11"],
        ]
        assert settings == [f"algorithm\t{HOSTILE}\tDQN"]
        assert pairs == [f"{HOSTILE}\t\t100%", "DQN\t0%\t"]
        assert page.locator("td[title='" + HOSTILE + " > DQN: 100% (in all 9 pairs of runs)']").count() == 2
        with page.expect_download() as saved:
            page.get_by_role("button", name="CSV: CartPole-v1: returns").click()
        assert '\n"DQN (3)",1000,11,,' in saved.value.path().read_text(encoding="utf-8")
        page.get_by_role("combobox", name="score").click()
        page.get_by_role("option", name="last evaluation").click()
        page.wait_for_selector("text=Final score: mean return of the last evaluation")
        assert page.locator("tbody tr").nth(1).inner_text().split("\t")[3] == "12"
        page.reload()
        page.wait_for_selector("text=Final score: mean return of the last evaluation")
        with page.expect_download() as saved:
            page.get_by_role("link", name="table").click()
        assert saved.value.path().read_text(encoding="utf-8").splitlines()[2].startswith("DQN,CartPole-v1,3,12.0")
        check_widths(page)


def test_what_cannot_be_compared_is_one_line(browser, common):
    with opened(browser, common, "/compare?run=no-such-run") as page:
        page.wait_for_selector("text=there is nothing to compare")


def test_a_folder_without_runs_is_said_to_be_one_in_the_language_of_the_page(browser, tmp_path):
    with serving(tmp_path) as served, opened(browser, served, "/compare?language=fr") as page:
        page.wait_for_selector("text=Il n'y a pas encore d'entraînement dans ce dossier.")


def test_a_folder_in_the_address_stands_for_its_runs_and_names_of_no_run_get_a_note(tmp_path):
    for name in ("sweep/a", "sweep/b", "sweep2"):
        write_run(tmp_path / name)
    states = {"sweep/a": "finished", "sweep/b": "finished", "sweep2": "finished", "away": "gone"}
    rows = [
        replace(nothing(tmp_path / name, "unread"), run=name, path=tmp_path / name, state=state)
        for name, state in states.items()
    ]
    studio = SimpleNamespace(rows=rows)
    scope = {"type": "http", "path": "/", "headers": [(b"host", b"localhost")], "query_string": b""}
    choice = choice_of(Request(scope))
    comparison = compared(studio, ["sweep", "renamed", "away"], choice)
    assert [run.name for run in comparison.groups[0].runs] == ["a", "b"]
    assert comparison.notes[0] == "not compared, since renamed, moved or deleted: renamed, away"
    with pytest.raises(ValueError, match="nothing to compare; not compared, since renamed, moved or deleted: renamed"):
        compared(studio, ["renamed"], choice)


@exhaustive
def test_of_many_environments_some_are_drawn_and_others_on_demand(browser, tmp_path):
    for i in range(MOST_DRAWN + 2):
        write_run(tmp_path / f"run{i:02}", env=f"Env{i:02}-v0")
    with serving(tmp_path) as served, opened(browser, served, "/compare") as page:
        page.wait_for_selector(f".plot.js-plotly-plot >> nth={2 * MOST_DRAWN - 1}")
        assert page.locator(".plot.js-plotly-plot").count() == 2 * MOST_DRAWN
        last = f"Env{MOST_DRAWN + 1:02}-v0"
        assert page.get_by_text(f"{last}: returns").count() == 0
        page.get_by_role("combobox", name="environments drawn").click()
        page.get_by_role("option", name="Env00-v0").click()
        page.get_by_role("option", name=last).click()
        page.wait_for_selector(f"text={last}: returns")
        assert page.locator(".plot.js-plotly-plot").count() == 2 * MOST_DRAWN
