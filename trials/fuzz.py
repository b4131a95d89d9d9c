"""Coverage-guided fuzzing of all functions that read files.

Requires atheris, which is not a dependency of rejeu (Linux and macOS)::

    pip install atheris
    python trials/fuzz.py --seconds 300 --target all

Each target runs in its own process. Its seeds are the recorded files of ``tests/golden``. Inputs are mutated as bytes, as
JSON, as arrays and as tables. Most of the time checksums and lengths are corrected afterwards, so that the code behind
these checks is reached. A finding is any exception other than ``CheckpointError``, any input that exceeds its time limit,
and any file that loads but cannot be used. Findings are saved in ``trials/results/findings``, and counts in
``trials/results/fuzz.json``.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import random
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from provenance import provenance

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
RESULTS = ROOT / "trials" / "results"
SECONDS = {"agent": 20.0}
"""Maximum processor time per input in seconds; two by default. Creating networks includes their compilation."""
SEEDS = {
    "table": ("sac", "td3", "dqn", "ppo", "replay", "vec_normalize"),
    "header": ("sac", "td3", "dqn", "ppo"),
    "agent": ("sac", "td3", "dqn", "ppo"),
    "replay": ("replay",),
    "vec_normalize": ("vec_normalize",),
}
"""The targets and their seed files from ``tests/golden``."""
VALUES: tuple[Any, ...] = (None, True, False, 0, -1, 1, 2, 3, 0.5, 1e-9, 1e300, -1e300, 2**31, 2**63, 2**127, 10**15)
VALUES += ([], {}, [[]], [1], [0.0], [3, 3], {"float": "nan"}, {"float": "inf"}, {"tuple": []}, {"dict": {}})
VALUES += ("", "a", "inf", "-inf", "auto", "normal", "linear", "relu", "simba", "gru", "os.system", "float64")
VALUES += ("envpool", "CartPole-v1", "rejeu/Ball-v0", "HerReplayBuffer")
VALUES += ("SAC", "DDPG", "TD3", "TQC", "CrossQ", "DQN", "QRDQN", "PPO", "A2C", "PQN", "RecurrentPPO", "MaskablePPO")
"""Replacements for values of a header, in addition to each other."""


def main() -> None:
    """Runs the selected targets one after the other and writes the results."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=int, default=300, help="time for each target")
    parser.add_argument("--target", choices=["all", *SEEDS], default="all")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        fuzz(arguments.target, arguments.seconds)
        return
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / "fuzz.json"
    for target in SEEDS if arguments.target == "all" else [arguments.target]:
        found = in_process(target, arguments.seconds)
        print(target, found, flush=True)
        found |= provenance()
        result = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        path.write_text(json.dumps(result | {target: found}, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def in_process(target: str, seconds: int) -> dict[str, Any]:
    """Fuzzes one target in a new process and returns the results to record."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        command = [sys.executable, __file__, "--child", "--target", target, "--seconds", str(seconds)]
        environment = os.environ | {"FUZZ_FOLDER": folder}
        began = time.monotonic()
        with open(Path(folder) / "log", "w+", encoding="utf-8", errors="replace") as log:
            code = subprocess.run(command, env=environment, stderr=log, stdout=log, check=False).returncode
            log.seek(0)
            text = log.read()
        counts_path = Path(folder) / "counts.json"
        counts = json.loads(counts_path.read_text(encoding="utf-8")) if counts_path.exists() else {}
        lines = re.findall(r"cov: (\d+) ft: (\d+) corp: (\d+)", text)
        cover = dict(zip(("coverage", "features", "corpus"), map(int, lines[-1]), strict=True)) if lines else {}
        ended = {} if code == 0 else {"ended_with": code, "last_words": text[-1500:]}
        return counts | cover | ended | {"seconds": round(time.monotonic() - began)}


def fuzz(target: str, seconds: int) -> None:
    """Fuzzes one target in this process, which then exits."""
    import atheris

    with atheris.instrument_imports(include=["rejeu"]):
        import rejeu  # noqa: F401

    folder = Path(os.environ["FUZZ_FOLDER"])
    golden = [ROOT / "tests" / "golden" / schema for schema in ("schema1", "schema2")]
    corpus = folder / "corpus"
    corpus.mkdir()
    seeds = []
    files = [path / f"{name}.safetensors" for path in golden for name in SEEDS[target]]
    if "replay" in SEEDS[target]:
        files.append(ROOT / "tests" / "golden" / "replay_without_counters" / "replay.safetensors")
    for path in files:
        seeds.append(path.read_bytes())
        (corpus / f"{path.parent.name}-{path.stem}").write_bytes(seeds[-1])
    watched = Watched(target, folder)
    mutate = mutator(seeds, lambda data, size: atheris.Mutate(data, size))  # fuzzing replaces Mutate
    flags = [f"-max_total_time={seconds}", "-max_len=60000", "-rss_limit_mb=8000", "-timeout=3600", "-len_control=0"]
    flags.append(f"-artifact_prefix={folder}{os.sep}")
    atheris.Setup([sys.argv[0], str(corpus), *flags], watched, custom_mutator=mutate)
    atheris.Fuzz()


class Watched:
    """Passes inputs to a target, counts outcomes and saves findings."""

    def __init__(self, target: str, folder: Path) -> None:
        self.target, self.folder = target, folder
        self.path = folder / "input.safetensors"
        self.read = READERS[target](self.path)
        self.counts = {"executions": 0, "refused": 0, "read": 0, "findings": 0}
        self.seen: set[str] = set()
        self.written = 0.0

    def __call__(self, data: bytes) -> None:
        """Reads one input."""
        from rejeu.errors import CheckpointError

        self.path.write_bytes(data)
        began = time.process_time()
        try:
            self.read()
            self.counts["read"] += 1
        except CheckpointError as error:
            self.counts["refused"] += 1
            if "\n" in str(error) or len(str(error)) > 1500:
                self.note(data, "a message of many lines")
        except Exception as error:
            self.note(data, "".join(traceback.format_exception(error)[-3:]))
        if (seconds := time.process_time() - began) > SECONDS.get(self.target, 2.0):
            self.note(data, f"slow: {seconds:.0f} s")
        self.counts["executions"] += 1
        if time.monotonic() - self.written > 2.0:
            self.written = time.monotonic()
            new = self.folder / "counts.new"
            new.write_text(json.dumps(self.counts), encoding="utf-8")
            new.replace(self.folder / "counts.json")  # atomic, so that the file is complete when the process ends

    def note(self, data: bytes, what: str) -> None:
        """Saves an input, once per location of the failure."""
        where = "".join(re.findall(r"File .*line \d+", what)) or what.split(":")[0]
        if where in self.seen:
            return
        self.seen.add(where)
        self.counts["findings"] += 1
        target = RESULTS / "findings"
        target.mkdir(parents=True, exist_ok=True)
        name = f"{self.target}-{hashlib.sha256(data).hexdigest()[:12]}"
        (target / f"{name}.safetensors").write_bytes(data)
        (target / f"{name}.txt").write_text(what, encoding="utf-8", errors="replace")


def mutator(seeds: list[bytes], mutate: Callable[[bytes, int], bytes]) -> Callable[[bytes, int, int], bytes]:
    """Returns a function that mutates an input, or one of the seeds where the input is no file."""
    from tests import hostile_files

    def mutated(data: bytes, max_size: int, seed: int) -> bytes:
        draw = random.Random(seed)
        try:
            parts = hostile_files.take_apart(data)
        except Exception:
            if draw.random() < 0.5:
                return mutate(data, max_size)
            parts = hostile_files.take_apart(draw.choice(seeds))
        way = draw.randrange(8)
        if way == 0:
            return mutate(data, max_size)
        text = None
        if way == 1:
            sums = {name: hostile_files.checksum(array) for name, array in parts.arrays.items()}
            text = mutate(json.dumps({**parts.header, "checksums": sums}).encode(), max_size).decode("utf-8", "replace")
        elif way == 2:
            table = hostile_files.table_of(parts.header, parts.arrays)
            content = hostile_files.content_of(parts)
            if draw.random() < 0.5:
                return hostile_files.join(mutate(json.dumps(table).encode(), max_size), content)[:max_size]
            return hostile_files.join(change_json(table, draw), content)[:max_size]
        elif way == 3 and parts.arrays:
            change_array(parts.arrays, draw)
        else:
            for _ in range(draw.choice((1, 1, 1, 2, 5))):
                change_json(parts.header, draw)
        try:
            return hostile_files.put_together(parts, text)[:max_size]
        except (TypeError, ValueError, KeyError):
            return mutate(data, max_size)

    return mutated


def change_json(tree: Any, draw: random.Random) -> Any:
    """Changes one value of a JSON tree in place, and returns the tree."""
    places: list[tuple[Any, Any]] = []
    stack = [tree]
    while stack:
        node = stack.pop()
        for key, value in list(node.items() if isinstance(node, dict) else enumerate(node)):
            places.append((node, key))
            if isinstance(value, dict | list):
                stack.append(value)
    if not places:
        return tree
    node, key = draw.choice(places)
    way = draw.randrange(5)
    if way == 0:
        del node[key]
    elif way == 1:
        other, other_key = draw.choice(places)
        node[key] = json.loads(json.dumps(other[other_key])) if other is not None else None
    elif way == 2 and isinstance(node[key], int | float) and not isinstance(node[key], bool):
        node[key] = draw.choice(
            (node[key] + 1, -node[key], node[key] * 1000, node[key] / 2, 10 ** draw.randrange(1, 38))
        )
    elif way == 3 and isinstance(node, list) and len(node) < 1000:
        node.insert(key, draw.choice(VALUES))
    else:
        node[key] = json.loads(json.dumps(draw.choice(VALUES)))
    return tree


def change_array(arrays: dict[str, Any], draw: random.Random) -> None:
    """Changes numbers, shape, dtype or name of one array."""
    import numpy as np

    name = draw.choice(sorted(arrays))
    array = arrays[name]
    way = draw.randrange(6)
    if way == 0 and array.size:
        array.reshape(-1).view(np.uint8)[draw.randrange(array.nbytes)] = draw.randrange(256)
    elif way == 1 and array.size:
        extremes = [0, 1, -1, 2, 127, 2**31 - 1, -(2**31)] + [np.nan, np.inf, 1e38] * (array.dtype.kind == "f")
        with np.errstate(all="ignore"):
            array.flat[draw.randrange(array.size)] = np.asarray(draw.choice(extremes)).astype(array.dtype)
    elif way == 2:
        del arrays[name]
    elif way == 3:
        arrays[name] = array.astype(draw.choice(("float32", "float64", "int64", "int32", "uint8", "bool")))
    elif way == 4 and array.ndim:
        arrays[name] = (
            array[: draw.randrange(len(array) + 1)] if draw.random() < 0.5 else np.concatenate([array, array])
        )
    else:
        arrays[draw.choice(["x", "", "obs", *arrays])] = array.copy()


def table_reader(path: Path) -> Callable[[], None]:
    """Returns a function that reads the table, the header and the arrays."""
    from rejeu.io import checkpoint

    def read() -> None:
        for kind in ("agent", "replay", "vec_normalize"):
            try:
                checkpoint.read(path, kind)
                return
            except checkpoint.CheckpointError as error:
                last = error
        raise last

    return read


def header_reader(path: Path) -> Callable[[], None]:
    """Returns a function that validates headers of any algorithm without creating networks."""
    from rejeu import agents
    from rejeu.agents import model_files
    from rejeu.io import checkpoint

    def read() -> None:
        header = checkpoint.read_header(path, "agent")
        kind = agents.AGENTS.get(str(header.get("algorithm")), agents.SAC)
        model_files.interpret(header, path.stat().st_size, kind.algorithm.Config, {})

    return read


def agent_reader(path: Path) -> Callable[[], None]:
    """Returns a function that loads models. Models with equal configurations share compiled functions, to save time."""
    import jax

    import rejeu
    from tests import sharing

    numbers = itertools.count(1)

    def read() -> None:
        if next(numbers) % 200 == 0:
            sharing.forget_learners()
            jax.clear_caches()
        with sharing.shared_learners():
            rejeu.load(path)

    return read


def replay_reader(path: Path) -> Callable[[], None]:
    """Returns a function that loads replay buffers and samples from them. Rejected files must change nothing."""
    import numpy as np

    from rejeu.errors import CheckpointError
    from tests.golden import record_files

    agent = record_files.replay_agent().learn(7)

    def read() -> None:
        before = {name: array.copy() for name, array in agent.replay_buffer.arrays().items()}
        try:
            agent.load_replay_buffer(path)
        except CheckpointError:
            after = agent.replay_buffer.arrays()
            if not all(np.array_equal(before[name], after[name], equal_nan=True) for name in before):
                raise AssertionError("a refused file changed the buffer") from None
            raise
        if agent.replay_buffer.size():
            agent.replay_buffer.sample(np.random.default_rng(0), (16,))

    return read


def statistics_reader(path: Path) -> Callable[[], None]:
    """Returns a function that loads the statistics of a wrapper and uses them."""
    import numpy as np

    from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
    from tests.environments import Counter

    env = DummyVecEnv([lambda: Counter((5,))])
    obs = np.ones((1, 3), np.float32)

    def read() -> None:
        wrapper = VecNormalize.load(path, env)
        with np.errstate(all="ignore"):
            wrapper.normalize_obs(obs)

    return read


READERS: dict[str, Callable[[Path], Callable[[], None]]] = {
    "table": table_reader,
    "header": header_reader,
    "agent": agent_reader,
    "replay": replay_reader,
    "vec_normalize": statistics_reader,
}


if __name__ == "__main__":
    main()
