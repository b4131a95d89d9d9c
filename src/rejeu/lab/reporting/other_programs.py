"""Runs of other programs: Stable-Baselines3's ``monitor.csv``, TensorBoard files and folders of RL Zoo.

YAML files of RL Zoo (``config.yml``, ``args.yml``) are not read, because they may name code; algorithm and environment are
taken from the names of the folders, as RL Zoo gives them: ``ALGORITHM/ENV_NUMBER``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from rejeu.algorithms.catalog import CATALOG
from rejeu.core.errors import requires
from rejeu.core.records import Malformed, parse_json, shown
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.read import MAX_NAME, MAX_STEP, RunSummary, is_file, ordered
from rejeu.logs.formatting import counted
from rejeu.logs.tables import EMPTY, MAX_CELLS, MAX_COLUMNS, Table, read_bytes, read_table

MONITOR = re.compile(r"(.*\.)?monitor\.csv")
EVENTS = re.compile(r"events\.out\.tfevents\..+")
FILES = (MONITOR, EVENTS)
ZOO_NAME = re.compile(r"(.+-v\d+)_(\d+)")
ALGORITHMS = {key: entry.name for entry in CATALOG.values() for key in (entry.name.lower(), entry.zoo) if key}
ALGORITHMS["her"] = "HER"
"""Algorithms by the names of RL Zoo's folders."""
MAX_FILES = 4096
"""Upper limit on the files of one run."""
MAX_SCALAR_BYTES = 2**24
"""Upper limit on the bytes of the records with scalars of one run: some 300,000 points."""
MAX_RECORD = 2**16
"""Upper limit on the bytes of a record with scalars."""
MAX_EVENTS = 10_000
"""Points that are kept of each curve in TensorBoard files, up to twice as many; of longer ones every second is dropped."""


def files(folder: Path, pattern: re.Pattern[str]) -> list[Path]:
    """Returns the files in a folder whose names match ``MONITOR``, one for each environment, or ``EVENTS``."""
    return sorted(path for path in folder.iterdir() if pattern.fullmatch(path.name) and is_file(path))[:MAX_FILES]


def read_monitor(path: Path) -> RunSummary:
    """Returns the run of a ``monitor.csv``, or of all such files in a folder as the environments of one run.

    Raises:
        ValueError: if no file holds the columns r, l and t.
    """
    notes: list[str] = []
    tables, starts, env_id = [], [], ""
    for file in files(path, MONITOR) if path.is_dir() else [path]:
        start, said_env = monitor_header(file)
        table = read_table(file, only=("r", "l", "t", "is_success"), skip_lines=1)
        notes += table.notes
        if {"r", "l", "t"} <= table.columns.keys():
            tables.append(table)
            starts.append(start)
            env_id = env_id or said_env
    if not tables:
        raise ValueError(f"{shown(path, 300)} is no monitor.csv of Stable-Baselines3: expected the columns r, l and t")
    env = np.repeat(np.arange(float(len(tables))), [*map(len, tables)])
    began = np.repeat(np.array(starts) - min(starts), [*map(len, tables)])
    names = ("r", "l", "is_success", "t")
    returns, length, success, time = (np.concatenate([table.column(name) for table in tables]) for name in names)
    seconds = time + began
    valid = (length >= 0) & (length <= MAX_STEP)
    if not valid.all():
        n_bad = int(np.sum(~valid))
        rows = f"{counted(n_bad, 'damaged row')} without a valid length"
        notes.append(f"{rows} {'was' if n_bad == 1 else 'were'} left out")
    order = np.argsort(seconds, kind="stable")
    order = order[valid[order]]
    steps = np.cumsum(length[order])
    columns = {"env": env, "return": returns, "length": length, "success": success, "seconds": seconds}
    table = ordered(Table({"step": steps, **{name: column[order] for name, column in columns.items()}}, tuple(notes)))
    folder = path if path.is_dir() else path.parent
    algorithm, named_env, number = named(folder)
    return RunSummary(
        path=path.resolve(),
        name=shown(folder.name, MAX_NAME),
        format="monitor",
        config=RunConfig(env=env_id or named_env, algorithm=algorithm, seed=number, n_envs=len(tables)),
        steps=int(steps[-1]) if len(steps) else 0,
        seconds=float(table.columns["seconds"][-1]) if len(table) else float("nan"),
        episodes=table,
        notes=table.notes,
    )


def monitor_header(path: Path) -> tuple[float, str]:
    """Returns start time and environment from the first line of a ``monitor.csv``: ``#{"t_start": ..., "env_id": ...}``."""
    try:
        line = read_bytes(path, 4096).split(b"\n")[0]
        content = parse_json(line.removeprefix(b"#"))
    except (OSError, Malformed):
        return 0.0, ""
    if not isinstance(content, Mapping):
        return 0.0, ""
    start, env = content.get("t_start"), content.get("env_id")
    began = float(start) if isinstance(start, int | float) and abs(start) < 1e12 else 0.0
    return began, shown(env, MAX_NAME) if isinstance(env, str) else ""


def named(folder: Path) -> tuple[str, str, int | None]:
    """Returns algorithm, environment and number of a run from the names of RL Zoo's folders; empty where they do not say.

    >>> named(Path("logs/ppo/CartPole-v1_2"))
    ('PPO', 'CartPole-v1', 2)
    """
    algorithm = ALGORITHMS.get(folder.parent.name.lower(), "")
    numbered = ZOO_NAME.fullmatch(folder.name)
    if numbered is None:  # as Stable-Baselines3 names its TensorBoard folders
        match = re.fullmatch(r"([A-Za-z0-9]+)_(\d{1,9})", folder.name)
        if match is not None and match[1].lower() in ALGORITHMS:
            return ALGORITHMS[match[1].lower()], "", int(match[2])
        return algorithm, "", None
    return algorithm, shown(numbered[1], MAX_NAME), int(numbered[2][:9])


def read_tensorboard(folder: Path) -> RunSummary:
    """Returns the run of a folder with TensorBoard files: its scalars are the metrics.

    Raises:
        MissingExtra: if tensorboard is not installed.
    """
    with requires("reading TensorBoard files", "tensorboard", "tensorboard"):
        import tensorboard.util.tensor_util  # noqa: F401 - where it is used it may not fail
    notes = []
    values: dict[str, dict[int, tuple[float, float]]] = {}
    bytes_left = MAX_SCALAR_BYTES
    for path in files(folder, EVENTS):
        with path.open("rb") as file:
            try:
                for record in records(file):
                    if (bytes_left := bytes_left - len(record)) < 0:
                        break
                    take_scalars(record, values)
            except Exception as error:  # of protobuf or of TensorBoard, for damaged records
                notes.append(f"{path.name} is damaged or incomplete: {shown(error)}")
            if bytes_left < 0:
                notes.append(f"only the first {MAX_SCALAR_BYTES >> 20} MiB of scalars were read")
                break
    metrics = ordered(table_of(values)) if values else EMPTY
    algorithm, env_id, number = named(folder)
    seconds = metrics.column("time/time_elapsed")
    return RunSummary(
        path=folder.resolve(),
        name=shown(folder.name, MAX_NAME),
        format="tensorboard",
        config=RunConfig(env=env_id, algorithm=algorithm, seed=number),
        steps=int(metrics.columns["step"][-1]) if len(metrics) else 0,
        seconds=float(seconds[-1]) if len(seconds) else float("nan"),
        metrics=metrics,
        notes=(*notes, *metrics.notes),
    )


def records(file: BinaryIO) -> Iterator[bytes]:
    """Yields the records of a TensorBoard file that are small enough to hold scalars; pictures and texts are passed over.

    TensorBoard's own reader takes a minute for 256 MiB of one record.

    Raises:
        Malformed: at a damaged or incomplete record.
    """
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c

    while head := file.read(12):
        n, begin = int.from_bytes(head[:8], "little"), file.tell()
        record = file.read(min(n, MAX_RECORD) + 4)
        size = os.fstat(file.fileno()).st_size
        parts = [(head[:8], head[8:]), *([(record[:-4], record[-4:])] if n <= MAX_RECORD else [])]
        if begin + n + 4 > size or any(masked_crc32c(data) != int.from_bytes(crc, "little") for data, crc in parts):
            raise Malformed(f"it was read up to byte {begin - 12:,}")
        if n <= MAX_RECORD:
            yield record[:-4]
        file.seek(begin + n + 4)


def take_scalars(record: bytes, values: dict[str, dict[int, tuple[float, float]]]) -> None:
    """Adds the scalars of a record of a TensorBoard file to the columns in ``values``."""
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.util.tensor_util import make_ndarray

    event = Event.FromString(record)
    for scalar in event.summary.value:
        if scalar.HasField("simple_value"):
            value = scalar.simple_value
        elif scalar.metadata.plugin_data.plugin_name == "scalars" and not scalar.tensor.tensor_shape.dim:
            value = float(make_ndarray(scalar.tensor).item())
        else:
            continue
        name = shown(scalar.tag, MAX_NAME)
        if name not in values and len(values) == MAX_COLUMNS:
            continue
        column = values.setdefault(name, {})
        column[event.step] = value, event.wall_time
        if len(column) > 2 * MAX_EVENTS:
            values[name] = dict([*column.items()][::2])


def table_of(values: Mapping[str, Mapping[int, tuple[float, float]]]) -> Table:
    """Returns scalars as one table by step, with the wall time since the first; of too many steps some are left out."""
    steps = sorted({step for column in values.values() for step in column})
    steps = steps[:: 1 + len(steps) * len(values) // MAX_CELLS]
    row = {step: i for i, step in enumerate(steps)}
    columns: dict[str, np.ndarray] = {"step": np.array(steps, np.float64)}
    wall = np.full(len(steps), np.nan)
    for name, column in values.items():
        columns[name] = np.full(len(steps), np.nan)
        for step in column.keys() & row:
            columns[name][row[step]], wall[row[step]] = column[step]
    columns.setdefault("time/time_elapsed", wall - np.nanmin(wall))
    return Table(columns)
