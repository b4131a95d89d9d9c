"""Reads all kinds of damaged and malicious files and records the outcomes.

This is the larger version of ``tests/core/test_hostile_files.py``. It truncates every kind of file, in both schemas, at
every
byte and flips every bit. It also reads the corpus of ``tests/hostile_files.py``, and files in which a pickle that creates
a file when it is loaded stands in the place of every string::

    python trials/hostile.py

Results are written to ``trials/results/hostile.json``.
"""

from __future__ import annotations

import base64
import collections
import json
import os
import pickle
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from provenance import provenance, write

import rejeu
from rejeu.core import checkpoint
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from tests import hostile_files
from tests.core.test_hostile_runs import files_of, make_run, replaced, trained_further
from tests.environments import Counter
from tests.golden import record_files
from tests.sharing import shared_learners

ROOT = Path(__file__).parents[1]
KINDS = {"agent": "sac", "replay": "replay", "vec_normalize": "vec_normalize"}
SPECIAL = {
    "agent": hostile_files.bad_models,
    "replay": hostile_files.bad_buffers,
    "vec_normalize": hostile_files.bad_statistics,
}


def main() -> None:
    """Creates and reads the files, and writes the results."""
    result: dict[str, Any] = {**provenance()}
    before = peak_memory()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file.safetensors"
        loaders = readers()
        schemas = [f"schema{schema}" for schema in range(1, checkpoint.SCHEMA + 1)]
        files = [(of, file_kind, name) for of in schemas for file_kind, name in KINDS.items()]
        for of, file_kind, name in [*files, ("replay_without_counters", "replay", "replay")]:
            content = (ROOT / "tests" / "golden" / of / f"{name}.safetensors").read_bytes()
            title = f"{of.replace('schema', 'schema ').replace('_', ' ')}, {file_kind}"
            outcomes = result[title] = {
                "bytes": len(content),
                "cut short at every byte": count(cuts(content), lambda p, k=file_kind: checkpoint.read(p, k), path),
                "every bit flipped": count(flips(content), lambda p, k=file_kind: checkpoint.read(p, k), path),
            }
            if of not in schemas[:-1]:
                outcomes["hostile"] = by_kind(file_kind, content, loaders[file_kind], path)
                outcomes["six GiB in a hole"] = holes(content, lambda p, k=file_kind: outcome(loaders[k], p), path)
            print(title, json.dumps(outcomes), flush=True)
        for file_kind, parts in runs(Path(folder)).items():
            result[file_kind] = parts
            print(file_kind, json.dumps(parts), flush=True)
        result["megabytes that reading all of them took"] = round((peak_memory() - before) / 2**20)
        result["code in a rejeu file"] = code_in_ours(Path(folder))
    write(ROOT / "trials" / "results" / "hostile.json", result)
    print(json.dumps({key: value for key, value in result.items() if key.startswith(("code", "mega"))}, indent=1))


def readers() -> dict[str, Callable[[Path], object]]:
    """Returns the function that reads each kind of file."""
    agent = record_files.replay_agent().learn(7)
    env = DummyVecEnv([lambda: Counter((5,))])
    return {
        "agent": rejeu.load,
        "replay": agent.load_replay_buffer,
        "vec_normalize": lambda path: VecNormalize.load(path, env),
    }


def outcome(read: Callable[[Path], object], path: Path) -> str:
    """Returns ``refused``, ``read``, or the name of any other exception."""
    try:
        read(path)
    except rejeu.CheckpointError:
        return "refused"
    except Exception as error:
        return type(error).__name__
    return "read"


def count(contents: Iterator[bytes], read: Callable[[Path], object], path: Path) -> dict[str, Any]:
    """Reads files and returns the count of each outcome and the longest time of one file in seconds."""
    outcomes: collections.Counter[str] = collections.Counter()
    longest = 0.0
    with path.open("w+b", buffering=0) as file:
        for content in contents:
            file.seek(0)
            file.truncate()
            file.write(content)
            began = time.perf_counter()
            outcomes[outcome(read, path)] += 1
            longest = max(longest, time.perf_counter() - began)
    return {**outcomes, "longest seconds": round(longest, 2)}


def cuts(content: bytes) -> Iterator[bytes]:
    """Yields a file truncated at every byte."""
    return (content[:length] for length in range(len(content)))


def flips(content: bytes) -> Iterator[bytes]:
    """Yields a file with each of its bits flipped."""
    return (hostile_files.flipped(content, bit) for bit in range(8 * len(content)))


def by_kind(file_kind: str, content: bytes, read: Callable[[Path], object], path: Path) -> dict[str, Any]:
    """Returns the outcomes of the corpus, by fault."""
    groups = collections.defaultdict(list)
    for variant in (*hostile_files.variants(content), *SPECIAL[file_kind](content)):
        groups[variant.kind].append(variant.content)
    return {group: count(iter(contents), read, path) for group, contents in sorted(groups.items())}


def holes(content: bytes, read: Callable[[Path], str], path: Path) -> dict[str, Any]:
    """Returns the outcomes of sparse files, and the longest time of one file in seconds."""
    outcomes: collections.Counter[str] = collections.Counter()
    longest = 0.0
    for sparse_file in hostile_files.sparse(content):
        path.write_bytes(sparse_file.content)
        os.truncate(path, sparse_file.size)
        began = time.perf_counter()
        outcomes[read(path)] += 1
        longest = max(longest, time.perf_counter() - began)
    path.unlink()
    return {**outcomes, "longest seconds": round(longest, 2)}


def runs(folder: Path) -> dict[str, Any]:
    """Returns the outcomes of checkpoints with one file replaced by each file of the corpus, by the replaced file."""
    results: dict[str, Any] = {}
    for name in ("replay", "rollout"):
        with shared_learners():
            run = make_run(name, folder / name)
            for whole in files_of(run[1]):
                content, file_kind = whole.read_bytes(), whole.name.split("_")[0]
                groups: dict[str, collections.Counter[str]] = collections.defaultdict(collections.Counter)
                longest = 0.0
                for variant in (*hostile_files.variants(content), *hostile_files.bad_runs(content)):
                    began = time.perf_counter()
                    groups[variant.kind][replaced(run, folder / "tried", whole, variant.content)] += 1
                    longest = max(longest, time.perf_counter() - began)
                results[f"checkpoint with a {name}, {file_kind}"] = {
                    "bytes": len(content),
                    "hostile": {group: {**counts} for group, counts in sorted(groups.items())},
                    "longest seconds": round(longest, 2),
                    "six GiB in a hole": holes(
                        content, lambda path, r=run, w=whole: replaced_by(r, folder / "tried", w, path), folder / "hole"
                    ),
                }
    return results


def replaced_by(run: Any, folder: Path, whole: Path, path: Path) -> str:
    """Returns the outcomes of runs with one file replaced by a sparse one."""
    shutil.copytree(run[1], folder, dirs_exist_ok=True)
    (folder / whole.name).unlink()
    path.rename(folder / whole.name)
    path.touch()
    return hostile_files.outcome_of(trained_further, run, folder)


def peak_memory() -> int:
    """Returns the peak memory of this process in bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


class Payload:
    """An object that creates a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return open, (str(self.marker), "w")


def code_in_ours(folder: Path) -> dict[str, Any]:
    """Inserts a pickle that executes code at every string of a model file, and as the file; returns outcomes."""
    marker = folder / "ours-was-run"
    raw = pickle.dumps(Payload(marker))
    text = base64.b64encode(raw).decode()
    content = (ROOT / "tests" / "golden" / f"schema{checkpoint.SCHEMA}" / "sac.safetensors").read_bytes()
    path = folder / "evil.safetensors"
    contents = [raw]
    for places in range(len(texts(hostile_files.take_apart(content).header))):
        for value in (text, {":type:": "<class 'function'>", ":serialized:": text}):

            def put(header: dict, arrays: dict, i: int = places, value: Any = value) -> None:
                node, key = texts(header)[i]
                node[key] = value

            contents.append(hostile_files.changed(content, put))
    return {"attempts": len(contents), **count(iter(contents), rejeu.load, path), "ran the code": marker.exists()}


def texts(tree: Any) -> list[tuple[Any, Any]]:
    """Returns the paths of all values of a header."""
    items = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    return [path for key, value in items for path in [(tree, key), *texts(value)]]


if __name__ == "__main__":
    main()
