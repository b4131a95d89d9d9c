"""Whatever a file holds, reading it ends soon, in little memory, with rejeu's own error, and changes nothing."""

import os
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

import rejeu
from rejeu.core import checkpoint
from rejeu.core.errors import CheckpointError
from rejeu.export import numpy_policy
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from rejeu.teaching.courses import leaderboard
from tests import hostile_files
from tests.core.test_schemas import FILES as RECORDED
from tests.environments import Counter
from tests.golden import record_files
from tests.hostile_files import outcome_of
from tests.tiers import only

SECONDS = 2.0
"""Longest that any file may take."""
MEGABYTES = 64
"""Most memory that any file may take, beyond what was in use."""
FILES = {"agent": RECORDED / "sac", "replay": RECORDED / "replay", "vec_normalize": RECORDED / "vec_normalize"}
"""A valid file of each kind, which is the first word."""
CONTENTS = {kind: path.with_suffix(".safetensors").read_bytes() for kind, path in FILES.items()}
SPECIAL = {
    "agent": hostile_files.bad_models,
    "replay": hostile_files.bad_buffers,
    "replay with counters": hostile_files.bad_buffers,
    "vec_normalize": hostile_files.bad_statistics,
}


@pytest.fixture(scope="module")
def loaders():
    """For every kind of file what reads it, and returns what it may not have changed."""
    agent = record_files.replay_agent().learn(7)
    env = DummyVecEnv([lambda: Counter((5,))])

    def load_replay(path):
        agent.load_replay_buffer(path)

    def load_statistics(path):
        VecNormalize.load(path, env)

    def state():
        return {**agent.replay_buffer.arrays(), **agent.get_parameters()}

    loaders = {"agent": rejeu.load, "vec_normalize": load_statistics}
    return loaders | dict.fromkeys(("replay", "replay with counters"), load_replay), state


def all_variants(kind):
    yield from hostile_files.variants(CONTENTS[kind])
    yield from SPECIAL[kind](CONTENTS[kind])


def same(one, other):
    return one.keys() == other.keys() and all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)


@pytest.mark.parametrize("kind", FILES)
def test_the_parts_put_together_are_a_valid_file(kind, loaders, tmp_path):
    """Else every variant would be refused for what is wrong with all of them."""
    path = tmp_path / "whole.safetensors"
    path.write_bytes(hostile_files.put_together(hostile_files.take_apart(CONTENTS[kind])))
    loaders[0][kind](path)


@pytest.mark.parametrize("each", only([4], [4, 1]))
@pytest.mark.parametrize("kind", FILES)
def test_a_hostile_file_is_refused_soon_and_changes_nothing(kind, each, loaders, tmp_path):
    load, state = loaders[0][kind], loaders[1]
    path = tmp_path / "hostile.safetensors"
    before, wrong, variants = state(), [], [*all_variants(kind)]
    for variant in variants[::each]:
        path.write_bytes(variant.content)
        began = time.perf_counter()
        outcome = outcome_of(load, path)
        seconds = time.perf_counter() - began
        if outcome != "refused" or seconds > SECONDS:
            wrong.append((variant.kind, variant.name, outcome, round(seconds, 1)))
    assert not wrong
    assert len(variants) > 120
    assert same(before, state())


@pytest.mark.parametrize("kind", only([], FILES))
def test_a_hostile_file_takes_little_memory(kind, loaders, tmp_path):
    """Those that speak of large things, and that are large themselves."""
    path = tmp_path / "hostile.safetensors"
    kinds = ("huge", "shape", "places", "length", "json", "header text", "deep", "buffer", "duplicate", "table")
    tracemalloc.start()
    try:
        for variant in all_variants(kind):
            if variant.kind not in kinds:
                continue
            path.write_bytes(variant.content)
            tracemalloc.reset_peak()
            before = tracemalloc.get_traced_memory()[0]
            outcome_of(loaders[0][kind], path)
            taken = tracemalloc.get_traced_memory()[1] - before
            assert taken < MEGABYTES * 2**20, f"{variant.kind}, {variant.name}: {taken / 2**20:.0f} MB"
    finally:
        tracemalloc.stop()


def test_a_refused_file_leaves_the_parameters_as_they_were(tmp_path):
    """The same for ``set_parameters``, which gets behind the header: only the arrays count there."""
    agent = rejeu.load(RECORDED / "sac.safetensors")
    before, path = agent.get_parameters(), tmp_path / "hostile.safetensors"
    for variant in hostile_files.bad_arrays(CONTENTS["agent"]):
        path.write_bytes(variant.content)
        assert outcome_of(agent.set_parameters, path) == "refused", variant.name
        assert same(before, agent.get_parameters())


@pytest.mark.parametrize("kind", FILES)
def test_a_file_cut_short_at_any_byte_is_refused(kind, tmp_path):
    content, path = CONTENTS[kind], tmp_path / "cut.safetensors"
    path.write_bytes(content)
    for length in reversed(range(0, len(content), 3)):
        os.truncate(path, length)
        assert outcome_of(lambda p: checkpoint.read(p, kind.split()[0]), path) == "refused", length


def test_a_damaged_array_is_named(tmp_path):
    path = tmp_path / "damaged.safetensors"
    content = bytearray(CONTENTS["replay"])
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="the array kind is damaged"):
        checkpoint.read(path, "replay")


# What is no file at all.


def test_a_folder_a_pipe_or_a_link_to_itself_is_no_file(tmp_path):
    path = tmp_path / "model.safetensors"
    path.mkdir()
    with pytest.raises(CheckpointError, match=r"model\.safetensors is not a file but a folder"):
        rejeu.load(tmp_path / "model")
    path.rmdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(path)
        with pytest.raises(CheckpointError, match="is not a file but"):  # which is not waited for
            rejeu.load(path)
        path.unlink()
    try:
        path.symlink_to(path)
    except (OSError, NotImplementedError):
        return  # symbolic links cannot be made here
    with pytest.raises(FileNotFoundError, match="there is no"):
        rejeu.load(path)


@pytest.mark.skipif(os.name != "posix", reason="holes in files are POSIX's")
def test_a_file_larger_than_the_memory_is_refused_before_it_is_read(tmp_path, monkeypatch):
    text = '{"schema": 2, "kind": "agent", "checksums": {"a": 0}}'
    table = hostile_files.table_of({}, {}, text)
    table["a"] = {"dtype": "U8", "shape": [2**32], "data_offsets": [0, 2**32]}
    path = tmp_path / "sparse.safetensors"
    path.write_bytes(content := hostile_files.join(table, b""))
    os.truncate(path, len(content) + 2**32)
    monkeypatch.setattr(checkpoint, "physical_memory", lambda: 2**31)
    with pytest.raises(CheckpointError, match=r"has 4\.0 GiB and the machine 2\.0 GiB"):
        checkpoint.read(path, "agent")


@pytest.mark.skipif(os.name != "posix", reason="holes in files are POSIX's")
def test_a_file_that_is_nearly_all_holes_is_refused_though_the_memory_would_do(tmp_path):
    """A network of 4 GB of zeros, whose checksums are right, takes no room in an archive."""
    table = hostile_files.table_of({}, {}, '{"schema": 2, "kind": "agent", "checksums": {"a": 0}}')
    table["a"] = {"dtype": "U8", "shape": [2**26], "data_offsets": [0, 2**26]}
    path = tmp_path / "sparse.safetensors"
    path.write_bytes(content := hostile_files.join(table, b""))
    os.truncate(path, len(content) + 2**26)
    with pytest.raises(CheckpointError, match="nearly empty"):
        checkpoint.read(path, "agent")
    with pytest.raises(CheckpointError, match="nearly empty"):
        numpy_policy.read(path)
    assert leaderboard.equal_files([path, path]) == []


@pytest.mark.skipif(os.name != "posix", reason="holes in files are POSIX's")
@pytest.mark.parametrize("kind", FILES)
def test_no_array_is_read_that_the_model_does_not_have(kind, loaders, tmp_path, monkeypatch):
    """Six GiB in a hole of a few KiB are refused at once, by names and shapes."""
    path, load = tmp_path / "sparse.safetensors", loaders[0][kind]
    names, read = [], checkpoint.Contents.read
    monkeypatch.setattr(checkpoint.Contents, "read", lambda file, prefix="": names.append(prefix) or read(file, prefix))
    monkeypatch.setattr(checkpoint, "physical_memory", lambda: 2**40)
    for one in hostile_files.sparse(CONTENTS[kind]):
        path.write_bytes(one.content)
        os.truncate(path, one.size)
        began = time.perf_counter()
        assert outcome_of(load, path) == "refused", one.name
        assert time.perf_counter() - began < SECONDS, one.name
    assert not names


def test_a_hole_makes_no_room_for_a_space_or_a_network(tmp_path):
    """A header may ask for as much as the file has bytes, and a hole has none."""
    path = tmp_path / "sparse.safetensors"
    large, many = hostile_files.LARGE_SPACES[0], 10**9
    for change in (
        lambda header, arrays: header.update(observation_space=large),
        lambda header, arrays: header["config"].update(n_critics=many),
    ):
        one = next(hostile_files.sparse(hostile_files.changed(CONTENTS["agent"], change)))
        path.write_bytes(one.content)
        os.truncate(path, one.size)
        with pytest.raises(CheckpointError, match=r"1000000000( numbers| must be a whole number)"):
            rejeu.load(path)


@pytest.mark.parametrize("path", ["", ".", "..", "/", "a/..", Path()])
def test_a_path_that_names_no_file_is_refused_on_one_line(path, tmp_path, monkeypatch):
    agent, here = rejeu.load(RECORDED / "sac.safetensors"), tmp_path / "empty" / "here"
    here.mkdir(parents=True)
    monkeypatch.chdir(here)
    words = r"^'.*' is (a folder without a model; a run|not the path of a file; give one, such as).*$"
    for load in (rejeu.load, rejeu.SAC.load):
        with pytest.raises((CheckpointError, FileNotFoundError), match=words):
            load(path)
    with pytest.raises(CheckpointError, match="is not the path of a file"):
        agent.set_parameters(path)
    with pytest.raises(ValueError, match="is not the path of a file"):
        agent.save(path)


def test_a_path_that_is_too_long_is_refused_in_a_few_words(tmp_path):
    agent = rejeu.load(RECORDED / "sac.safetensors")
    for path in (tmp_path / ("a" * 5000), "b/" * 5000 + "c"):
        for call in (rejeu.load, agent.set_parameters):
            with pytest.raises(CheckpointError, match=r"cannot be read: .*long") as caught:
                call(path)
            assert len(str(caught.value)) < 500
        with pytest.raises(OSError, match=r"could not be written: .*long") as failed:
            agent.save(path)
        assert len(str(failed.value)) < 600


@pytest.mark.parametrize("env_id", ["evil:Env-v0", "os:system", "../x:y", "", "a" * 1000, "a b", 3, None])
def test_the_environment_of_a_file_is_only_looked_for_among_those_that_are_registered(env_id, tmp_path):
    """Gymnasium imports the module that an id names before a colon, which no file may choose."""
    from rejeu.lab.cli.commands import Evaluate
    from rejeu.lab.runs.environment import environment_of

    path = tmp_path / "model.safetensors"
    path.write_bytes(hostile_files.changed(CONTENTS["agent"], lambda h, a: h.update(env_id=env_id)))
    with pytest.raises(CheckpointError, match="no file may name what is imported"):
        environment_of(path, Evaluate(path))
    path.write_bytes(hostile_files.changed(CONTENTS["agent"], lambda h, a: h.update(env_id="rejeu/Ball-v0")))
    assert environment_of(path, Evaluate(path)).env_id == "rejeu/Ball-v0"


def test_the_file_is_blamed_for_what_it_holds_and_not_for_what_the_caller_gives(tmp_path):
    for given in ({"gamma": 7}, {"seed": -1}):
        with pytest.raises(ValueError, match="must be") as caught:
            rejeu.load(RECORDED / "sac.safetensors", **given)
        assert not isinstance(caught.value, CheckpointError)
    path = tmp_path / "model.safetensors"
    path.write_bytes(hostile_files.changed(CONTENTS["agent"], lambda h, a: h["config"].update(gamma=7)))
    with pytest.raises(CheckpointError, match="gamma=7"):
        rejeu.load(path, seed=1, batch_size=2)


def test_a_buffer_larger_than_the_memory_is_refused_only_where_there_is_to_be_one(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(hostile_files.changed(CONTENTS["agent"], lambda h, a: h["config"].update(buffer_size=10**12)))
    assert rejeu.load(path).config.buffer_size == 10**12
    with pytest.raises(CheckpointError, match=r"buffer_size=1000000000000 takes|allocate"):
        rejeu.load(path, env=Counter((5,)))
    assert rejeu.load(path, env=Counter((5,)), buffer_size=50).replay_buffer.size() == 0
