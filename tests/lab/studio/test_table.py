"""The lines of the table of runs, and the names of keys. No browser."""

import pytest

from rejeu.lab.reporting.rows import RowReader
from tests.lab.reporting.report.folders import CONFIG, write

runs = pytest.importorskip("rejeu.lab.studio.runs", reason="needs nicegui, which is in the extra studio")


def test_the_line_of_a_group_is_about_all_of_its_runs(tmp_path):
    for seed in range(3):
        write(tmp_path / "seeds" / f"seed_{seed}", {**CONFIG, "seed": seed}, videos=False)
    rows = RowReader(tmp_path).read()
    best = [{**row, "best": {**row["best"], "mean_return": value}} for row, value in zip(rows, (1, 2, 6), strict=True)]
    [folded] = runs.lines(best, ["seeds"] * 3, set())
    assert (folded["name"], folded["best"]) == ("seeds (3)", "3.00")
    assert folded["steps"] == f"{sum(row['steps'] for row in rows):,}"
    opened = [*runs.lines(best, ["seeds"] * 3, {"seeds"})]
    assert [line["key"] for line in opened] == ["seeds", *(row["run"] for row in rows)]


def test_the_share_of_a_group_is_that_of_the_steps_of_all_its_runs():
    rows = [{"steps": 500, "steps_asked": asked, "state": "running"} for asked in (1_000, 3_000)]
    assert runs.share(rows) == pytest.approx(0.25)
    assert runs.share([{**row, "state": "finished"} for row in rows]) is None
