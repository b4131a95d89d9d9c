"""The form on the page of a run that begins another run from a checkpoint, in headless Chromium."""

import json

import pytest

from rejeu.lab.studio.state import Studio
from tests.lab.studio.conftest import opened


def test_a_run_is_branched_with_other_settings(browser, common):
    with opened(browser, common, "/run?run=trained") as page:
        page.get_by_role("button", name="Branch").click()
        page.get_by_label("from step").wait_for()
        assert page.get_by_label("train for so many more steps").input_value() == "512"  # the run has reached its goal
        for label, text in (("settings that change", "learning_rate=0.5"), ("train for so many more steps", "64")):
            page.get_by_label(label).fill(text)
        page.get_by_label("new folder").fill("../elsewhere")
        page.get_by_role("button", name="Start").click()
        page.wait_for_selector("text=must be a name of a folder below")
        page.get_by_label("new folder").fill("branched")
        page.get_by_role("button", name="Start").click()
        page.wait_for_url("**/run?run=branched", timeout=120_000)
    config = json.loads((common.folder / "branched" / "config.json").read_text())
    assert config["origin"] == {
        "run": str(common.folder / "trained"),
        "step": 512,  # 128 steps, rounded up to a rollout of 64 in each of 8 environments
        "changes": {"learning_rate": 0.5},
    }


@pytest.mark.parametrize("name", ["", "/elsewhere/x", "a/../../b"])
def test_a_new_run_begins_below_the_folder_only(tmp_path, name):
    with pytest.raises(ValueError, match="must be a name of a folder below"):
        Studio(tmp_path).below(name)
