"""The pages of the studio in headless Chromium."""

import pytest

from tests.lab.reporting.report.folders import write, write_hostile
from tests.lab.studio.conftest import opened, serving


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    write(folder / "first", videos=False)
    write_hostile(folder)
    with serving(folder) as one:
        yield one


@pytest.mark.parametrize("width", [1280, 400])
def test_runs_are_listed(browser, served, width):
    with opened(browser, served, width=width) as page:
        page.wait_for_selector("text=first")
        assert page.locator("tbody tr").count() == 2
        page.wait_for_selector("text=window.hacked=1")
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
