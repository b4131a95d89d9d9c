"""Files: what they keep, and what happens when they are damaged, foreign, or cannot be written."""

import errno
import os
import stat
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as npst
from safetensors.numpy import load_file, save_file

import rejeu
from rejeu.core import atomic, checkpoint
from rejeu.core.errors import CheckpointError
from tests import hostile_files
from tests.environments import Counter, Reach, Sampled
from tests.helpers import assert_same_parameters, small_sac


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
    """Copies a file with its header and arrays changed by ``change(header, arrays)``, checksums right."""
    target.write_bytes(hostile_files.changed(source.read_bytes(), change))
    return target


# Round trips.


def test_a_loaded_agent_predicts_the_same_bits_with_the_settings_and_counters_of_the_saved_one(trained, tmp_path):
    agent, path = trained
    loaded = rejeu.load(path)
    assert isinstance(loaded, rejeu.SAC)
    np.testing.assert_array_equal(
        loaded.predict(observations(), deterministic=True)[0], agent.predict(observations(), deterministic=True)[0]
    )
    assert_same_parameters(agent, loaded)
    assert loaded.config == agent.config
    of = lambda a: (a.n_updates, a.seed, a.policy, a.num_timesteps)  # noqa: E731
    assert of(loaded) == of(agent) == (12, 0, "MlpPolicy", 20)
    assert loaded.env is None
    again = rejeu.SAC.load(path, env=Counter((5,))).save(tmp_path / "again")
    assert again.read_bytes() == path.read_bytes()


def test_a_suffix_is_added_where_there_is_none_and_that_of_stable_baselines3_stands_for_ours(trained, tmp_path):
    agent, _ = trained
    assert agent.save(tmp_path / "other.zip") == tmp_path / "other.zip"
    assert agent.save(tmp_path / "new" / "folder" / "model").is_file()
    path = agent.save(tmp_path / "model")
    assert path == tmp_path / "model.safetensors"
    for name in ("model", "model.zip", "other.zip"):
        assert_same_parameters(rejeu.SAC.load(str(tmp_path / name)), agent)
    with pytest.raises(FileNotFoundError, match=r"third\.zip"):
        rejeu.SAC.load(tmp_path / "third.zip")


def test_settings_may_be_changed_when_loading(trained):
    loaded = rejeu.SAC.load(trained[1], learning_rate=1e-5, seed=7, stats_window_size=3)
    assert (loaded.config.learning_rate, loaded.seed, loaded.ep_info_buffer.maxlen) == (1e-5, 7, 3)
    assert loaded.config.tau == trained[0].config.tau


def test_agents_of_nested_observations_survive(tmp_path):
    inner = gym.spaces.Tuple([gym.spaces.MultiBinary(3), gym.spaces.MultiDiscrete([2, 3])])
    box = gym.spaces.Box(-np.inf, np.inf, (2,))
    env = Sampled(gym.spaces.Dict({"c": inner, "b": gym.spaces.Discrete(3, start=-1), "a": box}))
    agent = small_sac(env)
    loaded = rejeu.SAC.load(agent.save(tmp_path / "nested"))
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


@pytest.mark.skipif(os.name != "posix", reason="permissions of this kind are POSIX's")
def test_a_file_may_be_read_by_whoever_may_read_new_files(trained):
    plain = trained[1].with_name("plain")
    plain.touch()
    assert stat.S_IMODE(trained[1].stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


@given(
    st.dictionaries(
        st.text(st.characters(exclude_categories=["Cs"]), max_size=20).filter(lambda name: name != "__metadata__"),
        npst.arrays(
            st.sampled_from(sorted(set(checkpoint.DTYPES.values()))), npst.array_shapes(min_dims=0, min_side=0)
        ),
        max_size=5,
    ),
    st.dictionaries(
        st.text(st.characters(exclude_categories=["Cs"])).filter(lambda name: name not in checkpoint.RESERVED),
        st.recursive(
            st.none() | st.booleans() | st.floats(-1e300, 1e300) | st.text() | st.integers(-(2**100), 2**100), st.lists
        ),
        max_size=4,
    ),
)
@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_arrays_and_any_header_come_back_as_they_were(tmp_path, arrays, header):
    path = checkpoint.write(tmp_path / "any", "rows", arrays, header)
    again, found = checkpoint.read(path, "rows")
    assert again == {"schema": checkpoint.SCHEMA, "kind": "rows", **header} == checkpoint.read_header(path, "rows")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        assert (found[name].dtype, found[name].shape) == (array.dtype, array.shape)
        assert found[name].tobytes() == array.tobytes()


def test_the_library_of_the_format_reads_what_is_written(trained):
    library = load_file(trained[1])
    for name, value in trained[0].get_parameters().items():
        np.testing.assert_array_equal(library[name], value, err_msg=name)


def test_arrays_in_another_order_of_bytes_and_memory_come_back_as_numbers(tmp_path):
    array = np.arange(12, dtype=">f8").reshape(3, 4).T
    found = checkpoint.read(checkpoint.write(tmp_path / "a", "rows", {"a": array, "b": array[::2]}, {}), "rows")[1]
    np.testing.assert_array_equal(found["a"], array)
    np.testing.assert_array_equal(found["b"], array[::2])
    assert found["a"].dtype == np.float64


# What does not fit is named.


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h, a: h.update(schema=99), "has schema 99 and this rejeu reads schema 2; upgrade rejeu"),
        (lambda h, a: h.update(schema="1"), "header is damaged"),
        (lambda h, a: h.update(kind="replay"), "holds 'replay', expected 'agent'"),
        (lambda h, a: h.update(algorithm="TD3"), "holds a TD3 agent, not SAC; use rejeu.load"),
        (lambda h, a: h.pop("config"), "header is damaged or of another version"),
        (lambda h, a: h["config"].update(gamma=7), "gamma=7 must be"),
        (lambda h, a: h["config"].update(speed=7), "no setting 'speed'"),
        (lambda h, a: h.update(observation_space={"os.system": "true"}), "not the description of a space"),
        (lambda h, a: h.update(action_space={"MultiBinary": {"shape": [2]}}), "SAC needs"),
        (lambda h, a: h.update(counters={}), "header is damaged"),
        (lambda h, a: h["counters"].update(step=-1), "step=-1"),
        (lambda h, a: h.update(rng={"state": "x", "inc": 1}), "header is damaged"),
        (lambda h, a: h.update(policy="__import__"), "policy='__import__' must be one of"),
        (lambda h, a: h["config"]["policy_kwargs"].update(net_arch=[9]), "it was saved with other networks"),
        (lambda h, a: a["actor.head.bias"].fill(np.nan), "actor.head.bias holds numbers that are not finite"),
        (lambda h, a: a.pop("actor.head.bias"), "has no actor.head.bias; it was saved with other networks"),
        (lambda h, a: a.update(extra=np.zeros(2)), "has extra, which this agent does not have"),
        (lambda h, a: a.update(log_alpha=np.zeros(2, np.float32)), r"log_alpha is float32\[2\], expected float32\[\]"),
        (lambda h, a: a.update(log_alpha=np.zeros((), np.float64)), r"log_alpha is float64\[\], expected float32\[\]"),
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
        (lambda h, a: h["rng"].update(state=2**128), "other.safetensors"),
        (lambda h, a: h["config"].update(buffer_size=10**18), "buffer_size"),
        (lambda h, a: h["config"]["policy_kwargs"].update(net_arch=[10**9, 10**9]), "net_arch.*up to 1048576"),
    ],
)
def test_numbers_beyond_reason_are_refused_as_such(trained, tmp_path, change, words):
    path = rewrite(trained[1], tmp_path / "other.safetensors", change)
    with pytest.raises((CheckpointError, MemoryError), match=words):
        rejeu.SAC.load(path, env=Counter())


def test_another_environment_or_another_kind_of_file_is_refused_when_loading(trained, buffer_file):
    with pytest.raises(ValueError, match=r"given environment has the observation space .* this agent was made for"):
        rejeu.SAC.load(trained[1], env=Reach())
    with pytest.raises(ValueError, match="given environment has the action space"):
        rejeu.SAC.load(trained[1], env=Counter(low=[-2.0], high=[2.0]))
    agent, path = buffer_file
    with pytest.raises(CheckpointError, match="holds 'replay', expected 'agent'"):
        rejeu.SAC.load(path)
    with pytest.raises(CheckpointError, match="holds 'agent', expected 'replay'"):
        agent.load_replay_buffer(trained[1])


def test_a_replay_buffer_of_another_environment_is_refused_and_nothing_changes(buffer_file):
    other = small_sac(Sampled(gym.spaces.Box(-1.0, 1.0, (2,))), learning_starts=10**6).learn(7)
    with pytest.raises(CheckpointError, match=r"it is of the observation space .*, and this agent was made for Box"):
        other.load_replay_buffer(buffer_file[1])
    assert other.replay_buffer.size() == 7


# Damage.


@pytest.mark.parametrize(
    ("metadata", "words"),
    [
        (None, "not one that rejeu wrote: its header is missing"),
        ({"rejeu": "[]"}, "header is damaged"),
        ({"rejeu": '{"schema": NaN}'}, "header is damaged"),
        ({"rejeu": "[" * 100_000}, "header is damaged"),
        ({"rejeu": '{"schema": 1}'}, "has schema 1 and this rejeu reads schema 2; it is from an unreleased version"),
        ({"rejeu": '{"schema": 2}', "crc32": "00000000"}, "header is damaged"),
    ],
)
def test_safetensors_files_of_other_programs_are_refused(tmp_path, metadata, words):
    path = tmp_path / "foreign.safetensors"
    save_file({"weight": np.zeros(3, np.float32)}, path, metadata)
    with pytest.raises(CheckpointError, match=words):
        rejeu.SAC.load(path)


# Writing.


def fails_with(number):
    def fail(*_):
        raise OSError(number, os.strerror(number)) if number is not None else KeyboardInterrupt

    return fail


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (errno.ENOSPC, OSError, "model.safetensors could not be written: No space left on device; free some space"),
        (errno.EACCES, PermissionError, "Permission denied; give a path that you may write to"),
        (errno.ENOENT, FileNotFoundError, "its folder was removed while the file was written"),
        (errno.EFBIG, OSError, "File too large; raise the limit on the size of files"),
        (None, KeyboardInterrupt, "^$"),
    ],
)
@pytest.mark.parametrize("where", ["fsync", "replace", "open"])
def test_a_write_that_fails_says_why_and_leaves_the_old_file_and_nothing_else(
    trained, tmp_path, monkeypatch, number, kind, words, where
):
    agent, _ = trained
    path = agent.save(tmp_path / "model")
    before = path.read_bytes()
    if where == "fsync":
        monkeypatch.setattr(atomic.os, "fsync", fails_with(number))
    else:
        monkeypatch.setattr(Path, where, fails_with(number))
    with pytest.raises(kind, match=words) as caught:
        agent.save(path)
    monkeypatch.undo()
    assert getattr(caught.value, "errno", None) == number
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["model.safetensors"]


def test_the_file_is_on_disk_before_it_takes_the_old_ones_place_and_its_name_after(trained, tmp_path, monkeypatch):
    order = []
    real_sync, real_replace = os.fsync, Path.replace
    monkeypatch.setattr(atomic.os, "fsync", lambda f: (order.append("sync"), real_sync(f))[1])
    monkeypatch.setattr(Path, "replace", lambda s, t: (order.append("replace"), real_replace(s, t))[1])
    trained[0].save(tmp_path / "model")
    assert order == ["sync", "replace", "sync"] if os.name == "posix" else ["sync", "replace"]


def test_a_folder_that_cannot_be_brought_to_disk_is_no_error(tmp_path, monkeypatch):
    """Some network file systems cannot; the file itself is there."""
    real = os.fsync
    monkeypatch.setattr(
        atomic.os, "fsync", lambda f: fails_with(errno.EINVAL)() if stat.S_ISDIR(os.fstat(f).st_mode) else real(f)
    )
    assert checkpoint.read(checkpoint.write(tmp_path / "a", "rows", {}, {"n": 1}), "rows")[0]["n"] == 1


def test_what_a_killed_process_left_behind_goes_with_the_next_write(tmp_path):
    old, new = tmp_path / ".a.safetensors.0123abcd.tmp", tmp_path / ".a.safetensors.4567cdef.tmp"
    others = [
        ".a.safetensors.0123abcd.tmp.bak",
        ".b.safetensors.0123abcd.tmp",
        ".a.safetensors.xyz.tmp",
        ".axsafetensors.0123abcd.tmp",
    ]
    for path in (old, new, *(tmp_path / name for name in others)):
        path.write_bytes(b"half of")
        os.utime(path, (0, 0))
    os.utime(new)
    checkpoint.write(tmp_path / "a", "rows", {}, {})
    assert {p.name for p in tmp_path.iterdir()} == {"a.safetensors", new.name, *others}


def test_a_path_that_is_a_folder_or_no_file_is_refused(trained, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no run folder or model file nowhere"):
        rejeu.SAC.load("nowhere")
    (tmp_path / "model.safetensors").mkdir()
    words = r"model.safetensors could not be written: there is a folder.* not a folder"
    with pytest.raises(IsADirectoryError, match=words):
        trained[0].save(tmp_path / "model")
    assert [p.name for p in tmp_path.iterdir()] == ["model.safetensors"]


@pytest.mark.parametrize(
    ("arrays", "header", "error", "words"),
    [
        ({}, {"x": float("nan")}, ValueError, "JSON"),
        ({}, {"x": object()}, TypeError, "JSON"),
        ({}, {"kind": "agent"}, ValueError, "may not have a 'kind' of its own"),
        ({}, {"checksums": {}}, ValueError, "may not have a 'checksums' of its own"),
        ({}, {"x": "x" * 5 * 2**20}, ValueError, "use arrays for many numbers"),
        ({"a": np.zeros(2, np.complex64)}, {}, TypeError, "a has the dtype complex64; expected one of float32"),
        ({"a": np.array([object()])}, {}, TypeError, "a has the dtype object"),
        ({"__metadata__": np.zeros(2)}, {}, ValueError, "no array may be called __metadata__"),
        ({"\ud800": np.zeros(2)}, {}, ValueError, "surrogates|utf-8"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(tmp_path, arrays, header, error, words):
    path = checkpoint.write(tmp_path / "a", "rows", {"a": np.arange(3)}, {})
    before = path.read_bytes()
    with pytest.raises(error, match=words):
        checkpoint.write(path, "rows", arrays, header)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.safetensors"]
