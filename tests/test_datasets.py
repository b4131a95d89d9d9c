"""Minari datasets as files: the layouts that Minari writes are read, hostile ones are refused, crashes lose no episode."""

import errno
import json
import os
import shutil
import sys
import time
import tracemalloc
import zlib
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

from rejeu import demonstrations
from rejeu.core.errors import CheckpointError
from rejeu.core.spaces import same
from rejeu.demonstrations import dataset
from rejeu.demonstrations.recording import Recording
from tests.full_disk import FullDisk

h5py = pytest.importorskip("h5py")
minari = pytest.importorskip("minari")
from minari.data_collector.episode_buffer import EpisodeBuffer  # noqa: E402

STEPS = 3
VECTOR = Box(-np.inf, np.inf, (2,), np.float64)
IMAGE = Box(0, 255, (40, 36, 3), np.uint8)


class Shaped(gym.Env[Any, Any]):
    """An environment of any spaces, which ends after three steps."""

    def __init__(self, observation_space: gym.Space, action_space: gym.Space) -> None:
        self.observation_space, self.action_space = observation_space, action_space


def record(folder: Path, env: gym.Env, n: int = 2, close: bool = True) -> list[Any]:
    """Records episodes of samples, and returns their observations."""
    recording, seen = Recording(folder, env, None), []
    for i in range(n):
        env.observation_space.seed(i)
        seen.append([env.observation_space.sample() for _ in range(STEPS + 1)])
        recording.begin(seen[-1][0], i)
        for t, obs in enumerate(seen[-1][1:]):
            recording.step(obs, env.action_space.sample(), float(t), t == STEPS - 1, False)
    if close:
        recording.close()
    return seen


def plain(tmp_path: Path) -> Path:
    """Returns the folder ``data`` of a recording of two episodes."""
    record(tmp_path / "shown", Shaped(VECTOR, Discrete(2)))
    return next((tmp_path / "shown").rglob("data"))


SPACES = {
    "door: unbounded float64": (VECTOR, Box(-1, 1, (3,), np.float32)),
    "pointmaze: goals": (Dict(achieved_goal=VECTOR, desired_goal=VECTOR, observation=VECTOR), Box(-1, 1, (2,))),
    "kitchen: goals by task": (Dict(achieved_goal=Dict(kettle=VECTOR), observation=VECTOR), Box(-1, 1, (9,))),
    "a key with a slash": (Dict({"a/b": VECTOR, "a.c": VECTOR}), Discrete(2)),
    "frozen lake: numbers": (Discrete(16), Discrete(4)),
    "tuples": (Tuple((VECTOR, Discrete(3), MultiBinary(4))), MultiDiscrete([2, 3])),
    "atari: images": (IMAGE, Discrete(4, start=-1)),
    "gray images": (Box(0, 255, (40, 36), np.uint8), MultiBinary(2)),
    "small images": (Dict(image=Box(0, 255, (7, 7, 3), np.uint8), direction=Discrete(4)), Discrete(7)),
    "integers": (Box(-5, 5, (2, 2), np.int32), MultiBinary([2, 2])),
}
"""Spaces of public datasets."""


@pytest.mark.filterwarnings("ignore:env_spec is None")
@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("by", ["rejeu", "minari 0.5.4", "minari 0.5.0"])
def test_a_dataset_of_any_layout_is_read(name: str, by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    observation_space, action_space = SPACES[name]
    env = Shaped(observation_space, action_space)
    if by == "rejeu":
        seen = record(tmp_path / "shown", env)
    else:
        if "slash" in name:
            pytest.skip("Minari itself cannot read keys with a slash")
        seen = by_minari(tmp_path / "shown", env, monkeypatch)
    if by == "minari 0.5.0":
        change_metadata(next((tmp_path / "shown").rglob("data")), as_of_0_5_0)
    found = demonstrations.read(tmp_path / "shown")
    assert same(found.observation_space, observation_space, bounds=True)
    assert same(found.action_space, action_space, bounds=True)
    assert len(found.episodes) == 2
    for rows, episode in zip(seen, found.episodes, strict=True):
        stacked = gym.vector.utils.concatenate(
            observation_space, rows, gym.vector.utils.create_empty_array(observation_space, STEPS + 1)
        )
        compare(episode.observations, stacked, tolerance=0 if by == "rejeu" else 60)
        assert len(episode.actions) == STEPS
        assert episode.rewards.tolist() == [0, 1, 2]
        assert episode.terminated


def compare(found: Any, expected: Any, tolerance: float) -> None:
    if isinstance(expected, dict):
        for key, value in expected.items():
            compare(found[key], value, tolerance)
    elif isinstance(expected, tuple):
        for one, other in zip(found, expected, strict=True):
            compare(one, other, tolerance)
    elif tolerance and expected.dtype == np.uint8 and expected.ndim > 2 and expected.shape[1] > 32:
        assert found.shape == expected.shape
        assert np.abs(found.astype(float) - expected).mean() < tolerance  # noise, compressed
    else:
        np.testing.assert_array_equal(found, expected)


def by_minari(folder: Path, env: gym.Env, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Lets Minari write two episodes, the second one appended, with everything else that it can write."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    buffers, seen = [], []
    for i in range(2):
        env.observation_space.seed(i)
        seen.append([env.observation_space.sample() for _ in range(STEPS + 1)])
        buffer = EpisodeBuffer(seed=i, options={"goal": {"x": 1}}, observations=seen[-1][0])
        for t, obs in enumerate(seen[-1][1:]):
            step = {"observation": obs, "action": env.action_space.sample(), "reward": float(t)}
            ends = {"terminated": t == STEPS - 1, "truncated": False, "info": {"qpos": np.zeros(3), "success": False}}
            buffer = buffer.add_step_data({**step, **ends})
        buffers.append(buffer)
    made = minari.create_dataset_from_buffers(
        "D4RL/env/human-v2",
        buffers[:1],
        observation_space=env.observation_space,
        action_space=env.action_space,
        algorithm_name="a",
        author="b",
        author_email="c",
        code_permalink="d",
        description="e",
        eval_env=gym.spec("CartPole-v1"),
        requirements=["mujoco>=3"],
    )
    made.update_dataset_from_buffer(buffers[1:])
    return seen


def as_of_0_5_0(metadata: dict[str, Any]) -> None:
    """With the fields of Gymnasium 0.29's specs, and without those that came later."""
    spec = {"id": "AdroitHandDoor-v1", "entry_point": "no_such_package:Env", "kwargs": {}, "order_enforce": True}
    spec |= {
        "apply_api_compatibility": False,
        "autoreset": False,
        "vector_entry_point": None,
        "additional_wrappers": [],
    }
    metadata.update(minari_version="0.5.0", env_spec=json.dumps(spec), combined_datasets=["a", "b"])
    del metadata["jpeg_encoding"]


def change_metadata(data: Path, change: Any) -> None:
    metadata = json.loads((data / dataset.METADATA).read_text())
    change(metadata)
    (data / dataset.METADATA).write_text(json.dumps(metadata))


def test_minari_reads_a_recording_of_large_spaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = record(tmp_path / "shown", Shaped(Box(0, 255, (100, 100, 3), np.uint8), Discrete(2)))
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "shown"))
    found = minari.load_dataset("Shaped/human-v0")
    assert (found.total_episodes, found.total_steps) == (2, 6)
    np.testing.assert_array_equal(found[1].observations, seen[1])
    assert [*minari.list_local_datasets()] == ["Shaped/human-v0"]


@pytest.mark.parametrize("damage", ["{", "", "[]", "{}", "[" * 100_000, None])
@pytest.mark.parametrize("close", [True, False])
def test_damaged_metadata_are_restored_from_the_episodes(damage: str | None, close: bool, tmp_path: Path) -> None:
    record(tmp_path / "shown", Shaped(VECTOR, Discrete(2)), close=close)
    file = next((tmp_path / "shown").rglob(dataset.METADATA))
    file.unlink() if damage is None else file.write_text(damage)
    with pytest.warns(UserWarning, match=r"metadata\.json is damaged .*is read without it"):
        found = demonstrations.read(tmp_path / "shown")
    assert (len(found.episodes), found.observation_space, found.action_space) == (2, VECTOR, Discrete(2))


def test_a_merge_that_was_killed_is_read_and_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At each of its steps: nothing replaced, the file replaced, the metadata replaced, one of the episodes removed."""
    record(tmp_path / "shown", Shaped(VECTOR, Discrete(2)), n=11, close=False)
    data = next((tmp_path / "shown").rglob("data"))
    expected = demonstrations.read(data).episodes
    kept = {path.name: path.read_bytes() for path in data.iterdir()}
    dataset.merge(data)
    merged = {path.name: path.read_bytes() for path in data.iterdir()}
    assert {*merged} == {dataset.MAIN, dataset.METADATA}
    for there in (
        {**kept, dataset.MAIN: merged[dataset.MAIN]},
        {**kept, **merged},
        {name: content for name, content in {**kept, **merged}.items() if name != "episode_0.hdf5"},
        merged,
    ):
        for path in data.iterdir():
            path.unlink()
        for name, content in there.items():
            (data / name).write_bytes(content)
        for again in (False, True):
            if again:
                dataset.merge(data)
            found = demonstrations.read(data).episodes
            assert [one.observations.tolist() for one in found] == [one.observations.tolist() for one in expected]
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "shown"))
    assert minari.load_dataset("Shaped/human-v0").total_episodes == 11


def test_a_full_disk_keeps_the_episodes_before_and_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk, env = FullDisk(monkeypatch), Shaped(VECTOR, Discrete(2))
    recording = Recording(tmp_path / "shown", env, None)

    def play(episodes: range) -> None:
        for i in episodes:
            recording.begin(np.full(2, i, float), None)
            recording.step(np.zeros(2), 1, 0.0, True, False)

    play(range(2))
    disk.full = True
    with pytest.warns(UserWarning, match="No space left on device.*the rest continues") as warned:
        play(range(2, 4))
    assert len(warned) == 1
    assert len(demonstrations.read(tmp_path / "shown").episodes) == 2
    disk.full = False
    play(range(4, 6))
    recording.close()
    found = demonstrations.read(tmp_path / "shown").episodes
    assert [one.observations[0, 0] for one in found] == [0, 1, 4, 5]
    assert str(recording).endswith("not written (No space left on device): episodes of the recording")


def test_a_disk_that_is_full_at_the_end_keeps_the_episodes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """HDF5 itself ends the process where a write fails, so it may not meet one."""
    record(tmp_path / "shown", Shaped(VECTOR, Discrete(2)), close=False)
    data = next((tmp_path / "shown").rglob("data"))

    class Full(dataset.Hdf5Output):
        error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(dataset, "Hdf5Output", Full)
    with pytest.raises(OSError, match=r"main_data.hdf5 could not be written: No space left on device"):
        dataset.merge(data)
    assert len(demonstrations.read(data).episodes) == 2


def compressed(data: Path, episode: Any) -> None:
    array = episode.create_dataset("rewards", (50_000_000,), "f8", compression="gzip", chunks=(1_000_000,))
    array[:1_000_000] = 0


def never_written(data: Path, episode: Any) -> None:
    """A fiftieth of what the file could hold if all of it were packed."""
    episode["noise"] = np.random.default_rng(0).random(200_000)
    episode.create_dataset("rewards", (100_000_000,), "f8", compression="gzip", chunks=(1_000_000,))[:10] = 0


def packed_chunks(data: Path, episode: Any) -> None:
    """Three chunks of 128 MiB, of which each takes 128 KiB."""
    array = episode.create_dataset("rewards", (3 * 2**24,), "f8", compression="gzip", chunks=(2**24,))
    packer = zlib.compressobj(9)
    chunk = b"".join([*(packer.compress(bytes(2**23)) for _ in range(16)), packer.flush()])
    for i in range(3):
        array.id.write_direct_chunk((i * 2**24,), chunk)


def large_chunk(data: Path, episode: Any) -> None:
    """Three numbers in a chunk of 2 GB."""
    array = episode.create_dataset("rewards", (3,), "f8", maxshape=(None,), compression="gzip", chunks=(2**28,))
    array.id.write_direct_chunk((0,), zlib.compress(bytes(2**20)))


def same_episode(data: Path, episode: Any) -> None:
    episode["rewards"] = np.zeros(20_000)
    for i in range(1000):
        episode.file[f"episode_{i + 10}"] = episode


def storage(data: Path, episode: Any) -> None:
    (data / "secret").write_bytes(bytes(range(24)))
    episode.create_dataset("rewards", (3,), "f8", external=[(str(data / "secret"), 0, 24)])


def virtual(data: Path, episode: Any) -> None:
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource("other.h5", "episode_0/rewards", (3,))
    episode.create_virtual_dataset("rewards", layout)


def picture(data: Path, episode: Any) -> None:
    """JPEG images of another size than that of the space, in a row of one byte each."""
    change_metadata(data, lambda m: m.update(jpeg_encoding=True, observation_space=json.dumps(LARGE)))
    episode.create_dataset("observations", (4,), h5py.vlen_dtype(np.uint8))[:] = [np.zeros(1, np.uint8)] * 4


def pictures(data: Path, episode: Any) -> None:
    """A million images without a byte."""
    change_metadata(data, lambda m: m.update(jpeg_encoding=True, observation_space=json.dumps(LARGE)))
    episode.create_dataset("observations", (1_000_000,), h5py.vlen_dtype(np.uint8))


def holding(value: Any) -> tuple[str, Any]:
    return "rewards", lambda data, episode: episode.update(rewards=value)


LARGE = {"type": "Box", "dtype": "uint8", "shape": [500, 500, 3], "low": 0, "high": 255}
DEEP = '{"type": "Tuple", "subspaces": [' * 5000 + "]}" * 5000
METADATA: dict[str, dict[str, Any]] = {
    "a Box of 10 GB": {"observation_space": json.dumps({**LARGE, "shape": [100_000, 100_000]})},
    "2 ** 62 choices": {"action_space": json.dumps({"type": "Discrete", "n": 2**62, "start": 0})},
    "binary of 10 ** 12": {"action_space": json.dumps({"type": "MultiBinary", "n": 10**12})},
    "a deep space": {"observation_space": DEEP},
    "a space of another kind": {"observation_space": json.dumps({"type": "Text", "max_length": 3})},
    "a space of no kind": {"observation_space": "[]"},
    "a space that is a number": {"observation_space": 3},
    "another format": {"data_format": "arrow"},
    "a deep spec": {"env_spec": '{"kwargs": ' + "[" * 100_000},
    "an id that is none": {"env_spec": json.dumps({"id": "\n"})},
    "a negative shape": {"observation_space": json.dumps({**LARGE, "shape": [-1]})},
}
FILES: dict[str, tuple[str | None, Any]] = {
    "sparse": ("rewards", lambda data, episode: episode.create_dataset("rewards", (500_000_000,), "f8")),
    "hole": ("rewards", lambda data, episode: episode.create_dataset("rewards", (500_000_000,), "f8").write_direct(
        np.ones(1), dest_sel=np.s_[-1:]
    )),
    "compressed": ("rewards", compressed),
    "never written": ("rewards", never_written),
    "packed chunks": ("rewards", packed_chunks),
    "large chunk": ("rewards", large_chunk),
    "filter": ("rewards", lambda data, episode: episode.create_dataset("rewards", data=np.arange(3), scaleoffset=4)),
    "the same episode": ("rewards", same_episode),
    "storage": ("rewards", storage),
    "virtual": ("rewards", virtual),
    "external": holding(h5py.ExternalLink("other.h5", "episode_0/rewards")),
    "soft": holding(h5py.SoftLink("/episode_1/rewards")),
    "text": holding(["a", "b", "c"]),
    "scalar": holding(3.0),
    "pairs": holding(np.zeros(3, [("a", "f8"), ("b", "f8")])),
    "missing": ("terminations", lambda data, episode: None),
    "group": (None, lambda data, episode: episode.file.update(episode_7=h5py.ExternalLink("other.h5", "episode_0"))),
    "array": (None, lambda data, episode: episode.file.update(episode_7=np.zeros(3))),
    "picture": ("observations", picture),
    "pictures": ("observations", pictures),
}  # fmt: skip
"""What is removed from the first episode, and what is done to it then."""


def damage(data: Path, name: str) -> None:
    """Damages a dataset, beside which there is a copy of its file."""
    shutil.copy(data / dataset.MAIN, data / "other.h5")
    removed, change = FILES[name]
    with h5py.File(data / dataset.MAIN, "r+") as file:
        if removed is not None:
            del file["episode_0"][removed]
        change(data, file["episode_0"])


@pytest.mark.parametrize("name", [*FILES, *METADATA])
def test_a_hostile_dataset_is_refused_on_one_line_in_little_time_and_memory(name: str, tmp_path: Path) -> None:
    data = plain(tmp_path)
    damage(data, name) if name in FILES else change_metadata(data, lambda m: m.update(METADATA[name]))
    tracemalloc.start()
    began = time.perf_counter()
    try:
        with pytest.raises(ValueError, match=r"data is damaged or of another kind \(.+\); copy or record it") as caught:
            demonstrations.read(tmp_path / "shown")
        assert tracemalloc.get_traced_memory()[1] < 64 * 2**20
    finally:
        tracemalloc.stop()
    assert time.perf_counter() - began < 5
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("content", [b"", b"no HDF5", None])
def test_one_damaged_episode_is_left_out_with_a_warning_and_the_others_are_read(
    content: bytes | None, tmp_path: Path
) -> None:
    record(tmp_path / "shown", Shaped(VECTOR, Discrete(2)), n=3, close=False)
    path = next((tmp_path / "shown").rglob("episode_1.hdf5"))
    path.write_bytes(path.read_bytes()[:-500] if content is None else content)
    (path.parent / "episode_of_mine.hdf5").write_bytes(b"stray")
    with pytest.warns(
        UserWarning,
        match=r"is read without episode_1\.hdf5, which is damaged \(.+; episode_of_mine\.hdf5, which is damaged \(.+\)$",
    ) as warned:
        found = demonstrations.read(tmp_path / "shown")
    assert len(found.episodes) == 2
    assert len(warned) == 1


def test_episodes_beside_a_damaged_main_file_are_read(tmp_path: Path) -> None:
    data = plain(tmp_path)
    content = (data / dataset.MAIN).read_bytes()
    shutil.copy(data / dataset.MAIN, data / "episode_0.hdf5")
    whole = len(demonstrations.read(data).episodes)
    (data / dataset.MAIN).write_bytes(content[: len(content) // 2])
    with pytest.warns(UserWarning, match=r"is read without main_data\.hdf5, which is damaged"):
        assert len(demonstrations.read(data).episodes) == whole


def test_a_thousand_links_to_one_episode_are_refused(tmp_path: Path) -> None:
    data = plain(tmp_path)
    with h5py.File(data / dataset.MAIN, "r+") as file:
        for i in range(2, 1000):
            file[f"episode_{i}"] = file["episode_0"]
    with pytest.raises(ValueError, match=r"it has [\d,]+ episodes, more than the file holds"):
        demonstrations.read(data)


@pytest.mark.parametrize("name", ["observations", "actions", *dataset.SERIES])
def test_an_episode_whose_parts_differ_in_length_is_left_out(name: str, tmp_path: Path) -> None:
    data = plain(tmp_path)
    whole = len(demonstrations.read(data).episodes)
    with h5py.File(data / dataset.MAIN, "r+") as file:
        rows = file["episode_0"][name][()]
        del file["episode_0"][name]
        file["episode_0"][name] = rows[:-1]
    with pytest.warns(
        UserWarning, match=r"is read without episode_0 of main_data.hdf5, it has \d+ rewards and \d+ \w+, expected"
    ):
        assert len(demonstrations.read(data).episodes) == whole - 1


@pytest.mark.parametrize(
    ("name", "rows", "message"),
    [
        ("observations", np.zeros((STEPS + 1, 7)), r"observations has rows of the shape \(7,\), expected \(\d+,\)"),
        ("observations", np.zeros(STEPS + 1), r"observations has rows of the shape \(\), expected \(\d+,\)"),
        ("rewards", np.zeros((STEPS, 1)), r"rewards has rows of the shape \(1,\), expected \(\)"),
        ("actions", np.full(STEPS, 0.5), r"actions has the dtype float64, expected whole numbers for Discrete\(2\)"),
        ("rewards", np.full(STEPS, b"a"), "rewards has the dtype .*, expected numbers"),
    ],
)
def test_wrong_contents_are_named_with_their_episode(name: str, rows: Any, message: str, tmp_path: Path) -> None:
    data = plain(tmp_path)
    with h5py.File(data / dataset.MAIN, "r+") as file:
        del file["episode_1"][name]
        file["episode_1"][name] = rows
    with pytest.raises(ValueError, match=rf"of another kind \(episode_1/{message}"):
        demonstrations.read(data)


def test_a_dataset_without_spaces_runs_no_code_to_find_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Minari makes the environment of the spec, whose code the file names."""
    (tmp_path / "rejeu_test_evil.py").write_text("raise SystemExit('code of a file was run')")
    monkeypatch.syspath_prepend(tmp_path)
    data = plain(tmp_path)
    spec = json.dumps({"id": "Evil-v0", "entry_point": "rejeu_test_evil:Env", "kwargs": {}, "additional_wrappers": []})
    change_metadata(data, lambda metadata: (metadata.pop("observation_space"), metadata.update(env_spec=spec)))
    with h5py.File(data / dataset.MAIN, "r+") as file:
        del file.attrs["observation_space"]
    with pytest.raises(ValueError, match="does not describe the spaces"):
        demonstrations.read(data)
    assert "rejeu_test_evil" not in sys.modules


@pytest.mark.parametrize(
    ("env_id", "kwargs"),
    [
        ("rejeu_test_evil:Env-v0", {}),
        ("FrozenLake-v1", {"map_name": "rejeu_test_evil:Env"}),
        ("Ant-v5", {"xml_file": "/rejeu_test_evil.xml"}),
    ],
)
def test_a_clone_imports_no_environment_that_a_dataset_names(
    env_id: str, kwargs: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Gymnasium imports what an id has before a colon."""
    from rejeu.lab.cli.clone import environment_of
    from rejeu.lab.cli.commands import Clone

    (tmp_path / "rejeu_test_evil.py").write_text("raise SystemExit('code of a file was run')")
    monkeypatch.syspath_prepend(tmp_path)
    data = plain(tmp_path)
    spec = json.dumps({"id": env_id, "entry_point": "rejeu_test_evil:Env", "kwargs": kwargs})
    change_metadata(data, lambda metadata: metadata.update(env_spec=spec))
    with pytest.raises(CheckpointError, match=r"no file may .*: *--env") as caught:
        environment_of(demonstrations.read(data), Clone(dataset=data))
    assert "\n" not in str(caught.value)
    assert "rejeu_test_evil" not in sys.modules
