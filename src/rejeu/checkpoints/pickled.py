"""Pickles and PyTorch's files read as data: nothing that they name is imported or called.

A pickle is a program of opcodes, some of which name functions and call them. :func:`parse` follows the opcodes that build
plain values. A name stays a :class:`Name`, and what would be called with it becomes a :class:`PickledCall`, which only
holds the arguments; names of packages other than :data:`PACKAGES` are refused. The opcodes are decoded by the standard
library's ``pickletools``, which disassembles pickles and executes none.

A file of PyTorch is a zip file with the pickle of a structure, ``data.pkl``, and the bytes of each storage, to which the
structure refers by name. Before PyTorch 1.6 it was one pickle after another, followed by the bytes of the storages.
"""

from __future__ import annotations

import contextlib
import io
import math
import pickletools
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from rejeu.core.errors import CheckpointError
from rejeu.core.records import MAX_DEPTH, WRONG, Malformed, brief, read_bytes, shown
from rejeu.core.types import JsonObject

PACKAGES = {"collections", "copyreg", "gym", "gymnasium", "numpy", "sb3_contrib", "stable_baselines3", "torch"}
"""Packages whose names a pickle may mention."""
MOST_OPCODES = 200_000
"""Upper limit on the opcodes of a pickle, each of which can take some hundred bytes of memory."""
MOST_DIRECTORY = 2**20
"""Upper limit on the bytes of a zip file's table of contents."""
MOST_TEXT = 4 * 2**20
"""Upper limit on the bytes of a pickle without the arrays."""
MOST_FIELD = 4 * 2**20
"""Upper limit on the bytes of one of its values, and of a ``VecNormalize`` file."""
MOST_NAME = 200
"""Upper limit on the length of the name of a module, class or function."""
MOST_DTYPE = 8
"""Length of the longest name of a dtype of numbers; longer ones describe tables."""
MOST_WRITTEN = 32 * 2**20
"""Upper limit on the size of a value when each part counts as often as it occurs: 64 bytes, and those of texts and arrays. A
part that is shared many times takes little memory, and endless time to print, hash or convert."""
OLD_MAGIC, OLD_PROTOCOL = 0x1950A86A20F9469CFC6C, 1001
"""The first two values of a file of PyTorch before 1.6."""
STORAGES = {"Float": "f4", "Double": "f8", "Half": "f2", "Long": "i8", "Int": "i4", "Short": "i2", "Char": "i1"}
STORAGES |= {"Byte": "u1", "Bool": "b1"}
"""The dtypes of PyTorch's storages, by the first word of their names."""
SETS = {("builtins", "set"), ("builtins", "frozenset"), ("__builtin__", "set"), ("__builtin__", "frozenset")}
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
VALUES = {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8"}
VALUES |= {"BINBYTES", "SHORT_BINBYTES", "BINBYTES8", "BYTEARRAY8"}
"""Opcodes whose argument is a value."""
UNREADABLE = (*WRONG, EOFError, OSError, RuntimeError, struct.error, zipfile.BadZipFile, zlib.error)
"""Exceptions that a damaged file can cause."""


class Name(NamedTuple):
    """The name of a class or function, which is never looked up."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


class PickledCall:
    """An object that a pickle would create by a call: the name, the arguments, and the attributes that it would set."""

    def __init__(self, name: object, arguments: tuple[Any, ...]) -> None:
        self.name, self.arguments = str(name) if isinstance(name, Name) else "", arguments
        self.state: Any = None


def parse(
    data: bytes | BinaryIO,
    call: Callable[[Any, tuple[Any, ...]], Any] = PickledCall,
    storage: Any = None,
    arrays: int = 0,
) -> Any:
    """Returns the value of a pickle. A set becomes a list.

    Args:
        data: the pickle, or a file that is read to its end.
        call: returns the value that stands for a call of a name with arguments.
        storage: returns the value that stands for a reference to something outside of the pickle.
        arrays: upper limit on the bytes of the arrays in the value, each as often as it occurs.

    Raises:
        Malformed: for an opcode or a name that is not known, a damaged pickle, or a value that is too large.
    """
    stack: list[Any] = []
    marks: list[list[Any]] = []
    memo: dict[int, Any] = {}
    value: Any
    for n, (opcode, value, _) in enumerate(pickletools.genops(data)):
        code = opcode.name
        if n >= MOST_OPCODES:
            raise Malformed(f"it has more than {MOST_OPCODES:,} opcodes")
        if code in VALUES:
            stack.append(value)
        elif code in CONSTANTS:
            stack.append(CONSTANTS[code])
        elif code in ("BINGET", "LONG_BINGET"):
            stack.append(memo[value])
        elif code in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
            memo[len(memo) if code == "MEMOIZE" else value] = stack[-1]
        elif code in ("EMPTY_TUPLE", "EMPTY_LIST", "EMPTY_DICT", "EMPTY_SET"):
            stack.append({"EMPTY_TUPLE": (), "EMPTY_DICT": {}}.get(code, []))
        elif code == "MARK":
            marks.append(stack)
            stack = []
        elif code in ("TUPLE", "FROZENSET", "APPENDS", "ADDITEMS", "SETITEMS"):
            items, stack = stack, marks.pop()
            if code in ("TUPLE", "FROZENSET"):
                stack.append(tuple(items))
            else:
                add(stack[-1], items, code == "SETITEMS")
        elif code in ("TUPLE1", "TUPLE2", "TUPLE3"):
            stack.append(tuple(popped(stack, int(code[-1]))))
        elif code in ("APPEND", "SETITEM"):
            items = popped(stack, 1 + (code == "SETITEM"))
            add(stack[-1], items, code == "SETITEM")
        elif code in ("GLOBAL", "STACK_GLOBAL"):
            module, name = value.split(" ") if code == "GLOBAL" else popped(stack, 2)
            if module in ("cloudpickle.cloudpickle", "dill._dill"):
                raise Malformed("it holds a class or function of your own, whose code rejeu does not run")
            is_name = all(isinstance(text, str) and len(text) <= MOST_NAME for text in (module, name))
            if not is_name or (module.split(".")[0] not in PACKAGES and (module, name) not in SETS):
                raise Malformed(f"it names {named(module)}.{named(name)}, which has no place in such a file")
            stack.append(Name(module, name))
        elif code in ("REDUCE", "NEWOBJ"):
            function, arguments = popped(stack, 2)
            if not isinstance(arguments, tuple):
                raise Malformed("it calls something without arguments")
            if isinstance(function, Name) and function in SETS:
                items = arguments[0] if arguments else []
                if not isinstance(items, list | tuple):
                    raise Malformed(f"it makes a set of a {type(items).__name__}, expected a list")
                stack.append(items)
                continue
            is_empty = function == ("collections", "OrderedDict") and not arguments
            stack.append({} if is_empty else call(function, arguments))
        elif code == "BUILD":
            (state,) = popped(stack, 1)
            if isinstance(stack[-1], PickledCall):
                stack[-1].state = state
        elif code == "BINPERSID" and storage is not None:
            stack.append(storage(stack.pop()))
        elif code == "STOP":
            (result,) = stack
            check_size(result, MOST_WRITTEN, arrays)
            return result
        elif code not in ("PROTO", "FRAME"):
            raise Malformed(f"it has the opcode {code}, which such files do not use")
    raise Malformed("it is cut short")


def check_size(value: object, limit: int, arrays: int = 0) -> None:
    """Raises ``Malformed`` if a value is larger than ``limit``, see :data:`MOST_WRITTEN`, or its arrays than ``arrays``.

    Neither may it have more than :data:`MAX_DEPTH` levels: Python's hash of a tuple ends the process at some ten thousand.
    """
    level = [value]
    for _ in range(MAX_DEPTH):
        below: list[Any] = []
        for node in level:
            if isinstance(node, PickledCall):
                inside: Any = [node.arguments, node.state]
            else:
                inside = node.values() if isinstance(node, dict) else node if isinstance(node, list | tuple) else ()
            limit -= 64 * len(inside) + (len(node) if isinstance(node, str | bytes | bytearray) else 0)
            arrays -= node.nbytes if isinstance(node, np.ndarray) else 0
            if limit < 0 or arrays < 0:
                raise Malformed("its parts are shared so often that they have no end, or are larger than the file")
            below.extend(inside)
        level = below
    if level:
        raise Malformed(f"it is nested in more than {MAX_DEPTH} levels")


def popped(stack: list[Any], n: int) -> list[Any]:
    """Removes the last ``n`` values and returns them."""
    values = stack[-n:]
    if len(values) < n:
        raise Malformed("it takes more values than it has")
    del stack[-n:]
    return values


def add(target: object, items: list[Any], pairs: bool) -> None:
    """Adds items to a list, or alternating keys and values to a dict; of other objects they are of no interest."""
    if isinstance(target, dict) and pairs:
        for key, value in zip(items[::2], items[1::2], strict=True):
            if not isinstance(key, str | int):
                raise Malformed("it has a key that is no text or number")
            target[key] = value
    elif isinstance(target, list) and not pairs:
        target.extend(items)
    elif isinstance(target, PickledCall) and target.name == "collections.deque" and not pairs:
        target.state = target.state or []
        target.state.extend(items)


def named(value: object) -> str:
    """Returns a name from a file for a message; of anything else the type, since nested values may be endless to print."""
    return shown(value, 60) if isinstance(value, str | Name) else type(value).__name__


def array_of(value: object) -> np.ndarray:
    """Returns the array that a record of NumPy's describes, or a scalar of a pickle as an array.

    Raises:
        Malformed: for anything else, and unless the bytes are those of the shape.
    """
    if isinstance(value, bool | int | float):
        return np.asarray(value)
    if not isinstance(value, PickledCall):
        raise Malformed("it has no array where one is expected")
    end = value.name.rpartition(".")[2]
    if end == "_frombuffer":
        content, dtype, shape, order = value.arguments
    elif end == "_reconstruct":
        _, shape, dtype, is_fortran, content = value.state
        order = "F" if is_fortran else "C"
    elif end == "scalar":
        (dtype, content), shape, order = value.arguments, (), "C"
    else:
        raise Malformed(f"it has {named(value.name)} where an array is expected")
    array = np.frombuffer(content, dtype_of(dtype))
    if array.size == 0:  # of which one axis may be endless
        raise Malformed("it has an array without numbers")
    return array.reshape(shape, order="F" if order == "F" else "C")


def dtype_of(value: object) -> np.dtype:
    """Returns the dtype of numbers that a record of NumPy's, or the name of a class of scalars, describes."""
    if isinstance(value, Name) and value.module == "numpy":
        dtype = np.dtype(value.name)
    elif isinstance(value, PickledCall) and value.name == "numpy.dtype" and len(value.arguments[0]) <= MOST_DTYPE:
        dtype = np.dtype(value.arguments[0])
        if isinstance(value.state, tuple) and value.state[1] == ">":
            dtype = dtype.newbyteorder(">")
    else:
        raise Malformed("it has no dtype where one is expected")
    if dtype.kind not in "biuf":
        raise Malformed(f"it has the dtype {dtype}, expected numbers")
    return dtype


def tensors_of(data: bytes) -> Any:
    """Returns the structure that a file of PyTorch holds, with arrays in place of its tensors.

    Arrays are views of the bytes of a storage, so two tensors that share it have one address.

    Raises:
        Malformed: unless it is a complete file of tensors, dicts, lists and numbers.
    """
    if not data.startswith(b"PK"):
        return old_tensors(data)
    with opened(io.BytesIO(data)) as archive:
        members = {info.filename.partition("/")[2]: info for info in archive.infolist()}

        def member(name: str) -> bytes:
            if name not in members:
                raise Malformed(f"it has no {shown(name, 40)}: it is a file of another program")
            return archive.read(members[name])

        if "byteorder" in members and member("byteorder") != b"little":
            raise Malformed("its numbers are big-endian, which is not supported")
        if members.get("data.pkl", zipfile.ZipInfo()).file_size > MOST_TEXT:
            raise Malformed(f"its structure has more than {MOST_TEXT:,} bytes")
        return structure(member("data.pkl"), lambda key: member(f"data/{key}"), len(data))


def old_tensors(data: bytes) -> Any:
    """Returns the structure that a file of PyTorch before 1.6 holds."""
    file = io.BytesIO(data)
    if (parse(file), parse(file)) != (OLD_MAGIC, OLD_PROTOCOL) or parse(file).get("little_endian") is not True:
        raise Malformed("it is no file of PyTorch, or its numbers are big-endian")
    start, sizes, contents = file.tell(), {}, {}

    def storage(reference: Any) -> None:
        sizes[named(reference[2])] = kind_of(reference)[1].itemsize

    parse(file, storage=storage)  # once for what comes after it, and then with that
    for key in parse(file):
        contents[key] = file.read(struct.unpack("<q", file.read(8))[0] * sizes[key])
    return structure(data[start:], contents.__getitem__, len(data))


def structure(data: bytes, content: Callable[[str], bytes], room: int) -> Any:
    """Returns the structure of a pickle, with arrays in place of tensors.

    Args:
        data: the pickle.
        content: returns the bytes of a storage.
        room: bytes of the file; all arrays together may have four times as many, since some have several names.
    """
    storages: dict[str, np.ndarray] = {}

    def storage(reference: object) -> np.ndarray:
        key, dtype, n = kind_of(reference)
        if key not in storages:
            storages[key] = np.frombuffer(content(key), dtype.newbyteorder("<"))
        if storages[key].size != n or storages[key].dtype != dtype:
            raise Malformed(f"the tensor {shown(key, 40)} has {storages[key].nbytes} bytes, expected {n} numbers")
        return storages[key]

    return parse(data, tensor, storage, 4 * room)


def kind_of(reference: object) -> tuple[str, np.dtype, int]:
    """Returns name, dtype and number of values of the storage to which a structure refers."""
    if not isinstance(reference, tuple) or len(reference) > 6:
        raise Malformed("it has a tensor whose storage is not described by a tuple of five or six")
    _, storage, key, _, n, *view = reference
    code = STORAGES.get(storage.name.removesuffix("Storage")) if isinstance(storage, Name) else None
    if code is None:
        raise Malformed(f"it has a tensor of {named(storage)}, expected one of {', '.join(STORAGES)}")
    if type(n) is not int or not isinstance(key, str) or view not in ([], [None]):
        raise Malformed("it has a tensor whose storage is not named by a text and a size")
    return key, np.dtype(code), n


def tensor(function: object, arguments: tuple[Any, ...]) -> Any:
    """Returns the array that a function of PyTorch would make; the only other calls in such files are of no arguments."""
    if function == ("torch._utils", "_rebuild_parameter"):
        return arguments[0]
    if function != ("torch._utils", "_rebuild_tensor_v2"):
        raise Malformed(f"it calls {named(function)}, expected tensors only")
    storage, first, shape, strides = arguments[:4]
    if not all(isinstance(sizes, tuple) and len(sizes) <= 8 for sizes in (shape, strides)):
        raise Malformed("it has a tensor whose shape or strides are no tuple of at most 8 numbers")
    if not isinstance(storage, np.ndarray) or not all(type(n) is int and n >= 0 for n in (first, *shape, *strides)):
        raise Malformed("it has a tensor whose shape is not valid")
    n = math.prod(shape)
    last = first + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if n > storage.size or (n and last >= storage.size):
        raise Malformed(f"it has a tensor of the shape {shown(shape, 40)} in {storage.size} numbers")
    if n == 0:
        return np.zeros(shape, storage.dtype)
    steps = [stride * storage.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(storage[first:], shape, steps, writeable=False)


@contextlib.contextmanager
def opened(file: BinaryIO, room: int = 0) -> Iterator[zipfile.ZipFile]:
    """Opens a zip file whose table of contents and members are of a limited size.

    Args:
        file: the file.
        room: the most bytes of all members together; 0 refuses compressed members, which the file itself then bounds.

    Raises:
        Malformed: if it is no zip file, or larger than that.
    """
    size = file.seek(0, io.SEEK_END)
    file.seek(max(size - 66_000, 0))
    tail = file.read()
    at = tail.rfind(b"PK\5\6")
    if at < 0 or len(tail) < at + 22:
        raise Malformed("it is not a complete zip file")
    directory = struct.unpack_from("<I", tail, at + 12)[0]
    if tail[max(at - 20, 0) : at].startswith(b"PK\6\7"):  # the sizes of large files, which PyTorch always writes
        start, directory = struct.unpack_from("<Q", tail, at - 12)[0], struct.unpack_from("<Q", tail, at - 36)[0]
        if start != size - len(tail) + at - 76 or not tail[at - 76 :].startswith(b"PK\6\6"):
            raise Malformed("its table of contents is damaged")
    if directory > MOST_DIRECTORY:
        raise Malformed(f"its table of contents has more than {MOST_DIRECTORY:,} bytes")
    with zipfile.ZipFile(file) as archive:
        infos = archive.infolist()
        if not room and any(info.compress_type or info.file_size != info.compress_size for info in infos):
            raise Malformed("it is compressed, as such files are not")
        if any(info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for info in infos):
            raise Malformed("it has a member that is neither stored nor deflated")
        if (total := sum(info.file_size for info in infos)) > (room or size):
            raise Malformed(f"its members have {total:,} bytes, expected at most {room or size:,}")
        yield archive


def content_of(archive: zipfile.ZipFile, name: str) -> bytes:
    """Returns a member of a zip file; of one that unpacks to more than its declared size, no more is unpacked than that."""
    with archive.open(name) as file:
        return b"".join(iter(lambda: file.read(2**20), b""))


@contextlib.contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turns errors of a damaged file into ``CheckpointError`` with its path."""
    try:
        yield
    except (FileNotFoundError, CheckpointError):
        raise
    except UNREADABLE as error:
        raise CheckpointError(f"{path} cannot be read as a file of Stable-Baselines3: {brief(error)}") from None


def read_normalization(path: Path) -> JsonObject:
    """Returns the attributes of a ``VecNormalize`` file.

    Raises:
        Malformed: if it is none, or damaged.
    """
    wrapper = parse(read_bytes(path, MOST_FIELD))
    if (
        not isinstance(wrapper, PickledCall)
        or not wrapper.name.endswith("VecNormalize")
        or not isinstance(wrapper.state, dict)
    ):
        raise Malformed("it holds no VecNormalize")
    return wrapper.state
