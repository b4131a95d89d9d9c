"""The comparison of runs that were chosen in the table of runs, in headless Chromium."""

from tests.lab.studio.conftest import HOSTILE, check_widths, opened


def test_rows_that_are_chosen_are_compared_in_groups(browser, common):
    with opened(browser, common) as page:
        page.wait_for_selector("text=runs, 0 running")
        for group in ("dqn (3)", "other (3)"):
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
        check_widths(page)


def test_what_cannot_be_compared_is_one_line(browser, common):
    with opened(browser, common, "/compare?run=no-such-run") as page:
        page.wait_for_selector("text=there is nothing to compare")
