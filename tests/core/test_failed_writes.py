"""Writes that fail do not end training: they are warned of once, and reported at the end."""

import csv
import errno
import math
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint, Evaluate
from rejeu.core.failed_writes import FailedWrites
from rejeu.logs.logging import CsvFile
from rejeu.sb3.common.callbacks import CheckpointCallback, EvalCallback
from tests.full_disk import FullDisk
from tests.helpers import small_sac

BALL = "rejeu/Ball-v0"


@pytest.fixture
def disk(monkeypatch):
    return FullDisk(monkeypatch)


def full_between(disk, first, last=math.inf):
    """Returns a callback during which the disk is full from one step on to another."""

    def switch(agent, turn):
        disk.full = first <= turn.step < last

    return switch


def rows(path):
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(file))


def warned(record):
    return [str(one.message) for one in record]


def test_a_row_or_a_new_column_that_does_not_fit_leaves_no_part_of_it(tmp_path, disk):
    table = CsvFile(tmp_path / "table.csv")
    table.write(1, {"a": 1.5})
    before = table.path.read_bytes()
    for row in ({"a": 2.5}, {"a": 2.5, "b": 0.5}):
        disk.full = True
        with pytest.raises(OSError, match=r"table.csv could not be written: No space left on device") as error:
            table.write(2, row)
        assert error.value.errno == errno.ENOSPC
        assert table.path.read_bytes() == before
    disk.full = False
    table.write(2, {"a": 2.5, "b": 0.5})
    assert [list(row.values()) for row in rows(table.path)] == [["1", "1.5", ""], ["2", "2.5", "0.5"]]
    assert [path.name for path in tmp_path.iterdir()] == ["table.csv"]


def test_a_table_that_cannot_be_cut_on_resume_stays_whole_and_another_is_not_written(tmp_path, disk):
    path, other = tmp_path / "table.csv", CsvFile(tmp_path / "other.csv")
    path.write_bytes(b"step,a\r\n1,1.0\r\n2,2.0\r\n3,")
    other.write(1, {"a": 1.0})
    before = path.read_bytes()
    disk.full = True
    CsvFile(other.path, up_to=1)
    assert disk.failures == 0
    with pytest.raises(OSError, match=r"table.csv could not be written"):
        CsvFile(path, up_to=1)
    assert path.read_bytes() == before
    disk.full = False
    path.write_bytes(b"step,a\r\n1,1.0\r\n" + bytes(200_000) + b"\r\n")  # zeros that a power cut left
    CsvFile(path, up_to=10).write(2, {"a": 2.0})
    assert [row["step"] for row in rows(path)] == ["1", "2"]


def test_training_continues_while_the_disk_is_full_and_is_warned_of_once_a_file(tmp_path, disk):
    def learn(folder, *more):
        agent = small_sac(BALL)
        table = CsvFile(folder / "metrics.csv")
        agent.learn(100, [*more, Checkpoint(folder / "run", every=10)], log_interval=1, sinks=[table])
        return agent

    agents = [learn(tmp_path / "whole")]
    with pytest.warns(UserWarning, match="No space left") as record:
        agents.append(learn(tmp_path / "full", full_between(disk, 25, 85)))
    assert disk.failures > 4
    texts = sorted(warned(record))
    assert len(texts) == 2
    assert texts[0].startswith("checkpoints in")
    assert "the one before it is complete: " in texts[0]
    assert texts[1].startswith(f"rows of {tmp_path / 'full' / 'metrics.csv'}: ")
    assert agents[1].failed_writes.summary() == (
        f"not written (No space left on device): rows of {tmp_path / 'full' / 'metrics.csv'}"
    )
    assert rejeu.SAC.resume(tmp_path / "full" / "run").num_timesteps == 100
    steps = [[int(row["step"]) for row in rows(tmp_path / name / "metrics.csv")] for name in ("whole", "full")]
    assert steps[1] == [step for step in steps[0] if not 25 <= step < 85]
    one, two = (agent.get_parameters() for agent in agents)
    assert all(np.array_equal(one[key], two[key]) for key in one)


def test_the_best_model_is_written_late_as_it_was_when_it_was_the_best(tmp_path, disk):
    best = {}

    def report(result, is_best):
        if is_best:
            best.update(agent.get_parameters())

    evaluate = Evaluate(BALL, 20, episodes=1, best_path=tmp_path / "best", seed=0, report=report)
    evaluate.best = None
    agent = small_sac(BALL)
    with pytest.warns(UserWarning, match="best model"):
        agent.learn(110, [full_between(disk, 1, 101), evaluate])
    saved = rejeu.load(tmp_path / "best").get_parameters()
    assert all(np.array_equal(saved[key], best[key]) for key in best)
    assert not all(np.array_equal(saved[key], value) for key, value in agent.get_parameters().items())


@pytest.mark.filterwarnings(
    r"ignore:Exception ignored in. <function ZipFile\.__del__"
)  # NumPy 2.0 closes no file that is full
def test_hooks_that_cannot_write_do_not_end_training(tmp_path, disk):
    paths = {"log_path": tmp_path, "best_model_save_path": tmp_path}
    hooks = [
        CheckpointCallback(10, tmp_path, save_replay_buffer=True),
        EvalCallback(gym.make(BALL), n_eval_episodes=1, eval_freq=15, verbose=0, **paths),
    ]
    agent = small_sac(BALL)
    with pytest.warns(UserWarning, match="No space left") as record:
        agent.learn(40, [full_between(disk, 14, 25), *hooks])
    for name in ("rl_model_20_", "rl_model_replay", "evaluations.npz", "best_model"):
        assert name in str(warned(record))
    assert (tmp_path / "rl_model_30_steps.zip").exists()
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [15, 30]
    assert rejeu.load(tmp_path / "best_model")


def test_a_monitor_loses_the_rows_that_do_not_fit(tmp_path, disk):
    env = rejeu.Monitor(gym.make("CartPole-v1"), tmp_path / "run")
    with pytest.warns(UserWarning, match="No space left") as record:  # noqa: PT031
        for episode in range(4):
            disk.full = episode in (1, 2)
            env.reset(seed=episode)
            while not any(env.step(0)[2:4]):
                pass
        env.close()
    assert len(record) == 1
    lengths = env.get_episode_lengths()
    lines = env.path.read_text().splitlines()
    assert [int(line.split(",")[1]) for line in lines[2:]] == [lengths[0], lengths[3]]


def test_other_errors_of_a_write_are_raised():
    def write():
        raise TypeError("a defect")

    with warnings.catch_warnings(), pytest.raises(TypeError, match="a defect"):
        FailedWrites().attempt("the table", write)
