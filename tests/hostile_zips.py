"""Damaged and hostile variants of a model file of Stable-Baselines3."""

import io
import os
import pickle
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from tests.torch_files import Tensor, changed, members_of, old_torch_file, serialized, torch_file, zipped

BOMB = (
    b"\x80\x02(]q\x00"
    + b"".join(b"]q" + bytes([i]) + b"(" + b"h" + bytes([i - 1]) + b"h" + bytes([i - 1]) + b"e" for i in range(1, 200))
    + b"t."
)
"""A pickle of nested lists whose written form has 2^200 parts."""


KWARGS_BOMB = b"\x80\x02}X\x09\x00\x00\x00use_expln" + BOMB[2:-1] + b"s."
OLD_HEAD = old_torch_file({})[:-12]
"""What comes before the structure in a file of PyTorch before 1.6."""
EMPTY_BOX = gym.spaces.Box(np.zeros((2**28, 0), np.float32), np.zeros((2**28, 0), np.float32))


class Call:
    """Calls something when it is unpickled."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.made = function, arguments

    def __reduce__(self) -> Any:
        return self.made


def calls(ran: Path) -> list[bytes]:
    """Returns pickles that would create a folder, in several ways."""
    inside = pickle.dumps(Call(os.mkdir, str(ran)))
    return [
        pickle.dumps(Call(os.system, f"mkdir {ran}")),
        pickle.dumps(Call(eval, f"__import__('os').mkdir({str(ran)!r})")),
        pickle.dumps(Call(exec, f"import os; os.mkdir({str(ran)!r})")),
        inside,
        pickle.dumps(Call(pickle.loads, inside)),
        pickle.dumps({"a": [Call(os.mkdir, str(ran))]}),
        b"cos\nmkdir\n(V" + str(ran).encode() + b"\ntR.",
        b"\x80\x04\x8c\x05posix\x8c\x05mkdir\x93\x8c"
        + bytes([len(str(ran).encode()) % 256])
        + str(ran).encode()
        + b"\x85R.",
        b"(S'" + str(ran).encode() + b"'\nios\nmkdir\n.",
        b"\x80\x02ctorch\nload\n" + b"X\x01\x00\x00\x00a\x85R.",
    ]


def tensor_pickle(shape: tuple[int, ...], strides: tuple[int, ...], n: int = 4, kind: str = "FloatStorage") -> bytes:
    """Returns a structure with one tensor of 16 bytes."""
    head = b"\x80\x02}X\x07\x00\x00\x00log_stdctorch._utils\n_rebuild_tensor_v2\n((X\x07\x00\x00\x00storagectorch\n"
    body = head + kind.encode() + b"\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpu" + number(n) + b"tQK\x00"
    return body + sequence(shape) + sequence(strides) + b"\x89}tRs."


def number(n: int) -> bytes:
    """Returns an integer."""
    size = (n.bit_length() + 8) // 8
    return b"\x8a" + bytes([size]) + n.to_bytes(size, "little", signed=True)


def sequence(values: tuple[int, ...]) -> bytes:
    """Returns a tuple of integers."""
    return b"(" + b"".join(map(number, values)) + b"t"


def structures() -> Iterator[tuple[str, bytes]]:
    """Yields files of PyTorch that are damaged or ask for much."""
    pickles = {
        "huge shape": tensor_pickle((2**40, 2**20), (1, 1)),
        "expanded": tensor_pickle((2**31,), (0,)),
        "beyond": tensor_pickle((4,), (2**60,)),
        "negative": tensor_pickle((-4,), (-1,)),
        "more numbers than bytes": tensor_pickle((2**33,), (1,), 2**33),
        "other dtype": tensor_pickle((4,), (1,), 4, "DoubleStorage"),
        "unknown dtype": tensor_pickle((4,), (1,), 4, "ComplexFloatStorage"),
        "many axes": tensor_pickle((1,) * 60, (1,) * 60),
        "bomb": BOMB,
        "deep": b"\x80\x02" + b"]" * 100_000 + b"a" * 99_999 + b".",
        "many": b"\x80\x02" + b"}" * 3_000_000 + b".",
        "long text": b"\x80\x02X\xff\xff\xff\x7fa.",
        "no marks": b"\x80\x02t.",
        "memo": b"\x80\x02h\xff.",
        "endless": b"\x80\x02]q\x00h\x00a.",
        "storage named by a bomb": BOMB[:-1] + tensor_pickle((4,), (1,))[2:].replace(b"X\x01\x00\x00\x000", b"h\xc7"),
    }
    for name, content in pickles.items():
        yield name, zipped({"archive/data.pkl": content, "archive/data/0": bytes(16)}, zipfile.ZIP_STORED)
    many = {"archive/data.pkl": shared_tensors(5_000), "archive/data/0": bytes(2**20)}
    yield "many tensors of one storage", zipped(many, zipfile.ZIP_STORED)
    yield "compressed", zipped({"archive/data.pkl": b"\x80\x02}.", "archive/data/0": bytes(2**26)})
    yield "path", zipped({"../../archive/data.pkl": b"\x80\x02}.", "/etc/passwd": b""}, zipfile.ZIP_STORED)
    yield "empty", torch_file({})
    yield "number", torch_file(5)
    yield "texts", torch_file({"action_net.weight": "a", "value_net.weight": [1], "log_std": None})


def shared_tensors(n: int) -> bytes:
    """Returns a structure with ``n`` names of one tensor of 2^18 numbers, 5 GB of them together."""
    tensor = tensor_pickle((2**18,), (1,), 2**18)
    begin, end = tensor.index(b"ctorch._utils"), tensor.index(b"Rs.") + 1
    names = b"".join(b"X\x04\x00\x00\x00" + f"{i:04}".encode() + b"h\x01" for i in range(n))
    return b"\x80\x02}X\x05\x00\x00\x00first" + tensor[begin:end] + b"q\x01s(" + names + b"u."


def overfull(valid: bytes, name: str, method: int, n: int) -> bytes:
    """Returns a file in which a member says that it has ``n`` bytes, and unpacks to 2^28."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for key, content in members_of(valid).items():
            archive.writestr(
                key, bytes(2**28) if key == name else content, method if key == name else zipfile.ZIP_DEFLATED
            )
    found = bytearray(stream.getvalue())
    sizes = struct.pack("<I", 2**28)
    for at in (found.find(sizes), found.rfind(sizes)):
        found[at : at + 4] = struct.pack("<I", n)
    return bytes(found)


def with_many_critics(valid: bytes) -> bytes:
    """Returns a file with 400 critics that share one storage."""
    shapes = {"0.weight": (256, 256), "0.bias": (256,), "2.weight": (1, 256), "2.bias": (1,)}
    one = torch_file({f"critic.qf0.{key}": Tensor(np.zeros(shape)) for key, shape in shapes.items()})
    inner = members_of(one)
    key = next(key for key in inner if key.endswith("data.pkl"))
    pickled = inner[key]
    begin, end = pickled.index(b"("), pickled.rindex(b"u.")
    copies = b"".join(pickled[begin + 1 : end].replace(b"critic.qf0", b"critic.%03d" % i) for i in range(400))
    inner[key] = pickled[: begin + 1] + copies + b"u."
    return zipped({**members_of(valid), "policy.pth": zipped(inner, zipfile.ZIP_STORED)})


def hostile_zips(valid: bytes, n: int, seed: int, ran: Path) -> Iterator[tuple[str, bytes]]:
    """Yields ``n`` files or a few more, each with a name.

    Args:
        valid: a model file.
        n: how many.
        seed: of the random ones.
        ran: the folder that code in the files would create.
    """
    members = members_of(valid)
    n_special = 0
    for one in special(valid, members, ran):
        n_special += 1
        yield one
    rng = np.random.default_rng(seed)
    for i in range(max(n - n_special, 0)):
        name = list(members)[rng.integers(len(members))]
        kind = i % 6
        if kind == 0:
            yield f"cut {i}", valid[: rng.integers(len(valid))]
        elif kind == 1:
            yield f"flipped {i}", flipped(valid, rng, 1 + int(rng.integers(20)))
        elif kind in (2, 3):
            yield (
                f"{name} flipped {i}",
                zipped({**members, name: flipped(members[name], rng, 1 + int(rng.integers(8)))}),
            )
        elif kind == 4:
            yield f"{name} cut {i}", zipped({**members, name: members[name][: rng.integers(len(members[name]) + 1)]})
        else:
            inner = members_of(members["policy.pth"])
            key = next(key for key in inner if key.endswith("data.pkl"))
            inner[key] = flipped(inner[key], rng, 1 + int(rng.integers(4)))
            yield f"pickle flipped {i}", zipped({**members, "policy.pth": zipped(inner, zipfile.ZIP_STORED)})


def special(valid: bytes, members: dict[str, bytes], ran: Path) -> Iterator[tuple[str, bytes]]:
    """Yields the files that are made on purpose."""
    for i, call in enumerate(calls(ran)):
        for field in ("observation_space", "action_space", "policy_kwargs", "learning_rate"):
            yield f"{field} calls {i}", changed(valid, {field: serialized(call)})
        for name in ("policy.pth", "policy.optimizer.pth", "pytorch_variables.pth"):
            inner = zipped({"archive/data.pkl": call, "archive/data/0": bytes(16)}, zipfile.ZIP_STORED)
            yield f"{name} calls {i}", zipped({**members, name: inner})
            yield f"{name} is a pickle {i}", zipped({**members, name: call})
    for name, content in structures():
        for file in ("policy.pth", "policy.optimizer.pth"):
            yield f"{file}: {name}", zipped({**members, file: content})
    spaces = [
        gym.spaces.Discrete(2**40),
        gym.spaces.MultiBinary(2**28) if ran.name == "large" else gym.spaces.MultiBinary(2**21),
        gym.spaces.Text(3),
        gym.spaces.Dict({}),
        gym.spaces.Box(np.float32(0), np.float32(1), (3, 3)),
    ]
    for i, space in enumerate(spaces):
        yield f"space {i}", changed(valid, {"observation_space": serialized(space)})
        yield f"action space {i}", changed(valid, {"action_space": serialized(space)})
    yield "space of no numbers", changed(valid, {"observation_space": serialized(EMPTY_BOX)})
    bomb = b"\x80\x02}X\x04\x00\x00\x00full" + BOMB[2:-1] + b"s."
    yield ("shared policy_kwargs", changed(valid, {"policy_kwargs": serialized(bomb)}))
    yield "shared use_expln", changed(valid, {"policy_kwargs": serialized(KWARGS_BOMB)})
    yield "shared space", changed(valid, {"observation_space": serialized(BOMB)})
    yield "many critics", with_many_critics(valid)
    for method in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        for member in ("data", "policy.pth"):
            yield f"{member} overfull by method {method}", overfull(valid, member, method, 1000)
    yield "old file of tensors", zipped({**members, "policy.pth": old_torch_file({"a": Tensor(np.zeros(3))})})
    yield "old file cut", zipped({**members, "policy.pth": old_torch_file({"a": Tensor(np.zeros(300))})[:-1000]})
    large = old_torch_file({"a": Tensor(np.zeros(3))}, size=2**60)
    yield "old file of a huge tensor", zipped({**members, "policy.pth": large})
    yield "old file of a bomb", zipped({**members, "policy.pth": OLD_HEAD + BOMB})
    for name in ("data", "policy.pth"):
        yield f"no {name}", zipped({key: value for key, value in members.items() if key != name})
        yield f"zip bomb in {name}", zipped({**members, name: bytes(2**28)})
    yield "other bomb", zipped({**members, "more": bytes(2**28)})
    yield "deep JSON", zipped({**members, "data": b"[" * 100_000})
    yield "JSON of lists", zipped({**members, "data": b'{"gamma": [' + b"[]," * 1_000_000 + b"[]]}"})
    yield "paths", zipped({**members, "../../../evil.pth": members["policy.pth"], "/tmp/evil.pth": b""})
    yield "nested", zipped({**members, "policy.pth": valid})
    yield "many members", zipped({**members, **{f"{i}": b"" for i in range(30_000)}})
    for field, value in {
        "num_timesteps": 2**70,
        "gamma": "x",
        "policy_kwargs": [],
        "seed": -5,
        "n_steps": 1e300,
    }.items():
        yield f"{field}={value}", changed(valid, {field: value})
    at = valid.rindex(b"PK\5\6")
    yield "large directory", valid[: at + 12] + struct.pack("<I", 2**31) + valid[at + 16 :]


def flipped(content: bytes, rng: np.random.Generator, n: int) -> bytes:
    """Returns bytes of which ``n`` are replaced."""
    changed = bytearray(content)
    for _ in range(n if content else 0):
        changed[rng.integers(len(changed))] = rng.integers(256)
    return bytes(changed)
