"""Minari datasets in HDF5, read as data: nothing that a file names is imported or opened, and its sizes are those of the file.

A folder ``data`` holds ``metadata.json``, with the spaces, and ``main_data.hdf5``, with a group for each episode. While an
episode is recorded, those before it are each a file of their own, which is written at once or not at all; :func:`merge` moves
them into ``main_data.hdf5`` at the end.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium.envs.registration import EnvSpec

from rejeu.core import atomic, spaces
from rejeu.core.records import WRONG, brief, shown, stored_size
from rejeu.core.types import Action, Observation

METADATA, MAIN = "metadata.json", "main_data.hdf5"
EPISODE = re.compile(r"episode_(\d{1,9})")
SPACES = ("observation_space", "action_space")
SERIES = ("rewards", "terminations", "truncations")
MOST_METADATA = 16 * 2**20
"""Upper limit on the bytes of the metadata; the bounds of images are written as numbers."""
SLACK, ROOM = 2**20, 16
"""How many bytes may be read: a fixed number, and a multiple of those of the file, because some disks compress files."""
UNPACKED, PACKED = 2**28, 64
"""Of those that the file itself has compressed as many, or a multiple of those of the file if that is more."""
LEAST_EPISODE = 512
"""Fewest bytes of an episode in a file. Links to the same one take 30, and as long to be read."""
FILTERS = {1: 1032, 2: 1, 3: 1, 32000: 88}
"""The filters of HDF5 that are read, and how many bytes each makes of one at most: deflate, shuffle, checksum, LZF."""


class ArrayReader:
    """Reads arrays from the files of a dataset, until more was asked for than they can hold. Mutable."""

    def __init__(self, files: list[Path], is_jpeg: bool) -> None:
        self.is_jpeg = is_jpeg
        real = sum(map(stored_size, files))
        self.size, self.left = sum(file.stat().st_size for file in files), SLACK + ROOM * real
        self.unpacked = max(UNPACKED, PACKED * real)

    def part(self, group: Any, path: str, space: gym.Space | None) -> Any:
        """Returns a part of an episode: arrays in the structure of a space, or subspace array."""
        import h5py

        for name in path.split("/"):
            if not isinstance(group, h5py.Group) or not isinstance(group.get(name, getlink=True), h5py.HardLink):
                raise ValueError(f"{shown(path)} is missing, or a link to somewhere else")
            group = group[name]
        if isinstance(space, gym.spaces.Dict):
            return {key: self.part(group, key, subspace) for key, subspace in space.spaces.items()}
        if isinstance(space, gym.spaces.Tuple):
            return tuple(self.part(group, f"_index_{i}", subspace) for i, subspace in enumerate(space.spaces))
        if not isinstance(group, h5py.Dataset) or group.external or group.is_virtual or not group.ndim:
            raise ValueError(f"{shown(path)} is no array that the file itself holds")
        shape = () if space is None else space.shape or ()
        if self.is_jpeg and len(shape) > 1 and (group.dtype.kind == "O" or group.ndim != 1 + len(shape)):
            self._take(path, len(group) * math.prod(shape), self.unpacked)
            pictures = (picture(row, shape) for row in group)
            return np.fromiter(pictures, np.dtype((np.uint8, shape)), len(group))
        if group.dtype.kind not in "biuf":
            raise ValueError(f"{shown(path)} has the dtype {group.dtype}, expected numbers")
        if group.shape[1:] != shape:
            raise ValueError(f"{shown(path)} has rows of the shape {shown(group.shape[1:])}, expected {shape}")
        if group.dtype.kind == "f" and space is not None and space.dtype.kind != "f":  # type: ignore[union-attr]
            raise ValueError(f"{shown(path)} has the dtype {group.dtype}, expected whole numbers for {shown(space)}")
        plist = group.id.get_create_plist()
        filters = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]
        if unknown := {*filters} - FILTERS.keys():
            raise ValueError(f"{shown(path)} is packed by the filters {shown(sorted(unknown))}, expected gzip or lzf")
        limit = min(group.id.get_storage_size(), self.size) * math.prod(FILTERS[number] for number in filters)
        chunk = math.prod(group.chunks or ()) * group.dtype.itemsize  # subspace is unpacked as a whole
        self._take(path, max(group.nbytes, chunk if group.nbytes else 0), limit, bool(filters))
        return group[()]

    def _take(self, path: str, n: int, limit: int, is_packed: bool = True) -> None:
        self.left -= 0 if is_packed else n
        self.unpacked -= n if is_packed else 0
        if n > limit or min(self.left, self.unpacked) < 0:
            raise ValueError(f"{shown(path)} has {n:,} bytes, more than the file holds")


def read(data: Path) -> tuple[list[tuple[Any, ...]], gym.Space, gym.Space, EnvSpec | None]:
    """Returns the episodes of a dataset, its two spaces and its spec.

    An episode is its name, observations, actions, rewards, terminations and truncations.

    Warns if the metadata cannot be read and those in the episodes' file are used.

    Raises:
        ValueError: if the dataset is damaged, on one line.
    """
    import h5py

    files = [path for path in (data / MAIN, *parts(data)) if path.is_file()]
    try:
        metadata = metadata_of(data, files)
        rows = ArrayReader(files, bool(metadata.get("jpeg_encoding", True)))
        if (form := metadata.get("data_format", "hdf5")) != "hdf5":
            raise ValueError(f"it is in the format {shown(form)}, and only hdf5 is read")
        limit = max(spaces.MAX_NUMBERS, rows.left)
        both = [spaces.rebuild(described(json.loads(metadata[name])), limit) for name in SPACES]
        keys = dict(zip(("observations", "actions", *SERIES), (*both, None, None, None), strict=True))
        episodes: dict[int, tuple[Any, ...]] = {}
        left_out: list[str] = []
        for path in files:
            with passed_over(path, left_out), h5py.File(path, "r") as file:
                if len(file) > 1 + stored_size(path) // LEAST_EPISODE:
                    raise ValueError(f"it has {len(file):,} episodes, more than the file holds")
                for name in file:
                    if (match := EPISODE.fullmatch(name)) and (i := int(match[1])) not in episodes:
                        episode = tuple(rows.part(file, f"{name}/{key}", space) for key, space in keys.items())
                        if problem := problem_of(*episode):
                            left_out.append(f"{name} of {path.name}, {problem}")
                        else:
                            episodes[i] = name, *episode
        if left_out and not episodes:
            raise ValueError(f"nothing is left without {left_out[0]}")
        if left_out:
            more = f", and {len(left_out) - 3} more" if len(left_out) > 3 else ""
            warnings.warn(f"{atomic.shortened(data)} is read without {'; '.join(left_out[:3])}{more}", stacklevel=3)
        return [episodes[i] for i in sorted(episodes)], both[0], both[1], spec_of(metadata.get("env_spec"))
    except (*WRONG, OSError, RuntimeError) as error:
        problem = f"{atomic.shortened(data)} is damaged or of another kind ({brief(error)})"
        raise ValueError(f"{problem}; copy or record it again") from error


@contextmanager
def passed_over(path: Path, left_out: list[str]) -> Iterator[None]:
    """Context in which a file of episodes is read: a damaged one is added to those that are left out."""
    try:
        yield
    except (*WRONG, OSError, RuntimeError) as error:
        if path.name == MAIN and not isinstance(error, OSError):  # no accident
            raise
        left_out.append(f"{path.name}, which is damaged ({brief(error)})")


def problem_of(observations: Observation, actions: Action, rewards: np.ndarray, *ends: np.ndarray) -> str:
    """Returns the part of an episode whose length does not fit its rewards, as text; empty if all fit."""
    n = len(rewards)
    parts = {"observations": (observations, n + 1), "actions": (actions, n)}
    parts |= {key: (flags, n) for key, flags in zip(SERIES[1:], ends, strict=True)}
    for key, (series, expected) in parts.items():
        if wrong := {len(leaf) for leaf in jax.tree.leaves(series)} - {expected}:
            return f"it has {n} rewards and {wrong.pop()} {key}, expected {expected}"
    return ""


def metadata_of(data: Path, files: list[Path]) -> Mapping[str, Any]:
    """Returns the metadata of a dataset; where they are damaged those of its episodes' file, with a warning."""
    import h5py

    try:
        if not (data / METADATA).is_file():
            raise ValueError(f"{METADATA} is missing")
        with (data / METADATA).open("rb") as file:
            metadata = json.loads(file.read(MOST_METADATA))
        if not isinstance(metadata, dict) or not metadata.keys() >= {*SPACES}:
            raise ValueError(f"{METADATA} does not describe the spaces")
        return metadata
    except (ValueError, RecursionError) as error:
        for path in files:
            with suppress(OSError), h5py.File(path, "r") as file:
                if file.attrs.keys() >= {*SPACES}:
                    where = atomic.shortened(data / METADATA)
                    warnings.warn(f"{where} is damaged ({brief(error)}); {path.name} is read without it", stacklevel=4)
                    sizes = {name: file.attrs.get_id(name).get_storage_size() for name in file.attrs}
                    return {name: file.attrs[name] for name, size in sizes.items() if size <= MOST_METADATA}
        raise


def parts(data: Path) -> list[Path]:
    """Returns the files of the episodes that are not in the main file yet."""
    return sorted(data.glob("episode_*.hdf5"))


def described(space: Any) -> Any:
    """Returns Minari's description of a space as one of :func:`rejeu.core.spaces.describe`."""
    name = space["type"]
    if name == "Dict":
        return {name: {key: described(subspace) for key, subspace in space["subspaces"].items()}}
    if name == "Tuple":
        return {name: [described(subspace) for subspace in space["subspaces"]]}
    if name == "MultiBinary":
        return {name: {"shape": np.ravel(space["n"]).tolist()}}
    return {name: {"start": 0, **space}}


def spec_of(text: str | None) -> EnvSpec | None:
    """Returns the spec of an environment, also one that another version of Gymnasium wrote; it names code, and runs none."""
    if text is None:
        return None
    names = {field.name for field in dataclasses.fields(EnvSpec) if field.init}
    fields = {key: value for key, value in json.loads(text).items() if key in names}
    return EnvSpec.from_json(json.dumps({"additional_wrappers": [], **fields}))


def picture(data: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Returns the image of a JPEG file, ``uint8`` of this shape."""
    from PIL import Image

    try:
        image = Image.open(io.BytesIO(bytes(data)), formats=["JPEG"])
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from None
    if image.size != shape[1::-1]:
        raise ValueError(f"an image has the size {image.size}, expected {shape[1::-1]}")
    return np.asarray(image).reshape(shape)


def episode(i: int, steps: list[tuple[Any, ...]], seed: int | None, metadata: Mapping[str, object]) -> bytes:
    """Returns the file of an episode: ``(obs,)`` of the reset, then ``(obs, action, reward, terminated, truncated)``."""
    import h5py

    content = io.BytesIO()
    with h5py.File(content, "w", libver="latest") as file:  # of which attributes can be large
        file.attrs.update(metadata)
        group = file.create_group(f"episode_{i}")
        group.attrs.update({"id": i, "total_steps": len(steps) - 1, **({} if seed is None else {"seed": seed})})
        obs, *others = zip(*steps[1:], strict=True)
        put(group, "observations", [steps[0][0], *obs])
        for name, column in zip(("actions", *SERIES), others, strict=True):
            put(group, name, column)
    return content.getvalue()


def put(group: Any, name: str, rows: Sequence[Any]) -> None:
    """Adds rows to a file in Minari's layout: a dict or tuple is a group, everything else an array."""
    first = rows[0]
    if isinstance(first, Mapping | tuple):
        within = group.create_group(name)
        for key in range(len(first)) if isinstance(first, tuple) else first:
            put(within, f"_index_{key}" if isinstance(first, tuple) else str(key), [row[key] for row in rows])
    else:
        group.create_dataset(name, data=list(rows) if isinstance(first, str) else np.stack(rows))


class Hdf5Output(io.FileIO):
    """A file for HDF5, which ends the process where a write fails; here the first error is kept for later. Mutable."""

    error: OSError | None = None

    def write(self, content: Any) -> int:
        """Writes all of it, or nothing after an error."""
        remaining = memoryview(content).cast("B")
        try:
            while remaining and self.error is None:
                remaining = remaining[super().write(remaining) :]
        except OSError as error:
            self.error = error
        return len(content)


def merge(data: Path) -> None:
    """Moves recorded episodes into the main file and counts them, as Minari reads them; may be called again after a crash.

    Raises:
        OSError: if that cannot be written; the episodes are then where they were.
    """
    import h5py

    episode_files = parts(data)
    sources = [path for path in (data / MAIN, *episode_files) if path.is_file()]
    with atomic.replacing(data / MAIN) as replaced, Hdf5Output(replaced.name, "r+b") as sink:
        with h5py.File(sink, "w", libver="latest", track_order=True) as file:
            for path in sources:
                with h5py.File(path, "r") as source:
                    file.attrs.update(source.attrs)
                    for name in sorted(source.keys() - file.keys(), key=lambda name: int(name.rpartition("_")[2])):
                        source.copy(name, file)
            steps = [int(group.attrs["total_steps"]) for group in file.values()]
        if sink.error is not None:
            raise sink.error
    metadata = json.loads((data / METADATA).read_text(encoding="utf-8"))
    size = round((data / MAIN).stat().st_size / 1e6, 1)
    metadata |= {"total_episodes": len(steps), "total_steps": sum(steps), "dataset_size": size}
    atomic.write(data / METADATA, json.dumps(metadata))
    for path in episode_files:
        path.unlink()
