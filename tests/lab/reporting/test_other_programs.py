"""Runs of Stable-Baselines3 and TensorBoard; the recorded files are those of real runs (golden/record_monitor.py)."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest

from rejeu.lab.reporting import run_list
from rejeu.lab.reporting.comparison import compare
from rejeu.lab.reporting.other_programs import read_monitor
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
    monkeypatch.setitem(sys.modules, "tensorboard.backend.event_processing.event_file_loader", None)
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


def test_yaml_beside_a_run_is_never_read(tmp_path):
    folder = tmp_path / "ppo" / "CartPole-v1_3"
    folder.mkdir(parents=True)
    (folder / "monitor.csv").write_bytes((ZOO / "0.monitor.csv").read_bytes())
    (folder / "config.yml").write_text("!!python/object/apply:os.system ['touch hacked']", encoding="utf-8")
    found, _ = run_list.read_all(tmp_path)
    assert [(run.config.algorithm, run.config.seed) for run in found] == [("PPO", 3)]
    assert not Path("hacked").exists()
