"""Programs as loops over arrays of fixed sizes, in C or JavaScript."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from rejeu.export.program import Operation, Program, Value, unsupported

EXPRESSIONS = {
    "abs": "@abs({0})", "acos": "@acos({0})", "add": "({0} + {1})", "add_any": "({0} + {1})", "and": "({0} & {1})",
    "asin": "@asin({0})", "atan": "@atan({0})", "atan2": "@atan2({0}, {1})", "ceil": "@ceil({0})",
    "cos": "@cos({0})", "cosh": "@cosh({0})",
    "div": "({0} / {1})", "eq": "({0} == {1})", "erf": "@erf({0})", "exp": "@exp({0})",
    "expm1": "@expm1({0})", "floor": "@floor({0})", "ge": "({0} >= {1})", "gt": "({0} > {1})",
    "is_finite": "isfinite({0})", "le": "({0} <= {1})", "log": "@log({0})", "log1p": "@log1p({0})",
    "logistic": "(1.0f / (1.0f + @exp(-{0})))", "lt": "({0} < {1})", "max": "({0} > {1} ? {0} : {1})",
    "min": "({0} < {1} ? {0} : {1})", "mul": "({0} * {1})", "ne": "({0} != {1})", "neg": "(-{0})", "not": "(!{0})",
    "or": "({0} | {1})", "pow": "@pow({0}, {1})", "rem": "@mod({0}, {1})", "round": "@rint({0})",
    "rsqrt": "(1.0f / @sqrt({0}))", "select_n": "({0} ? {2} : {1})", "sign": "(({0} > 0) - ({0} < 0))",
    "sin": "@sin({0})", "sinh": "@sinh({0})", "sqrt": "@sqrt({0})", "sub": "({0} - {1})",
    "tan": "@tan({0})", "tanh": "@tanh({0})", "xor": "({0} ^ {1})",
}  # fmt: skip
"""Primitives of each element by itself, as expressions of C. ``@`` stands before functions of floats."""
REDUCTIONS = {
    "reduce_sum": ("0", "{0} + {1}"),
    "reduce_prod": ("1", "{0} * {1}"),
    "reduce_max": ("", "{0} > {1} ? {0} : {1}"),
    "reduce_min": ("", "{0} < {1} ? {0} : {1}"),
    "reduce_or": ("0", "{0} | {1}"),
    "reduce_and": ("1", "{0} & {1}"),
}
"""The first value, and how each element is added to it; without a first value the first element is."""


class Language(NamedTuple):
    """How code is written where C and JavaScript differ."""

    name: str
    types: dict[str, str]
    """Of the elements of arrays, by dtype."""
    variable: Callable[[str], str]
    """Returns how a variable is declared that holds an element of a dtype."""
    functions: dict[str, str]
    """Functions of floats, by the name in :data:`EXPRESSIONS`."""
    prefix: str
    """Of functions that are not in ``functions``."""
    suffix: str
    """Of functions that are not in ``functions``."""
    missing: tuple[str, ...]
    """Functions that the language does not have."""


class View(NamedTuple):
    """Elements of an array in memory: those at ``offset + sum(index * stride)``."""

    base: str
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: int
    dtype: str


class Expression(NamedTuple):
    """A number computed from the elements of other arrays, where it is needed."""

    text: str
    operands: tuple[Any, ...]
    shape: tuple[int, ...]
    dtype: str


def contiguous(base: str, shape: Sequence[int], dtype: Any) -> View:
    """Returns a whole array in C order."""
    strides = [math.prod(shape[axis + 1 :]) for axis in range(len(shape))]
    return View(base, tuple(shape), tuple(strides), 0, str(np.dtype(dtype)))


class Printer:
    """Translates a program into statements."""

    def __init__(self, language: Language, prefix: str = "v") -> None:
        self.language, self.prefix = language, prefix
        self.lines: list[str] = []
        """Statements."""
        self.buffers: list[tuple[str, str, int]] = []
        """Name, dtype and number of elements of arrays for intermediate results."""
        self.constants: dict[str, np.ndarray] = {}
        """Constant arrays by name."""
        self.known: dict[Value, View | Expression] = {}
        self._depth = 0

    def run(self, program: Program, arguments: Sequence[str]) -> list[View]:
        """Adds the statements of a program whose arguments have these names, and returns its outputs."""
        for value, name in zip(program.arguments, arguments, strict=True):
            self.known[value] = contiguous(name, value.shape, value.dtype)
        uses = Counter(one for operation in program.operations for one in operation.inputs)
        for operation in program.operations:
            if operation.name in VIEWS:
                found = self.read(operation.inputs[0])
                is_number = isinstance(found, Expression) and not found.operands
                moved = found._replace(shape=operation.outputs[0].shape) if is_number else None
                self.known[operation.outputs[0]] = moved or VIEWS[operation.name](
                    self.view(operation.inputs[0]), operation
                )
            elif (made := self.expression(operation)) is not None:
                is_used_once = uses[operation.outputs[0]] == 1
                self.known[operation.outputs[0]] = made if is_used_once else self.stored(made)
            elif operation.name in STATEMENTS:
                STATEMENTS[operation.name](self, operation)
            else:
                raise unsupported(operation, self.language.name)
        return [self.view(value) for value in program.outputs]

    def expression(self, operation: Operation) -> Expression | None:
        """Returns an operation on each element by itself; None for another."""
        name, out = operation.name, operation.outputs[0]
        dtype, source = str(out.dtype), str(operation.inputs[0].dtype) if operation.inputs else ""
        text = EXPRESSIONS.get(name)
        is_whole = source.startswith(("int", "uint"))
        if name == "integer_pow":
            y = operation.params["y"]
            text = "({0} * {0})" if y == 2 else "(1.0f / {0})" if y == -1 else f"@pow({{0}}, {y}.0f)"
        elif name == "convert_element_type":
            text = "({0} != 0)" if dtype == "bool" else self.cast(source, dtype)
        elif is_whole and name in ("abs", "rem"):
            text = "({0} < 0 ? -{0} : {0})" if name == "abs" else "({0} % {1})"
        elif is_whole and name == "div":
            text = self.cast("float32", dtype).format("({0} / {1})")
        if text is None or (name == "select_n" and source != "bool"):
            return None
        if any(f"@{one}(" in text for one in self.language.missing):
            raise unsupported(operation, self.language.name)
        operands = [self.read(one) for one in operation.inputs]
        for i, one in enumerate(operands):
            is_number = isinstance(one, Expression) and not one.operands
            if is_number or not one.shape:
                continue
            if isinstance(one, Expression) and (text.count(f"{{{i}}}") > 1 or one.shape != out.shape):
                one = self.stored(one)
            if isinstance(one, View):  # axes of length 1 are repeated
                strides = tuple(s if size != 1 else 0 for s, size in zip(one.strides, one.shape, strict=True))
                one = one._replace(shape=out.shape, strides=strides)
            operands[i] = one
        return Expression(self.written(text), tuple(operands), out.shape, dtype)

    def written(self, text: str) -> str:
        """Returns an expression of C in the language."""
        language = self.language
        if language.name != "C":
            text = re.sub(r"(\d)f\b", r"\1", text).replace("isfinite(", "Number.isFinite(")
        name = lambda match: language.functions.get(match[1], language.prefix + match[1] + language.suffix)  # noqa: E731
        return re.sub(r"@(\w+)", name, text)

    def cast(self, source: str, dtype: str) -> str:
        """Returns the expression of a conversion from one dtype to another."""
        if self.language.name == "C":
            return f"(({self.language.types[dtype]}){{0}})"
        return "Math.trunc({0})" if source.startswith("float") and not dtype.startswith("float") else "(+{0})"

    def read(self, value: Value) -> View | Expression:
        """Returns an array, or a number that is constant, as what an expression reads."""
        if value.data is None:
            return self.known[value]
        if value.data.size == 1:
            return Expression(self.literal(value.data), (), value.shape, str(value.dtype))
        key = next((name for name, array in self.constants.items() if array is value.data), None)
        if key is None:
            key = f"{self.prefix}c{len(self.constants)}"
            self.constants[key] = value.data
        return contiguous(key, value.shape, value.dtype)

    def literal(self, number: np.ndarray) -> str:
        """Returns a number as the language writes it."""
        one = number.reshape(()).item()
        if not math.isfinite(one):
            names = ("NAN", "INFINITY") if self.language.name == "C" else ("NaN", "Infinity")
            return names[0] if math.isnan(one) else f"({'-' * (one < 0)}{names[1]})"
        is_float = number.dtype.kind == "f" and self.language.name == "C"
        text = as_float(one) + "f" if is_float else repr(int(one) if number.dtype.kind != "f" else one)
        return f"({text})" if text.startswith("-") else text

    def view(self, value: Value) -> View:
        """Returns an array in memory."""
        found = self.read(value)
        if value in self.known and isinstance(found, Expression):
            found = self.known[value] = self.stored(found)
        return self.stored(found) if isinstance(found, Expression) else found

    def buffer(self, shape: Sequence[int], dtype: Any) -> View:
        """Returns a new array."""
        name = f"{self.prefix}{len(self.buffers)}"
        self.buffers.append((name, str(np.dtype(dtype)), max(math.prod(shape), 1)))
        return contiguous(name, shape, dtype)

    def stored(self, found: View | Expression) -> View:
        """Returns a new array of the elements of another one."""
        out = self.buffer(found.shape, found.dtype)
        self.copy(found, out)
        return out

    def copy(self, found: View | Expression, out: View) -> None:
        """Adds loops that copy elements to an array of the same shape."""
        sizes, (found, out) = merged_axes(out.shape, [found, out])
        with self.block(sizes) as index:
            self.lines.append(f"{self.element(out, index)} = {self.element(found, index)};")

    @contextmanager
    def block(self, sizes: Sequence[int]) -> Iterator[list[str]]:
        """Context of nested loops over axes of these lengths; it gives their indices."""
        index = ["0" if size == 1 else f"i{self._depth + axis}" for axis, size in enumerate(sizes)]
        kind = self.language.variable("index").removeprefix("const ")
        loops = [
            f"for ({kind} {name} = 0; {name} < {size}; ++{name}) {{"
            for name, size in zip(index, sizes, strict=True)
            if name != "0"
        ] or ["{"]
        self.lines += loops
        self._depth += len(sizes)
        yield index
        self._depth -= len(sizes)
        self.lines += "}" * len(loops)

    def whole_part(self, quotient: str) -> str:
        """Returns the whole part of a quotient of integers."""
        return f"({quotient})" if self.language.name == "C" else f"Math.trunc({quotient})"

    def element(self, found: View | Expression, index: Sequence[str]) -> str:
        """Returns the text of an element."""
        index = index if found.shape else []
        if isinstance(found, Expression):
            return found.text.format(*(self.element(one, index) for one in found.operands))
        terms = [str(found.offset)] if found.offset else []
        terms += [i if s == 1 else f"{i} * {s}" for i, s in zip(index, found.strides, strict=True) if s and i != "0"]
        return f"{found.base}[{' + '.join(terms).replace('+ -', '- ') or '0'}]"


def merged_axes(shape: Sequence[int], arrays: Sequence[View | Expression]) -> tuple[list[int], list[Any]]:
    """Returns a shape and arrays with fewer axes: axes that all of them store one after the other become one."""
    sizes, arrays = [*shape], [*arrays]

    def without(found: View | Expression, axis: int) -> View | Expression:
        if not found.shape:
            return found
        if isinstance(found, Expression):
            operands = tuple(without(one, axis) for one in found.operands)
            return found._replace(operands=operands, shape=tuple(sizes))
        return found._replace(strides=found.strides[:axis] + found.strides[axis + 1 :], shape=tuple(sizes))

    for axis in reversed(range(len(sizes))):
        views = [view for one in arrays for view in views_in(one) if view.shape]
        after = sizes[axis + 1] if axis + 1 < len(sizes) else 0
        if after and all(view.strides[axis] == view.strides[axis + 1] * after for view in views):
            sizes[axis + 1] *= sizes[axis]
        elif sizes[axis] != 1:
            continue
        del sizes[axis]
        arrays = [without(one, axis) for one in arrays]
    return sizes, arrays


def indented(lines: Sequence[str], depth: int = 1) -> str:
    """Returns statements with a tab for each block that they are in."""
    result = []
    for line in lines:
        depth -= line.startswith("}")
        result.append("\t" * depth + line)
        depth += line.endswith("{")
    return "\n".join(result)


def views_in(found: View | Expression) -> list[View]:
    """Returns the arrays that an element is computed from."""
    return [found] if isinstance(found, View) else [view for one in found.operands for view in views_in(one)]


def as_float(number: float) -> str:
    """Returns a number with as many digits as float32 needs.

    >>> as_float(2.0), as_float(1e-8)
    ('2.0', '1e-08')
    """
    text = f"{number:.9g}"
    return text if re.search(r"[.en]", text) else f"{text}.0"


def broadcast(view: View, operation: Operation) -> View:
    """Repeated along axes."""
    shape = operation.outputs[0].shape
    strides = [0] * len(shape)
    for axis, size, stride in zip(operation.params["broadcast_dimensions"], view.shape, view.strides, strict=True):
        strides[axis] = stride if size != 1 else 0
    return view._replace(shape=shape, strides=tuple(strides))


def part(view: View, operation: Operation) -> View:
    """From start to limit."""
    starts, steps = operation.params["start_indices"], operation.params["strides"] or (1,) * len(view.shape)
    offset = view.offset + sum(start * stride for start, stride in zip(starts, view.strides, strict=True))
    strides = tuple(step * stride for step, stride in zip(steps, view.strides, strict=True))
    return View(view.base, operation.outputs[0].shape, strides, offset, view.dtype)


def transposed(view: View, operation: Operation) -> View:
    """With its axes in another order."""
    order = operation.params["permutation"]
    return view._replace(shape=tuple(view.shape[i] for i in order), strides=tuple(view.strides[i] for i in order))


def backwards(view: View, operation: Operation) -> View:
    """With the last element first."""
    axes = operation.params["dimensions"]
    last = sum((view.shape[axis] - 1) * view.strides[axis] for axis in axes)
    strides = tuple(-s if axis in axes else s for axis, s in enumerate(view.strides))
    return view._replace(strides=strides, offset=view.offset + last)


VIEWS: dict[str, Callable[[View, Operation], View]] = {
    "broadcast_in_dim": broadcast,
    "rev": backwards,
    "slice": part,
    "transpose": transposed,
}
"""Operations whose result is the same memory, read otherwise."""


def reshape(printer: Printer, operation: Operation) -> None:
    """The same memory in another shape; a copy if it is not stored in order."""
    view, out = printer.view(operation.inputs[0]), operation.outputs[0]
    straight = contiguous(view.base, view.shape, view.dtype)
    pairs = zip(view.shape, view.strides, straight.strides, strict=True)
    if not all(size == 1 or own == other for size, own, other in pairs):
        view = printer.stored(view)
    printer.known[out] = contiguous(view.base, out.shape, view.dtype)._replace(offset=view.offset)


def split(printer: Printer, operation: Operation) -> None:
    """Parts along an axis."""
    view, axis = printer.view(operation.inputs[0]), operation.params["axis"]
    offset = view.offset
    for out in operation.outputs:
        printer.known[out] = view._replace(shape=out.shape, offset=offset)
        offset += out.shape[axis] * view.strides[axis]


def concatenate(printer: Printer, operation: Operation) -> None:
    """Arrays one after the other."""
    out, axis, start = operation.outputs[0], operation.params["dimension"], 0
    whole = printer.buffer(out.shape, out.dtype)
    for one in operation.inputs:
        place = whole._replace(shape=one.shape, offset=start * whole.strides[axis])
        printer.copy(printer.read(one), place)
        start += one.shape[axis]
    printer.known[out] = whole


def pad(printer: Printer, operation: Operation) -> None:
    """A border, and gaps between elements."""
    config, out = operation.params["padding_config"], operation.outputs[0]
    if any(low < 0 or high < 0 for low, high, _ in config):
        raise unsupported(operation, printer.language.name, " that cuts elements off")
    whole = printer.buffer(out.shape, out.dtype)
    filling = printer.view(operation.inputs[1])
    printer.copy(filling._replace(shape=whole.shape, strides=(0,) * len(whole.shape)), whole)
    offset = sum(low * stride for (low, _, _), stride in zip(config, whole.strides, strict=True))
    strides = tuple((gap + 1) * stride for (_, _, gap), stride in zip(config, whole.strides, strict=True))
    printer.copy(printer.read(operation.inputs[0]), View(whole.base, operation.inputs[0].shape, strides, offset, ""))
    printer.known[out] = whole


def reordered(view: View, axes: Sequence[int]) -> View:
    """Returns an array with these of its axes, in this order."""
    return view._replace(shape=tuple(view.shape[i] for i in axes), strides=tuple(view.strides[i] for i in axes))


def reduce(printer: Printer, operation: Operation) -> None:
    """A sum, or the like, over axes."""
    axes, out, found = operation.params["axes"], operation.outputs[0], printer.view(operation.inputs[0])
    first, text = REDUCTIONS[operation.name]
    kept = [axis for axis in range(len(found.shape)) if axis not in axes]
    whole, found = printer.buffer(out.shape, out.dtype), reordered(found, [*kept, *axes])
    with printer.block(out.shape) as index:
        start = printer.element(found, [*index, *("0" for _ in axes)])
        printer.lines.append(f"{printer.language.variable(whole.dtype)} sum = {first or start};")
        with printer.block(found.shape[len(kept) :]) as inner:
            element = printer.element(found, [*index, *inner])
            printer.lines.append(f"sum = {text.format('sum', element)};")
        printer.lines.append(f"{printer.element(whole, index)} = sum;")
    printer.known[out] = whole


def position(comparison: str) -> Callable[[Printer, Operation], None]:
    """The index of the first of the largest or smallest elements along an axis."""

    def add(printer: Printer, operation: Operation) -> None:
        (axis,), out, found = operation.params["axes"], operation.outputs[0], printer.view(operation.inputs[0])
        kept = [one for one in range(len(found.shape)) if one != axis]
        whole, found = printer.buffer(out.shape, out.dtype), reordered(found, [*kept, axis])
        with printer.block(out.shape) as index:
            printer.lines.append(f"{printer.language.variable('index')} best = 0;")
            with printer.block(found.shape[-1:]) as inner:
                element, best = (printer.element(found, [*index, one]) for one in (*inner, "best"))
                printer.lines.append(f"if ({element} {comparison} {best}) best = {inner[0]};")
            printer.lines.append(f"{printer.element(whole, index)} = best;")
        printer.known[out] = whole

    return add


def product(printer: Printer, operation: Operation) -> None:
    """A product of matrices, row by row of the right one."""
    (left_axes, right_axes), (left_batch, right_batch) = operation.params["dimension_numbers"]
    left, right = (printer.view(one) for one in operation.inputs)
    left_free = [axis for axis in range(len(left.shape)) if axis not in (*left_axes, *left_batch)]
    right_free = [axis for axis in range(len(right.shape)) if axis not in (*right_axes, *right_batch)]
    left = reordered(left, [*left_batch, *left_free, *left_axes])
    right = reordered(right, [*right_batch, *right_axes, *right_free])
    n_batch, n_rows, n_inner = len(left_batch), len(left_free), len(left_axes)
    out = printer.buffer(operation.outputs[0].shape, operation.outputs[0].dtype)
    with printer.block(left.shape[: n_batch + n_rows]) as rows:
        with printer.block(right.shape[n_batch + n_inner :]) as columns:
            printer.lines.append(f"{printer.element(out, [*rows, *columns])} = 0;")
        with printer.block(left.shape[n_batch + n_rows :]) as inner:
            printer.lines.append(
                f"{printer.language.variable(left.dtype)} x = {printer.element(left, [*rows, *inner])};"
            )
            with printer.block(right.shape[n_batch + n_inner :]) as columns:
                weight = printer.element(right, [*rows[:n_batch], *inner, *columns])
                printer.lines.append(f"{printer.element(out, [*rows, *columns])} += x * {weight};")
    printer.known[operation.outputs[0]] = out


def convolution(printer: Printer, operation: Operation) -> None:
    """A convolution."""
    params, (left_axes, right_axes, out_axes) = operation.params, operation.params["dimension_numbers"]
    if params["batch_group_count"] != 1 or any(size != 1 for size in params["lhs_dilation"]):
        raise unsupported(operation, printer.language.name, " if it is transposed")
    left, right = (printer.view(one) for one in operation.inputs)
    left, right = reordered(left, left_axes), reordered(right, right_axes)
    whole = printer.buffer(operation.outputs[0].shape, operation.outputs[0].dtype)
    out, kind = reordered(whole, out_axes), printer.language.variable(whole.dtype)
    groups, size = params["feature_group_count"], right.shape[1]
    with printer.block(out.shape) as (n, feature, *places):
        printer.lines.append(f"{kind} sum = 0;")
        with printer.block(right.shape[1:]) as (channel, *taps):
            at = [
                f"{place} * {step} + {tap} * {gap} - {before}"
                for place, tap, step, gap, (before, _) in zip(
                    places, taps, params["window_strides"], params["rhs_dilation"], params["padding"], strict=True
                )
            ]
            inside = [f"{one} >= 0 && {one} < {side}" for one, side in zip(at, left.shape[2:], strict=True)]
            group = f"({printer.whole_part(f'{feature} / {out.shape[1] // groups}')} * {size} + {channel})"
            element = printer.element(left, [n, group, *(f"({one})" for one in at)])
            weight = printer.element(right, [feature, channel, *taps])
            printer.lines.append(f"if ({' && '.join(inside)}) sum += {element} * {weight};")
        printer.lines.append(f"{printer.element(out, [n, feature, *places])} = sum;")
    printer.known[operation.outputs[0]] = whole


STATEMENTS: dict[str, Callable[[Printer, Operation], None]] = {
    "argmax": position(">"),
    "argmin": position("<"),
    "concatenate": concatenate,
    "conv_general_dilated": convolution,
    "dot_general": product,
    "expand_dims": reshape,
    "pad": pad,
    "reshape": reshape,
    "split": split,
    "squeeze": reshape,
    **dict.fromkeys(REDUCTIONS, reduce),
}
"""Operations that are loops of their own."""
