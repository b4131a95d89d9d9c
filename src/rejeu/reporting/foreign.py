"""Runs of other programs as the same record: Stable-Baselines3's ``monitor.csv``, TensorBoard files and folders of RL Zoo.

YAML files of RL Zoo (``config.yml``, ``args.yml``) are not read, because they may name code; algorithm and environment are
taken from the names of the folders, as RL Zoo gives them: ``ALGORITHM/ENV_NUMBER``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rejeu.errors import MissingExtra
from rejeu.io.records import Malformed, parse_json, shown
from rejeu.reporting.runs import MAX_NAME, Episodes, Run, is_file, ordered
from rejeu.reporting.tables import EMPTY, Table, read_bytes, read_table

MONITOR = re.compile(r"(.*\.)?monitor\.csv")
EVENTS = re.compile(r"events\.out\.tfevents\..+")
ZOO_NAME = re.compile(r"(.+-v\d+)_(\d+)")
ALGORITHMS = {"a2c": "A2C", "ddpg": "DDPG", "dqn": "DQN", "ppo": "PPO", "sac": "SAC", "td3": "TD3", "tqc": "TQC"}
ALGORITHMS |= {
    "qrdqn": "QRDQN",
    "ppo_lstm": "RecurrentPPO",
    "crossq": "CrossQ",
    "trpo": "TRPO",
    "ars": "ARS",
    "her": "HER",
}
"""Algorithms by the names of RL Zoo's folders."""
MAX_FILES = 4096
"""Upper limit on the files of one run."""
MAX_EVENT_BYTES = 2**28
MAX_EVENTS = 10_000
"""Points that are kept of each curve in TensorBoard files; of longer ones a sample."""


def monitor_files(folder: Path) -> list[Path]:
    """Returns the ``monitor.csv`` files in a folder; Stable-Baselines3 writes one for each environment."""
    return sorted(path for path in folder.iterdir() if MONITOR.fullmatch(path.name) and is_file(path))[:MAX_FILES]


def event_files(folder: Path) -> list[Path]:
    """Returns the TensorBoard files in a folder."""
    return sorted(path for path in folder.iterdir() if EVENTS.fullmatch(path.name) and is_file(path))[:MAX_FILES]


def read_monitor(path: Path) -> Run:
    """Returns the run of a ``monitor.csv``, or of all such files in a folder as the environments of one run.

    Raises:
        ValueError: if no file holds the columns r, l and t.
    """
    files = monitor_files(path) if path.is_dir() else [path]
    notes: list[str] = []
    parts, starts, env_id = [], [], ""
    for file in files:
        start, said_env = monitor_header(file)
        table = read_table(file, only=("r", "l", "t", "is_success"), skip_lines=1)
        notes += table.notes
        if {"r", "l", "t"} <= table.columns.keys():
            parts.append(table)
            starts.append(start)
            env_id = env_id or said_env
    if not parts:
        raise ValueError(f"{shown(path, 300)} is no monitor.csv of Stable-Baselines3: expected the columns r, l and t")
    names = ("r", "l", "is_success")
    env = np.concatenate([np.full(len(one), float(i)) for i, one in enumerate(parts)])
    first = min(starts)
    seconds = np.concatenate([one.columns["t"] + (start - first) for one, start in zip(parts, starts, strict=True)])
    returns, length, success = (np.concatenate([one.column(name) for one in parts]) for name in names)
    order = np.argsort(seconds, kind="stable")
    steps = np.cumsum(np.nan_to_num(np.clip(length[order], 0, None), posinf=0.0))
    columns = {"env": env, "return": returns, "length": length, "success": success, "seconds": seconds}
    table = ordered(Table({"step": steps, **{name: one[order] for name, one in columns.items()}}, tuple(notes)))
    episodes = Episodes(*(table.column(name) for name in ("step", "env", "return", "length", "success", "seconds")))
    folder = path if path.is_dir() else path.parent
    said = named(folder)
    return Run(
        path=path.resolve(),
        name=shown(folder.name, MAX_NAME),
        format="monitor",
        algorithm=said[0],
        env_id=env_id or said[1],
        seed=said[2],
        n_envs=len(parts),
        steps=int(steps[-1]) if len(steps) else 0,
        seconds=float(episodes.seconds[-1]) if len(episodes) else float("nan"),
        episodes=episodes,
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
    found = ZOO_NAME.fullmatch(folder.name)
    if found is None:  # as Stable-Baselines3 names its TensorBoard folders
        kind = re.fullmatch(r"([A-Za-z0-9]+)_(\d{1,9})", folder.name)
        if kind is not None and kind[1].lower() in ALGORITHMS:
            return ALGORITHMS[kind[1].lower()], "", int(kind[2])
        return algorithm, "", None
    return algorithm, shown(found[1], MAX_NAME), int(found[2][:9])


def read_tensorboard(folder: Path) -> Run:
    """Returns the run of a folder with TensorBoard files: its scalars are the metrics.

    Raises:
        MissingExtra: if tensorboard is not installed.
    """
    try:
        from tensorboard.backend.event_processing.event_accumulator import SCALARS, TENSORS, EventAccumulator
    except ImportError:
        raise MissingExtra("reading TensorBoard files", "tensorboard", "tensorboard") from None
    files = event_files(folder)
    notes = []
    values: dict[str, dict[int, tuple[float, float]]] = {}
    for file in files:
        if file.stat().st_size > MAX_EVENT_BYTES:
            notes.append(f"{file.name} has more than {MAX_EVENT_BYTES >> 20} MiB and was left out")
            continue
        events = EventAccumulator(str(file), size_guidance={SCALARS: MAX_EVENTS, TENSORS: 1})
        try:
            events.Reload()
        except Exception as error:  # of protobuf or of TensorBoard, for damaged records
            notes.append(f"{file.name} is damaged: {shown(error)}")
        for tag in sorted(events.Tags()["scalars"])[:512]:
            column = values.setdefault(shown(tag, MAX_NAME), {})
            column.update((event.step, (event.value, event.wall_time)) for event in events.Scalars(tag))
    metrics = ordered(table_of(values)) if values else EMPTY
    algorithm, env_id, number = named(folder)
    seconds = metrics.column("time/time_elapsed")
    return Run(
        path=folder.resolve(),
        name=shown(folder.name, MAX_NAME),
        format="tensorboard",
        algorithm=algorithm,
        env_id=env_id,
        seed=number,
        steps=int(metrics.columns["step"][-1]) if len(metrics) else 0,
        seconds=float(seconds[-1]) if len(seconds) else float("nan"),
        metrics=metrics,
        notes=(*notes, *metrics.notes),
    )


def table_of(values: Mapping[str, Mapping[int, tuple[float, float]]]) -> Table:
    """Returns scalars as one table by step, with the wall time since the first of them."""
    steps = sorted({step for column in values.values() for step in column})
    row = {step: i for i, step in enumerate(steps)}
    columns: dict[str, Any] = {"step": np.array(steps, np.float64)}
    wall = np.full(len(steps), np.nan)
    for name, column in values.items():
        columns[name] = np.full(len(steps), np.nan)
        for step, (value, time) in column.items():
            columns[name][row[step]] = value
            wall[row[step]] = time
    columns.setdefault("time/time_elapsed", wall - np.nanmin(wall))
    return Table(columns)
