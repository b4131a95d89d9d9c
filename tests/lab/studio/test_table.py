"""The lines of the table of runs: groups, order, what an address holds. No browser."""

from dataclasses import replace
from math import nan
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from fastapi import Request

from rejeu.lab.reporting.rows import BestEvaluation, nothing
from rejeu.lab.studio.layout import Choice
from rejeu.lab.studio.runs import USUAL, VALID, Block, blocks_of, lines, listed, marked, ordered, page_of, together
from rejeu.lab.studio.state import Studio


def row(name, env="CartPole-v1", best=None, **fields):
    """A row whose best evaluation has this mean return."""
    evaluation = None if best is None else BestEvaluation(1_000, best, nan, nan, nan)
    unread = nothing(Path(name), "unread")
    return replace(unread, **{"run": name, "env": env, "state": "finished", "best": evaluation, **fields})


def names(blocks):
    return [block.total.run for block in blocks]


def asked(query):
    scope = {"type": "http", "path": "/", "headers": [(b"host", b"localhost")], "query_string": query.encode()}
    return Choice(Request(scope), USUAL, VALID)


def group(name, rows):
    return Block(together(name, rows), rows)


def test_the_line_of_a_group_is_about_all_of_its_runs():
    rows = [row(f"seeds/{i}", best=best, steps=1_000, curve=[0.0, best]) for i, best in enumerate((1.0, 2.0, 6.0))]
    (block,) = blocks_of(rows, ["seeds"] * 3)
    (folded,) = lines([block], set())
    # mean 3, standard deviation 2.16 of 3 runs: 3 -+ 4.303 * 2.16 / sqrt(2)
    assert (folded["name"], folded["best"], folded["more"]) == ("seeds (3)", "3.00", "-3.57 to 9.57")
    assert (folded["steps"], folded["state"], folded["is_group"], folded["is_open"]) == (
        "3,000",
        "3 finished",
        True,
        False,
    )
    opened = [*lines([block], {"seeds"})]
    assert [line["key"] for line in opened] == ["seeds", *(row.run for row in rows)]
    assert [line.get("is_inner") for line in opened] == [None, True, True, True]


def test_returns_of_several_environments_are_not_averaged():
    mixed = [
        row("m/cart", best=500.0, curve=[1.0, 2.0]),
        row("m/lander", "LunarLander-v3", best=-20.0, curve=[3.0, 4.0]),
    ]
    (line,) = lines([group("m", mixed)], set())
    assert (line["best"], line["more"], line["curve"]) == ("-", "several environments", "")


def test_a_damaged_run_has_no_part_in_the_mean_of_its_group():
    seeds = [row("s/0", best=1.0), row("s/1", best=3.0), row("s/2", "", best=500.0, state="damaged", notes=("config",))]
    folded, *_, last = lines([group("s", seeds)], {"s"})
    assert (folded["best"], folded["about"], folded["state"]) == ("2.00", "CartPole-v1", "2 finished, 1 damaged")
    assert (last["state"], last["reason"], last["color"]) == ("damaged", "config", "grey-7")


def test_best_first_goes_by_the_mean_that_is_shown_within_each_environment():
    lucky = group("lucky", [row("lucky/0", best=500.0), row("lucky/1", best=100.0)])
    steady = group("steady", [row("steady/0", best=400.0), row("steady/1", best=420.0)])
    lander = Block(row("lander", "LunarLander-v3", best=600.0))
    new, mixed = Block(row("new")), group("mixed", [*lucky.members, lander.total])
    damaged = Block(row("damaged", "", best=900.0))
    blocks = [new, mixed, damaged, lander, lucky, steady]
    assert names(ordered(blocks, "best", descending=True)) == ["steady", "lucky", "lander", "damaged", "new", "mixed"]
    assert names(ordered(blocks, "best", descending=False)) == ["lucky", "steady", "lander", "damaged", "new", "mixed"]


def test_the_share_of_a_group_is_that_of_the_steps_of_all_its_runs():
    rows = [
        row(str(asked), steps=500, steps_asked=asked, state="running", seconds_left=9.0) for asked in (1_000, 3_000)
    ]
    running = together("g", rows)
    assert (running.share, running.state) == (0.25, "2 running")
    assert together("g", [replace(row, state="finished") for row in rows]).share is None


def test_of_a_marked_group_the_runs_that_the_filter_shows_are_taken():
    studio = Studio(Path("runs"))
    studio.rows = [row(name) for name in ("s/xx1", "s/xx2", "s/zz", "alone", "zz")]
    assert marked(listed(studio, 1, "", "folder", "run", False), {"s", "alone"}) == ["alone", "s/xx1", "s/xx2", "s/zz"]
    assert marked(listed(studio, 1, "xx", "folder", "run", False), {"s", "zz"}) == ["s/xx1", "s/xx2"]
    assert marked(listed(studio, 1, "zz", "folder", "run", False), {"s", "s/zz", "alone"}) == ["s/zz"]


def test_an_address_holds_what_was_chosen_and_nothing_that_cannot_be():
    choice = asked("words=dqn&groups=none&sort=best&ascending=1&page=2&lines=25&evil=1")
    chosen = {"words": "dqn", "groups": "none", "sort": "best", "ascending": "1", "page": "2", "lines": "25"}
    assert choice.values == {**chosen, "opened": ""}
    assert choice.address() == "/?words=dqn&groups=none&sort=best&ascending=1&page=2&lines=25"
    usual = asked("groups=x&sort=__class__&page=-1&lines=9999999")
    assert (usual.values, usual.address()) == (USUAL, "/")


def test_only_one_page_of_the_lines_is_sent_to_the_browser():
    studio = Studio(Path("runs"))
    studio.rows = [row(f"r{i:04}", changed=float(i)) for i in range(2_000)]
    blocks = listed(studio, 1, "", "folder", "changed", True)
    assert names(page_of(blocks, asked("page=40")))[::49] == ["r0049", "r0000"]
    assert names(page_of(blocks, asked("page=41"))) == []
    assert names(listed(studio, 1, "r0007", "folder", "run", False)) == ["r0007"]
