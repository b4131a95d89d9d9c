"""Runs that are renamed, deleted and brought back; no link is followed. No browser."""

import os
from contextlib import closing
from dataclasses import replace

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import atomic
from rejeu.lab.studio import moving, processes
from rejeu.lab.studio.state import Studio
from tests.lab.reporting.report.folders import write

needs_links = pytest.mark.skipif(os.name != "posix", reason="links need a permission")


@pytest.fixture
def studio(tmp_path):
    """A studio that has read three runs."""
    for name in ("a", "group/b", "group/c"):
        write(tmp_path / name, videos=False)
    studio = Studio(tmp_path)
    look(studio)
    return studio


def look(studio):
    studio.rows = studio._reader.read()


def names(studio):
    return [row.run for row in studio.rows]


def test_deleted_runs_are_in_the_bin_without_a_row_and_come_back(studio):
    moving.delete(studio, ["a", "group/b"])
    assert names(studio) == ["group/c"]
    look(studio)
    assert names(studio) == ["group/c"]
    assert len([*(studio.folder / ".bin").glob("*/group/b/config.json")]) == 1
    moving.delete(studio, ["group/c"])
    moving.restore(studio)
    look(studio)
    assert names(studio) == ["group/c"]
    moving.restore(studio)
    look(studio)
    assert names(studio) == ["a", "group/b", "group/c"]
    assert studio.deleted == []


def test_a_run_that_came_back_and_vanishes_otherwise_has_a_row_that_says_so(studio):
    moving.delete(studio, ["a"])
    moving.restore(studio)
    look(studio)
    (studio.folder / "a").rename(studio.folder.parent / f"{studio.folder.name}-gone")
    look(studio)
    assert studio.row("a").state == "gone"


def test_a_run_does_not_come_back_over_another_one(studio):
    moving.delete(studio, ["a"])
    write(studio.folder / "a", videos=False)
    with pytest.raises(ValueError, match="exists"):
        moving.restore(studio)
    assert len([*(studio.folder / ".bin").glob("*/a/config.json")]) == len(studio.deleted) == 1


def test_a_run_is_renamed_with_its_log(studio):
    atomic.write(processes.log_of(studio.folder / "a"), "printed")
    moving.rename(studio, "a", "other/name")
    look(studio)
    assert names(studio) == ["group/b", "group/c", "other/name"]
    assert processes.read_log(studio.folder / "other" / "name") == "printed"


@pytest.mark.parametrize("name", ["", "..", "../x", "/x", "group/b", ".hidden", "con", "group/c/d"])
def test_a_name_that_no_run_may_have_moves_nothing(studio, name):
    with pytest.raises(ValueError, match=r"must be a name|exists|would be in|not in the folder"):
        moving.rename(studio, "a", name)
    assert (studio.folder / "a" / "config.json").is_file()


def test_of_runs_that_train_and_others_none_is_moved(studio):
    lock = RunFolder(studio.folder / "group" / "b").lock
    lock.parent.mkdir(exist_ok=True)
    with closing(lock.open("w")), atomic.lock(lock).acquire(timeout=0):
        for runs in (["a", "group/b"], ["a", "no-run"], ["a", "../a"]):
            with pytest.raises(ValueError, match=r"trains|no run|not in the folder"):
                moving.delete(studio, runs)
    look(studio)
    assert names(studio) == ["a", "group/b", "group/c"]


@needs_links
def test_links_are_neither_followed_nor_moved(studio, tmp_path):
    outside = tmp_path.parent / f"{tmp_path.name}-outside"
    (studio.folder / "group").rename(outside)
    (studio.folder / "group").symlink_to(outside, target_is_directory=True)
    (studio.folder / "inside").symlink_to("a", target_is_directory=True)
    studio.rows = [*studio.rows, replace(studio.rows[0], run="inside", path=studio.folder / "inside")]
    for run in ("group/b", "inside"):
        with pytest.raises((ValueError, OSError), match=r"not in the folder|symbolic link"):
            moving.delete(studio, [run])
    elsewhere = tmp_path.parent / f"{tmp_path.name}-elsewhere"
    elsewhere.mkdir()
    (studio.folder / ".bin").symlink_to(elsewhere, target_is_directory=True)
    with pytest.raises(OSError, match="symbolic link"):
        moving.delete(studio, ["a"])
    assert [*elsewhere.iterdir()] == []
    assert (outside / "b" / "config.json").is_file()
