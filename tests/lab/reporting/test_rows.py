"""Rows of runs: what is read again, and what is shown of runs that are damaged or have disappeared."""

import json
import os
import shutil
from dataclasses import replace

import pytest

from rejeu.lab.cli import dumps, main
from rejeu.lab.reporting import rows as module, run_list
from rejeu.lab.reporting.report import sections
from rejeu.lab.reporting.rows import COLUMNS, RowReader, cells
from rejeu.lab.runs.output import noted_in
from tests.lab.reporting.report.folders import CONFIG, write


@pytest.fixture
def reads(monkeypatch):
    """The runs that were read, in order."""
    names, read = [], run_list.read
    monkeypatch.setattr(run_list, "read", lambda path, **options: (names.append(path.name), read(path, **options))[1])
    monkeypatch.setattr(module, "SHARE", 0.0)
    return names


def test_the_best_evaluation_has_its_interval(tmp_path):
    write(tmp_path / "a" / "b")
    (row,) = RowReader(tmp_path).read()
    # mean 160, standard deviation 9 of 20 episodes: 160 -+ 2.093 * 9 / sqrt(19)
    assert (row.best.low, row.best.high) == pytest.approx((155.679, 164.321), abs=1e-3)
    assert cells(row)["best"] == "160.00 (155.68 to 164.32), 50% success"
    assert (row.run, [*cells(row)]) == ("a/b", [*COLUMNS])


def test_the_rate_is_what_training_measured_last(tmp_path):
    run = write(tmp_path / "a", videos=False)
    (run / "metrics.csv").write_text(
        "step,time/time_elapsed,time/fps\n1000,10,90\n2000,20,70\n3000,30,\n", encoding="utf-8"
    )
    (row,) = RowReader(tmp_path).read()
    assert row.steps_per_second == 70.0
    assert cells(row)["rate"] == "70/s"
    assert sections.facts(run_list.read(run))[-1] == "70 steps/s"


def test_a_run_is_read_again_only_after_it_has_changed(tmp_path, reads):
    for name in ("a", "b"):
        write(tmp_path / name)
    reader = RowReader(tmp_path)
    first = reader.read()
    assert reader.read() == first
    assert reads == ["a", "b"]
    with (tmp_path / "b" / "episodes.csv").open("a", encoding="utf-8") as file:
        file.write("3500,0,7,7,1,35\n")
    assert [row.steps for row in reader.read()] == [3000, 3500]
    write(tmp_path / "c")
    assert [row.run for row in reader.read()] == ["a", "b", "c"]
    assert reads == ["a", "b", "b", "c"]


def test_a_row_says_that_its_run_is_damaged_or_gone_or_not_read_yet(tmp_path):
    for name in ("a", "b", "c"):
        write(tmp_path / name)
    (tmp_path / "a" / "config.json").write_text("{", encoding="utf-8")
    (tmp_path / "monitor.csv").write_text("nothing", encoding="utf-8")
    shutil.move(tmp_path / "monitor.csv", tmp_path / "c" / "monitor.csv")
    for name in ("config.json", "episodes.csv", "metrics.csv"):
        (tmp_path / "c" / name).unlink()
    reader = RowReader(tmp_path)
    assert [row.state for row in reader.read(seconds=0)] == ["unread"] * 3
    a, b, c = reader.read()
    assert "config.json is damaged" in a.notes[0]
    assert (a.state, b.state, c.state) == ("damaged", "finished", "damaged")
    assert "expected the columns r, l and t" in c.notes[0]
    shutil.rmtree(tmp_path / "b")
    a, b, c = reader.read()
    assert (b.state, b.steps, b.notes) == ("gone", 3000, ("its folder is no longer there",))
    write(tmp_path / "b")
    assert reader.read()[1].state == "finished"


def test_a_row_says_that_its_run_compiles_how_much_is_done_and_why_it_has_ended(tmp_path):
    write(tmp_path / "a", videos=False)
    (row,) = RowReader(tmp_path).read()
    running = replace(
        row, state="running", notes=("odd",), steps=1_000, steps_asked=4_000, seconds=10.0, seconds_left=30.0
    )
    assert (running.share, running.reason, row.share) == (0.25, "", None)
    assert replace(running, steps_asked=None, seconds_left=40.0).share == 0.2
    assert replace(running, steps_asked=None, seconds_left=float("nan")).share is None
    assert "functions are compiled" in replace(running, steps=0).reason
    assert [replace(running, state=state).reason for state in ("damaged", "interrupted")] == ["odd", ""]


def test_rows_are_json(tmp_path):
    write(tmp_path / "a")
    (row,) = json.loads(dumps(RowReader(tmp_path).read()))
    assert len(row["curve"]) == 40


@pytest.mark.skipif(os.name != "posix", reason="names are Unicode, and links need a permission")
def test_odd_names_links_and_files_for_folders_hide_no_other_run(tmp_path, capsys):
    for name in ("good", "x", "L" * 250, "loops", "files"):
        write(tmp_path / name, videos=False)
    (tmp_path / "group").mkdir()
    for source, name in ((write(tmp_path / "y", videos=False), b"group/\xe9"), (tmp_path / "x", b"bad\xff\xfe")):
        os.rename(source, os.path.join(os.fsencode(tmp_path), name))
    for name in ("checkpoints", "models", "videos"):
        (tmp_path / "loops" / name).symlink_to(name)
        (tmp_path / "files" / name).touch()
    for name, target in (("loop", "loop"), ("up", ".."), ("nowhere", "no/where")):
        (tmp_path / name).symlink_to(target)
    reader = RowReader(tmp_path)
    rows = {row.run: row for row in reader.read()}
    assert {*rows} == {"good", "L" * 250, "loops", "files", r"group/\udce9", r"bad\udcff\udcfe"}
    for name, row in rows.items():
        expected = ("damaged", ("its name is not UTF-8; rename the folder",)) if "udc" in name else ("finished", ())
        assert (row.state, row.notes) == expected
    assert len(json.loads(dumps(reader.read()))) == 6
    assert main(["runs", str(tmp_path), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["runs"]) == 6
    shutil.rmtree(os.path.join(os.fsencode(tmp_path), b"bad\xff\xfe"))
    assert {row.run: row.state for row in reader.read()}[r"bad\udcff\udcfe"] == "gone"
    shutil.rmtree(tmp_path)
    assert {row.state for row in reader.read()} == {"gone"}


def test_a_run_that_causes_any_error_hides_no_other_run(tmp_path, monkeypatch):
    for name in ("a", "b"):
        write(tmp_path / name, videos=False)
    read = run_list.read

    def fail(path, **options):
        if path.name == "a":
            raise RecursionError
        return read(path, **options)

    monkeypatch.setattr(run_list, "read", fail)
    assert [(row.state, row.notes) for row in RowReader(tmp_path).read()] == [
        ("damaged", ("RecursionError()",)),
        ("finished", ()),
    ]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the superuser may read all")
@pytest.mark.parametrize("mode", [0o000, 0o444])
def test_a_folder_without_permission_has_a_row_that_says_so(tmp_path, mode):
    for name in ("a", "b"):
        write(tmp_path / name, videos=False)
    (tmp_path / "a").chmod(mode)
    a, b = RowReader(tmp_path).read()
    (tmp_path / "a").chmod(0o755)
    assert (a.state, b.state) == ("damaged", "finished")
    assert "Permission denied" in a.notes[0]


def test_a_folder_that_cannot_be_read_has_a_row_that_says_so(tmp_path, monkeypatch):
    """As the test above, also for the superuser."""
    for name in ("a", "b"):
        write(tmp_path / name, videos=False)

    def denied(function):
        def checked(path, *arguments, **options):
            if "a" in str(path).removeprefix(str(tmp_path)).split(os.sep):
                raise PermissionError(13, "Permission denied", str(path))
            return function(path, *arguments, **options)

        return checked

    for name in ("scandir", "lstat"):
        monkeypatch.setattr(os, name, denied(getattr(os, name)))
    a, b = RowReader(tmp_path).read()
    assert (a.run, a.state, b.state) == ("a", "damaged", "finished")
    assert "Permission denied" in a.notes[0]


def test_a_row_says_which_error_has_ended_a_run_until_it_is_resumed(tmp_path):
    run = write(tmp_path / "a", {**CONFIG, "steps": 10**6}, videos=False)
    (run / "warnings.txt").write_text("the reward is large\nNonFiniteError: the loss is NaN\n", encoding="utf-8")
    (row,) = RowReader(tmp_path).read()
    assert (row.state, row.notes[0]) == ("crashed", "NonFiniteError: the loss is NaN")
    with noted_in(run / "warnings.txt"):
        pass
    (row,) = RowReader(tmp_path).read()
    assert (row.state, row.notes) == ("interrupted", ())
    assert row.warnings[-1] == "the run was resumed after this error"
    with pytest.raises(KeyError), noted_in(run / "warnings.txt"):
        raise KeyError("at")
    (row,) = RowReader(tmp_path).read()
    assert (row.state, row.notes[0]) == ("crashed", "KeyError: 'at'")


def test_the_error_that_ended_a_run_is_found_after_many_warnings(tmp_path):
    run = write(tmp_path / "a", {**CONFIG, "steps": 10**6}, videos=False)
    (run / "warnings.txt").write_text("odd\n" * 500 + "ValueError: end\n", encoding="utf-8")
    (row,) = RowReader(tmp_path).read()
    assert (row.state, row.notes[0], len(row.warnings)) == ("crashed", "ValueError: end", 100)
