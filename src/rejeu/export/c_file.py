"""Programs as one C99 file with a header: no allocation, no library but the mathematical one, static state."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from string import Template

import numpy as np

from rejeu.core.types import JsonObject
from rejeu.export.check import Run
from rejeu.export.contract import Exportable, Policy, Port
from rejeu.export.loops import TEMPLATES, Language, Printer, indented, memory

TYPES = {
    "float32": "float",
    **{f"{sign}int{bits}": f"{sign}int{bits}_t" for sign in ("", "u") for bits in (8, 16, 32)},
    "int64": "int64_t",
    "bool": "uint8_t",
}
C = Language("C", TYPES)
COMPILERS = ("cc", "gcc", "clang")
TAKEN = frozenset((TEMPLATES / "words.txt").read_text(encoding="utf-8").split())
"""Words of C and C++, and names of the mathematical library, which also have the suffixes f and l there."""


def identifier(name: str) -> str:
    """Returns a name of C that resembles another one.

    >>> identifier("camera.left"), identifier("2nd-car"), identifier("tanhf")
    ('camera_left', 'p2nd_car', 'tanhf_')
    """
    name = re.sub(r"\W", "_", name, flags=re.ASCII)
    name = name if name[:1].isalpha() else f"p{name}"
    return f"{name}_" if {name, name.removesuffix("f"), name.removesuffix("l")} & TAKEN else name


def filled(template: str, **texts: object) -> bytes:
    """Returns a file made of one of the templates."""
    return Template((TEMPLATES / template).read_text(encoding="utf-8")).substitute(texts).encode()


def write(policy: Policy, card: JsonObject, stem: str) -> tuple[bytes, bytes]:
    """Returns the C file of a policy and its header; ``stem`` is the name of the files without suffix."""
    printer, names = Printer(C), names_of(policy)
    stored_arrays = printer.run(policy.program, list(names.values()))
    action, after = policy.outputs[0], policy.of("state")
    last = [printer.stored(value) if value.name in names.values() else value for value in stored_arrays[1:]]
    printer.copy(stored_arrays[0], memory("action", stored_arrays[0].shape, action.dtype))
    for port, value in zip(after, last, strict=True):
        printer.copy(value, memory(names[port.name], value.shape, port.dtype))
    input_ports = [port for port in policy.inputs if port.role not in ("state", "episode_start")]
    code = "\n".join(printer.lines)
    body = [f"(void){names[port.name]};" for port in input_ports if not re.search(rf"\b{names[port.name]}\[", code)]
    starts = [names[port.name] for port in policy.of("episode_start")]
    arrays = [array(constant, data) for constant, data in printer.constants.items()]
    arrays += [declaration(port, names[port.name], "static ") + ";" for port in after]
    arrays += [f"static uint8_t {start}[1] = {{1}};" for start in starts]
    arrays += [f"static {TYPES[dtype]} {buffer}[{n}];" for buffer, dtype, n in printer.buffers]
    name = identifier(stem)
    takes = [declaration(port, names[port.name], "const ") for port in input_ports]
    upper, sizes = name.upper(), [*((names[port.name], size(port)) for port in input_ports), ("action", size(action))]
    texts = {
        "name": name,
        "stem": stem,
        "upper": upper,
        "card": json.dumps(card, indent=1).replace("*/", "* /").replace("/*", "/ *"),
        "signature": f"void {name}_act({', '.join([*takes, declaration(action, 'action')])})",
        "arrays": "\n".join(arrays),
        "body": indented([*body, *printer.lines, *(f"{start}[0] = 0;" for start in starts)]),
        "resets": "".join(f"\t{start}[0] = 1;\n" for start in starts),
        "sizes": "\n".join(f"#define {upper}_{port_name.upper()}_SIZE {n}" for port_name, n in sizes),
    }
    return filled("policy.c", **texts), filled("policy.h", **texts, rejeu=card["rejeu"], weights=card["weights"])


def files(source: Exportable) -> tuple[tuple[bytes, ...], Run | None]:
    """Returns the C file and its header, and the run of both.

    Raises:
        ValueError: if no program can include a header of this name.
    """
    stem = source.stem
    if not stem.isprintable() or {*stem} & {*'"\\'}:
        raise ValueError(f"{stem + '.c'!r} cannot be included by a C program; leave out quotes and backslashes")
    code, header = write(source.single, source.card, stem)
    return (code, header), c_run(source.single, code, header, stem)


def c_run(policy: Policy, source: bytes, header: bytes, stem: str, compiler: str | None = None) -> Run | None:
    """Returns the run of a C file; None without a compiler.

    Raises:
        RuntimeError: if it does not compile without warnings.
    """
    compiler = compiler or next((command for command in COMPILERS if shutil.which(command)), None)
    if compiler is None:
        return None

    def run(inputs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / "policy.c").write_bytes(source)  # whose own name may be one that a compiler takes for an option
            (folder / f"{stem}.h").write_bytes(header)
            (folder / "main.c").write_bytes(main_of(policy, stem))
            options = ["-O2", "-std=c99", "-Wall", "-Wextra", "-Werror", "-c", "policy.c"]
            for arguments in (options, ["-O2", "main.c", "policy.o", "-lm", "-o", "main"]):
                command = [compiler, *arguments]
                compilation = subprocess.run(command, cwd=folder, capture_output=True, errors="replace", check=False)
                if compilation.returncode:
                    raise RuntimeError(f"{compiler} does not compile the C file: {compilation.stderr[:1000]}")
            input_ports = [port for port in policy.inputs if port.role != "state"]
            n = len(next(iter(inputs.values())))
            parts = [np.ascontiguousarray(inputs[p.name].reshape(n, -1), p.dtype).view(np.uint8) for p in input_ports]
            rows = np.concatenate(parts, axis=1)
            output_bytes = subprocess.run(
                [folder / "main"], input=rows.tobytes(), capture_output=True, check=True
            ).stdout
        action = policy.outputs[0]
        made_of = np.dtype([("action", action.dtype, action.shape), ("seconds", "f8")])
        result = np.frombuffer(output_bytes, made_of)
        return result["action"], result["seconds"]

    return run


def main_of(policy: Policy, stem: str) -> bytes:
    """Returns a program that reads inputs from standard input, and writes actions and times to standard output."""
    input_ports = [port for port in policy.inputs if port.role != "state"]
    starts = [i for i, port in enumerate(input_ports) if port.role == "episode_start"]
    arrays = [declaration(port, f"a{i}", "static ") + ";" for i, port in enumerate(input_ports)]
    return filled(
        "main.c",
        stem=stem,
        name=identifier(stem),
        arrays="\n".join([*arrays, declaration(policy.outputs[0], "action", "static ") + ";"]),
        reads=" && ".join(f"fread(a{i}, sizeof a{i}, 1, stdin)" for i in range(len(input_ports))),
        starts=" ".join(f"if (a{i}[0]) {identifier(stem)}_reset();" for i in starts),
        arguments=", ".join([*(f"a{i}" for i in range(len(input_ports)) if i not in starts), "action"]),
    )


def declaration(port: Port, name: str, qualifier: str = "") -> str:
    """Returns the declaration of an input or output."""
    return f"{qualifier}{TYPES[port.dtype]} {name}[{size(port)}]"


def size(port: Port) -> int:
    """Returns the number of elements of an input or output."""
    return max(math.prod(port.shape), 1)


def names_of(policy: Policy) -> dict[str, str]:
    """Returns names of C for the inputs, by their own; those that are taken already get an underscore."""
    result, used_names = {}, {"ACTION", "X", "SUM", "BEST"}
    for port in policy.inputs:
        name = identifier(port.name)
        while name.upper() in used_names or re.fullmatch(r"[vci]\d+|u?int\w*_t|[A-Z0-9_]*[A-Z0-9]", name):
            name += "_"
        used_names.add(name.upper())  # of the macro with its size
        result[port.name] = name
    return result


def array(name: str, data: np.ndarray) -> str:
    """Returns the declaration of a constant array."""
    numbers = [C.literal(number) for number in data.ravel()]
    text = ",\n".join(", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8))
    return f"static const {TYPES[str(data.dtype)]} {name}[{data.size}] = {{\n{text}}};"
