"""A run on a node that does not see the folder of the sweep: what is copied, in which order, and when."""

import contextlib
import io
import json
import os
import subprocess
import sys
import tarfile
from pathlib import Path

import pytest

from rejeu import cluster
from rejeu.errors import ClusterError
from rejeu.experiments import node, process
from rejeu.experiments.node import PACKAGES, Copy, Spec, Storage, files, sees, train

PROGRAM = """
import json, pathlib, sys, time
task = json.loads(pathlib.Path(sys.argv[1]).read_text())
run = pathlib.Path(task["folder"])
found = len(list((run / "checkpoints").glob("run_*"))) if run.is_dir() else 0
(run / "checkpoints").mkdir(parents=True, exist_ok=True)
print("checkpoints", found, flush=True)
(run / "checkpoints" / f"rows_{found:012d}_aa.safetensors").write_bytes(b"rows" * 100)
(run / "checkpoints" / f"run_{found:012d}.safetensors").write_bytes(b"run")
(run / "checkpoints" / "lock").touch()
(run / "config.json").write_text("{}")
if task["waits"]:
    sys.stdin.read()
    time.sleep(0.5)
sys.exit(143 if task["waits"] else 0)
"""


class Recorded(Storage):
    """A storage that records what is written."""

    def __init__(self, folder):
        super().__init__(folder)
        self.written = []

    def put(self, name, content, kept):
        with tarfile.open(fileobj=io.BytesIO(content)) as opened:
            self.written += opened.getnames()
        super().put(name, content, kept)


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "program", lambda task: [sys.executable, "-c", PROGRAM, str(task)])
    monkeypatch.setattr(node, "POLL", 0.01)
    monkeypatch.setattr(node, "ASK", 0.01)
    (tmp_path / "sweep" / ".sweep").mkdir(parents=True)
    (tmp_path / "marker").write_text("token", encoding="utf-8")
    return Recorded(str(tmp_path / "sweep"))


def make_spec(tmp_path, waits=False, token="other", **changes):
    run = str(tmp_path / "sweep" / "a")
    content = {"folder": run, "resume": False, "waits": waits}
    (tmp_path / "task").write_text(json.dumps(content), encoding="utf-8")
    spec = Spec(
        name="a",
        task=str(tmp_path / "task"),
        content=content,
        log=f"{run}.log",
        lock=str(tmp_path / "sweep" / ".sweep" / "a.run"),
        marker=str(tmp_path / "marker"),
        token=token,
        folder=str(tmp_path),
        environ={},
        versions=cluster.versions(PACKAGES),
    )
    return spec._replace(**changes)


def test_a_node_that_sees_the_folder_trains_in_it(tmp_path, server):
    assert sees(str(tmp_path / "marker"), "token")
    assert not sees(str(tmp_path / "none"), "token")
    assert train(make_spec(tmp_path, token="token"), server) == 0
    assert server.written == []
    assert (tmp_path / "sweep" / "a" / "config.json").is_file()


def test_another_node_copies_the_run_folder_back(tmp_path, server):
    assert train(make_spec(tmp_path), server) == 0
    first, last = (
        f"a/checkpoints/{name}_000000000000{end}.safetensors" for name, end in (("rows", "_aa"), ("run", ""))
    )
    assert {*server.written} == {first, last, "a/config.json", "a.log"}
    assert server.written.index(first) < server.written.index(last)
    run = tmp_path / "sweep" / "a"
    assert (run / "checkpoints" / "rows_000000000000_aa.safetensors").read_bytes() == b"rows" * 100
    assert not (run / "checkpoints" / "lock").exists()
    assert (tmp_path / "sweep" / "a.log").read_text(encoding="utf-8").split() == ["checkpoints", "0"]


def test_a_resumed_run_is_copied_there_first(tmp_path, server):
    train(make_spec(tmp_path), server)
    spec = make_spec(tmp_path)
    assert train(spec._replace(content={**spec.content, "resume": True}), server) == 0
    assert (tmp_path / "sweep" / "a.log").read_text(encoding="utf-8").split() == [
        "checkpoints",
        "0",
        "checkpoints",
        "1",
    ]
    assert (tmp_path / "sweep" / "a" / "checkpoints" / "run_000000000001.safetensors").is_file()


def test_a_checkpoint_is_copied_while_the_run_goes_on_and_a_stop_is_passed_on(tmp_path, server):
    copied = tmp_path / "sweep" / "a" / "checkpoints" / "run_000000000000.safetensors"
    asked = []

    def is_stopping(name):
        asked.append(copied.is_file())
        return copied.is_file()

    server.is_stopping = is_stopping
    assert train(make_spec(tmp_path, waits=True), server) == 143
    assert asked[-1]


def test_removed_files_are_removed_and_unchanged_ones_not_sent_again(tmp_path, server):
    copy = Copy("a", tmp_path / "here", server)
    (copy.folder / "a").mkdir(parents=True)
    (copy.folder / "a" / "large").write_bytes(bytes(range(25)) * 10**5)
    (copy.folder / "a" / "empty").touch()
    copy.send()
    assert (tmp_path / "sweep" / "a" / "large").read_bytes() == bytes(range(25)) * 10**5
    (copy.folder / "a" / "large").unlink()
    copy.send()
    assert sorted(os.listdir(tmp_path / "sweep" / "a")) == ["empty"]
    assert server.written == ["a/empty", "a/large"]
    other = Copy("a", tmp_path / "there", server)
    other.fetch()
    assert os.listdir(tmp_path / "there" / "a") == ["empty"]


def test_checkpoints_are_sent_after_what_they_refer_to(tmp_path):
    names = ["checkpoints/run_1", "checkpoints/rows_1", "metrics.csv", "videos/a.mp4"]
    for name in names:
        (tmp_path / "a" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "a" / name).touch()
    found = [path.removeprefix("a/") for path in files(tmp_path, "a")]
    assert found == ["metrics.csv", "videos/a.mp4", "checkpoints/rows_1", "checkpoints/run_1"]


@pytest.mark.parametrize("path", ["../evil", "/evil", "a/../../evil"])
def test_nothing_is_written_outside_of_the_folder(tmp_path, server, path):
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as opened:
        opened.addfile(tarfile.TarInfo(path))
    with contextlib.suppress(tarfile.FilterError):
        server.put("a", content.getvalue(), set())
    assert not (tmp_path / "evil").exists()
    assert not Path("/evil").exists()


def test_other_versions_are_refused(tmp_path, server):
    spec = make_spec(tmp_path)
    with pytest.raises(ClusterError, match=r"the node .* has jax .* and not 0\.0\.1"):
        train(spec._replace(versions={**spec.versions, "jax": "0.0.1"}), server)


def test_a_node_does_not_import_jax():
    code = "import sys, rejeu.experiments.node; print('jax' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
