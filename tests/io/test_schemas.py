"""Files of every schema that was ever written are read, and hold what they held."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rejeu
from rejeu.buffers.ring import COUNTERS
from rejeu.errors import CheckpointError
from rejeu.io import checkpoint
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from tests.environments import Counter
from tests.golden import record_files

GOLDEN = Path(record_files.__file__).parent
FOLDERS = [GOLDEN / f"schema{n}" for n in range(1, checkpoint.SCHEMA + 1)]
WITHOUT_COUNTERS = GOLDEN / "replay_without_counters"
MODELS = ("sac", "td3", "dqn", "ppo")


@pytest.fixture(params=FOLDERS, ids=lambda path: path.name)
def folder(request):
    """A folder of recorded files."""
    return request.param


def recorded(folder):
    with np.load(folder / "expected.npz") as file:
        return dict(file)


def test_there_are_files_of_every_schema():
    assert sorted(path.name for path in GOLDEN.glob("schema*")) == [path.name for path in FOLDERS]


@pytest.mark.parametrize("name", MODELS)
def test_a_model_holds_what_it_held_and_predicts_what_it_predicted(folder, name):
    expected = recorded(folder)
    agent = rejeu.load(folder / f"{name}.safetensors")
    np.testing.assert_array_equal(record_files.flat(agent), expected[f"{name}.parameters"])
    predictions = agent.predict(record_files.observations(name), deterministic=True)[0]
    np.testing.assert_allclose(predictions, expected[f"{name}.predictions"], rtol=1e-4, atol=1e-6)


def test_a_replay_buffer_holds_what_it_held(folder):
    expected = recorded(folder)
    agent = record_files.replay_agent()
    agent.load_replay_buffer(folder / "replay.safetensors")
    assert agent.replay_buffer.size() == 23
    arrays = agent.replay_buffer.arrays()
    counters = {f"replay.{name}" for name in COUNTERS}
    assert {f"replay.{name}" for name in arrays} | counters == {name for name in expected if name.startswith("replay.")}
    for name, value in arrays.items():
        np.testing.assert_array_equal(value, expected[f"replay.{name}"], err_msg=name)


def test_the_counters_in_older_replay_files_are_those_that_are_counted_now(folder):
    expected = recorded(folder)
    agent = record_files.replay_agent("episode")
    agent.load_replay_buffer(folder / "replay.safetensors")
    for name, value in record_files.kept_counters(agent).items():
        np.testing.assert_array_equal(value, expected[f"replay.{name}"][0], err_msg=name)


def test_a_replay_file_without_counters_holds_what_it_held():
    expected = recorded(WITHOUT_COUNTERS)
    agent = record_files.replay_agent("episode")
    agent.load_replay_buffer(WITHOUT_COUNTERS / "replay.safetensors")
    found = agent.replay_buffer.arrays()
    assert agent.replay_buffer.ring.oldest() > 0
    assert {*COUNTERS}.isdisjoint(checkpoint.read(WITHOUT_COUNTERS / "replay.safetensors", "replay")[1])
    found |= record_files.kept_counters(agent)
    assert found.keys() == expected.keys()
    for name, value in found.items():
        np.testing.assert_array_equal(value, expected[name], err_msg=name)


def test_the_statistics_of_a_wrapper_are_what_they_were(folder):
    expected = recorded(folder)
    env = VecNormalize.load(folder / "vec_normalize.safetensors", DummyVecEnv([lambda: Counter((5,))]))
    assert (env.clip_obs, env.clip_reward, env.norm_obs_keys) == (7.0, 10.0, None)
    for key, moments in (("obs", env.obs_rms), ("returns", env.ret_rms)):
        for part in ("mean", "var", "count"):
            np.testing.assert_array_equal(getattr(moments, part), expected[f"vec_normalize.{key}.{part}"])


def test_every_older_schema_has_a_way_to_the_present_one():
    assert sorted(checkpoint.MIGRATIONS) == list(range(1, checkpoint.SCHEMA))
    for schema, migrate in checkpoint.MIGRATIONS.items():
        before = {"schema": schema, "kind": "agent"}
        assert migrate(before)["schema"] == schema + 1
        assert before == {"schema": schema, "kind": "agent"}


def test_headers_pass_through_every_schema_in_turn(tmp_path, monkeypatch):
    path = checkpoint.write(tmp_path / "old", "rows", {"a": np.arange(3)}, {"rows": 3})
    steps = {
        2: lambda header: {**header, "schema": 3, "n_rows": header["rows"]},
        3: lambda header: {**header, "schema": 4, "n_rows": header["n_rows"] + 1},
    }
    monkeypatch.setattr(checkpoint, "MIGRATIONS", steps)
    monkeypatch.setattr(checkpoint, "SCHEMA", 4)
    header, arrays = checkpoint.read(path, "rows")
    assert header == checkpoint.read_header(path, "rows") == {"schema": 4, "kind": "rows", "rows": 3, "n_rows": 4}
    assert arrays["a"].tolist() == [0, 1, 2]


def test_an_old_header_that_cannot_be_brought_up_to_date_is_damaged(tmp_path, monkeypatch):
    path = checkpoint.write(tmp_path / "old", "rows", {}, {})
    monkeypatch.setattr(checkpoint, "MIGRATIONS", {2: lambda header: {**header, "schema": 3, "n_rows": header["rows"]}})
    monkeypatch.setattr(checkpoint, "SCHEMA", 3)
    with pytest.raises(CheckpointError, match="the header of schema 2 is damaged: 'rows'"):
        checkpoint.read(path, "rows")
