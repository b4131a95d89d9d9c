"""The hostile corpus: invalid files made from valid ones, which every reader must refuse without crashing or hanging.

Files are assembled without rejeu and with correct checksums, so that only the intended part is invalid.
"""

from __future__ import annotations

import io
import json
import math
import pickle
import zipfile
import zlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

NAMES = {"float32": "F32", "float64": "F64", "int64": "I64", "int32": "I32", "int16": "I16", "int8": "I8"}
NAMES |= {"uint64": "U64", "uint32": "U32", "uint16": "U16", "uint8": "U8", "bool": "BOOL", "float16": "F16"}
DTYPES = {name: dtype for dtype, name in NAMES.items()}


class Parts(NamedTuple):
    """The parts of a file."""

    header: dict[str, Any]
    """Without checksums."""
    arrays: dict[str, np.ndarray]


class Variant(NamedTuple):
    """A hostile file."""

    kind: str
    """What is invalid, in one or two words."""
    name: str
    content: bytes


def take_apart(content: bytes) -> Parts:
    """Returns the parts of a valid file."""
    n = int.from_bytes(content[:8], "little")
    table = json.loads(content[8 : 8 + n])
    header = json.loads(table.pop("__metadata__")["rejeu"])
    header.pop("checksums", None)
    arrays = {}
    for name, entry in table.items():
        begin, end = entry["data_offsets"]
        array = np.frombuffer(content[8 + n + begin : 8 + n + end], DTYPES[entry["dtype"]])
        arrays[name] = array.reshape(entry["shape"]).copy()
    return Parts(header, arrays)


def checksum(array: np.ndarray) -> int:
    """Returns the checksum of an array in a valid file."""
    return zlib.crc32(array.tobytes(), zlib.crc32(f"{array.dtype.name}{list(array.shape)}".encode()))


def table_of(header: Any, arrays: dict[str, np.ndarray], text: str | None = None) -> dict[str, Any]:
    """Returns the table of a file with correct checksums; ``text`` replaces the JSON of the header."""
    if text is None:
        sums = {name: checksum(array) for name, array in arrays.items()}
        full = {**header, "checksums": sums} if isinstance(header, dict) else header
        text = json.dumps(full)
    metadata = {"rejeu": text, "crc32": f"{zlib.crc32(text.encode('utf-8', 'surrogatepass')):08x}"}
    table: dict[str, Any] = {"__metadata__": metadata}
    place = 0
    for name, array in arrays.items():
        entry = {"dtype": NAMES[array.dtype.name], "shape": list(array.shape)}
        table[name] = {**entry, "data_offsets": [place, place + array.nbytes]}
        place += array.nbytes
    return table


def join(table: Any, data: bytes, length: int | None = None) -> bytes:
    """Returns a file from a table (bytes or a JSON value) and the bytes after it; ``length`` is the stated length."""
    text = table if isinstance(table, bytes) else json.dumps(table).encode()
    return (len(text) if length is None else length).to_bytes(8, "little") + text + data


def put_together(parts: Parts, text: str | None = None) -> bytes:
    """Returns a file of these parts, otherwise valid."""
    arrays = {name: np.asarray(array, order="C") for name, array in parts.arrays.items()}
    return join(table_of(parts.header, arrays, text), b"".join(array.tobytes() for array in arrays.values()))


def changed(content: bytes, change: Callable[[dict, dict], Any]) -> bytes:
    """Returns a file with its header and arrays changed by ``change(header, arrays)`` and correct checksums."""
    parts = take_apart(content)
    change(parts.header, parts.arrays)
    return put_together(parts)


def variants(content: bytes) -> Iterator[Variant]:
    """Yields invalid files made from a valid one of any kind, except bit flips (:func:`flipped`) and truncations."""
    yield from foreign()
    yield from bad_tables(content)
    yield from bad_arrays(content)
    yield from bad_texts(content)


def foreign() -> Iterator[Variant]:
    """Yields files of other programs."""
    zipped, array = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as file:
        file.writestr("data", "{}")
    np.save(array, np.arange(3))
    contents = {
        "empty": b"",
        "zip": zipped.getvalue(),
        "numpy": array.getvalue(),
        "zeros": bytes(64),
        "ones": b"\xff" * 64,
    }
    contents |= {f"pickle {n}": pickle.dumps({"a": [1, 2]}, protocol=n) for n in (0, 2, 4)}
    contents |= {
        "text": b"{}",
        "length only": (2).to_bytes(8, "little"),
        "no table": bytes(8),
        "empty table": join({}, b""),
    }
    for name, content in contents.items():
        yield Variant("foreign", name, content)


def bad_tables(content: bytes) -> Iterator[Variant]:
    """Yields files whose table has invalid lengths, offsets, shapes and names."""
    parts = take_apart(content)
    table, data = table_of(parts.header, parts.arrays), content_of(parts)
    size = len(json.dumps(table))
    for length in (0, 1, 7, size - 1, size + 1, size + len(data), size + len(data) + 1, 2**20, 2**31, 2**63, 2**64 - 1):
        yield Variant("length", str(length), join(table, data, length))
    names = [name for name in table if name != "__metadata__"]
    first, last = names[0], max(names, key=lambda name: table[name]["data_offsets"][1])
    large = max(names, key=lambda name: parts.arrays[name].nbytes)
    begin, end = table[large]["data_offsets"]

    def with_entry(name: str, **fields: Any) -> bytes:
        return join({**table, name: {**table[name], **fields}}, data)

    places = (
        [begin, end + 1],
        [begin - 1, end],
        [begin + 1, end],
        [end, begin],
        [-1, end],
        [begin, 2**62],
        [2**62, 2**63],
    )
    places += ([begin, end, end], [begin], [], [0.0, 1.0], [True, 2], "ab", None, [None, None], [10**30, 10**31])
    for place in places:
        yield Variant("places", str(place), with_entry(large, data_offsets=place))
    overlap = table[first]["data_offsets"]
    yield Variant(
        "places", "two arrays at one place", with_entry(large, data_offsets=[overlap[0], overlap[0] + end - begin])
    )
    shapes = ([2**40], [10**12], [2**62, 4], [2**63], [-1], [1.5], [True], "3", None, {}, [[1]], [0, 2**60, 2**60])
    shapes += ([1] * 100_000, [2] * 10_000, [10**30], [0], [], parts.arrays[large].size + 1)
    for i, shape in enumerate(shapes):
        yield Variant("shape", f"{i}: {str(shape)[:20]}", with_entry(large, shape=shape))
    own = table[large]["dtype"]
    for dtype in ("F64", "I32", "F16", "BF16", "F8_E4M3", "object", "O", "", None, 3, ["F32"], "U8", "BOOL", "V4"):
        if dtype != own:
            yield Variant("dtype", str(dtype), with_entry(large, dtype=dtype))
    more = {"extra": 1}
    yield Variant("table", "a field too many", with_entry(large, **more))
    yield Variant("table", "a field too few", join({**table, large: {"dtype": own}}, data))
    for value in (None, [], 3, "x", {}):
        yield Variant("table", f"entry {value!r}", join({**table, large: value}, data))
        yield Variant("table", f"metadata {value!r}", join({**table, "__metadata__": value}, data))
        yield Variant("table", f"table {value!r}", join([value], data))
    yield Variant("table", "bytes after the arrays", join(table, data + b"\0"))
    yield Variant("table", "a hole", join({**table, last: {**table[last]}}, data[:-1]))
    huge = {"dtype": "F32", "shape": [10**12], "data_offsets": [len(data), len(data) + 4 * 10**12]}
    yield Variant("table", "four terabytes", join({**table, "huge": huge}, data))
    empty = {"dtype": "F32", "shape": [0], "data_offsets": [len(data)] * 2}
    yield Variant("table", "an array too many", join({**table, "more": empty}, data))
    many = {f"more.{i}": empty for i in range(40_000)}
    yield Variant("table", "forty thousand arrays too many", join({**table, **many}, data))
    text = json.dumps(table)
    twice = text[:-1] + f', "{large}": {json.dumps(table[large])}}}'
    yield Variant("duplicate", "array", join(twice.encode(), data))
    yield Variant("duplicate", "metadata", join((text[:-1] + ', "__metadata__": {}}').encode(), data))
    yield Variant("duplicate", "many", join(("{" + '"a":1,' * 100_000 + '"a":1}').encode(), b""))
    for name, bad in (
        ("deep lists", "[" * 10_000),
        ("deep and closed", "[" * 10_000 + "]" * 10_000),
        ("quotes", '"' * 9999),
    ):
        yield Variant("json", name, join(bad.encode(), data))
    for name, bad in (("backslashes", '"\\' * 500_000), ("brackets", "[],"), ("million brackets", "[{}," * 400_000)):
        yield Variant("json", name, join(bad.encode(), data))
    yield Variant("json", "deep dicts", join(('{"a":' * 10_000 + "1" + "}" * 10_000).encode(), data))
    yield Variant("json", "no text", join(b'{"\xff": 1}', data))
    yield Variant("json", "a lone surrogate", join(text.replace(f'"{large}"', '"\\ud800"').encode(), data))
    yield Variant("json", "a new line", join(text.replace(f'"{large}"', '"a\\nb"').encode(), data))
    for number in ("NaN", "Infinity", "-Infinity", "1e999", "9" * 5000, "9" * 60):
        place = json.dumps([begin, end])
        yield Variant("json", f"place {number[:9]}", join(text.replace(place, f"[{begin}, {number}]").encode(), data))


def bad_arrays(content: bytes) -> Iterator[Variant]:
    """Yields files with wrong arrays."""
    parts = take_apart(content)
    for name, array in parts.arrays.items():
        if (array.dtype.kind == "f" and name.split(".")[0] not in ("obs",)) or name in ("obs.mean", "obs.var"):
            for value in (math.nan, math.inf):
                spoilt = array.copy()
                spoilt.flat[-1] = value
                yield Variant(
                    "not finite", f"{name} {value}", put_together(parts._replace(arrays=parts.arrays | {name: spoilt}))
                )
            break
    long = {"many\nlines " * 200: np.zeros(1, np.float32)}
    yield Variant("names", "of many lines", put_together(parts._replace(arrays=parts.arrays | long)))
    name, array = max(parts.arrays.items(), key=lambda item: item[1].nbytes)
    others = {
        "gone": None,
        "longer": np.zeros((*array.shape, 2), array.dtype),
        "flat": array.ravel() if array.ndim != 1 else array[None],
        "of bytes": array.view(np.uint8)
        if array.ndim and array.dtype != np.uint8
        else np.zeros(array.nbytes, np.uint8),
        "of half precision": array.astype(np.float16),
        "of double precision": array.astype(np.float64 if array.dtype != np.float64 else np.float32),
        "of truth": array.astype(bool),
    }
    for word, other in others.items():
        rest = {key: value for key, value in parts.arrays.items() if key != name}
        yield Variant(
            "array",
            f"{name} {word}",
            put_together(parts._replace(arrays=rest if other is None else {**rest, name: other})),
        )
    yield Variant(
        "array", "too many", put_together(parts._replace(arrays={**parts.arrays, "evil": np.zeros(3, np.float32)}))
    )
    yield Variant("array", "none", put_together(parts._replace(arrays={})))
    table, data = table_of(parts.header, parts.arrays), content_of(parts)
    damaged = bytearray(data)
    damaged[len(data) // 2] ^= 1
    yield Variant("checksum", "of an array", join(table, bytes(damaged)))
    header = table["__metadata__"]["rejeu"]
    for name, metadata in {
        "of the header": {"rejeu": header.replace('"schema"', ' "schema"'), "crc32": table["__metadata__"]["crc32"]},
        "of the header, missing": {"rejeu": header},
        "of the header, of another kind": {"rejeu": header, "crc32": "x"},
        "metadata of numbers": {"rejeu": header, "crc32": 3},
        "header missing": {"crc32": "00000000"},
    }.items():
        yield Variant("checksum", name, join({**table, "__metadata__": metadata}, data))
    for name, sums in {"missing": None, "a list": [], "of texts": dict.fromkeys(parts.arrays, "x"), "none": {}}.items():
        text = json.dumps(parts.header | ({} if sums is None else {"checksums": sums}))
        yield Variant("checksum", f"sums {name}", put_together(parts, text))


def bad_texts(content: bytes) -> Iterator[Variant]:
    """Yields files with an invalid header and its correct checksum."""
    parts = take_apart(content)
    good = json.dumps({**parts.header, "checksums": {name: checksum(a) for name, a in parts.arrays.items()}})
    texts = [
        "",
        "{",
        "[]",
        "{}",
        "null",
        "3",
        '"text"',
        "[" * 10_000,
        "[" * 10_000 + "]" * 10_000,
        '{"a":' * 5000 + "}" * 5000,
    ]
    texts += [good[:-1], good + "}", good[:-1] + ', "kind": "agent"}', good[:-1] + ', "schema": 2}', "\ufeff" + good]
    texts += [
        good.replace('"schema": 2', f'"schema": {n}')
        for n in ("NaN", "0", "3", "-1", "2.0", "true", "1e999", "[2]", "null")
    ]
    texts += [good.replace('"schema": 2', f'"schema": 2, "x": {n}') for n in ("NaN", "-Infinity", "1e999", "9" * 5000)]
    texts += [
        good.replace(f'"kind": "{parts.header["kind"]}"', f'"kind": {kind}')
        for kind in ('"evil"', "null", "[]", "{}", "7")
    ]
    for i, text in enumerate(texts):
        yield Variant("header text", f"{i}: {text[:20]!r}", put_together(parts, text))


LARGE_SPACES = (
    {"Box": {"low": 0, "high": 1, "shape": [10**9], "dtype": "float32"}},
    {"Discrete": {"n": 10**12, "start": 0}},
    {"MultiBinary": {"shape": [10**5, 10**5]}},
)
"""Spaces that would exhaust the memory."""
CODE = (
    "os.system",
    "__import__('os').system('true')",
    "builtins.eval",
    "subprocess:Popen",
    "../../evil",
    "gASVAAAAAA==",
)
"""Names of code and files, which may occur in a header and must not be looked up."""


def bad_models(content: bytes) -> Iterator[Variant]:
    """Yields model files whose header asks for unknown names, for code, or for too much memory."""

    def of(kind: str, name: str, change: Callable[[dict, dict], Any]) -> Variant:
        return Variant(kind, name, changed(content, change))

    policy = lambda h: h["config"]["policy_kwargs"]  # noqa: E731
    for text in CODE:
        yield of("code", f"algorithm {text}", lambda h, a, t=text: h.update(algorithm=t))
        yield of("code", f"policy {text}", lambda h, a, t=text: h.update(policy=t))
        yield of("code", f"torso {text}", lambda h, a, t=text: policy(h).update(torso=t))
        yield of("code", f"torso as data {text}", lambda h, a, t=text: policy(h).update(torso={":serialized:": t}))
        yield of("code", f"activation {text}", lambda h, a, t=text: policy(h).update(activation_fn=t))
        yield of("code", f"architecture {text}", lambda h, a, t=text: policy(h).update(architecture=t))
        yield of("code", f"space {text}", lambda h, a, t=text: h.update(observation_space={t: "true"}))
        yield of(
            "code", f"space type {text}", lambda h, a, t=text: h.update(action_space={":type:": t, ":serialized:": t})
        )
        yield of("code", f"schedule {text}", lambda h, a, t=text: h["config"].update(learning_rate={"schedule": t}))
        yield of("code", f"config {text}", lambda h, a, t=text: h["config"].update({t: 1}))
        yield of("code", f"config replaced {text}", lambda h, a, t=text: h.update(config=t))
    for number in (
        math.nan,
        math.inf,
        1e308,
        -1,
        10**15,
        10**30,
        0.5,
        "3",
        True,
        None,
        [],
        {},
        [[1]],
        "NaN",
        "Infinity",
    ):
        label = str(number)[:12]
        yield of("number", f"gamma {label}", lambda h, a, n=number: h["config"].update(gamma=n if n != 0.5 else 1.5))
        if number is not None:
            yield of("number", f"net_arch {label}", lambda h, a, n=number: policy(h).update(net_arch=[n]))
            yield of(
                "number", f"learning_rate {label}", lambda h, a, n=number: h["config"].update(learning_rate=bad_rate(n))
            )
        yield of("number", f"seed {label}", lambda h, a, n=number: h.update(seed=n))
        yield of(
            "number", f"window {label}", lambda h, a, n=number: h.update(stats_window_size=n if n != 10**15 else -3)
        )
        yield of("number", f"step {label}", lambda h, a, n=number: h["counters"].update(step=n))
        yield of(
            "number",
            f"rng {label}",
            lambda h, a, n=number: h.update(rng={"state": n if n != 10**15 and n != 10**30 else -1, "inc": 1}),
        )
        yield of("number", f"space {label}", lambda h, a, n=number: h.update(observation_space=n))
        if number != 0.5:
            yield of("number", f"dtype {label}", lambda h, a, n=number: h.update(observation_space=box(dtype=n)))
        yield of("number", f"shape {label}", lambda h, a, n=number: h.update(observation_space=box(shape=[n])))
        if number not in (10**15, 10**30, 1e308, -1, 0.5):
            yield of(
                "number",
                f"low {label}",
                lambda h, a, n=number: h.update(
                    observation_space=box(low=n if n not in (True, "Infinity", math.inf) else "x")
                ),
            )
        yield of(
            "number",
            f"choices {label}",
            lambda h, a, n=number: h.update(observation_space={"Discrete": {"n": n, "start": 0}}),
        )
    for arch in (
        [10**9] * 2,
        [10**15],
        [10**30],
        [1] * 100_000,
        [8] * 10**5,
        [[8]],
        [None],
        [math.nan],
        "8",
        {"os": [1]},
        {"pi": [10**12]},
    ):
        yield of("huge", f"net_arch {str(arch)[:20]}", lambda h, a, v=arch: policy(h).update(net_arch=v))
    for n in (10**6, 10**9, 10**15, 2**63):
        yield of(
            "huge", f"n_blocks {n}", lambda h, a, v=n: policy(h).update(net_arch=None, architecture="simba", n_blocks=v)
        )
        yield of("huge", f"width {n}", lambda h, a, v=n: policy(h).update(net_arch=None, architecture="simba", width=v))
        yield of("huge", f"branches {n}", lambda h, a, v=n: policy(h).update(net_arch=None, state_layers=[v]))
        yield of(
            "huge",
            f"image {n}",
            lambda h, a, v=n: h.update(
                policy="CnnPolicy", observation_space=box(shape=[v, 84, 3], dtype="uint8", low=0)
            ),
        )
        yield of(
            "huge",
            f"choices {n}",
            lambda h, a, v=n: h.update(observation_space={"MultiDiscrete": {"nvec": [v], "start": [0]}}),
        )
        yield of("huge", f"bits {n}", lambda h, a, v=n: h.update(observation_space={"MultiBinary": {"shape": [v]}}))
        yield of("huge", f"actions {n}", lambda h, a, v=n: h.update(action_space={"Discrete": {"n": v, "start": 0}}))
        if "n_critics" in take_apart(content).header["config"]:
            yield of("huge", f"n_critics {n}", lambda h, a, v=n: h["config"].update(n_critics=v))
    parts = {f"k{i}": box() for i in range(20_000)}
    yield of(
        "huge", "a Dict of 20,000", lambda h, a: h.update(policy="MultiInputPolicy", observation_space={"Dict": parts})
    )
    boxes = {"Dict": {f"k{i}": box(shape=[2**19]) for i in range(100)}}
    yield of("huge", "a Dict of large ones", lambda h, a: h.update(policy="MultiInputPolicy", observation_space=boxes))
    for deep in (50, 10_000):
        space = '{"Tuple": [' * deep + json.dumps(box()) + "]}" * deep
        header = json.dumps(
            take_apart(content).header
            | {
                "observation_space": "HERE",
                "checksums": {name: checksum(a) for name, a in take_apart(content).arrays.items()},
            }
        )
        yield Variant("deep", f"spaces {deep}", put_together(take_apart(content), header.replace('"HERE"', space)))
    for key in take_apart(content).header:
        if key not in ("env_id", "success_threshold"):
            yield of("missing", key, lambda h, a, k=key: h.pop(k))
            yield of("of another type", key, lambda h, a, k=key: h.update({k: [] if k != "config" else 3}))
    for algorithm in ([], {}, 3, None, "sac", "SAC\n", "x" * 100_000):
        yield of("algorithm", str(algorithm)[:10], lambda h, a, v=algorithm: h.update(algorithm=v))


def bad_statistics(content: bytes) -> Iterator[Variant]:
    """Yields files with invalid normalization statistics."""

    def of(name: str, change: Callable[[dict, dict], Any]) -> Variant:
        return Variant("statistics", name, changed(content, change))

    for key in ("clip_obs", "clip_reward", "gamma", "epsilon"):
        may_be_none = key.startswith("clip")  # nothing is clipped then
        for value in (
            math.nan,
            math.inf,
            -1.0,
            "1",
            {} if may_be_none else None,
            [],
            True,
            10**30 if key == "gamma" else "x",
        ):
            yield of(f"{key} {value}", lambda h, a, k=key, v=value: h["settings"].update({k: v}))
    for key in ("training", "norm_obs", "norm_reward"):
        for value in (1, "true", None, []):
            yield of(f"{key} {value}", lambda h, a, k=key, v=value: h["settings"].update({k: v}))
    for value in ([1], [[]], "keys", {}, ["nothing"], 3):
        yield of(f"keys {value}", lambda h, a, v=value: h.update(keys=v))
    for value in (None, [], 3, "x", {}):
        yield of(f"settings {value}", lambda h, a, v=value: h.update(settings=v))
    for name in ("obs.var", "returns.var", "returns.count"):
        yield of(f"negative {name}", lambda h, a, n=name: a.update({n: -1 - np.abs(a[n])}))
        yield of(f"{name} not there", lambda h, a, n=name: a.pop(n))


def bad_buffers(content: bytes) -> Iterator[Variant]:
    """Yields replay files with counters outside of the ring, or with values that no environment returns."""

    def of(name: str, change: Callable[[dict, dict], Any]) -> Variant:
        return Variant("buffer", name, changed(content, change))

    arrays = take_apart(content).arrays
    for kind in ("observation_space", "action_space"):
        values = (None, [], {}, 3, "x", {"Box": {}}, {"Box": None}, {"Text": 3}, {"Dict": {}}, {"Tuple": []})
        for i, value in enumerate((*values, *LARGE_SPACES)):
            yield of(f"{kind} {i}", lambda h, a, k=kind, v=value: h.update({k: v}))
        yield of(f"{kind} gone", lambda h, a, k=kind: h.pop(k))
        yield of(f"{kind} of another", lambda h, a, k=kind: h.update({k: {"MultiBinary": {"shape": [7]}}}))
    # A full ring may start at any row: with another newest row the file is valid.
    is_full = (arrays["head"] >= arrays["kind"].shape[1]).all()
    for name in ("head", "n_steps"):
        for value in (-2, -1, 0, 10**6, 2**62, 2**63 - 1, -(2**63)):
            if (name, value) != ("head", 10**6) or not is_full:
                yield of(f"{name} {value}", lambda h, a, n=name, v=value: a[n].fill(v))
        yield of(f"{name} of nothing", lambda h, a, n=name: a.update({n: a[n][:0]}))
        yield of(f"{name} of more", lambda h, a, n=name: a.update({n: np.repeat(a[n], 2)}))
    for value in (3, 255):
        yield of(f"kind {value}", lambda h, a, v=value: a["kind"].fill(v))
    # Only older files contain the counters of each row.
    for name in ("since_start", "until_end"):
        for value in (10**6, 2**31 - 1, -1, -(2**31)):
            yield of(f"{name} {value}", lambda h, a, n=name, v=value: a.update({**counters(a), n: counters(a)[n] + v}))
        yield of(f"{name} alone", lambda h, a, n=name: only_counter(a, n))
        yield of(f"{name} wide", lambda h, a, n=name: a.update({**counters(a), n: counters(a)[n].astype(np.int64)}))
        yield of(f"{name} flat", lambda h, a, n=name: a.update({**counters(a), n: counters(a)[n].ravel()}))
    for name in ("reward", "action"):
        yield of(f"{name} not finite", lambda h, a, n=name: a[n].fill(np.nan))
    for name in arrays:
        yield of(f"{name} gone", lambda h, a, n=name: a.pop(n))
        yield of(f"{name} shorter", lambda h, a, n=name: a.update({n: a[n][:, :-1] if a[n].ndim > 1 else a[n][:-1]}))


def bad_runs(content: bytes) -> Iterator[Variant]:
    """Yields files of a run, or of its rows, whose header has wrong or missing values."""
    parts = take_apart(content)
    values = (
        None,
        True,
        0,
        -1,
        2**62,
        0.5,
        "x",
        "../x",
        [],
        ["x"],
        [None],
        {},
        {"dict": {}},
        {"array": "nothing"},
        [[[]]],
    )
    for name in parts.header:
        if name not in ("schema", "kind"):
            yield Variant("run header", f"{name} gone", changed(content, lambda h, a, n=name: h.pop(n)))
            for value in values:
                put = lambda h, a, n=name, v=value: h.update({n: v})  # noqa: E731
                yield Variant("run header", f"{name} {value!r}", changed(content, put))
    for name in parts.header.get("run", {}).get("dict", {}):
        yield Variant("run", f"{name} gone", changed(content, lambda h, a, n=name: h["run"]["dict"].pop(n)))
        for value in (*values, {"array": max(parts.arrays)}, {"scalar": max(parts.arrays)}, {"float": "nan"}):
            put = lambda h, a, n=name, v=value: h["run"]["dict"].update({n: v})  # noqa: E731
            yield Variant("run", f"{name} {value!r}", changed(content, put))
    for name in parts.header.get("rows", []):
        for value in (f"../{name}", name.upper(), name + "\0", "/dev/zero", f"{name}/{name}"):
            yield Variant("rows", value, changed(content, lambda h, a, v=value: h.update(rows=[v])))
        yield Variant("rows", "twice", changed(content, lambda h, a, n=name: h.update(rows=[n, n, *h["rows"]][:-1])))


class Sparse(NamedTuple):
    """The beginning of a sparse file."""

    name: str
    content: bytes
    size: int
    """Size of the whole file in bytes."""


def sparse(content: bytes, size: int = 6 * 2**30) -> Iterator[Sparse]:
    """Yields sparse files in which one array has about 6 GiB but which take a few KiB on disk."""
    parts = take_apart(content)
    rows = {name: array for name, array in parts.arrays.items() if array.ndim}
    for name in ("a", min(rows), max(rows), max(rows, key=lambda name: rows[name].nbytes)):
        one = rows.get(name, np.zeros(1, np.float32))
        others = {key: array for key, array in parts.arrays.items() if key != name}
        table, begin = table_of({}, others), sum(array.nbytes for array in others.values())
        shape = [size // max(one[:1].nbytes, 1), *one.shape[1:]]
        end = begin + math.prod(shape) * one.itemsize
        sums = {**{key: checksum(array) for key, array in others.items()}, name: 0}
        table["__metadata__"] = table_of({}, {}, json.dumps({**parts.header, "checksums": sums}))["__metadata__"]
        table[name] = {"dtype": NAMES[one.dtype.name], "shape": shape, "data_offsets": [begin, end]}
        start = join(table, b"".join(array.tobytes() for array in others.values()))
        yield Sparse(name, start, len(start) - begin + end)


def counters(arrays: dict) -> dict[str, np.ndarray]:
    """Returns the counters of each row in older replay files: zeros, which are valid."""
    return {name: np.zeros(arrays["kind"].shape, np.int32) for name in ("since_start", "until_end")}


def only_counter(arrays: dict, name: str) -> None:
    """Keeps only one of the two counters in a file."""
    for other in counters(arrays):
        arrays.pop(other, None)
    arrays[name] = counters(arrays)[name]


def flipped(content: bytes, bit: int) -> bytes:
    """Returns a file with one bit flipped; ``bit`` counts from the beginning."""
    damaged = bytearray(content)
    damaged[bit // 8] ^= 1 << bit % 8
    return bytes(damaged)


def content_of(parts: Parts) -> bytes:
    """Returns the bytes of all arrays."""
    return b"".join(array.tobytes() for array in parts.arrays.values())


def box(shape: Any = (3,), dtype: Any = "float32", low: Any = "-inf") -> Any:
    """Returns the description of a Box."""
    return {"Box": {"low": low, "high": "inf", "shape": list(shape), "dtype": dtype}}


def bad_rate(number: Any) -> Any:
    """Returns an invalid learning rate, from a number that may be valid."""
    fine = isinstance(number, int | float) and not isinstance(number, bool) and 0 <= number < math.inf
    return {"schedule": "linear", "start": 1.0, "slope": number} if fine else number
