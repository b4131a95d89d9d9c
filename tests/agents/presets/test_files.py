"""Presets as files, and the option ``--preset``."""

import dataclasses
import json
import sys

import pytest

import rejeu
from rejeu.agents import exporting, find_preset, presets
from rejeu.core.errors import CheckpointError
from rejeu.lab import cli, hub
from tests import hostile_files
from tests.core.test_schemas import FILES

SMALL = presets.Preset(
    env_id="CartPole-v1",
    algorithm="PPO",
    hyperparameters={"n_steps": 16, "learning_rate": "lin_1e-3", "policy_kwargs": {"net_arch": [8]}},
    n_envs=2,
    total_steps=64,
    evaluate_every=32,
    evaluate_episodes=2,
    backend="gymnasium",
    source="a test",
)


def test_what_is_written_is_read(tmp_path):
    assert presets.read(presets.write(SMALL, tmp_path / "a.json")) == SMALL
    for preset in presets.ALL:
        found = presets.read(presets.write(preset, tmp_path / "b.json"))
        assert json.dumps(dict(found.hyperparameters)) == json.dumps(dict(preset.hyperparameters))


def test_a_preset_needs_no_source_and_more_than_json_is_not_written(tmp_path):
    path = presets.write(SMALL, tmp_path / "preset.json")
    content = json.loads(path.read_text(encoding="utf-8"))
    del content["source"]
    path.write_text(json.dumps(content), encoding="utf-8")
    assert presets.read(path).source == ""
    own = dataclasses.replace(SMALL, hyperparameters={"learning_rate": lambda progress: progress})
    with pytest.raises(TypeError, match="hyperparameters that a file cannot hold"):
        presets.write(own, tmp_path / "a.json")
    assert not (tmp_path / "a.json").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "it is not valid JSON"),
        ("[]", "expected `object`"),
        ("{}", "missing required field"),
        ({"n_envs": 0}, "n_envs=0: expected `int` >= 1"),
        ({"n_envs": 10**9}, "expected `int` <= 4096"),
        ({"backend": "os.system"}, "backend='os.system'"),
        ({"hyperparameters": []}, "expected `object`"),
        ("x" * 2**21, "more than 1,048,576 bytes"),
    ],
)
def test_a_file_that_is_no_preset_is_one_line(tmp_path, content, message):
    path = tmp_path / "preset.json"
    if isinstance(content, dict):
        fields = {**vars(SMALL), "hyperparameters": dict(SMALL.hyperparameters), **content}
        content = json.dumps(fields)
    path.write_text(content, encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"preset\.json is no preset: .*") as error:
        presets.read(path)
    assert message in str(error.value)


@pytest.mark.usefixtures("untrained")
def test_train_takes_the_preset_of_a_file(tmp_path):
    path = presets.write(SMALL, tmp_path / "preset.json")
    out = tmp_path / "run"
    command = ["train", "CartPole-v1", "--preset", str(path), "--seed", "0", "--out", str(out)]
    assert cli.main([*command, "--set", "gamma=0.9", "--no-video", "--no-report", "--checkpoint-minutes", "0"]) == 0
    config = json.loads((out / "config.json").read_text(encoding="utf-8"))
    assert (config["algorithm"], config["n_envs"], config["steps"]) == ("PPO", 2, 64)
    assert (config["hyperparameters"]["n_steps"], config["hyperparameters"]["gamma"]) == (16, 0.9)


@pytest.mark.usefixtures("untrained")
@pytest.mark.filterwarnings("default")
def test_a_preset_of_another_environment_is_used_with_a_warning(tmp_path, capsys):
    path = presets.write(dataclasses.replace(SMALL, env_id="Acrobot-v1", algorithm="PPO"), tmp_path / "preset.json")
    command = ["train", "CartPole-v1", "--preset", str(path), "--out", str(tmp_path / "run"), "--steps", "32"]
    assert cli.main([*command, "--no-video", "--no-report"]) == 0
    assert "was made for Acrobot-v1" in capsys.readouterr().err


def test_the_id_of_a_file_imports_nothing(tmp_path, monkeypatch):
    """Gymnasium imports what an id names before a colon."""
    (tmp_path / "imported_by_a_file.py").write_text("raise AssertionError('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    own = dataclasses.replace(SMALL, env_id="imported_by_a_file:Walk-v0")
    path = presets.write(own, tmp_path / "preset.json")
    with pytest.warns(UserWarning, match="was made for imported_by_a_file"):
        assert find_preset("CartPole-v1", None, str(path)).env_id == own.env_id
    named = {"env_id": own.env_id, "made_from": {"env_id": own.env_id, "env_kwargs": {}}}
    recorded = (FILES / "sac.safetensors").read_bytes()
    content = hostile_files.changed(recorded, lambda header, arrays: header.update(named))
    (tmp_path / "model.safetensors").write_bytes(content)
    agent = rejeu.load(tmp_path / "model.safetensors")
    assert own.env_id not in hub.card(agent, "me/model", tmp_path / "model.safetensors", set())
    exporting.environment(agent, None)
    with pytest.raises(ValueError, match="environment"):
        agent.evaluate(1)
    assert "imported_by_a_file" not in sys.modules
