"""All pages for everybody, in headless Chromium: names of controls, contrast and headings by axe; languages; a projector."""

from __future__ import annotations

import shutil
from importlib import resources

import pytest

from tests.lab.reporting.report.folders import CONFIG, write
from tests.lab.studio.conftest import opened, serving
from tests.tiers import only

pytest.importorskip("axe_playwright_python", reason="needs axe-playwright-python, which is in the extra test")

AXE = resources.files("axe_playwright_python").joinpath("axe.min.js").read_text(encoding="utf-8")
PAGES = {
    "/": "text=running",
    "/new?env=CartPole-v1": "text=rejeu train CartPole-v1",
    "/play": "text=Start",
    "/compare": ".plot.js-plotly-plot >> nth=1",
    "/class": "text=of each model",
    "/run?run=crashed": "text=Environment steps",
}
"""A selector of each page that is there once it is drawn."""


@pytest.fixture(scope="module")
def served(tmp_path_factory, common):
    """A studio with a run of each color, remarks, a group and models."""
    folder = tmp_path_factory.mktemp("access")
    for seed in range(2):
        write(folder / "seeds" / f"seed_{seed}", {**CONFIG, "seed": seed}, videos=False)
    crashed = write(folder / "crashed", {**CONFIG, "steps": 10**6}, videos=False)
    (crashed / "warnings.txt").write_text("ValueError: end\n", encoding="utf-8")
    (crashed / "remarks.json").write_text('{"note": "odd", "tags": ["paper"]}', encoding="utf-8")
    write(folder / "stopped", {**CONFIG, "steps": 10**6}, videos=False)
    (write(folder / "damaged", videos=False) / "config.json").write_text("{", encoding="utf-8")
    for name in "abcdefghij":
        shutil.copyfile(common.folder / "anna.safetensors", folder / f"Student {name}.safetensors")
    with serving(folder) as one:
        yield one


@pytest.mark.parametrize("path", PAGES)
@pytest.mark.parametrize("scheme", only(["dark"], ["dark", "light"]))
def test_axe_finds_nothing_serious(browser, served, path, scheme):
    with opened(browser, served, path, color_scheme=scheme, bypass_csp=True) as page:
        page.wait_for_selector(PAGES[path])
        page.evaluate(AXE)
        violations = page.evaluate("axe.run({resultTypes: ['violations']})")["violations"]
        found = [
            (violation["id"], node["html"]) for violation in violations for node in violation["nodes"]
            if violation["impact"] in ("serious", "critical") or violation["id"] == "page-has-heading-one"
        ]  # fmt: skip
        assert found == []
        title = (
            "crashed · Run · rejeu" if path.startswith("/run") else page.locator("h1, [aria-level='1']").inner_text()
        )
        assert page.title() == title


def test_a_browser_chooses_the_language_of_all_its_pages(browser, served):
    with opened(browser, served) as page:
        page.get_by_role("button", name="français").click()
        page.wait_for_selector("text=5 entraînements, 0 en cours")
        assert page.evaluate("document.documentElement.lang") == "fr"
        page.goto(served.at("/new"))
        page.wait_for_selector("text=Graine de tout le hasard")
        page.get_by_role("button", name="English").click()
        page.wait_for_selector("text=Seeds everything")


def test_ten_students_fit_on_a_projector(browser, served):
    with opened(browser, served, "/class?projector=1", width=1280, height=720) as page:
        page.wait_for_selector("text=The same file")
        names = [page.locator("tr", has_text=f"Student {name}").bounding_box() for name in "abcdefghij"]
        assert max(box["y"] + box["height"] for box in names) < 720
