"""Writing where a folder from elsewhere holds links to the user's own files."""

import ast
import os
import re
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

import rejeu
from rejeu.agents import presets
from rejeu.core import atomic
from rejeu.lab.experiments.work import Work
from rejeu.lab.runs import config
from rejeu.lab.runs.config import DecidedRun, Task
from rejeu.lab.runs.output import noted_in
from rejeu.lab.runs.process import Process
from rejeu.logs.history import History
from rejeu.logs.logging import CsvFile, JsonLines

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
        atomic.open_file(link)
    for refused in (atomic.touch, atomic.lock):
        with pytest.raises(OSError, match="is a symbolic link; remove it"):
            refused(link)


def test_a_link_that_is_made_after_the_check_is_not_followed(link, monkeypatch):
    monkeypatch.setattr(atomic, "check_no_link", lambda path: None)
    for mode in ("ab", "wb", "r+b"):
        with pytest.raises(OSError, match="symbolic links"):
            atomic.open_file(link, mode)


def test_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "log")
    with pytest.raises(OSError, match="No such device"):
        atomic.open_file(tmp_path / "log")


def test_a_link_that_leads_out_of_a_folder_is_found_at_any_depth(tmp_path):
    (tmp_path / "run" / "wandb" / "run-1").mkdir(parents=True)
    (tmp_path / "run" / "wandb" / "latest-run").symlink_to("run-1", target_is_directory=True)  # as wandb makes it
    atomic.check_no_links(tmp_path / "run")
    (tmp_path / "run" / "wandb" / "run-1" / "lock").symlink_to(tmp_path / "nowhere")
    with pytest.raises(OSError, match="lock is a symbolic link"):
        atomic.check_no_links(tmp_path / "run")


OPENED_ELSEWHERE = {
    ("atomic.py", "replacing"),  # a new file of a name of its own
    ("notebooks.py", "_write_new"),  # a new file
    ("logging.py", "__init__"),  # likewise
    ("run_folder.py", "create"),
    ("hub.py", "lay_out"),  # in a new folder
    ("branch.py", "branch"),
    ("branch.py", "begin"),
    ("work.py", "move_aside"),  # a folder, in one without links
    ("web_file.py", "node"),  # in a temporary folder
    ("c_file.py", "c_run"),
    ("c_file.py", "run"),
    ("algorithms.py", "readable"),
    ("atomic.py", "open_file"),
    ("atomic.py", "lock"),
}
"""Functions that write without :func:`rejeu.core.atomic.open_file`, where no link can be."""


def test_every_file_is_opened_for_writing_where_links_are_not_followed():
    writers = set()
    for path in Path(rejeu.__file__).parent.rglob("*.py"):
        for scope in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            calls = ast.walk(scope) if isinstance(scope, ast.FunctionDef) else ()
            writers |= {(path.name, scope.name) for call in calls if isinstance(call, ast.Call) and writes(call)}
    assert writers == OPENED_ELSEWHERE


def writes(call):
    """Returns whether a call opens a file for writing, or creates one."""
    name = ast.unparse(call.func)
    if name.endswith(
        (".touch", ".write_text", ".write_bytes", "FileLock", "np.save", "copyfile", "shutil.copy", "shutil.move")
    ):
        return not name.startswith("atomic.")
    modes = [
        one.value for one in (*call.args, *(word.value for word in call.keywords)) if isinstance(one, ast.Constant)
    ]
    is_open = name == "open" or name.endswith(".open")
    is_for_writing = any(isinstance(mode, str) and re.fullmatch("[rwaxbt+]*[wax+][rwaxbt+]*", mode) for mode in modes)
    return is_open and (is_for_writing or any(ast.unparse(one) == "mode" for one in call.args))


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
        Process(["list"], link, dict(os.environ))


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


RUN = DecidedRun(env="CartPole-v1", algorithm="DQN", policy="MlpPolicy", seed=0, n_envs=1, backend="gymnasium", preset=True,
                 hyperparameters={}, evaluate_every=1, evaluate_episodes=1)  # fmt: skip
WRITERS = {
    "config.json": lambda path: config.write(path, RUN),
    "task.json": lambda path: config.write_task(path, Task(folder="run", run=RUN)),
    "preset.json": lambda path: presets.write(presets.find("CartPole-v1", "DQN"), path),
    "job.exit": lambda path: Work.write_exit(SimpleNamespace(exit=path), 0),
    "episodes.csv": lambda path: History([]).write_csv(path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_new_file_takes_the_place_of_the_old_one_which_is_never_written_to(name, tmp_path):
    (tmp_path / name).write_text("old")
    os.link(tmp_path / name, tmp_path / "same")
    WRITERS[name](tmp_path / name)
    assert (tmp_path / name).read_text() != "old"
    assert (tmp_path / "same").read_text() == "old"
