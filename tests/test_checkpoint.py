"""Files: what they keep, and what happens when they are damaged, foreign, or cannot be written."""

from __future__ import annotations

import ast
import json
import os
import stat
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

import rejeu
from rejeu import checkpoint
from rejeu.errors import CheckpointError
from tests.environments import Counter, Reach, Sampled
from tests.helpers import assert_same_parameters, small_sac

SOURCE = Path(rejeu.__file__).parent


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """An agent after a few updates, and its file."""
    agent = small_sac(Counter((5,)), ent_coef="auto_0.5", learning_rate=rejeu.Linear(1e-2, 1e-3)).learn(20)
    return agent, agent.save(tmp_path_factory.mktemp("saved") / "model")


@pytest.fixture(scope="module")
def buffer_file(tmp_path_factory):
    agent = small_sac(Counter((5,)), learning_starts=10**6).learn(20)
    return agent, agent.save_replay_buffer(tmp_path_factory.mktemp("saved") / "buffer")


def observations(n=6):
    return np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32)


def rewrite(source, target, change):
    """Copies a model file with its header and arrays changed by ``change(header, arrays)``."""
    with safe_open(source, framework="numpy") as file:
        header = json.loads(file.metadata()["rejeu"])
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - the handle is no dict
    change(header, arrays)
    save_file(arrays, target, {"rejeu": json.dumps(header)})
    return target


# Round trips.


def test_a_loaded_agent_predicts_the_same_bits(trained):
    agent, path = trained
    loaded = rejeu.SAC.load(path)
    np.testing.assert_array_equal(
        loaded.predict(observations(), deterministic=True)[0], agent.predict(observations(), deterministic=True)[0]
    )
    assert_same_parameters(agent, loaded)


def test_a_loaded_agent_has_the_settings_and_counters_of_the_saved_one(trained):
    agent, path = trained
    loaded = rejeu.SAC.load(path)
    assert loaded.config == agent.config
    assert (
        (loaded.n_updates, loaded.seed, loaded.policy)
        == (agent.n_updates, agent.seed, agent.policy)
        == (12, 0, "MlpPolicy")
    )
    assert loaded.num_timesteps == 20
    assert loaded.env is None


def test_saving_a_loaded_agent_gives_the_same_file(trained, tmp_path):
    again = rejeu.SAC.load(trained[1], env=Counter((5,))).save(tmp_path / "again")
    assert again.read_bytes() == trained[1].read_bytes()


def test_the_kind_of_agent_is_found_by_load(trained):
    assert isinstance(rejeu.load(trained[1]), rejeu.SAC)


def test_a_suffix_is_added_only_where_there_is_none(trained, tmp_path):
    agent, _ = trained
    assert agent.save(tmp_path / "model") == tmp_path / "model.safetensors"
    assert agent.save(tmp_path / "model.zip") == tmp_path / "model.zip"
    assert agent.save(tmp_path / "new" / "folder" / "model").is_file()
    assert rejeu.SAC.load(tmp_path / "model").n_updates == rejeu.SAC.load(str(tmp_path / "model.zip")).n_updates == 12


def test_settings_may_be_changed_when_loading(trained):
    loaded = rejeu.SAC.load(trained[1], learning_rate=1e-5, seed=7, stats_window_size=3)
    assert (loaded.config.learning_rate, loaded.seed, loaded.ep_info_buffer.maxlen) == (1e-5, 7, 3)
    assert loaded.config.tau == trained[0].config.tau


def test_a_misspelt_change_is_named(trained):
    with pytest.raises(TypeError, match="SAC has no setting 'learning_rat'; did you mean learning_rate"):
        rejeu.SAC.load(trained[1], learning_rat=1e-5)


@pytest.mark.parametrize(
    ("space", "name"),
    [
        (gym.spaces.Dict({"b": gym.spaces.Discrete(3, start=-1), "a": gym.spaces.Box(-np.inf, np.inf, (2,))}), "Dict"),
        (gym.spaces.Tuple([gym.spaces.MultiBinary(3), gym.spaces.MultiDiscrete([2, 3])]), "Tuple"),
    ],
)
def test_agents_of_nested_observations_survive(space, name, tmp_path):
    env = Sampled(space)
    agent = small_sac(env)
    loaded = rejeu.SAC.load(agent.save(tmp_path / name))
    obs = env.reset(seed=3)[0]
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], agent.predict(obs, deterministic=True)[0])


def test_a_replay_buffer_survives(buffer_file, tmp_path):
    agent, path = buffer_file
    other = small_sac(Counter((5,)), learning_starts=10**6)
    other.load_replay_buffer(path)
    assert other.replay_buffer.size() == agent.replay_buffer.size() == 20
    one, two = (a.replay_buffer.sample(np.random.default_rng(0), (64,)) for a in (agent, other))
    for left, right in zip(one[:5], two[:5], strict=True):
        np.testing.assert_array_equal(left, right)


def test_a_hindsight_buffer_survives_with_its_episodes(tmp_path):
    make = lambda: small_sac(Reach(), replay_buffer_class=rejeu.HerReplayBuffer, learning_starts=10**6)  # noqa: E731
    agent = make().learn(37)
    other = make()
    other.load_replay_buffer(agent.save_replay_buffer(tmp_path / "buffer"))
    one, two = (a.replay_buffer.sample(np.random.default_rng(0), (64,)) for a in (agent, other))
    np.testing.assert_array_equal(one.obs["desired_goal"], two.obs["desired_goal"])
    np.testing.assert_array_equal(one.reward, two.reward)


def test_a_file_may_be_read_by_whoever_may_read_new_files(trained):
    if os.name != "posix":
        pytest.skip("permissions of this kind are POSIX's")
    plain = trained[1].with_name("plain")
    plain.touch()
    assert stat.S_IMODE(trained[1].stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


# What does not fit is named.


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h, a: h.update(schema=99), "has schema 99 and this rejeu reads schema 1; upgrade rejeu"),
        (lambda h, a: h.update(schema=0), "has schema 0"),
        (lambda h, a: h.update(schema="1"), "header is damaged"),
        (lambda h, a: h.update(kind="replay"), "holds 'replay', expected 'agent'"),
        (lambda h, a: h.update(algorithm="TD3"), "holds a TD3 agent, not SAC; use rejeu.load"),
        (lambda h, a: h.update(algorithm=None), "holds a None agent, not SAC"),
        (lambda h, a: h.pop("config"), "header is damaged or of another version"),
        (lambda h, a: h.update(config=[1]), "header is damaged or of another version"),
        (lambda h, a: h["config"].update(gamma=7), "gamma=7 must be"),
        (lambda h, a: h["config"].update(speed=7), "no setting 'speed'"),
        (lambda h, a: h.update(observation_space={"os.system": "true"}), "not the description of a space"),
        (lambda h, a: h.update(action_space={"MultiBinary": {"shape": [2]}}), "SAC needs"),
        (lambda h, a: h.update(counters={}), "header is damaged"),
        (lambda h, a: h["counters"].update(step=-1), "step=-1"),
        (lambda h, a: h.update(rng={"state": "x", "inc": 1}), "header is damaged"),
        (lambda h, a: h.update(seed=-1), "seed=-1"),
        (lambda h, a: h.update(policy="__import__"), "policy='__import__' must be one of"),
        (lambda h, a: h["config"]["policy_kwargs"].update(net_arch=[9]), "it was saved with other networks"),
        (lambda h, a: a.pop("actor.head.bias"), "has no actor.head.bias; it was saved with other networks"),
        (lambda h, a: a.update(extra=np.zeros(2)), "has extra, which this agent has not"),
        (lambda h, a: a.update(log_alpha=np.zeros(2, np.float32)), r"log_alpha is float32\[2\], expected float32\[\]"),
        (lambda h, a: a.update(log_alpha=np.zeros((), np.float64)), r"log_alpha is float64\[\], expected float32\[\]"),
        (lambda h, a: a.update(log_alpha=np.zeros((), np.float16)), "log_alpha has a dtype that rejeu does not write"),
    ],
)
def test_a_file_that_does_not_fit_says_what_differs(trained, tmp_path, change, words):
    path = rewrite(trained[1], tmp_path / "other.safetensors", change)
    with pytest.raises(CheckpointError, match=words) as caught:
        rejeu.SAC.load(path)
    assert "\n" not in str(caught.value)
    assert "other.safetensors" in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h, a: h["counters"].update(step=10**30), "step"),
        (lambda h, a: h["rng"].update(state=2**128), r"from 0 to 2\*\*128"),
        (lambda h, a: h["config"].update(buffer_size=10**18), "buffer_size"),
        (lambda h, a: h["config"]["policy_kwargs"].update(net_arch=[10**9, 10**9]), "other networks|memory"),
    ],
)
def test_numbers_beyond_reason_are_refused_as_such(trained, tmp_path, change, words):
    path = rewrite(trained[1], tmp_path / "other.safetensors", change)
    with pytest.raises((CheckpointError, MemoryError), match=words):
        rejeu.SAC.load(path, env=Counter())


def test_another_environment_is_refused_when_loading(trained):
    with pytest.raises(ValueError, match=r"given environment has the observation space .* this agent was made for"):
        rejeu.SAC.load(trained[1], env=Reach())
    with pytest.raises(ValueError, match="given environment has the action space"):
        rejeu.SAC.load(trained[1], env=Counter(low=[-2.0], high=[2.0]))


def test_a_model_is_no_replay_buffer_and_the_reverse(trained, buffer_file):
    agent, path = buffer_file
    with pytest.raises(CheckpointError, match="holds 'replay', expected 'agent'"):
        rejeu.SAC.load(path)
    with pytest.raises(CheckpointError, match="holds 'agent', expected 'replay'"):
        agent.load_replay_buffer(trained[1])


def test_a_replay_buffer_of_another_environment_is_refused_and_nothing_changes(buffer_file):
    other = small_sac(Sampled(gym.spaces.Box(-1.0, 1.0, (2,))), learning_starts=10**6).learn(7)
    with pytest.raises(CheckpointError, match="saved with another environment or buffer_size"):
        other.load_replay_buffer(buffer_file[1])
    assert other.replay_buffer.size() == 7


def test_a_missing_file_is_named():
    with pytest.raises(FileNotFoundError, match=r"there is no file .*nowhere\.safetensors"):
        rejeu.SAC.load("nowhere")


# Damage.


def load_any(path, buffer_agent):
    with pytest.raises(CheckpointError):
        rejeu.SAC.load(path)
    with pytest.raises(CheckpointError):
        rejeu.load(path)
    before = buffer_agent.replay_buffer.size()
    with pytest.raises(CheckpointError):
        buffer_agent.load_replay_buffer(path)
    assert buffer_agent.replay_buffer.size() == before


def test_a_file_cut_short_anywhere_is_refused(trained, buffer_file, tmp_path):
    for whole in (trained[1], buffer_file[1]):
        content = whole.read_bytes()
        for length in [*range(0, 12), *np.linspace(12, len(content) - 1, 40, dtype=int)]:
            path = tmp_path / "cut.safetensors"
            path.write_bytes(content[:length])
            load_any(path, buffer_file[0])


def test_bytes_of_another_kind_are_refused(buffer_file, tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "noise.safetensors"
    zipped = b"PK\x03\x04" + bytes(100)
    pickled = b"\x80\x04\x95" + bytes(100)
    for content in (zipped, pickled, b"", b"{}", b"\xff" * 64, *(rng.bytes(n) for n in (1, 8, 9, 100, 5000))):
        path.write_bytes(content)
        load_any(path, buffer_file[0])


def test_a_flipped_byte_in_the_header_is_refused_or_harmless(trained, tmp_path):
    """Whatever the byte becomes, either a CheckpointError is raised or an agent of the right shape results."""
    content = trained[1].read_bytes()
    size = 8 + int.from_bytes(content[:8], "little")
    rng = np.random.default_rng(0)
    path = tmp_path / "flipped.safetensors"
    refused = 0
    for position in rng.integers(0, size, 120):
        damaged = bytearray(content)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:
            header, arrays = checkpoint.read(path, "agent")
        except CheckpointError:
            refused += 1
        else:
            assert isinstance(header, dict)
            assert all(isinstance(a, np.ndarray) for a in arrays.values())
    assert refused > 20


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        (None, "not one that rejeu wrote: its header is missing"),
        ({"format": "pt"}, "not one that rejeu wrote"),
        ({"rejeu": "{"}, "header is damaged"),
        ({"rejeu": "[]"}, "header is damaged"),
        ({"rejeu": "{}"}, "header is damaged"),
        ({"rejeu": '{"schema": NaN}'}, "header is damaged"),
        ({"rejeu": "[" * 100_000}, "header is damaged"),
        ({"rejeu": '{"schema": 1}'}, "holds 'None', expected 'agent'"),
    ],
)
def test_safetensors_files_of_other_programs_are_refused(tmp_path, metadata, words):
    path = tmp_path / "foreign.safetensors"
    save_file({"weight": np.zeros(3, np.float32)}, path, metadata)
    with pytest.raises(CheckpointError, match=words):
        rejeu.SAC.load(path)


# Writing.


def test_a_write_that_fails_halfway_leaves_the_old_file_and_nothing_else(trained, tmp_path, monkeypatch):
    agent, _ = trained
    path = agent.save(tmp_path / "model")
    before = path.read_bytes()

    def disk_full(arrays, name, metadata):
        Path(name).write_bytes(b"half of")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "save_file", disk_full)
    with pytest.raises(OSError, match="No space left"):
        agent.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["model.safetensors"]


def test_ctrl_c_while_writing_leaves_the_old_file_and_nothing_else(trained, tmp_path, monkeypatch):
    agent, _ = trained
    path = agent.save(tmp_path / "model")
    before = path.read_bytes()

    def interrupted(file):
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint.os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        agent.save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["model.safetensors"]


def test_the_file_is_on_disk_before_it_takes_the_old_ones_place(trained, tmp_path, monkeypatch):
    order = []
    real_sync, real_replace = os.fsync, Path.replace
    monkeypatch.setattr(checkpoint.os, "fsync", lambda f: (order.append("sync"), real_sync(f))[1])
    monkeypatch.setattr(Path, "replace", lambda s, t: (order.append("replace"), real_replace(s, t))[1])
    trained[0].save(tmp_path / "model")
    assert order == ["sync", "replace"]


def test_a_folder_that_cannot_be_written_is_an_os_error_that_names_it(trained, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="file"):
        trained[0].save(tmp_path / "file" / "model")
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_read_only_folder_is_an_os_error(trained, tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(PermissionError):
        trained[0].save(tmp_path / "model")


# Nothing that a file holds can be run.


def calls_in(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield f"{node.func.id}()"
        for keyword in getattr(node, "keywords", []):
            if keyword.arg == "allow_pickle" and not (
                isinstance(keyword.value, ast.Constant) and not keyword.value.value
            ):
                yield "allow_pickle"


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda p: str(p.relative_to(SOURCE)))
def test_the_source_neither_unpickles_nor_evaluates(path):
    forbidden = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "eval()", "exec()", "compile()"}
    forbidden |= {"__import__()", "allow_pickle"}
    assert not forbidden & set(calls_in(path))


def test_the_search_for_pickles_finds_them(tmp_path):
    sample = tmp_path / "sample.py"
    sample.write_text("import pickle\nfrom joblib import load\neval('1')\nnp.load('x', allow_pickle=True)\n")
    assert {"pickle", "joblib", "eval()", "allow_pickle"} <= set(calls_in(sample))


def test_a_file_of_stable_baselines3_s_suffix_is_looked_for_under_ours(trained, tmp_path):
    agent, _ = trained
    path = agent.save(tmp_path / "model")
    assert_same_parameters(rejeu.SAC.load(tmp_path / "model.zip"), agent)
    path.rename(tmp_path / "model.zip")
    assert_same_parameters(rejeu.SAC.load(tmp_path / "model.zip"), agent)
    with pytest.raises(FileNotFoundError, match=r"other\.zip"):
        rejeu.SAC.load(tmp_path / "other.zip")
