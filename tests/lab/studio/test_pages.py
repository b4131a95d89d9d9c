"""The pages of the studio in headless Chromium."""

import shutil

import pytest

from tests.lab.reporting.report.folders import CONFIG, write, write_hostile
from tests.lab.studio.conftest import opened, serving


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    write(folder / "first", videos=False)
    for seed in range(3):
        write(folder / "seeds" / f"seed_{seed}", {**CONFIG, "seed": seed}, videos=False)
    write_hostile(folder)
    with serving(folder) as one:
        yield one


@pytest.mark.parametrize("width", [1280, 400])
def test_runs_are_listed_and_seeds_folded(browser, served, width):
    with opened(browser, served, width=width) as page:
        page.wait_for_selector("text=5 runs, 0 running")
        assert page.locator("tbody tr").count() == 3
        page.locator("button", has_text="seeds (3)").click()
        page.wait_for_selector("text=seeds/seed_2")
        assert page.locator("tbody tr").count() == 6
        assert page.locator("polyline[points]").count() == 6
        page.get_by_label("filter").fill("dqn seed_1")
        page.wait_for_selector("text=1 run, 0 running")
        assert page.locator("tbody tr").all_inner_texts()[0].split("\n")[0].strip() == "seeds/seed_1"
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")


def test_a_run_that_changes_and_one_that_disappears_are_followed(browser, served):
    folder = write(served.folder / "second", videos=False)
    with opened(browser, served) as page:
        row = page.locator("tr", has_text="second")
        row.locator("text=3,000").wait_for()
        with (folder / "episodes.csv").open("a", encoding="utf-8") as file:
            file.write("3500,0,7,7,1,35\n")
        row.locator("text=3,500").wait_for()
        shutil.rmtree(folder)
        row.locator("text=its folder is no longer there").wait_for()
