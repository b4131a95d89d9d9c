"""The comparison of runs that were chosen in the table of runs, in headless Chromium."""

from __future__ import annotations

import pytest

from tests.lab.reporting.test_comparison import write_run
from tests.lab.studio.conftest import opened, serving

HOSTILE = "<img src=x onerror=window.hacked=1>"


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for algorithm, level in (("DQN", 10.0), (HOSTILE, 20.0)):
        for seed in range(3):
            write_run(folder / algorithm[:3].strip("<") / f"seed_{seed}", algorithm, seed=seed, level=level + seed)
    write_run(folder / "alone", "PPO", level=99.0)
    with serving(folder) as one:
        yield one


@pytest.mark.parametrize("width", [1280, 400])
def test_rows_that_are_chosen_are_compared_in_groups(browser, served, width):
    with opened(browser, served, width=width) as page:
        page.wait_for_selector("text=7 runs, 0 running")
        for group in ("DQN (3)", "img"[:2] + " (3)"):
            page.locator("tr", has_text=group).get_by_role("checkbox").click()
        page.get_by_role("button", name="Compare").click()
        page.wait_for_selector(".plot.js-plotly-plot >> nth=1")
        groups, improvements = (page.locator("table").nth(i).locator("tbody tr").all_inner_texts() for i in (0, 1))
        assert [text.split("\t")[:4] for text in groups] == [
            [HOSTILE, "CartPole-v1", "3", "21"],
            ["DQN", "CartPole-v1", "3", "11"],
        ]
        assert improvements == [f"{HOSTILE}\tDQN\tCartPole-v1\t100% (100% to 100%)"]
        page.get_by_role("combobox", name="score").click()
        page.get_by_role("option", name="last evaluation").click()
        page.wait_for_selector("text=Final score: mean return of the last evaluation")
        assert page.locator("tbody tr").nth(1).inner_text().split("\t")[3] == "12"
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_what_cannot_be_compared_is_one_line(browser, served):
    with opened(browser, served, "/compare?run=no-such-run") as page:
        page.wait_for_selector("text=there is nothing to compare")
