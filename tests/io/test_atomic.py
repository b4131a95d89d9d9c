"""Writing where a folder from elsewhere holds links to the user's own files."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import pytest

from rejeu.cli.output import noted_in
from rejeu.experiments.process import Process
from rejeu.io import atomic
from rejeu.reporting.history import History
from rejeu.reporting.logging import CsvFile, JsonLines

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links need rights on Windows")


@pytest.fixture
def link(tmp_path):
    """A link in a run folder to a file that is the user's own."""
    (tmp_path / "run").mkdir()
    (tmp_path / "profile").write_text("export PATH\n")
    path = tmp_path / "run" / "link.png"
    path.symlink_to(tmp_path / "profile")
    yield path
    assert (tmp_path / "profile").read_text() == "export PATH\n"


def test_nothing_is_appended_to_the_target_of_a_link(link):
    with pytest.raises(OSError, match=r"link.png could not be written: .*is a symbolic link; remove it"):
        atomic.append(link, b"1,2\n")
    with pytest.raises(OSError, match="is a symbolic link; remove it"):
        atomic.open_log(link)


def test_a_file_takes_the_place_of_a_link_and_not_of_its_target(link):
    with atomic.replacing(link) as file:
        file.write(b"new")
    assert not link.is_symlink()
    assert link.read_text() == "new"


@pytest.mark.parametrize("log", [CsvFile, JsonLines])
def test_a_log_that_is_a_link_is_not_continued(link, log):
    with pytest.raises(OSError, match="not a regular file"):
        log(link, up_to=100)


def test_warnings_are_not_written_to_the_target_of_a_link(link):
    with pytest.warns(UserWarning, match="touch"), noted_in(link):
        warnings.warn("$(touch /tmp/x)", UserWarning, stacklevel=1)


def test_the_log_of_a_process_is_no_link(link, tmp_path):
    with pytest.raises(OSError, match="is a symbolic link; remove it"):
        Process(["list"], link, tmp_path / "lock", dict(os.environ))


def test_a_curve_takes_the_place_of_a_link(link):
    pytest.importorskip("matplotlib")
    History([]).plot(link)
    assert link.read_bytes().startswith(b"\x89PNG")


def test_a_file_that_a_reader_holds_is_replaced_when_it_is_closed(tmp_path, monkeypatch):
    """As on Windows, where another process that reads a file keeps it from being replaced."""
    new, old, tries, rename = tmp_path / "new", tmp_path / "old", [], Path.replace
    new.write_text("new")
    old.write_text("old")

    def held(source, target):
        tries.append(target)
        if len(tries) < 3:
            raise PermissionError
        rename(source, target)

    monkeypatch.setattr(Path, "replace", held)
    atomic.replace_patiently(new, old, (0.0, 0.0))
    assert (old.read_text(), len(tries)) == ("new", 3)
    new.write_text("newer")
    tries.clear()
    with pytest.raises(PermissionError):
        atomic.replace_patiently(new, old, (0.0,))
