"""Pages about runs in headless Chromium: drawn, interactive, silent, and never running what a run folder contains."""

import pytest

from rejeu.lab.reporting.comparison import compare
from rejeu.lab.reporting.report import write_report
from tests.lab.reporting.report.folders import write, write_hostile
from tests.lab.reporting.test_comparison import write_run
from tests.tiers import crossed, exhaustive


class Opened:
    """A page that has been drawn, with what it wrote to the console and what it asked for."""

    def __init__(self, browser, address, width=1400, scheme="light"):
        self.messages, self.requests = [], []
        self.page = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        self.page.on("console", lambda message: self.messages.append(message.text))
        self.page.on("pageerror", lambda error: self.messages.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)
        self.page.wait_for_selector("body[data-drawn=all]", timeout=120_000)
        self.requests = [url for url in self.requests if url != address and not url.startswith("data:")]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.page.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = write(tmp_path_factory.mktemp("runs") / "run", videos=False)
    return write_report(folder).as_uri()


@pytest.mark.parametrize(("width", "scheme"), crossed([1400, 390], ["light", "dark"]))
def test_page_is_drawn_without_errors_and_requests(browser, report, width, scheme):
    with Opened(browser, report, width, scheme) as opened:
        page = opened.page
        assert opened.messages == []
        assert opened.requests == []
        assert page.locator("div.plot .main-svg").count() >= 2 * page.locator("div.plot").count()
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, background[4:-1].split(","))) < 300) == (scheme == "dark")


def test_bar_of_the_histogram_lists_its_episodes(browser, report):
    with Opened(browser, report) as opened:
        page = opened.page
        page.locator("[data-histogram]").scroll_into_view_if_needed()
        bars = page.locator("[data-histogram] .points .point")
        box = bars.nth(0).bounding_box()
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] - 3)
        page.wait_for_selector(".episodes tbody tr")
        count = page.evaluate(
            "JSON.parse(document.querySelector('#data').textContent).histograms['run0-episodes'].counts[0]"
        )
        assert page.locator(".episodes tbody tr").count() == count
        assert page.locator("select[data-bars]").input_value() == "0"
        page.locator("select[data-bars]").select_option(index=2)
        assert page.locator("select[data-bars]").input_value() != "0"
        assert opened.messages == []


def test_axis_and_legend_can_be_switched(browser, report):
    with Opened(browser, report) as opened:
        page = opened.page
        page.locator("[data-axis=t]").click()
        page.locator(".xtitle", has_text="minutes of training").first.wait_for()
        shown = page.locator(".chart").first.locator(".trace").count()
        page.locator(".legend button").first.click()
        assert page.locator(".chart").first.locator(".trace").count() < shown
        page.locator(".legend button").first.press("Enter")
        assert page.locator(".chart").first.locator(".trace").count() == shown
        assert page.evaluate("document.activeElement === document.querySelector('.legend button')")
        assert opened.messages == []


def test_one_of_several_runs_is_shown(browser, tmp_path):
    path = write_report(
        [write(tmp_path / "a", videos=False), write(tmp_path / "b", videos=False)], tmp_path / "both.html"
    )
    with Opened(browser, path.as_uri()) as opened:
        page = opened.page
        assert [page.locator(f"#run{i}").is_visible() for i in range(2)] == [True, False]
        page.locator("#choose").select_option("run1")
        page.wait_for_selector("#run1 .main-svg")
        assert [page.locator(f"#run{i}").is_visible() for i in range(2)] == [False, True]
        assert opened.messages == []


def test_no_script_of_a_hostile_run_folder_runs(browser, tmp_path):
    path = write_report(write_hostile(tmp_path), tmp_path / "page.html")
    with Opened(browser, path.as_uri()) as opened:
        page = opened.page
        for bar in page.locator("select[data-bars] option").all()[1:]:
            page.locator("select[data-bars]").select_option(bar.get_attribute("value"))
        assert page.evaluate("window.hacked") is None
        assert page.locator("img").count() == 0
        assert opened.requests == []
        assert page.locator("h2").last.text_content() in ("Configuration", "Repeat this run")


def test_comparison_with_long_labels_fits_the_window(browser, tmp_path):
    runs = [write_run(tmp_path / str(seed), "A" * 200, env="E" * 300, seed=seed) for seed in range(2)]
    (path,) = compare(runs, samples=10).save(tmp_path / "page.html")
    with Opened(browser, path.as_uri(), width=390) as opened:
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= 390
        assert opened.messages == []
        assert opened.requests == []


def test_policy_stops_an_injected_script_and_requests(browser, report):
    with Opened(browser, report) as opened:
        page = opened.page
        page.evaluate("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=\"window.hacked=1\">')")
        page.evaluate(
            "{const one = document.createElement('script'); one.textContent = 'window.hacked=1'; document.body.append(one)}"
        )
        assert page.evaluate("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'stopped')") == "stopped"
        page.wait_for_timeout(300)
        assert page.evaluate("window.hacked") is None
        assert len([text for text in opened.messages if "Content Security Policy" in text]) >= 3


@exhaustive
def test_million_episodes_are_drawn_quickly(browser, tmp_path):
    path = write_report(write(tmp_path / "run", episodes=1_000_000, videos=False))
    assert path.stat().st_size < 3e6
    with Opened(browser, path.as_uri()) as opened:
        assert opened.page.locator(".points .point").count() < 2000
        assert opened.messages == []
