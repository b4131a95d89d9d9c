"""A run on a node that does not see the folder of the sweep: what is copied, in which order, and when."""

import os
import subprocess
import sys

import pytest

from rejeu import cluster
from rejeu.errors import ClusterError
from rejeu.sweeps import node, process
from rejeu.sweeps.node import PACKAGES, Copy, FileServer, Spec, order, sees, train

PROGRAM = """
import pathlib, sys, time
run = pathlib.Path(sys.argv[sys.argv.index("resume") + 1] if "resume" in sys.argv else sys.argv[sys.argv.index("--out") + 1])
found = len(list((run / "checkpoints").glob("run_*"))) if run.is_dir() else 0
(run / "checkpoints").mkdir(parents=True, exist_ok=True)
print("checkpoints", found, flush=True)
(run / "checkpoints" / f"rows_{found:012d}_aa.safetensors").write_bytes(b"rows" * 100)
(run / "checkpoints" / f"run_{found:012d}.safetensors").write_bytes(b"run")
(run / "checkpoints" / "lock").touch()
(run / "config.json").write_text("{}")
if "--wait" in sys.argv:
    sys.stdin.read()
    time.sleep(0.5)
sys.exit(143 if "--wait" in sys.argv else 0)
"""


class Recorded(FileServer):
    """A server that records what is written."""

    def __init__(self, folder):
        super().__init__(folder)
        self.written = []

    def write(self, name, path, offset, content, is_last):
        self.written.append((path, offset, is_last))
        super().write(name, path, offset, content, is_last)


@pytest.fixture
def server(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "program", lambda words: [sys.executable, "-c", PROGRAM, *words])
    monkeypatch.setattr(node, "POLL", 0.01)
    monkeypatch.setattr(node, "ASK", 0.01)
    (tmp_path / "sweep" / ".sweep").mkdir(parents=True)
    (tmp_path / "marker").write_text("token", encoding="utf-8")
    return Recorded(str(tmp_path / "sweep"))


def make_spec(tmp_path, *words, token="other", **changes):
    run = str(tmp_path / "sweep" / "a")
    spec = Spec(
        name="a",
        words=("train", "CartPole-v1", "--out", run, *words),
        run=run,
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
    names = [path for path, _, _ in server.written]
    assert names == [
        "config.json",
        "checkpoints/rows_000000000000_aa.safetensors",
        "checkpoints/run_000000000000.safetensors",
    ]
    run = tmp_path / "sweep" / "a"
    assert (run / "checkpoints" / "rows_000000000000_aa.safetensors").read_bytes() == b"rows" * 100
    assert not (run / "checkpoints" / "lock").exists()
    assert (tmp_path / "sweep" / "a.log").read_text(encoding="utf-8").split() == ["checkpoints", "0"]


def test_a_resumed_run_is_copied_there_first(tmp_path, server):
    train(make_spec(tmp_path), server)
    spec = make_spec(tmp_path)
    assert train(spec._replace(words=("resume", spec.run)), server) == 0
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
    assert train(make_spec(tmp_path, "--wait"), server) == 143
    assert asked[-1]


def test_large_files_are_sent_in_parts_and_removed_ones_are_removed(tmp_path, server, monkeypatch):
    monkeypatch.setattr(node, "CHUNK", 10)
    copy = Copy("a", tmp_path / "here", server)
    copy.run.mkdir(parents=True)
    (copy.run / "large").write_bytes(bytes(range(25)))
    (copy.run / "empty").touch()
    copy.send()
    assert (tmp_path / "sweep" / "a" / "large").read_bytes() == bytes(range(25))
    assert [one for one in server.written if one[0] == "large"] == [
        ("large", 0, False),
        ("large", 10, False),
        ("large", 20, True),
    ]
    (copy.run / "large").unlink()
    copy.send()
    assert sorted(os.listdir(tmp_path / "sweep" / "a")) == ["empty"]
    other = Copy("a", tmp_path / "there", server)
    other.fetch()
    assert sorted(os.listdir(other.run)) == ["empty"]


def test_checkpoints_are_sent_after_what_they_refer_to():
    names = ["checkpoints/run_1", "checkpoints/rows_1", "metrics.csv", "videos/a.mp4"]
    assert sorted(names, key=order) == ["metrics.csv", "videos/a.mp4", "checkpoints/rows_1", "checkpoints/run_1"]


@pytest.mark.parametrize("path", ["../evil", "/evil", "a/../../evil", ""])
def test_nothing_is_written_outside_of_a_run_folder(server, path):
    with pytest.raises(ValueError, match="is no file of a run folder"):
        server.write("a", path, 0, b"", True)
    with pytest.raises(ValueError, match="is no file of a run folder"):
        server.write("../a", "file", 0, b"", True)


def test_other_versions_are_refused(tmp_path, server):
    spec = make_spec(tmp_path)
    with pytest.raises(ClusterError, match=r"the node .* has jax .* and not 0\.0\.1"):
        train(spec._replace(versions={**spec.versions, "jax": "0.0.1"}), server)


def test_a_node_does_not_import_jax():
    code = "import sys, rejeu.sweeps.node; print('jax' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
