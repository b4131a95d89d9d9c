"""The trackers' own packages, offline: what they hold after a training run is what the CSV file holds.

To run them, in an environment of their own: ``pip install -e ".[wandb,mlflow,trackio,tensorboard,test]"`` and
``pytest tests/logs/test_trackers.py``. Without a package its test is skipped.
"""

import csv
import json
import math
import struct

import pytest

import rejeu
from rejeu.callbacks import Evaluate, RecordVideo
from rejeu.logs import trackers
from tests.helpers import small_sac

pytestmark = pytest.mark.filterwarnings("ignore", "error::UserWarning:rejeu")  # the packages' own warnings
BALL = "rejeu/Ball-v0"
NAMES = {
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "rollout/success_rate",
    "time/fps",
    "time/total_timesteps",
    "train/actor_loss",
    "train/critic_loss",
    "train/ent_coef",
    "train/ent_coef_loss",
    "train/learning_rate",
    "train/n_updates",
    "eval/mean_reward",
    "eval/mean_ep_length",
    "eval/success_rate",
}


@pytest.fixture(autouse=True)
def offline(tmp_path, monkeypatch):
    """Writes into a temporary folder, and reaches no network."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{(tmp_path / 'mlflow.db').as_posix()}")
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))  # read when trackio is imported
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    for name in ("WANDB_PROJECT", "MLFLOW_EXPERIMENT_NAME", "TRACKIO_SPACE_ID", "TRACKIO_SERVER_URL"):
        monkeypatch.delenv(name, raising=False)


def learn(*logs, video=False):
    """A short run with evaluations and, if asked for, a video; returns the agent, and its rows by step and name."""
    agent = small_sac(BALL, log=["csv", *logs])
    callbacks = [Evaluate(BALL, 50, episodes=2, seed=0)]
    if video:
        pytest.importorskip("imageio_ffmpeg")
        callbacks.append(RecordVideo("videos", 50, max_steps=5, seed=0))
    agent.learn(100, callbacks, log_interval=1)
    assert agent.failed_writes.summary() == ""
    with open("logs/SAC_1/progress.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    values = {
        (int(row["step"]), name): float(value)
        for row in rows
        for name, value in row.items()
        if value and name != "step"
    }
    assert {name for _, name in values} >= NAMES
    return agent, values


def assert_close(given, expected):
    assert given.keys() == expected.keys()
    for key, value in expected.items():
        assert given[key] == pytest.approx(value, rel=1e-6, nan_ok=True), key


def test_json_lines_hold_what_the_csv_file_holds():
    _, expected = learn("json")
    with open("logs/SAC_1/progress.json", encoding="utf-8") as file:
        rows = [json.loads(line) for line in file]
    assert_close({(row["step"], name): v for row in rows for name, v in row.items() if name != "step"}, expected)


def test_tensorboard_holds_what_the_csv_file_holds():
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    agent, expected = learn("tensorboard")
    events = accumulator.EventAccumulator("logs/SAC_1", size_guidance={"scalars": 0}).Reload()
    given = {(one.step, name): one.value for name in events.Tags()["scalars"] for one in events.Scalars(name)}
    assert_close(given, expected)
    (table,) = events.Tensors("config/text_summary")
    assert f"| learning_rate | {agent.config.learning_rate} |" in table.tensor_proto.string_val[0].decode()


def wandb_records(path):
    """The records of a file of W&B: a header of 7 bytes, then blocks of 32 KiB as in LevelDB's log."""
    from wandb.proto import wandb_internal_pb2

    content, at, parts = path.read_bytes(), 7, b""
    while at + 7 <= len(content):
        if 32768 - at % 32768 < 7:  # padding
            at += 32768 - at % 32768
            continue
        _, length, kind = struct.unpack("<IHB", content[at : at + 7])
        parts += content[at + 7 : at + 7 + length]
        at += 7 + length
        if kind in (1, 4):  # the whole, or the last part
            record = wandb_internal_pb2.Record()
            record.ParseFromString(parts)
            yield record
            parts = b""


def items_of(items):
    return {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items}


def test_weights_and_biases_holds_what_the_csv_file_holds(tmp_path):
    pytest.importorskip("wandb")
    agent, expected = learn("wandb", video=True)
    (path,) = tmp_path.glob("logs/SAC_1/wandb/offline-run-*/*.wandb")
    given, config, videos = {}, {}, []
    for record in wandb_records(path):
        kind = record.WhichOneof("record_type")
        if kind == "history":
            row = items_of(record.history.item)
            step = row["_step"]
            given |= {(step, name): value for name, value in row.items() if "/" in name and "video" not in name}
            videos += [step for name in row if name.startswith("video")]
        elif kind in ("run", "config"):
            config |= items_of((record.run.config if kind == "run" else record.config).update)
    assert_close({key: math.nan if value == "NaN" else value for key, value in given.items()}, expected)
    assert sorted(set(videos)) == [50, 100]
    assert config["learning_rate"] == agent.config.learning_rate
    assert (config["algorithm"], config["env_id"], config["seed"]) == ("SAC", BALL, agent.seed)
    assert path.stem == f"run-{agent.run_id}"


def test_mlflow_holds_what_the_csv_file_holds():
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    agent, expected = learn("mlflow", video=True)
    client = mlflow.MlflowClient()
    (run,) = client.search_runs([client.get_experiment_by_name("rejeu").experiment_id])
    given = {
        (one.step, name): one.value
        for name in run.data.metrics
        for one in client.get_metric_history(run.info.run_id, name)
    }
    assert_close(given, expected)
    assert (run.info.status, run.data.tags["rejeu.run_id"]) == ("FINISHED", agent.run_id)
    assert run.data.params["learning_rate"] == str(agent.config.learning_rate)
    assert run.data.params["policy_kwargs.net_arch"] == str(list(agent.config.policy_kwargs.net_arch))
    assert len(client.list_artifacts(run.info.run_id, "videos")) == 2


def test_a_run_that_is_resumed_continues_the_run_in_mlflow():
    mlflow = pytest.importorskip("mlflow")
    pytest.importorskip("sqlalchemy")
    agent, _ = learn("mlflow")
    agent.learn(50, reset_num_timesteps=False, log_interval=1)
    client = mlflow.MlflowClient()
    (run,) = client.search_runs([client.get_experiment_by_name("rejeu").experiment_id])
    steps = [one.step for one in client.get_metric_history(run.info.run_id, "time/total_timesteps")]
    assert max(steps) > 100
    assert steps == sorted(set(steps))
    agent.learn(50, log_interval=1)  # counts from 0, which is another run
    assert len(client.search_runs([client.get_experiment_by_name("rejeu").experiment_id])) == 2


def test_trackio_holds_what_the_csv_file_holds(tmp_path):
    pytest.importorskip("trackio")
    from trackio.sqlite_storage import SQLiteStorage

    agent, expected = learn("trackio", video=True)
    (run,) = SQLiteStorage.get_runs("rejeu")
    name = run["name"] if isinstance(run, dict) else run
    assert name.startswith(f"{BALL}-SAC-seed{agent.seed}-")
    rows = SQLiteStorage.get_logs("rejeu", name)
    given = {(row["step"], key): value for row in rows for key, value in row.items() if "/" in key}
    assert_close(given, expected)
    assert [row["step"] for row in rows if "video" in row] == [50, 100]
    assert SQLiteStorage.get_run_config("rejeu", name)["learning_rate"] == agent.config.learning_rate


def test_rows_configurations_and_videos_are_given_to_the_packages_as_they_document_them(monkeypatch):
    """Stand-ins that note the calls, where the packages are not installed: units, columns and how runs continue."""
    import sys
    import time
    from pathlib import Path
    from types import SimpleNamespace
    from unittest.mock import MagicMock

    monkeypatch.setattr(time, "time", lambda: 1234.5678)
    monkeypatch.delenv("WANDB_MODE")
    path = Path("video.mp4")
    packages = {name: MagicMock() for name in ("wandb", "mlflow", "trackio")}
    for name, package in packages.items():
        monkeypatch.setitem(sys.modules, name, package)
    entities = packages["mlflow"].entities
    entities.Metric = entities.Param = lambda *given: given

    for given, resume in (("r1", "allow"), (None, None)):
        wandb = trackers.WandB("one", given, Path("local"))
        wandb.write_config({"gamma": 0.9})
        wandb.write(7, {"a": 1.0})
        wandb.write_video(8, path)
        init = packages["wandb"].init
        assert (
            init.call_args.kwargs.items() >= {"project": "rejeu", "name": "one", "id": given, "resume": resume}.items()
        )
        init.return_value.config.update.assert_called_with({"gamma": 0.9}, allow_val_change=True)
        assert [one.kwargs["step"] for one in init.return_value.log.call_args_list[-2:]] == [7, 8]
        wandb.close()
    assert (init.call_count, init.return_value.finish.call_count) == (2, 2)
    assert init.call_args.kwargs["dir"] == Path("local")

    client = packages["mlflow"].MlflowClient.return_value
    client.search_runs.return_value = []
    client.create_run.return_value.info.run_id = "new"
    client.get_run.return_value.data.params = {"p0": "kept"}
    mlflow = trackers.MLflow("one", "r1")
    mlflow.write_config({f"p{i}": "x" * 600 for i in range(151)})
    batches = [one.kwargs["params"] for one in client.log_batch.call_args_list]
    assert [len(one) for one in batches] == [100, 50]
    assert (batches[0][0], batches[1][-1]) == (("p1", "x" * 500), ("p150", "x" * 500))
    mlflow.write(7, {"a": 1.0, "b": 2.0})
    client.log_batch.assert_called_with("new", metrics=[("a", 1.0, 1234567, 7), ("b", 2.0, 1234567, 7)])
    mlflow.write_video(8, path)
    client.log_artifact.assert_called_once_with("new", "video.mp4", "videos")
    mlflow.close()
    client.set_terminated.assert_called_once_with("new")
    assert client.create_run.call_args.kwargs == {"tags": {"rejeu.run_id": "r1"}, "run_name": "one"}
    client.search_runs.return_value = [SimpleNamespace(info=SimpleNamespace(run_id="earlier"))]
    trackers.MLflow("one", "r1").write(9, {})
    client.update_run.assert_called_once_with("earlier", status="RUNNING")
    assert client.log_batch.call_args.args == ("earlier",)

    for name, resume in (("one", "allow"), (None, "never")):
        trackio = trackers.Trackio(name)
        trackio.write_config({"policy_kwargs": {"net_arch": [8]}})
        trackio.write(7, {"a": 1.0})
        init = packages["trackio"].init
        assert init.call_args.args == ("rejeu", name)
        assert init.call_args.kwargs == {"config": {"policy_kwargs.net_arch": [8]}, "resume": resume, "embed": False}
        init.return_value.log.assert_called_with({"a": 1.0}, step=7)


def test_without_its_package_a_log_names_the_command_that_installs_it(monkeypatch):
    import sys

    for kind in ("wandb", "mlflow", "trackio"):
        monkeypatch.setitem(sys.modules, kind, None)
        agent = small_sac(BALL, log=kind)
        with pytest.raises(rejeu.core.errors.MissingExtra, match=rf'pip install "rejeu\[{kind}\]"'):
            agent.learn(10)
