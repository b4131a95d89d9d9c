"""Runs of Stable-Baselines3 and TensorBoard; the recorded files are those of real runs (golden/record_monitor.py)."""

import csv
import os
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from rejeu.lab.reporting import other_programs, run_list
from rejeu.lab.reporting.comparison import compare
from rejeu.lab.reporting.other_programs import read_monitor
from rejeu.logs import tables
from rejeu.sb3.common.monitor import ResultsWriter, load_results

RECORDED = Path(__file__).parents[2] / "golden" / "sb3_monitor"
ZOO = RECORDED / "ppo" / "CartPole-v1_1"


def rows(path):
    with path.open(encoding="utf-8") as file:
        next(file)
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def test_recorded_monitor_files_are_one_run_of_two_environments():
    run = run_list.read(ZOO)
    both = [rows(ZOO / f"{i}.monitor.csv") for i in range(2)]
    assert (run.format, run.config.algorithm, run.config.env, run.config.seed, run.config.n_envs) == (
        "monitor",
        "PPO",
        "CartPole-v1",
        1,
        2,
    )
    assert run.steps == sum(row["l"] for part in both for row in part)
    assert len(run.episodes) == sum(map(len, both))
    assert sorted(run.episodes.column("return")) == sorted(row["r"] for part in both for row in part)
    assert (np.diff(run.episodes.column("seconds")) >= 0).all()
    assert (np.diff(run.episodes.column("step")) > 0).all()


def test_single_monitor_file():
    run = run_list.read(ZOO / "0.monitor.csv")
    expected = rows(ZOO / "0.monitor.csv")
    np.testing.assert_array_equal(run.episodes.column("step"), np.cumsum([row["l"] for row in expected]))
    np.testing.assert_array_equal(run.episodes.column("seconds"), [row["t"] for row in expected])


def test_the_clocks_of_several_files_begin_with_the_first(tmp_path):
    for i, (start, row) in enumerate([(100.0, "1,5,30"), (120.0, "2,5,15")]):
        head = f'#{{"t_start": {start}, "env_id": "CartPole-v1"}}'
        (tmp_path / f"{i}.monitor.csv").write_text(f"{head}\nr,l,t\n{row}\n", encoding="utf-8")
    episodes = read_monitor(tmp_path).episodes
    assert (episodes.column("seconds").tolist(), episodes.column("return").tolist()) == ([30, 35], [1, 2])


def test_episodes_with_texts_of_the_info_are_all_read(tmp_path):
    file = ResultsWriter(tmp_path, {"t_start": 0.0}, ("is_success", "note"))
    for i, note in enumerate(["plain", "two, words", 'say "yes"', "two\nlines", {"a": 1, "b": [2, 3]}]):
        file.write_row({"r": float(i), "l": 1, "t": float(i), "is_success": i > 2, "note": note})
    run = read_monitor(tmp_path)
    assert len(run.episodes) == len(load_results(tmp_path)) == 5
    assert run.episodes.column("success").tolist() == [0, 0, 0, 1, 1]
    assert run.notes == ()


def test_hostile_monitor_file(tmp_path):
    path = tmp_path / "monitor.csv"
    path.write_bytes(b'#{"t_start": "now", "env_id": ["<b>"]}\nr,l,t\n1e999,5,1\nx,-3,nan\n2,1e300,3\n3,4,4\n5,')
    run = read_monitor(path)
    assert run.config.env == ""
    assert "the last row of monitor.csv is incomplete and was left out" in run.notes
    assert np.isfinite(run.episodes.column("step")).all()
    assert run.steps == 9
    assert "2 damaged rows without a valid length were left out" in run.notes
    path.write_bytes(b"#\nreward,length\n1,2\n")
    with pytest.raises(ValueError, match="expected the columns r, l and t"):
        read_monitor(path)


def test_tensorboard_files():
    pytest.importorskip("tensorboard")
    run = run_list.read(RECORDED / "tb" / "PPO_1")
    assert (run.format, run.config.algorithm, run.config.seed, run.steps) == ("tensorboard", "PPO", 1, 768)
    assert np.isfinite(run.metrics.column("rollout/ep_rew_mean")).all()
    (group,) = compare(run, x="time", samples=10).groups
    assert group.x[-1] == run.seconds > 0


def test_tensorboard_files_without_the_package_are_left_out(monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorboard.util.tensor_util", None)
    runs, notes = run_list.read_all([ZOO, RECORDED / "tb"])
    assert [run.format for run in runs] == ["monitor"]
    assert "PPO_1 is left out: reading TensorBoard files needs" in notes[0]


def test_damaged_tensorboard_file(tmp_path):
    pytest.importorskip("tensorboard")
    source = next((RECORDED / "tb" / "PPO_1").iterdir())
    whole = source.read_bytes()
    for content, rows in ((whole[:700], 1), (whole[:700] + b"x" + whole[701:], 1), (b"\xff" * 3000, 0)):
        (tmp_path / source.name).write_bytes(content)
        run = run_list.read(tmp_path)
        assert len(run.metrics) >= rows
        assert any("damaged" in note for note in run.notes)
    (tmp_path / source.name).write_bytes(whole)
    assert run_list.read(tmp_path).notes == ()


def events(*records):
    """A TensorBoard file of records, each with its length and checksums."""
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c

    parts = [(struct.pack("<Q", len(record)), record) for record in records]
    return b"".join(part + struct.pack("<I", masked_crc32c(part)) for pair in parts for part in pair)


def scalar(name, step, value=1.0):
    from tensorboard.compat.proto.event_pb2 import Event

    event = Event(step=step, wall_time=1.0)
    event.summary.value.add(tag=name, simple_value=value)
    return event.SerializeToString()


def test_records_too_long_for_scalars_are_passed_over(tmp_path):
    """Their checksums alone took TensorBoard's own reader a minute."""
    pytest.importorskip("tensorboard")
    picture = events(bytes(100)).replace(struct.pack("<Q", 100), struct.pack("<Q", 2**27))
    start = events(bytes(2**17))[:12]
    (tmp_path / "events.out.tfevents.1").write_bytes(
        events(scalar("a", 1)) + start + bytes(2**17 + 4) + events(scalar("a", 2))
    )
    run = run_list.read(tmp_path)
    assert (run.metrics.column("a").tolist(), run.notes) == ([1.0, 1.0], ())
    (tmp_path / "events.out.tfevents.1").write_bytes(events(scalar("a", 1)) + picture)
    assert "damaged or incomplete" in run_list.read(tmp_path).notes[0]


def test_many_curves_with_steps_of_their_own_are_one_table_of_limited_size(tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    monkeypatch.setattr(other_programs, "MAX_CELLS", 1000)
    records = [scalar(f"curve{i}", 100 * i + j) for i in range(20) for j in range(10)]
    (tmp_path / "events.out.tfevents.1").write_bytes(events(*records))
    metrics = run_list.read(tmp_path).metrics
    assert len(metrics.columns) == 22
    assert 20 <= len(metrics) <= 1000 / 20
    monkeypatch.setattr(other_programs, "MAX_SCALAR_BYTES", 400)
    assert "only the first" in run_list.read(tmp_path).notes[0]


def test_sparse_monitor_files_are_read_up_to_the_hole(tmp_path, monkeypatch):
    """Three hundred of a terabyte each fit into an archive of some KiB."""
    monkeypatch.setattr(tables, "MAX_BYTES", 2**20)
    with (tmp_path / "monitor.csv").open("wb") as file:
        file.write(b'#{"t_start": 1.0}\nr,l,t\n1,2,3\n')
        file.truncate(2**30)
        if 512 * os.fstat(file.fileno()).st_blocks > 2**20:
            pytest.skip("the disk has no holes")
    assert len(read_monitor(tmp_path).episodes) == 1
    assert len(tables.read_bytes(tmp_path / "monitor.csv", 2**20, has_holes=False)) < 2**16


def test_yaml_beside_a_run_is_never_read(tmp_path):
    folder = tmp_path / "ppo" / "CartPole-v1_3"
    folder.mkdir(parents=True)
    (folder / "monitor.csv").write_bytes((ZOO / "0.monitor.csv").read_bytes())
    (folder / "config.yml").write_text("!!python/object/apply:os.system ['touch hacked']", encoding="utf-8")
    found, _ = run_list.read_all(tmp_path)
    assert [(run.config.algorithm, run.config.seed) for run in found] == [("PPO", 3)]
    assert not Path("hacked").exists()
