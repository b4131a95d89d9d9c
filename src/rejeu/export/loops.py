"""Programs as loops over arrays of fixed sizes, in C or JavaScript."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from rejeu.export import PRIMITIVES
from rejeu.export.program import Operation, TracedProgram, Value, unsupported

TEMPLATES = Path(__file__).parent / "templates"
REDUCTIONS = {
    "reduce_max": "{0} > {1} ? {0} : {1}",
    "reduce_min": "{0} < {1} ? {0} : {1}",
    "reduce_sum": "{0} + {1}",
}
"""How each element is added to the result so far."""


class Language(NamedTuple):
    """How code is written where C and JavaScript differ."""

    name: str
    types: dict[str, str]
    """Of the elements of arrays, by dtype."""

    def declaration(self, dtype: str) -> str:
        """Returns how a variable is declared that holds an element of a dtype, or an ``index``."""
        return "let" if self.name == "JavaScript" else "int" if dtype == "index" else self.types[dtype]

    def cast(self, source: str, dtype: str) -> str:
        """Returns the expression of a conversion from one dtype to another."""
        if dtype == "bool":
            return "({0} != 0)"
        if self.name == "C":
            return f"(({self.types[dtype]}){{0}})"
        return "Math.trunc({0})" if source.startswith("float") and not dtype.startswith("float") else "(+{0})"

    def literal(self, number: np.ndarray) -> str:
        """Returns how a number is written."""
        value = number.reshape(()).item()
        if not math.isfinite(value):
            names = ("NAN", "INFINITY") if self.name == "C" else ("NaN", "Infinity")
            return names[0] if math.isnan(value) else f"({'-' * (value < 0)}{names[1]})"
        is_float = number.dtype.kind == "f" and self.name == "C"
        text = as_float(value) + "f" if is_float else repr(int(value) if number.dtype.kind != "f" else value)
        return f"({text})" if text.startswith("-") else text


class Array(NamedTuple):
    """Numbers that are in memory, or computed where they are needed."""

    shape: tuple[int, ...]
    dtype: str
    read: Callable[[Sequence[str]], str]
    """Returns the text of the element at indices."""
    is_stored: bool = True
    """Whether an element is in memory or a constant, so that reading it twice costs nothing."""
    name: str = ""
    """Of the memory that holds the array in C order; empty for a part of one, or other elements."""


def memory(name: str, shape: Sequence[int], dtype: DTypeLike) -> Array:
    """Returns a whole array in C order."""
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]

    def read(index: Sequence[str]) -> str:
        pairs = zip(index, strides, strict=True)
        terms = [i if stride == 1 else f"{i} * {stride}" for i, stride in pairs if i != "0"]
        return f"{name}[{' + '.join(terms) or '0'}]"

    return Array(tuple(shape), str(np.dtype(dtype)), read, name=name)


class Printer:
    """Translates a program into statements."""

    def __init__(self, language: Language) -> None:
        self.language = language
        self.lines: list[str] = []
        """Statements."""
        self.buffers: list[tuple[str, str, int]] = []
        """Name, dtype and number of elements of arrays for intermediate results."""
        self.constants: dict[str, np.ndarray] = {}
        """Constant arrays by name."""
        self.known: dict[Value, Array] = {}
        self._depth = 0

    def run(self, program: TracedProgram, arguments: Sequence[str]) -> list[Array]:
        """Adds the statements of a program whose arguments have these names, and returns its outputs."""
        for value, name in zip(program.arguments, arguments, strict=True):
            self.known[value] = memory(name, value.shape, value.dtype)
        uses = Counter(argument for operation in program.operations for argument in operation.inputs)
        for operation in program.operations:
            out = operation.outputs[0]
            if operation.name in MAPS:
                move = partial(MAPS[operation.name], operation)
                self.known[out] = moved(self.view(operation.inputs[0]), out.shape, move)
            elif (text := self.expression(operation)) is not None:
                computed = self.computed(operation, text)
                self.known[out] = computed if uses[out] == 1 else self.stored(computed)
            elif operation.name in STATEMENTS:
                STATEMENTS[operation.name](self, operation)
            else:
                raise unsupported(operation, self.language.name)
        return [self.view(value) for value in program.outputs]

    def expression(self, operation: Operation) -> str | None:
        """Returns the expression of an operation on each element by itself; None for another."""
        name, is_c = operation.name, self.language.name == "C"
        source, dtype = (str(values[0].dtype) for values in (operation.inputs or operation.outputs, operation.outputs))
        if name == "convert_element_type":
            return self.language.cast(source, dtype)
        if is_c and name == "rem" and "int" in source:
            return "({0} % {1})"
        if name not in PRIMITIVES or (name == "select_n" and source != "bool"):
            return None
        if (text := PRIMITIVES[name].get("c" if is_c else "javascript")) is None:
            raise unsupported(operation, self.language.name)
        return f"Math.trunc({text})" if not is_c and name == "div" and "int" in source else text

    def computed(self, operation: Operation, text: str) -> Array:
        """Returns the result of an operation on each element by itself."""
        counts = [text.count(f"{{{i}}}") for i in range(len(operation.inputs))]
        pairs = zip(operation.inputs, counts, strict=True)
        operands = [self.view(argument) if count > 1 else self.read(argument) for argument, count in pairs]
        out = operation.outputs[0]

        def read(index: Sequence[str]) -> str:
            shapes = (zip(index, operand.shape, strict=False) for operand in operands)
            at = [[i if n != 1 else "0" for i, n in sizes] for sizes in shapes]  # or repeated
            return text.format(*(operand.read(i) for operand, i in zip(operands, at, strict=True)))

        return Array(out.shape, str(out.dtype), read, is_stored=False)

    def read(self, value: Value) -> Array:
        """Returns an array."""
        if value.data is None:
            return self.known[value]
        if value.data.size == 1:
            text = self.language.literal(value.data)
            return Array(value.shape, str(value.dtype), lambda index: text)
        key = next((name for name, array in self.constants.items() if array is value.data), None)
        if key is None:
            key = f"c{len(self.constants)}"
            self.constants[key] = value.data
        return memory(key, value.shape, value.dtype)

    def view(self, value: Value) -> Array:
        """Returns an array whose elements are in memory, or constant."""
        array = self.read(value)
        if not array.is_stored:
            array = self.known[value] = self.stored(array)
        return array

    def buffer(self, shape: Sequence[int], dtype: DTypeLike) -> Array:
        """Returns a new array."""
        name = f"v{len(self.buffers)}"
        self.buffers.append((name, str(np.dtype(dtype)), max(math.prod(shape), 1)))
        return memory(name, shape, dtype)

    def stored(self, array: Array) -> Array:
        """Returns a new array of the elements of another one."""
        out = self.buffer(array.shape, array.dtype)
        self.copy(array, out)
        return out

    def copy(self, array: Array, out: Array) -> None:
        """Adds loops that copy elements to an array of the same shape."""
        with self.block(array.shape) as index:
            self.lines.append(f"{out.read(index)} = {array.read(index)};")

    @contextmanager
    def block(self, sizes: Sequence[int]) -> Iterator[list[str]]:
        """Context of nested loops over axes of these lengths; it gives their indices."""
        index = ["0" if size == 1 else f"i{self._depth + axis}" for axis, size in enumerate(sizes)]
        pairs, index_type = zip(index, sizes, strict=True), self.language.declaration("index")
        loops = [f"for ({index_type} {i} = 0; {i} < {size}; ++{i}) {{" for i, size in pairs if i != "0"] or ["{"]
        self.lines += loops
        self._depth += len(sizes)
        yield index
        self._depth -= len(sizes)
        self.lines += "}" * len(loops)

    def declare(self, name: str, dtype: str, value: str) -> None:
        """Adds a variable."""
        self.lines.append(f"{self.language.declaration(dtype)} {name} = {value};")


def indented(lines: Sequence[str], depth: int = 1) -> str:
    """Returns statements with a tab for each block that they are in."""
    result = []
    for line in lines:
        depth -= line.startswith("}")
        result.append("\t" * depth + line)
        depth += line.endswith("{")
    return "\n".join(result)


def as_float(number: float) -> str:
    """Returns a number with as many digits as float32 needs.

    >>> as_float(2.0), as_float(1e-8)
    ('2.0', '1e-08')
    """
    text = f"{number:.9g}"
    return text if re.search(r"[.en]", text) else f"{text}.0"


def moved(array: Array, shape: tuple[int, ...], index_of: Callable[[Sequence[str]], list[str]]) -> Array:
    """Returns an array whose elements are those of another one, at other indices."""
    return array._replace(shape=shape, read=lambda index: array.read(index_of(index)), name="")


def shifted(index: str, start: int, step: int = 1) -> str:
    """Returns the index ``start + step * index``."""
    if index == "0":
        return str(start)
    index = index if step == 1 else f"({index} * {step})"
    return f"({index} + {start})" if start else index


def along(axis: int, start: int, index: Sequence[str]) -> list[str]:
    """Returns an index that is shifted along an axis."""
    return [shifted(i, start) if k == axis else i for k, i in enumerate(index)]


Map = Callable[[Operation, Sequence[str]], list[str]]


def broadcast(operation: Operation, index: Sequence[str]) -> list[str]:
    """Of an array that is repeated along axes."""
    pairs = zip(operation.params["broadcast_dimensions"], operation.inputs[0].shape, strict=True)
    return [index[axis] if size != 1 else "0" for axis, size in pairs]


def sliced(operation: Operation, index: Sequence[str]) -> list[str]:
    """Of a part of an array."""
    starts, steps = operation.params["start_indices"], operation.params["strides"] or (1,) * len(index)
    return [shifted(*shift) for shift in zip(index, starts, steps, strict=True)]


def transposed(operation: Operation, index: Sequence[str]) -> list[str]:
    """Of an array with its axes in another order."""
    return placed((operation.params["permutation"], index))


MAPS: dict[str, Map] = {"broadcast_in_dim": broadcast, "slice": sliced, "transpose": transposed}
"""Operations whose elements are those of their input, with the indices there of an element."""


def placed(*groups: tuple[Sequence[int], Sequence[str]]) -> list[str]:
    """Returns an index in the order of the axes, from groups of axes with their indices."""
    index = {axis: i for axes, names in groups for axis, i in zip(axes, names, strict=True)}
    return [index[axis] for axis in sorted(index)]


def reshape(printer: Printer, operation: Operation) -> None:
    """Gives memory another shape; copies it if it is not stored in order."""
    array, out = printer.view(operation.inputs[0]), operation.outputs[0]
    name = array.name or printer.stored(array).name
    printer.known[out] = memory(name, out.shape, array.dtype)


def concatenate(printer: Printer, operation: Operation) -> None:
    """Arrays one after the other."""
    out, axis, start = operation.outputs[0], operation.params["dimension"], 0
    whole = printer.buffer(out.shape, out.dtype)
    for value in operation.inputs:
        array = printer.read(value)
        with printer.block(array.shape) as index:
            printer.lines.append(f"{whole.read(along(axis, start, index))} = {array.read(index)};")
        start += value.shape[axis]
    printer.known[out] = whole


def reduce(printer: Printer, operation: Operation) -> None:
    """A sum, or the like, over axes."""
    axes, out, array = operation.params["axes"], operation.outputs[0], printer.view(operation.inputs[0])
    remaining_axes = [axis for axis in range(len(array.shape)) if axis not in axes]
    whole = printer.buffer(out.shape, out.dtype)
    with printer.block(out.shape) as index:
        first = array.read(placed((remaining_axes, index), (axes, ["0"] * len(axes))))
        printer.declare("sum", whole.dtype, "0" if operation.name == "reduce_sum" else first)
        with printer.block([array.shape[axis] for axis in axes]) as inner:
            element = array.read(placed((remaining_axes, index), (axes, inner)))
            printer.lines.append(f"sum = {REDUCTIONS[operation.name].format('sum', element)};")
        printer.lines.append(f"{whole.read(index)} = sum;")
    printer.known[out] = whole


def argmax(printer: Printer, operation: Operation) -> None:
    """The index of the first of the largest elements along an axis."""
    axes, out, array = operation.params["axes"], operation.outputs[0], printer.view(operation.inputs[0])
    remaining_axes = [axis for axis in range(len(array.shape)) if axis not in axes]
    whole = printer.buffer(out.shape, out.dtype)
    with printer.block(out.shape) as index:
        printer.declare("best", "index", "0")
        with printer.block([array.shape[axes[0]]]) as (i,):
            element, best = (
                array.read(placed((remaining_axes, index), (axes, [element_index]))) for element_index in (i, "best")
            )
            printer.lines.append(f"if ({element} > {best}) best = {i};")
        printer.lines.append(f"{whole.read(index)} = best;")
    printer.known[out] = whole


def product(printer: Printer, operation: Operation) -> None:
    """A product of matrices, row by row of the right one."""
    matrix, weights = (printer.view(value) for value in operation.inputs)
    out = printer.buffer(operation.outputs[0].shape, operation.outputs[0].dtype)
    *outer, shared, width = weights.shape
    with printer.block([*outer, matrix.shape[-2]]) as rows:
        with printer.block([width]) as columns:
            printer.lines.append(f"{out.read([*rows, *columns])} = 0;")
        with printer.block([shared]) as inner:
            printer.declare("x", matrix.dtype, matrix.read([*rows, *inner]))
            with printer.block([width]) as columns:
                weight = weights.read([*rows[:-1], *inner, *columns])
                printer.lines.append(f"{out.read([*rows, *columns])} += x * {weight};")
    printer.known[operation.outputs[0]] = out


STATEMENTS: dict[str, Callable[[Printer, Operation], None]] = {
    "argmax": argmax,
    "concatenate": concatenate,
    "dot_general": product,
    **dict.fromkeys(("expand_dims", "reshape", "squeeze"), reshape),
    **dict.fromkeys(REDUCTIONS, reduce),
}
"""Operations that are loops of their own."""
