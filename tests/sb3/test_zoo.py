"""Files that others trained: RL Zoo's folders, the files beside a model, and the forms of older versions."""

import json
import pickle
import shutil
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.agents.zoo import model_in, notes_beside, read_yaml, statistics_beside
from rejeu.checkpoints.pickled import parse, tensors_of
from rejeu.core.errors import CheckpointError
from rejeu.core.records import Malformed
from rejeu.lab.cli import main
from rejeu.sb3 import algorithms, load_zip
from rejeu.sb3.common.env_util import make_vec_env
from rejeu.sb3.common.vec_env import VecNormalize
from tests.tiers import exhaustive
from tests.torch_files import (
    Tensor,
    changed,
    members_of,
    old_torch_file,
    serialized,
    torch_file,
    vecnormalize_file,
    zipped,
)

pytestmark = pytest.mark.usefixtures("learners_are_shared")

FOLDER = Path(__file__).parents[1] / "data" / "sb3"
ZOO = Path(__file__).parents[2].parent / "shared" / "data" / "zoo"
"""Eighteen folders of RL Zoo's public collection."""
PPO = (FOLDER / "ppo-normalized.zip").read_bytes()
SCALER = FOLDER / "ppo-normalized.pkl"
PENDULUM = {
    "observation_space": serialized(gym.spaces.Box(-8, 8, (3,), np.float32)),
    "action_space": serialized(gym.spaces.Box(-2, 2, (1,), np.float32)),
}
CONFIG = """!!python/object/apply:collections.OrderedDict
- - - env_wrapper
    - - sb3_contrib.common.wrappers.TimeFeatureWrapper
      - my_package.Wrapper:
          scale: 2
  - - frame_stack
    - 4
  - - learning_rate
    - lin_0.001
  - - normalize
    - true
  - - train_freq
    - !!python/tuple
      - 1
      - episode
"""
ARGS = """!!python/object/apply:collections.OrderedDict
- - - algo
    - a2c
  - - env
    - Walk-v3
  - - env_kwargs
    - gravity: 3
"""


def ars(weights, **changes):
    """Returns a file of ARS with these arrays."""
    members = members_of(
        changed(PPO, {**PENDULUM, "n_delta": 4, "policy_kwargs": {}, "learning_rate": 0.02, **changes})
    )
    data = {key: value for key, value in json.loads(members["data"]).items() if key != "clip_range"}
    policy = torch_file({key: Tensor(value) for key, value in weights.items()})
    kept = {"data": json.dumps(data).encode(), "policy.pth": policy, "pytorch_variables.pth": torch_file({})}
    return zipped(kept)


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", ["action_net.weight", "action_net.0.weight"])
def test_a_linear_policy_of_ars_clips_actions_in_the_unit_of_the_environment(name, tmp_path):
    weight = np.array([[1.5, -2.0, 0.25]])
    agent = load_zip(write(tmp_path / "model.zip", ars({name: weight})))
    obs = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    found = agent.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(found, np.clip(obs @ weight.T, -2, 2), atol=1e-6)
    assert (agent.name, agent.config.n_delta, agent.config.learning_rate) == ("ARS", 4, 0.02)


def test_a_policy_of_ars_with_hidden_layers_squashes_actions(tmp_path):
    rng = np.random.default_rng(0)
    shapes = {"0.weight": (5, 3), "0.bias": (5,), "2.weight": (1, 5), "2.bias": (1,)}
    weights = {f"action_net.{key}": rng.normal(size=shape) for key, shape in shapes.items()}
    agent = load_zip(write(tmp_path / "model.zip", ars(weights, policy_kwargs={"net_arch": [5]})))
    obs = rng.normal(size=(50, 3)).astype(np.float32)
    hidden = np.maximum(obs @ weights["action_net.0.weight"].T + weights["action_net.0.bias"], 0)
    expected = 2 * np.tanh(hidden @ weights["action_net.2.weight"].T + weights["action_net.2.bias"])
    # ARS has ReLU by default there; rejeu's default is read from the file's policy_kwargs, where it is given.
    np.testing.assert_allclose(agent.predict(obs, deterministic=True)[0], expected, atol=1e-5)
    with pytest.raises(CheckpointError, match="squashed behind a linear policy, or clipped behind hidden layers"):
        load_zip(write(tmp_path / "b.zip", ars(weights, policy_kwargs={"squash_output": False})))


def test_files_of_pytorch_before_1_6_are_read():
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.ones(2)}
    found = tensors_of(old_torch_file({key: Tensor(value) for key, value in arrays.items()} | {"step": 3}))
    assert found.pop("step") == 3
    for key, value in arrays.items():
        np.testing.assert_array_equal(found[key], value.astype(np.float32))
    with pytest.raises(Malformed, match="expected one of Float"):
        tensors_of(old_torch_file({"a": Tensor([1])}, "ComplexFloatStorage"))


def test_the_optimizer_of_an_old_file_names_parameters_by_large_numbers(tmp_path):
    """``policy.pth`` and the temperature, ``tensors.pth``, are of PyTorch before 1.6."""
    members = members_of((FOLDER / "sac-sde.zip").read_bytes())
    weights = tensors_of(members["policy.pth"])
    old = {"policy.pth": old_torch_file({key: Tensor(value) for key, value in weights.items()})}
    state = tensors_of(members["actor.optimizer.pth"])
    moments = {
        7000 + i: {key: Tensor(value) if np.ndim(value) else int(value) for key, value in one.items()}
        for i, one in state["state"].items()
    }
    group = {"params": [7000 + i for i in state["param_groups"][0]["params"]], "lr": 1e-3}
    old["actor.optimizer.pth"] = old_torch_file({"state": moments, "param_groups": [group]})
    path = write(tmp_path / "model.zip", zipped({**members, **old}))
    agent, expected = load_zip(path), load_zip(FOLDER / "sac-sde.zip")
    for key, value in expected.get_parameters().items():
        np.testing.assert_array_equal(agent.get_parameters()[key], value, err_msg=key)
    assert agent.notes == []


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_a_set_is_data(protocol):
    assert parse(pickle.dumps({"keys": {"a"}, "more": [frozenset({"b"})]}, protocol)) in (
        {"keys": ["a"], "more": [("b",)]},
        {"keys": ["a"], "more": [["b"]]},
    )


@pytest.mark.parametrize(("rate", "note"), [(-9.6e-7, "had ended at 0"), (0.0, "had ended at 0"), (3e-4, None)])
def test_a_learning_rate_that_ended_below_0_is_0(rate, note, tmp_path):
    path = write(tmp_path / "model.zip", changed(PPO, {"learning_rate": rate}))
    agent = load_zip(path)
    assert agent.config.learning_rate == max(rate, 0)
    assert [one for one in agent.notes if "learning_rate" in one] == [
        one for one in agent.notes if note is not None and note in one
    ]
    replaced = load_zip(path, learning_rate=1e-3)
    assert replaced.config.learning_rate == 1e-3
    assert replaced.notes == []


@pytest.mark.parametrize("name", ["model/vecnormalize.pkl", "vecnormalize.pkl", "vec_normalize.pkl"])
def test_statistics_beside_a_model_are_used_and_named(name, tmp_path):
    path, scaler = write(tmp_path / "model.zip", PPO), write(tmp_path / name, SCALER.read_bytes())
    agent, expected = load_zip(path), load_zip(path, vecnormalize=SCALER)
    obs = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        agent.predict(obs, deterministic=True)[0], expected.predict(obs, deterministic=True)[0]
    )
    assert str(scaler) in agent.notes[0]
    assert load_zip(path, vecnormalize=False).config.normalize is None
    with pytest.warns(UserWarning, match=r"vec_?normalize.pkl lies beside the model.*VecNormalize.load"):
        found = algorithms.PPO.load(path)
    assert found.config.normalize is None


def test_statistics_belong_to_a_model_by_name(tmp_path):
    names = ["a/rl_model_1000_steps.zip", "a/rl_model_2000_steps.zip", "b/x_1/best_model.zip", "c/model.zip"]
    paths = [write(tmp_path / name, b"") for name in names]
    first = write(tmp_path / "a/rl_model_vecnormalize_1000_steps.pkl", b"")
    last = write(tmp_path / "b/x_1/x/vecnormalize.pkl", b"")
    write(tmp_path / "c/model_replay_buffer.pkl", b"")
    assert [statistics_beside(path) for path in paths] == [first, None, last, None]
    assert notes_beside(paths[3], None) == ["not read: model_replay_buffer.pkl"]


def test_the_original_statistics_load_into_the_wrapper(tmp_path):
    path = write(
        tmp_path / "vecnormalize.pkl", vecnormalize_file((np.arange(3.0), np.full(3, 2.0), 50.0), clip_obs=5.0)
    )
    env = VecNormalize.load(path, make_vec_env("Pendulum-v1"))
    np.testing.assert_array_equal(env.obs_rms.mean, np.arange(3.0))
    assert (env.obs_rms.count, env.ret_rms.var, env.clip_obs) == (50.0, 4.0, 5.0)
    with pytest.raises(CheckpointError, match=r"obs\.mean is float64\[3\], expected float64\[4\]"):
        VecNormalize.load(path, make_vec_env("CartPole-v1"))


@pytest.mark.parametrize(
    ("obs_rms", "message"),
    [
        ((np.zeros(4), np.array([1, 1, -1.0, 1]), 5.0), "negative variances"),
        ((np.zeros(4), np.array([1, 1, np.nan, 1]), 5.0), "not finite"),
        ((np.full(4, 1e300), np.ones(4), 5.0), "larger than float32"),
        ((np.zeros(4), np.ones(4), -5.0), "negative variances or counts"),
        ((np.zeros(3), np.ones(3), 5.0), "expected \\[4\\]"),
    ],
)
def test_statistics_that_cannot_be_are_refused(obs_rms, message, tmp_path):
    path = write(tmp_path / "vecnormalize.pkl", vecnormalize_file(obs_rms))
    with pytest.raises(CheckpointError, match=message):
        load_zip(write(tmp_path / "model.zip", PPO))
    if "expected" not in message and "float32" not in message:
        with pytest.raises(CheckpointError, match=r"negative values|not finite"):
            VecNormalize.load(path, make_vec_env("CartPole-v1"))


def test_goals_keep_statistics_of_their_own(tmp_path):
    """Against the same numbers normalized by hand; ``obs_keys`` is a set, as in Stable-Baselines3 1.1."""
    rng = np.random.default_rng(0)
    keys = ("achieved_goal", "desired_goal", "observation")
    rms = {key: (rng.normal(size=2), rng.uniform(0.5, 2, 2), 100.0) for key in keys}
    path = write(tmp_path / "sac-her.zip", (FOLDER / "sac-her.zip").read_bytes())
    plain = load_zip(path)
    write(tmp_path / "vecnormalize.pkl", vecnormalize_file(rms, protocol=3, obs_keys={*keys}, norm_obs_keys=None))
    agent = load_zip(path)
    obs = {key: rng.normal(size=(30, 2)).astype(np.float32) for key in keys}
    scaled = {key: ((obs[key] - m) / np.sqrt(v + 1e-8)).astype(np.float32) for key, (m, v, _) in rms.items()}
    expected = plain.predict(scaled, deterministic=True)[0]
    np.testing.assert_allclose(agent.predict(obs, deterministic=True)[0], expected, atol=1e-5)
    policy = rejeu.load_policy(agent.save(tmp_path / "agent"))
    np.testing.assert_allclose(policy.predict(obs)[0], expected, atol=1e-5)


def test_her_as_an_algorithm_takes_the_parts_of_an_observation(tmp_path):
    """Before Stable-Baselines3 1.1 its policy took observation and desired goal in one array."""
    last = {key: np.zeros((1, 2), np.float32) for key in ("observation", "achieved_goal", "desired_goal")}
    content = (FOLDER / "sac-sde.zip").read_bytes()
    data = {"goal_selection_strategy": "future", "n_sampled_goal": 4, "_last_obs": serialized(last)}
    plain = load_zip(write(tmp_path / "plain.zip", content))
    agent = load_zip(write(tmp_path / "her.zip", changed(content, data)))
    obs = {key: np.random.default_rng(0).normal(size=(9, 2)).astype(np.float32) for key in last}
    joined = np.concatenate([obs["observation"], obs["desired_goal"]], axis=-1)
    expected = plain.predict(joined, deterministic=True)[0]
    np.testing.assert_allclose(agent.predict(obs, deterministic=True)[0], expected, atol=1e-6)
    assert agent.config.replay_buffer_class == "HerReplayBuffer"
    assert agent.config.hindsight.n_sampled_goal == 4


def test_a_folder_of_rl_zoo_is_imported_with_what_lies_in_it(tmp_path, capsys):
    pytest.importorskip("yaml")
    folder = tmp_path / "Walk-v3_1"
    for name in ("Walk-v3", "best_model", "rl_model_100_steps"):
        write(folder / f"{name}.zip", PPO)
    write(folder / "Walk-v3" / "config.yml", CONFIG)
    write(folder / "Walk-v3" / "args.yml", ARGS)
    assert main(["import", str(folder)]) == 0
    found = capsys.readouterr().out
    for part in (
        "trained on Walk-v3 with {'gravity': 3}",
        "my_package.Wrapper",
        "--wrapper rejeu.sb3_contrib.common.wrappers:TimeFeatureWrapper",
        "stacks of 4 frames",
        "--set learning_rate=lin_0.001",
        "trained behind VecNormalize, whose file is missing",
    ):
        assert part in found
    assert rejeu.load(folder / "Walk-v3.safetensors").name == "PPO"
    shutil.copy(SCALER, folder / "Walk-v3" / "vecnormalize.pkl")
    assert main(["import", str(folder), "--which", "best"]) == 0
    assert "normalized by" in capsys.readouterr().out
    assert rejeu.load(folder / "best_model.safetensors").config.normalize is not None
    assert main(["import", str(folder), "--vecnormalize", "none", "--out", str(tmp_path / "x")]) == 0
    (folder / "Walk-v3.zip").unlink()
    with pytest.raises(FileNotFoundError, match=r"0 files that could be the last model.*holds best_model.zip"):
        model_in(folder, "last")


@pytest.mark.parametrize(
    "text",
    [
        "!!python/object/apply:os.system ['echo']",
        "!!python/name:os.system",
        "!!python/object/new:os.mkdir [x]",
        "a: &c0 [x, x]\n" + "".join(f"c{i}: &c{i} [*c{i - 1}, *c{i - 1}]\n" for i in range(1, 99)),
        pytest.param("[" * 20_000, id="deep"),
        pytest.param("x" * 70_000, id="long"),
        "- [1, 2",
        "? [a]\n: 1",
        "!!python/object/apply:collections.OrderedDict\n- - - [a]\n    - 1",
        "\x00",
    ],
)  # fmt: skip
def test_yaml_that_is_hostile_or_damaged_is_one_note(text, tmp_path):
    pytest.importorskip("yaml")
    path = write(tmp_path / "config.yml", text)
    (note,) = notes_beside(tmp_path / "model.zip", None)
    assert note.startswith(f"{path} is not read: ")
    assert "\n" not in note


def test_yaml_of_rl_zoo_is_data(tmp_path):
    pytest.importorskip("yaml")
    found = read_yaml(write(tmp_path / "config.yml", CONFIG))
    assert (found["train_freq"], found["frame_stack"]) == ([1, "episode"], 4)


def test_a_missing_time_feature_is_named(tmp_path):
    low, high = np.array([-np.inf, -np.inf, -np.inf, 0], np.float32), np.array([np.inf, np.inf, np.inf, 1], np.float32)
    data = {"observation_space": serialized(gym.spaces.Box(low, high))}
    content = changed(PPO, {**data, "action_space": PENDULUM["action_space"]})
    with pytest.raises(CheckpointError, match=r"--wrapper rejeu\.sb3_contrib\.common\.wrappers:TimeFeatureWrapper"):
        load_zip(write(tmp_path / "model.zip", content), env="Pendulum-v1")


@exhaustive
def test_a_policy_in_which_large_numbers_cancel_is_exported(tmp_path):
    """Products of 5,000 in float32 that cancel differ by 1e-3 in another order, which is no fault of the file."""
    pytest.importorskip("onnxruntime")
    weight = np.random.default_rng(0).normal(size=(1, 64)) * 5000
    space = {"observation_space": serialized(gym.spaces.Box(-8, 8, (64,), np.float32))}
    agent = load_zip(write(tmp_path / "model.zip", ars({"action_net.weight": weight}, **space)))
    found = agent.export(tmp_path / "policy.onnx").check
    assert found.difference <= found.allowed


@pytest.mark.parametrize(
    ("changes", "error"), [({"learning_rat": 1e-3}, TypeError), ({"learning_rate": "lin_x"}, ValueError)]
)
def test_a_setting_that_is_wrong_is_not_blamed_on_the_file(changes, error, tmp_path):
    with pytest.raises(error, match="learning_rate") as caught:
        load_zip(write(tmp_path / "model.zip", PPO), **changes)
    assert "model.zip" not in str(caught.value)


def test_the_note_on_a_schedule_ends_once_it_is_given(tmp_path):
    pytest.importorskip("yaml")
    write(tmp_path / "config.yml", CONFIG)
    assert "--set learning_rate=lin_0.001" in str(notes_beside(tmp_path / "model.zip", None))
    assert "learning_rate" not in str(notes_beside(tmp_path / "model.zip", None, {"learning_rate": "lin_0.001"}))


FOLDERS = sorted(path.parent for path in ZOO.glob("*/*/*.zip") if path.stem != "best_model")


@pytest.mark.skipif(not FOLDERS, reason="the collection is not beside the repository")
@pytest.mark.parametrize("folder", FOLDERS, ids=[f"{path.parent.name}/{path.name}" for path in FOLDERS])
def test_the_folders_of_the_collection_load(folder):
    """Their actions are compared by ``trials/zoo.py``."""
    agent = load_zip(folder)
    statistics = [*folder.glob("*/vecnormalize.pkl")]
    assert any(str(path) in note for note in agent.notes for path in statistics) is bool(statistics)
    assert not any("not read" in note for note in agent.notes)
    action = agent.predict(agent.observation_space.sample(), deterministic=True)[0]
    assert agent.action_space.contains(action if agent.action_space.shape else int(action))
