"""The hostile corpus: invalid files made from valid ones, which every reader must refuse without crashing or hanging.

Files are assembled without rejeu and with correct checksums, so that only the intended part is invalid.
"""

import io
import json
import math
import pickle
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from rejeu.core.errors import CheckpointError

NAMES = {"float32": "F32", "float64": "F64", "int64": "I64", "int32": "I32", "int16": "I16", "int8": "I8"}
NAMES |= {"uint64": "U64", "uint32": "U32", "uint16": "U16", "uint8": "U8", "bool": "BOOL", "float16": "F16"}
DTYPES = {name: dtype for dtype, name in NAMES.items()}
GONE = object()
"""Stands for a value that is left out."""


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


def outcome_of(read: Callable[..., Any], *arguments: Any) -> str:
    """Returns what became of a file: ``refused`` with our own error on one line, ``read``, or what else was raised."""
    try:
        read(*arguments)
    except CheckpointError as error:
        text = str(error)
        return "refused" if "\n" not in text and len(text) < 1000 else f"refused at length: {text[:300]}"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:300]}"
    return "read"


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


def text_of(parts: Parts) -> str:
    """Returns the JSON of a header with correct checksums."""
    return json.dumps({**parts.header, "checksums": {name: checksum(a) for name, a in parts.arrays.items()}})


def table_of(header: Any, arrays: dict[str, np.ndarray], text: str | None = None) -> dict[str, Any]:
    """Returns the table of a file with correct checksums; ``text`` replaces the JSON of the header."""
    text = text_of(Parts(header, arrays)) if text is None else text
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


def with_values(content: bytes, kind: str, path: str, values: Iterable[Any]) -> Iterator[Variant]:
    """Yields files whose header has each of the values at a path of keys, for example ``config.gamma``."""
    for value in values:

        def change(header: dict, arrays: dict, value: Any = value) -> None:
            *way, last = path.split(".")
            for key in way:
                header = header[key]
            header.pop(last) if value is GONE else header.update({last: value})

        name = "gone" if value is GONE else str(value)[:20]
        yield Variant(kind, f"{path} {name}", changed(content, change))


def with_arrays(content: bytes, kind: str, changes: dict[str, Callable[[dict], Any]]) -> Iterator[Variant]:
    """Yields files whose arrays were changed by each of the functions."""
    for name, change in changes.items():
        yield Variant(kind, name, changed(content, lambda header, arrays, change=change: change(arrays)))


def variants(content: bytes) -> Iterator[Variant]:
    """Yields invalid files made from a valid one of any kind, except bit flips (:func:`flipped`) and truncations."""
    yield from foreign()
    yield from bad_entries(content)
    yield from bad_tables(content)
    yield from bad_json(content)
    yield from bad_arrays(content)
    yield from bad_checksums(content)
    yield from bad_texts(content)


def foreign() -> Iterator[Variant]:
    """Yields files of other programs."""
    zipped, array = io.BytesIO(), io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as file:
        file.writestr("data", "{}")
    np.save(array, np.arange(3))
    contents = {"empty": b"", "zip": zipped.getvalue(), "numpy": array.getvalue(), "text": b"{}", "ones": b"\xff" * 64}
    contents |= {"pickle": pickle.dumps({"a": [1]}), "old pickle": pickle.dumps({"a": [1]}, protocol=0)}
    contents |= {"length only": (2).to_bytes(8, "little"), "no table": bytes(8), "empty table": join({}, b"")}
    for name, content in contents.items():
        yield Variant("foreign", name, content)


def bad_entries(content: bytes) -> Iterator[Variant]:
    """Yields files whose table has an invalid place, shape or dtype of the largest array."""
    parts = take_apart(content)
    table, data = table_of(parts.header, parts.arrays), content_of(parts)
    large = max(parts.arrays, key=lambda name: parts.arrays[name].nbytes)
    begin, end = table[large]["data_offsets"]
    first = table[next(iter(parts.arrays))]["data_offsets"][0]
    places = ([begin, end + 1], [begin - 1, end], [end, begin], [-1, end], [begin, 2**62], [2**62, 2**63])
    places += ([begin, end, end], [], [0.0, 1.0], [True, 2], "ab", None, [10**30, 10**31], [first, first + end - begin])
    shapes = ([2**40], [2**62, 4], [-1], [1.5], [True], "3", None, {}, [[1]], [0, 2**60, 2**60], [1] * 100_000)
    shapes += ([10**30], [0], [], parts.arrays[large].size + 1)
    dtypes = {"F64", "BF16", "object", "", None, 3, "U8", "V4"} - {table[large]["dtype"]}
    for key, values in (("data_offsets", places), ("shape", shapes), ("dtype", dtypes)):
        kind = {"data_offsets": "places"}.get(key, key)
        for i, value in enumerate(values):
            yield Variant(kind, f"{i}: {str(value)[:20]}", join({**table, large: {**table[large], key: value}}, data))


def bad_tables(content: bytes) -> Iterator[Variant]:
    """Yields files whose table has an invalid length, or too few or too many entries."""
    parts = take_apart(content)
    table, data = table_of(parts.header, parts.arrays), content_of(parts)
    size = len(json.dumps(table))
    for length in (0, 1, size - 1, size + 1, size + len(data) + 1, 2**20, 2**31, 2**63, 2**64 - 1):
        yield Variant("length", str(length), join(table, data, length))
    large = max(parts.arrays, key=lambda name: parts.arrays[name].nbytes)
    empty = {"dtype": "F32", "shape": [0], "data_offsets": [len(data)] * 2}
    huge = {"dtype": "F32", "shape": [10**12], "data_offsets": [len(data), len(data) + 4 * 10**12]}
    for name, bad in {
        "a field too few": {**table, large: {"dtype": table[large]["dtype"]}},
        "four terabytes": {**table, "huge": huge},
        "an array too many": {**table, "more": empty},
        "forty thousand arrays too many": {**table, **{f"more.{i}": empty for i in range(40_000)}},
        **{f"entry {value!r}": {**table, large: value} for value in (None, [], 3, "x", {})},
        **{f"metadata {value!r}": {**table, "__metadata__": value} for value in (None, [], 3, "x", {})},
        **{f"table {value!r}": [value] for value in (None, [], 3, "x", {})},
    }.items():
        yield Variant("table", name, join(bad, data))
    yield Variant("table", "bytes after the arrays", join(table, data + b"\0"))
    yield Variant("table", "bytes missing", join(table, data[:-1]))


def bad_json(content: bytes) -> Iterator[Variant]:
    """Yields files whose table is no JSON, or JSON that no program would write."""
    parts = take_apart(content)
    table, data = table_of(parts.header, parts.arrays), content_of(parts)
    text, name = json.dumps(table), max(parts.arrays, key=lambda name: parts.arrays[name].nbytes)
    place = json.dumps(table[name]["data_offsets"])
    begin = table[name]["data_offsets"][0]
    texts = {
        "deep lists": "[" * 10_000,
        "deep and closed": "[" * 10_000 + "]" * 10_000,
        "deep dicts": '{"a":' * 10_000 + "1" + "}" * 10_000,
        "quotes": '"' * 9999,
        "backslashes": '"\\' * 500_000,
        "million brackets": "[{}," * 400_000,
        "a lone surrogate": text.replace(f'"{name}"', '"\\ud800"'),
        "a new line": text.replace(f'"{name}"', '"a\\nb"'),
        "metadata twice": text[:-1] + ', "__metadata__": {}}',
        "a key many times": "{" + '"a":1,' * 100_000 + '"a":1}',
    }
    numbers = ("NaN", "-Infinity", "1e999", "9" * 5000, "9" * 60)
    texts |= {f"place {number[:9]}": text.replace(place, f"[{begin}, {number}]") for number in numbers}
    for what, bad in texts.items():
        yield Variant("json", what, join(bad.encode(), data))
    yield Variant("json", "no text", join(b'{"\xff": 1}', data))


def bad_arrays(content: bytes) -> Iterator[Variant]:
    """Yields files with wrong arrays."""
    parts = take_apart(content)
    numbers = [
        name
        for name, array in parts.arrays.items()
        if parts.header["kind"] not in ("replay", "rows")
        and ((array.dtype.kind == "f" and name.split(".")[0] != "obs") or name in ("obs.mean", "obs.var"))
    ][:1]
    name, array = max(parts.arrays.items(), key=lambda item: item[1].nbytes)
    others = {
        "gone": None,
        "longer": np.zeros((*array.shape, 2), array.dtype),
        "flat": array.ravel() if array.ndim != 1 else array[None],
        "of half precision": array.astype(np.float16),
        "of double precision": array.astype(np.float64 if array.dtype != np.float64 else np.float32),
        "of truth": array.astype(bool),
    }
    changes: dict[str, Callable[[dict], Any]] = {
        f"{name} {word}": lambda a, other=other: a.pop(name) if other is None else a.update({name: other})
        for word, other in others.items()
    }
    changes |= {
        "too many": lambda a: a.update(evil=np.zeros(3, np.float32)),
        "none": lambda a: a.clear(),
        "of a name of many lines": lambda a: a.update({"many\nlines " * 200: np.zeros(1, np.float32)}),
        **{
            f"{one} {value}": lambda a, one=one, value=value: np.put(a[one], -1, value)
            for one in numbers
            for value in (math.nan, math.inf)
        },
    }
    yield from with_arrays(content, "array", changes)


def bad_checksums(content: bytes) -> Iterator[Variant]:
    """Yields files whose checksums are wrong, missing or something else."""
    parts = take_apart(content)
    table, data = table_of(parts.header, parts.arrays), content_of(parts)
    damaged = bytearray(data)
    damaged[len(data) // 2] ^= 1
    yield Variant("checksum", "of an array", join(table, bytes(damaged)))
    header, crc32 = table["__metadata__"].values()
    for name, metadata in {
        "of the header": {"rejeu": header.replace('"schema"', ' "schema"'), "crc32": crc32},
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
    good, schema, kind = text_of(parts), '"schema": 2', f'"kind": "{parts.header["kind"]}"'
    texts = ["", "{", "[]", "{}", "null", "3", '"text"', "[" * 10_000, '{"a":' * 5000 + "}" * 5000]
    texts += [good[:-1], good + "}", "\ufeff" + good]
    texts += [good.replace(schema, f'"schema": {n}') for n in ("NaN", "0", "3", "-1", "2.0", "true", "[2]", "null")]
    texts += [good.replace(schema, f'{schema}, "x": {n}') for n in ("NaN", "-Infinity", "1e999", "9" * 5000)]
    texts += [good.replace(kind, f'"kind": {other}') for other in ('"evil"', "null", "[]", "{}", "7")]
    for i, text in enumerate(texts):
        yield Variant("header text", f"{i}: {text[:20]!r}", put_together(parts, text))


NUMBERS = (math.nan, math.inf, -1, 10**30, "3", "NaN", True, None, [], {})
"""What is no number that a header may hold."""
LARGE_SPACES = (
    {"Box": {"low": 0, "high": 1, "shape": [10**9], "dtype": "float32"}},
    {"Discrete": {"n": 10**12, "start": 0}},
    {"MultiBinary": {"shape": [10**5, 10**5]}},
)
"""Spaces that would exhaust the memory."""
CODE = ("os.system", "__import__('os').system('true')", "subprocess:Popen", "../../evil", "gASVAAAAAA==")
"""Names of code and files, which may occur in a header and must not be looked up."""
LARGE = (10**6, 10**9, 10**15, 2**63)


def bad_models(content: bytes) -> Iterator[Variant]:
    """Yields model files whose header asks for unknown names, for code, or for too much memory."""
    header = take_apart(content).header
    shape = "config.policy_kwargs"
    for path in ("algorithm", "policy", "config", f"{shape}.torso", f"{shape}.activation_fn", f"{shape}.architecture"):
        yield from with_values(content, "code", path, CODE)
    yield from with_values(content, "code", f"{shape}.torso", [{":serialized:": text} for text in CODE])
    yield from with_values(content, "code", "observation_space", [{text: "true"} for text in CODE])
    yield from with_values(content, "code", "action_space", [{":type:": text, ":serialized:": text} for text in CODE])
    yield from with_values(content, "code", "config.learning_rate", [{"schedule": text} for text in CODE])
    for text in CODE:
        yield from with_values(content, "code", f"config.{text.replace('.', ' ')}", [1])

    for path in ("config.gamma", "seed", "stats_window_size", "counters.step", "observation_space"):
        yield from with_values(content, "number", path, NUMBERS)
    yield from with_values(content, "number", f"{shape}.net_arch", [[n] for n in NUMBERS if n is not None])
    rates = [n for n in NUMBERS if n not in (None, 10**30)] + [{"schedule": "linear", "start": 1.0, "slope": 3}]
    yield from with_values(content, "number", "config.learning_rate", rates)
    yield from with_values(content, "number", "rng.state", [n for n in NUMBERS if n != 10**30])
    boxes = [box(dtype=n) for n in NUMBERS] + [box(shape=[n]) for n in NUMBERS]
    boxes += [box(low=n) for n in (math.nan, None, [], {}, "x")]
    choices = [{"Discrete": {"n": n, "start": 0}} for n in NUMBERS]
    yield from with_values(content, "number", "observation_space", boxes + choices)

    arches = ([10**9] * 2, [10**30], [1] * 100_000, [[8]], [None], "8", {"os": [1]}, {"pi": [10**12]})
    yield from with_values(content, "huge", f"{shape}.net_arch", arches)
    simba = changed(content, lambda h, a: h["config"]["policy_kwargs"].update(net_arch=None, architecture="simba"))
    branches = changed(content, lambda h, a: h["config"]["policy_kwargs"].update(net_arch=None))
    image = changed(content, lambda h, a: h.update(policy="CnnPolicy"))
    yield from with_values(simba, "huge", f"{shape}.n_blocks", LARGE)
    yield from with_values(simba, "huge", f"{shape}.width", LARGE)
    yield from with_values(branches, "huge", f"{shape}.state_layers", [[n] for n in LARGE])
    images = [box(shape=[n, 84, 3], dtype="uint8", low=0) for n in LARGE]
    yield from with_values(image, "huge", "observation_space", images)
    spaces = [{"MultiDiscrete": {"nvec": [n], "start": [0]}} for n in LARGE]
    yield from with_values(content, "huge", "observation_space", [*spaces, *LARGE_SPACES])
    yield from with_values(content, "huge", "action_space", [{"Discrete": {"n": n, "start": 0}} for n in LARGE])
    if "n_critics" in header["config"]:
        yield from with_values(content, "huge", "config.n_critics", LARGE)
    many = [{"Dict": {f"k{i}": box() for i in range(20_000)}}, {"Dict": {f"k{i}": box([2**19]) for i in range(100)}}]
    dicts = changed(content, lambda h, a: h.update(policy="MultiInputPolicy"))
    yield from with_values(dicts, "huge", "observation_space", many)
    for deep in (10_000,):
        space = '{"Tuple": [' * deep + json.dumps(box()) + "]}" * deep
        text = text_of(Parts({**header, "observation_space": "HERE"}, take_apart(content).arrays))
        yield Variant("deep", f"spaces {deep}", put_together(take_apart(content), text.replace('"HERE"', space)))

    for key in header.keys() - {"env_id", "success_threshold", "made_from"}:
        yield from with_values(content, "of another type", key, [GONE, [] if key != "config" else 3])
    yield from with_values(content, "algorithm", "algorithm", ([], {}, 3, None, "sac", "SAC\n", "x" * 100_000))


def bad_statistics(content: bytes) -> Iterator[Variant]:
    """Yields files with invalid normalization statistics."""
    for key in ("clip_obs", "clip_reward", "gamma", "epsilon"):
        values = (math.nan, math.inf, -1.0, "1", "x", [], {}, True)  # None: nothing is clipped
        yield from with_values(content, "statistics", f"settings.{key}", values)
    for key in ("training", "norm_obs", "norm_reward"):
        yield from with_values(content, "statistics", f"settings.{key}", (1, "true", None, []))
    yield from with_values(content, "statistics", "keys", ([1], [[]], "keys", {}, ["nothing"], 3))
    yield from with_values(content, "statistics", "settings", (None, [], 3, "x", {}))
    for name in ("obs.var", "returns.var", "returns.count"):
        changes = {
            f"negative {name}": lambda a, n=name: a.update({n: -1 - np.abs(a[n])}),
            f"{name} gone": lambda a, n=name: a.pop(n),
        }
        yield from with_arrays(content, "statistics", changes)


def bad_buffers(content: bytes) -> Iterator[Variant]:
    """Yields replay files with counters outside of the ring, or with values that no environment returns."""
    arrays = take_apart(content).arrays
    values = (None, [], {}, 3, "x", {"Box": {}}, {"Box": None}, {"Text": 3}, {"Dict": {}}, {"Tuple": []}, GONE)
    for kind in ("observation_space", "action_space"):
        other = {"MultiBinary": {"shape": [7]}}
        yield from with_values(content, "buffer", kind, (*values, *LARGE_SPACES, other))
    changes: dict[str, Callable[[dict], Any]] = {}
    changes["head"] = lambda a: a["head"].fill(-(2**63))
    for name in ("head", "n_steps"):
        changes[f"{name} of nothing"] = lambda a, n=name: a.update({n: a[n][:0]})
        changes[f"{name} of more"] = lambda a, n=name: a.update({n: np.repeat(a[n], 2)})
    for name in arrays:
        changes[f"{name} gone"] = lambda a, n=name: a.pop(n)
        changes[f"{name} shorter"] = lambda a, n=name: a.update({n: a[n][:, :-1] if a[n].ndim > 1 else a[n][:-1]})
    yield from with_arrays(content, "buffer", changes)


def bad_runs(content: bytes) -> Iterator[Variant]:
    """Yields files of a run, or of its rows, whose header has wrong or missing values."""
    parts = take_apart(content)
    values = (
        GONE,
        None,
        True,
        -1,
        2**62,
        0.5,
        "../x",
        [],
        ["x"],
        [None],
        {},
        {"dict": {}},
        {"array": "nothing"},
        [[[]]],
    )
    for name in parts.header.keys() - {"schema", "kind"}:
        yield from with_values(content, "run header", name, values)
    names = max(parts.arrays)
    more = ({"array": names}, {"scalar": names}, {"float": "nan"})
    for name in parts.header.get("run", {}).get("dict", {}):
        yield from with_values(content, "run", f"run.dict.{name}", (*values, *more))
    for name in parts.header.get("rows", []):
        wrong = (f"../{name}", name.upper(), name + "\0", "/dev/zero", f"{name}/{name}")
        twice = [name, name, *parts.header["rows"]][:-1]
        yield from with_values(content, "rows", "rows", [*([value] for value in wrong), twice])


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
