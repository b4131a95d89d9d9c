"""Programs as one C99 file with a header: no allocation, no library but the mathematical one, static state."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np

from rejeu.export.contract import Policy, Port
from rejeu.export.loops import Language, Printer, as_float, contiguous, indented

TYPES = {
    "float32": "float",
    "int8": "int8_t",
    "int16": "int16_t",
    "int32": "int32_t",
    "int64": "int64_t",
    "uint8": "uint8_t",
    "uint16": "uint16_t",
    "uint32": "uint32_t",
    "bool": "uint8_t",
}
C = Language(
    name="C",
    types=TYPES,
    variable=lambda dtype: "int" if dtype == "index" else TYPES[dtype],
    functions={"abs": "fabsf", "mod": "fmodf"},
    prefix="",
    suffix="f",
    missing=(),
)


def identifier(name: str) -> str:
    """Returns a name of C that resembles another one.

    >>> identifier("camera.left"), identifier("2nd-car")
    ('camera_left', 'p2nd_car')
    """
    name = re.sub(r"\W", "_", name, flags=re.ASCII)
    return name if name[:1].isalpha() else f"p{name}"


def write(policy: Policy, card: dict[str, Any], stem: str) -> tuple[bytes, bytes]:
    """Returns the C file of a policy and its header; ``stem`` is the name of the files without suffix."""
    name = identifier(stem)
    names = dict(
        zip(
            [port.name for port in policy.inputs],
            unique([identifier(port.name) for port in policy.inputs]),
            strict=True,
        )
    )
    printer = Printer(C)
    found = printer.run(policy.program, list(names.values()))
    action, after = policy.outputs[0], policy.of("state")
    given = [port for port in policy.inputs if port.role not in ("state", "episode_start")]
    takes = [f"const {TYPES[port.dtype]} {names[port.name]}[{size(port)}]" for port in given]
    signature = f"void {name}_act({', '.join([*takes, f'{TYPES[action.dtype]} action[{size(action)}]'])})"
    reset = f"void {name}_reset(void)"
    out = contiguous("action", found[0].shape, action.dtype)
    last = [printer.stored(one) if names and one.base in names.values() else one for one in found[1:]]
    printer.copy(found[0], out)
    for port, one in zip(after, last, strict=True):
        printer.copy(one, contiguous(names[port.name], one.shape, port.dtype))
    unused = [
        names[port.name] for port in given if not any(re.search(rf"\b{names[port.name]}\[", x) for x in printer.lines)
    ]
    statics = [f"static {TYPES[port.dtype]} {names[port.name]}[{size(port)}];" for port in after]
    starts = [names[port.name] for port in policy.of("episode_start")]
    statics += [f"static uint8_t {one}[1] = {{1}};" for one in starts]
    buffers = [f"static {TYPES[dtype]} {one}[{n}];" for one, dtype, n in printer.buffers]
    body = [f"(void){one};" for one in unused] + printer.lines + [f"{one}[0] = 0;" for one in starts]
    source = "\n".join(
        [
            comment(card),
            f'#include "{stem}.h"',
            "",
            "#include <math.h>",
            "",
            *(array(one, data) for one, data in printer.constants.items()),
            *statics,
            *buffers,
            "",
            signature + " {",
            indented(body),
            "}",
            "",
            reset + " {",
            *(f"\t{one}[0] = 1;" for one in starts),
            "}",
            "",
        ]
    )
    guard = f"{name.upper()}_H"
    lengths = [f"#define {name.upper()}_{names[port.name].upper()}_SIZE {size(port)}" for port in given]
    header = "\n".join(
        [
            comment(card),
            f"#ifndef {guard}",
            f"#define {guard}",
            "",
            "#include <stdint.h>",
            "",
            *lengths,
            f"#define {name.upper()}_ACTION_SIZE {size(action)}",
            f'#define {name.upper()}_REJEU "{card["rejeu"]}"',
            f'#define {name.upper()}_WEIGHTS "{card["weights"]}"',
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            "/* Computes the action for an observation. Arrays are in C order. Not reentrant: its memory is static. */",
            signature + ";",
            "",
            "/* Starts an episode: a policy with memory forgets. The first episode needs no call. */",
            reset + ";",
            "",
            "#ifdef __cplusplus",
            "}",
            "#endif",
            "#endif",
            "",
        ]
    )
    return source.encode(), header.encode()


def size(port: Port) -> int:
    """Returns the number of elements of an input or output."""
    return max(math.prod(port.shape), 1)


def unique(names: list[str]) -> list[str]:
    """Returns names in which later ones that are equal to earlier ones, or to names of the file, get an underscore."""
    taken = {"action", "x", "sum", "best"}
    result = []
    for name in names:
        while name in taken or re.fullmatch(r"vc?\d+|i\d+", name):
            name += "_"
        taken.add(name)
        result.append(name)
    return result


def comment(card: dict[str, Any]) -> str:
    """Returns the card as a comment."""
    text = json.dumps(card, indent=1).replace("*/", "* /").replace("/*", "/ *")
    return f"/* Made by rejeu. The contract of this policy:\n{text}\n*/"


def array(name: str, data: np.ndarray) -> str:
    """Returns the declaration of a constant array."""
    is_float = data.dtype.kind == "f"
    numbers = [as_float(one) + "f" if is_float else str(int(one)) for one in data.ravel().tolist()]
    lines = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    text = ",\n".join(lines)
    return f"static const {TYPES[str(data.dtype)]} {name}[{data.size}] = {{\n{text}}};"
