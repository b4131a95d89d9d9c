"""The pages of the studio in headless Chromium."""

import shutil

import pytest

from rejeu.lab.reporting import run_list
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
        assert not [
            url for url in page.requests if "plotly" in url
        ]  # without charts the page need not wait for its 5 MB


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


@pytest.mark.parametrize("is_paused", [True, False])
def test_a_run_that_was_stopped_can_be_resumed(browser, served, is_paused):
    folder = write(served.folder / f"stopped_{is_paused}", {**CONFIG, "steps": 100_000}, videos=False)
    if is_paused:
        (folder / "paused").touch()
    with opened(browser, served, f"/run?run={folder.name}") as page:
        page.locator(".q-badge", has_text="paused" if is_paused else "interrupted").wait_for()
        page.get_by_role("button", name="Resume").wait_for()
    shutil.rmtree(folder)


def check_hints(page):
    """Checks that the hints of a form keep clear of the fields below, as wide as a phone's and as a desktop's."""
    page.wait_for_timeout(300)  # the animation of an opened section
    for width in (400, 1280):
        page.set_viewport_size({"width": width, "height": 900})
        boxes = [one.bounding_box() for one in page.locator(".q-field:visible, .q-toggle:visible").all()]
        hints = [one.bounding_box() for one in page.locator(".q-field__messages:visible").all()]
        assert len(hints) > 10
        for hint in hints:
            below = [box["y"] for box in boxes if box["y"] > hint["y"] and abs(box["x"] - hint["x"]) < 40]
            assert hint["y"] + hint["height"] <= min(below, default=1e9)


@pytest.fixture
def ended(served):
    """Asks the run that a test has started to end, also if the test has failed."""
    yield
    if (served.folder / "mine").is_dir():
        (served.folder / "mine" / "stop").touch()


@pytest.mark.usefixtures("ended")
def test_a_run_is_started_from_the_form_watched_stopped_and_resumed(browser, served):
    with opened(browser, served, "/new?env=CartPole-v1") as page:
        settings = {"steps": "400000", "folder": "mine", "hyperparameters": "learning_starts=200"}
        for label, text in settings.items():
            page.get_by_label(label, exact=True).fill(text)
        page.get_by_label("seed", exact=True).fill("x")
        page.get_by_text("seed 'x' must be a whole number").first.wait_for()
        page.get_by_label("seed", exact=True).fill("3")
        page.get_by_text("Output").click()
        check_hints(page)
        page.get_by_role("switch", name="no report").click()
        page.get_by_role("switch", name="no video").click()
        page.get_by_role("button", name="Start").click()
        page.wait_for_url("**/run?run=mine", timeout=60_000)
        page.locator(".q-badge", has_text="running").wait_for()
        live = page.locator("figcaption", has_text="the policy at step")
        live.wait_for(timeout=60_000)
        seen = live.inner_text()
        changes = "seen => document.querySelector('figcaption').innerText !== seen"
        page.wait_for_function(changes, arg=seen, timeout=60_000)
        page.get_by_text("of 400,000").first.wait_for()
        page.get_by_role("button", name="Stop").click()
        page.locator(".q-badge", has_text="interrupted").wait_for(timeout=60_000)
        steps = run_list.read(served.folder / "mine").steps
        assert 0 < steps < 400_000
        page.get_by_role("button", name="Resume").dblclick()
        page.wait_for_selector("button:has-text('Resume'):disabled")
        page.locator(".q-badge", has_text="running").wait_for(timeout=60_000)
        page.get_by_role("button", name="Stop").click()
        page.locator(".q-badge", has_text="interrupted").wait_for(timeout=60_000)
        ended = run_list.read(served.folder / "mine")
        assert ended.steps > steps
        assert ended.warnings == ()
