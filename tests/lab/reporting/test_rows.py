"""Rows of runs: what is read again, and what is shown of runs that are damaged or have disappeared."""

import json
import shutil

import pytest

from rejeu.lab.reporting import rows as module, run_list
from rejeu.lab.reporting.rows import COLUMNS, Rows, cells
from tests.lab.reporting.report.folders import write


@pytest.fixture
def reads(monkeypatch):
    """The runs that were read, in order."""
    names, read = [], run_list.read
    monkeypatch.setattr(run_list, "read", lambda path, **options: (names.append(path.name), read(path, **options))[1])
    monkeypatch.setattr(module, "SHARE", 0.0)
    return names


def test_the_best_evaluation_has_its_interval(tmp_path):
    write(tmp_path / "a" / "b")
    (row,) = Rows(tmp_path).read()
    # mean 160, standard deviation 9 of 20 episodes: 160 -+ 2.093 * 9 / sqrt(19)
    assert (row["best"]["low"], row["best"]["high"]) == pytest.approx((155.679, 164.321), abs=1e-3)
    assert cells(row)["best"] == "160.00 (155.68 to 164.32), 50% success"
    assert (row["run"], [*cells(row)]) == ("a/b", [*COLUMNS])


def test_the_rate_is_what_training_measured_last(tmp_path):
    run = write(tmp_path / "a", videos=False)
    (run / "metrics.csv").write_text(
        "step,time/time_elapsed,time/fps\n1000,10,90\n2000,20,70\n3000,30,\n", encoding="utf-8"
    )
    (row,) = Rows(tmp_path).read()
    assert row["steps_per_second"] == 70.0
    assert cells(row)["rate"] == "70/s"


def test_a_run_is_read_again_only_after_it_has_changed(tmp_path, reads):
    for name in ("a", "b"):
        write(tmp_path / name)
    reader = Rows(tmp_path)
    first = reader.read()
    assert reader.read() == first
    assert reads == ["a", "b"]
    with (tmp_path / "b" / "episodes.csv").open("a", encoding="utf-8") as file:
        file.write("3500,0,7,7,1,35\n")
    assert [row["steps"] for row in reader.read()] == [3000, 3500]
    write(tmp_path / "c")
    assert [row["run"] for row in reader.read()] == ["a", "b", "c"]
    assert reads == ["a", "b", "b", "c"]


def test_a_row_says_that_its_run_is_damaged_or_gone_or_not_read_yet(tmp_path):
    for name in ("a", "b", "c"):
        write(tmp_path / name)
    (tmp_path / "a" / "config.json").write_text("{", encoding="utf-8")
    (tmp_path / "monitor.csv").write_text("nothing", encoding="utf-8")
    shutil.move(tmp_path / "monitor.csv", tmp_path / "c" / "monitor.csv")
    for name in ("config.json", "episodes.csv", "metrics.csv"):
        (tmp_path / "c" / name).unlink()
    reader = Rows(tmp_path)
    assert [row["state"] for row in reader.read(seconds=0)] == ["unread"] * 3
    a, b, c = reader.read()
    assert "config.json is damaged" in a["notes"][0]
    assert (b["state"], c["state"]) == ("finished", "damaged")
    assert "expected the columns r, l and t" in c["notes"][0]
    shutil.rmtree(tmp_path / "b")
    a, b, c = reader.read()
    assert (b["state"], b["steps"], b["notes"]) == ("gone", 3000, ("its folder is no longer there",))
    write(tmp_path / "b")
    assert reader.read()[1]["state"] == "finished"


def test_rows_are_json(tmp_path):
    from rejeu.lab.cli import dumps

    write(tmp_path / "a")
    (row,) = json.loads(dumps(Rows(tmp_path).read()))
    assert len(row["curve"]) == 40
