"""The agent on the page of a run, its map of goals and its course, in headless Chromium."""

import shutil

from tests.lab.studio.conftest import check_widths, opened


def test_an_agent_is_stepped_and_a_place_of_the_map_shows_its_episode(browser, common):
    run = shutil.copytree(common.folder / "trained", common.folder / "watched")
    (run / "replays.csv").write_text(
        "seed,return,length,success,goal_0,goal_1\n5,9,9,1,0,0\n6,9,9,0,8,4\n", encoding="utf-8"
    )
    with opened(browser, common, "/run?run=watched") as page:
        page.get_by_role("button", name="pause").click()
        page.locator(".bar >> nth=1").wait_for()
        assert [text.split("\n")[0] for text in page.locator(".bar").all_inner_texts()] == ["left", "right"]
        goals = page.locator(".card", has_text="Goals of the trained agent")
        goals.locator(".point").first.scroll_into_view_if_needed()
        assert "always reached (1)" in goals.inner_text()
        dot = goals.locator(".point").first.bounding_box()
        page.mouse.click(dot["x"] + dot["width"] / 2, dot["y"] + dot["height"] / 2)
        page.get_by_text("The best policy acts from the seed").wait_for()
        page.wait_for_function(
            "document.querySelector('.screen').getBoundingClientRect().top >= 48"
        )  # below the header
        page.locator("figcaption", has_text="step 0").wait_for()
        page.get_by_role("button", name="one step").click()
        page.locator("figcaption", has_text="step 1").wait_for()
        page.get_by_text("Then and now").click()
        page.locator(".q-expansion-item", has_text="Then and now").get_by_role("button", name="Play").click()
        page.locator(".one-row canvas").first.wait_for()
        assert "after 512 steps" in page.locator(".one-row").inner_text()
        check_widths(page)
    shutil.rmtree(run)
