"""Where rows of statistics go, and what happens if they cannot be written there."""

import csv
import json
import math
import os
import re
import threading
import warnings
from pathlib import Path

import pytest

import rejeu
from rejeu.callbacks import Evaluate
from rejeu.logs import logging
from rejeu.logs.logging import CsvFile, JsonLines
from tests.helpers import small_sac
from tests.tiers import exhaustive

BALL = "rejeu/Ball-v0"
ROOT = Path(__file__).parents[2]


def lines(path):
    return [json.loads(line) for line in Path(path).read_text(encoding="utf-8").splitlines()]


def test_numbers_that_json_does_not_have_are_null(tmp_path):
    log = JsonLines(tmp_path / "rows.json")
    log.write(1, {"a": math.nan, "b": -math.inf, "c": 2})
    assert lines(log.path) == [{"step": 1, "a": None, "b": None, "c": 2}]


def test_json_lines_that_are_continued_keep_the_complete_rows_up_to_a_step(tmp_path):
    path = tmp_path / "rows.json"
    path.write_bytes(b'{"step": 1}\n[' + b"[" * 100_000 + b'\n7\n{"step": "x"}\n{"step": 2}\n{"step": 3}\n{"step": 2')
    JsonLines(path, up_to=2).write(3, {"a": 1.0})
    assert lines(path) == [{"step": 1}, {"step": 2}, {"step": 3, "a": 1.0}]


def test_rows_that_add_columns_leave_empty_cells_in_the_rows_before_them(tmp_path):
    log = CsvFile(tmp_path / "rows.csv")
    for step, row in ((1, {"a": 1.0}), (2, {"c": 2.0, "b": 3.0, "d": 4.0}), (3, {"d": 5.0, "a": 6.0})):
        log.write(step, row)
    assert log.path.read_text(encoding="utf-8").splitlines() == [
        "step,a,c,b,d",
        "1,1.0,,,",
        "2,,2.0,3.0,4.0",
        "3,6.0,,,5.0",
    ]


@pytest.mark.parametrize(
    "content",
    [b"stfp,a\r\n1,2\r\n", b"2" * 200_000 + b"\r\n1,2\r\n", b'"step,a\r\n1,2\r\n'],
    ids=["no step", "a long name", "a quote that does not end"],
)
def test_a_table_that_cannot_be_continued_is_kept_under_another_name(tmp_path, content):
    path = tmp_path / "metrics.csv"
    path.write_bytes(content)
    with pytest.warns(UserWarning, match=r"metrics.csv is damaged and is now metrics.csv.damaged; a new table begins"):
        CsvFile(path, up_to=10).write(11, {"a": 1.0})
    assert (tmp_path / "metrics.csv.damaged").read_bytes() == content
    assert path.read_text().splitlines() == ["step,a", "11,1.0"]


def test_damaged_rows_of_a_table_are_left_out_when_it_is_continued(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_bytes("step,a\r\n1,2\r\n²,3\r\n".encode() + b"2,\xff\r\n" + b"9" * 5000 + b",4\r\n3\r\n4,5,6\r\n5,7\r\n")
    CsvFile(path, up_to=10)
    assert path.read_text(encoding="utf-8").splitlines() == ["step,a", "1,2", "5,7"]


@pytest.mark.parametrize("log", [CsvFile, JsonLines])
def test_a_log_larger_than_any_is_not_read(tmp_path, log, monkeypatch):
    monkeypatch.setattr("rejeu.logs.logging.MAX_LOG_BYTES", 2**20)
    path = tmp_path / "metrics"
    path.touch()
    os.truncate(path, 2**40)
    with pytest.raises(OSError, match="metrics has more than 0 GiB; move it away, and a new one begins"):
        log(path, up_to=10)
    assert path.stat().st_size == 2**40


def test_each_learn_writes_the_logs_into_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent = small_sac(BALL, log=("csv", "json"))
    agent.learn(40, log_interval=1).learn(40, log_interval=1, tb_log_name="again")
    assert sorted(path.as_posix() for path in Path("logs").rglob("*.*")) == [
        "logs/SAC_1/progress.csv",
        "logs/SAC_1/progress.json",
        "logs/again_1/progress.csv",
        "logs/again_1/progress.json",
    ]
    with open("logs/SAC_1/progress.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["time/total_timesteps"]) for row in rows] == [
        row["step"] for row in lines("logs/SAC_1/progress.json")
    ]
    agent.save("model")
    assert rejeu.load("model").log == ()
    assert rejeu.SAC.load("model", log="csv").log == ("csv",)


def test_evaluations_are_rows_under_the_names_of_stable_baselines3(tmp_path):
    log = JsonLines(tmp_path / "rows.json")
    evaluate = Evaluate(BALL, 20, episodes=2, seed=0)
    small_sac(BALL).learn(40, evaluate, log_interval=10**6, sinks=[log])
    assert lines(log.path) == [
        {
            "step": step,
            "eval/mean_reward": result.mean_return,
            "eval/mean_ep_length": result.mean_length,
            "eval/success_rate": result.success_rate,
        }
        for step, result in evaluate.results
    ]


@exhaustive
def test_every_name_in_the_log_is_documented():
    text = (ROOT / "docs" / "logging.md").read_text(encoding="utf-8")
    documented = set(re.findall(r"`((?:rollout|time|train|eval)/[a-z_]+)`", text))
    common = {"verbose": 0, "seed": 0}
    agents = [
        small_sac(BALL),
        rejeu.DQN("MlpPolicy", "CartPole-v1", learning_starts=8, policy_kwargs={"net_arch": [8]}, **common),
        rejeu.PPO("MlpPolicy", BALL, n_steps=32, batch_size=16, n_epochs=1, policy_kwargs={"net_arch": [8]}, **common),
        rejeu.A2C("MlpPolicy", BALL, policy_kwargs={"net_arch": [8]}, **common),
    ]
    logged = {"eval/mean_reward", "eval/mean_ep_length", "eval/success_rate", "train/skipped_updates"}
    for agent in agents:
        logged |= agent.learn(64).statistics().keys()
    assert logged == documented


# Trackers that fail. The real ones are in test_trackers.py.


class Fake:
    """A tracker that fails as it is told."""

    def __init__(self, fails=lambda n: False):
        self.fails, self.calls, self.rows, self.closed = fails, 0, [], 0

    def __str__(self):
        return "the tracker"

    def __call__(self, *arguments):
        return self

    def write(self, step, metrics):
        self.calls += 1
        if self.fails(self.calls):
            raise ConnectionResetError("no route to host")
        self.rows.append(step)

    def write_config(self, config):
        self.config = config

    def write_video(self, step, path):
        pass

    def close(self):
        self.closed += 1


def learn(monkeypatch, fake, steps=60):
    """Trains with this tracker in the place of W&B; returns the agent and the warnings."""
    monkeypatch.setattr(rejeu.agents.training, "open_log", lambda *arguments: fake)
    monkeypatch.setattr(
        rejeu.agents.training,
        "guarded",
        lambda sink, failed, closes=False: logging.GuardedSink(sink, failed, closes, in_background=True),
    )
    agent = small_sac(BALL, log="wandb")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        agent.learn(steps, log_interval=1)
    return agent, [str(one.message) for one in caught]


def test_a_tracker_gets_the_configuration_and_every_row_and_is_closed(monkeypatch):
    fake = Fake()
    agent, said = learn(monkeypatch, fake)
    assert said == []
    assert fake.rows == sorted(set(agent.history["step"].astype(int).tolist()))
    assert (fake.config["algorithm"], fake.config["env_id"], fake.config["batch_size"]) == ("SAC", BALL, 4)
    assert fake.config["total_timesteps"] == 60
    assert fake.closed == 1


def test_a_tracker_that_fails_does_not_end_training_and_is_warned_of_once(monkeypatch):
    agent, said = learn(monkeypatch, Fake(lambda n: True))
    assert agent.num_timesteps == 60
    assert said == [
        "rows of the tracker: ConnectionResetError: no route to host; it is not written, and the rest continues"
    ]
    assert agent.failed_writes.summary() == (
        "not written (ConnectionResetError: no route to host): rows of the tracker"
    )


def test_rows_after_those_that_failed_are_written(monkeypatch):
    fake = Fake(lambda n: n < 3)
    agent, _ = learn(monkeypatch, fake)
    assert fake.rows == sorted(set(agent.history["step"].astype(int).tolist()))[2:]
    assert not agent.failed_writes.complete
    assert fake.closed == 1


def test_a_tracker_that_hangs_delays_neither_training_nor_its_end(monkeypatch):
    monkeypatch.setattr(logging, "CLOSE_SECONDS", 0.1)
    release = threading.Event()
    fake = Fake(lambda n: not release.wait(30))
    agent, said = learn(monkeypatch, fake)
    release.set()
    assert agent.num_timesteps == 60
    assert said[-1].startswith("rows of the tracker: TimeoutError: not done 0 seconds after the end of training; ")


def test_of_too_many_rows_the_first_wait_and_the_loss_is_reported(monkeypatch):
    monkeypatch.setattr(logging, "MAX_ROWS", 3)
    failed, fake, release = rejeu.core.failed_writes.FailedWrites(), Fake(), threading.Event()
    fake.fails = lambda n: not release.wait(30)
    log = logging.GuardedSink(fake, failed, in_background=True)
    with pytest.warns(UserWarning, match="3 rows wait, and no more can"):  # noqa: PT031
        for step in range(10):
            log.write(step, {})
    release.set()
    log.close()
    assert fake.rows[:3] == [0, 1, 2]
    assert len(fake.rows) in (3, 4)  # the first may be under way already
    assert not failed.complete
