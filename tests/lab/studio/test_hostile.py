"""40 hostile run folders: nothing is executed, nothing is requested from elsewhere, and no row is missing."""

from urllib.parse import urlencode

import pytest

from rejeu.lab.reporting.rows import RowReader
from tests.lab.studio.conftest import opened, serving
from tests.lab.studio.hostile import write_all
from tests.tiers import exhaustive


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    assert write_all(folder) == 40
    with serving(folder) as one:
        yield one


@pytest.fixture(scope="module")
def names(served):
    """The names of the runs, as addresses have them."""
    return [row.run for row in RowReader(served.folder).read()]


def test_no_row_is_missing(browser, served, names):
    with opened(browser, served) as page:
        page.wait_for_selector("text=40 runs", timeout=60_000)
        rows = page.locator("tbody tr")
        page.wait_for_function("document.querySelectorAll('tbody tr').length >= 40")
        shown = "".join(rows.all_inner_texts())
        assert len(names) == 40
        assert [name for name in names if name[:20] not in shown] == []
        assert "unread" not in shown
        assert page.locator("tbody img[src*=onerror], tbody iframe, tbody script").count() == 0


def visit(browser, served, names):
    """Opens the pages of runs, and all that is folded on them."""
    with opened(browser, served) as page:
        for name in names:
            page.goto(served.at(f"/run?{urlencode({'run': name})}"))
            page.locator(".q-badge").first.wait_for()
            page.wait_for_timeout(500)
            page.evaluate("document.querySelectorAll('[aria-label=Expand]').forEach((one) => one.click())")
            page.wait_for_timeout(500)
            assert page.locator("main iframe, main script, main img[src*=example]").count() == 0
            assert page.evaluate("window.hacked") is None


def test_pages_of_runs_execute_nothing(browser, served, names):
    kinds = ("text_04", "odd_0", "name_1")
    visit(browser, served, [next(name for name in names if name.startswith(kind)) for kind in kinds])


@exhaustive
def test_no_page_of_a_run_executes_anything(browser, served, names):
    visit(browser, served, names)


def test_an_address_leads_to_no_other_folder(browser, served):
    with opened(browser, served) as page:
        for query in ("run=../secret", "run=/etc", "run=%00", "run=<script>", "run=odd_3/../odd_4", ""):
            page.goto(served.at(f"/run?{query}"))
            page.get_by_text("there is no run of this name").wait_for()


def test_files_are_served_only_if_they_are_pictures_of_runs(browser, served):
    with opened(browser, served) as page:
        for name, run, status in (
            ("curve.png", "odd_0", 200),
            ("curve.png", "odd_3", 404),
            ("config.json", "odd_0", 404),
            ("report.html", "odd_0", 404),
            ("curve.png", "../runs0/odd_0", 404),
            ("..%2Fodd_0%2Fcurve.png", "odd_0", 404),
        ):
            answer = page.request.get(f"http://{served.host}/file/{name}?{urlencode({'run': run})}")
            assert answer.status == status, (name, run)
            if status == 200:
                assert (answer.headers["content-type"], answer.headers["x-content-type-options"]) == (
                    "image/png",
                    "nosniff",
                )


def test_reports_are_saved_of_runs_alone_and_shown_by_no_browser(browser, served):
    with opened(browser, served) as page:
        answer = page.request.get(f"http://{served.host}/save/run?run=odd_0")
        assert answer.status == 200
        assert answer.headers["content-disposition"] == "attachment; filename*=UTF-8''odd_0.html"
        for path in ("run?run=..%2Fodd_0", "run?run=no-run", "comparison/py?run=odd_0"):
            assert page.request.get(f"http://{served.host}/save/{path}").status == 404
