"""A traced function as a list of operations on arrays, which the writers of each format translate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from numpy.typing import DTypeLike

from rejeu.core.types import AnyArray

LARGEST_FOLD = 4096
"""Elements up to which a constant may be larger than the constants it is computed from, as by broadcasting."""
INLINED = ("jaxpr", "call_jaxpr", "fun_jaxpr")
"""Parameters of primitives that call a function."""
IDENTITIES = ("copy", "copy_p", "optimization_barrier", "reduce_precision", "stop_gradient")
DRAWS = {"_normal": "normal", "_uniform": "uniform", "_randint": "uniform"}
"""JAX's functions that draw, by name, and the distribution of the input that replaces them."""


def power(params: Any, x: Any) -> Any:
    """A power with a whole exponent, as products."""
    y, unit = params["y"], x.dtype.type(1)
    result = math.prod([x] * (abs(y) - 1), start=x) if y else jnp.ones_like(x)
    return unit / result if y < 0 else result


def padded(params: Any, x: Any, value: Any) -> Any:
    """An array with a border, as a concatenation."""
    for axis, (low, high, _) in enumerate(params["padding_config"]):
        border = lambda n, axis=axis: jnp.broadcast_to(value, [*x.shape[:axis], n, *x.shape[axis + 1 :]])  # noqa: B023, E731
        parts = (border(low) if low else None, x, border(high) if high else None)
        x = jnp.concatenate([piece for piece in parts if piece is not None], axis)
    return x


def convolution(params: Any, x: Any, kernel: Any) -> Any:
    """A convolution, as the product of a matrix of patches."""
    lhs, rhs, out = params["dimension_numbers"]
    x = x.transpose(lhs[0], *lhs[2:], lhs[1])
    x = jnp.pad(x, [(0, 0), *params["padding"], (0, 0)])
    kernel = kernel.transpose(*rhs[2:], rhs[1], rhs[0])
    steps, gaps = params["window_strides"], params["rhs_dilation"]
    patches = []
    for tap in np.ndindex(*kernel.shape[:-2]):
        patch = x
        for axis, (i, n, step, gap) in enumerate(zip(tap, kernel.shape, steps, gaps, strict=False), 1):
            patch = jax.lax.slice_in_dim(patch, i * gap, x.shape[axis] - (n - 1 - i) * gap, step, axis)
        patches.append(patch)
    result = jnp.concatenate(patches, -1) @ kernel.reshape(-1, kernel.shape[-1])
    return result.transpose(np.argsort([out[0], *out[2:], out[1]]))


def product(params: Any, x: Any, y: Any) -> Any:
    """A product along any axes, as one of matrices."""
    (lhs_axes, rhs_axes), (left_batch, rhs_batch) = params["dimension_numbers"]
    n, n_shared = len(left_batch), len(lhs_axes)
    free = [i for i in range(x.ndim) if i not in (*left_batch, *lhs_axes)]
    x = x.transpose(*left_batch, *free, *lhs_axes)
    y = y.transpose(*rhs_batch, *rhs_axes, *(i for i in range(y.ndim) if i not in (*rhs_batch, *rhs_axes)))
    shape, rows, columns = x.shape[:n], x.shape[n : n + len(free)], y.shape[n + n_shared :]
    shared = math.prod(y.shape[n : n + n_shared])
    x, y = x.reshape(*shape, math.prod(rows), shared), y.reshape(*shape, shared, math.prod(columns))
    result = jax.lax.dot_general(x, y, of_matrices(n), params["precision"], params["preferred_element_type"])
    return result.reshape(*shape, *rows, *columns)


def of_matrices(n: int) -> Any:
    """Returns the axes of a product of matrices ``(..., rows, shared)`` and ``(..., shared, columns)``, after ``n`` others."""
    return ((n + 1,), (n,)), (tuple(range(n)), tuple(range(n)))


def parts(params: Any, x: Any) -> list[Any]:
    """Parts along an axis, as slices."""
    ends, axis = [*accumulate(params["sizes"], initial=0)], params["axis"]
    return [jax.lax.slice_in_dim(x, begin, end, axis=axis) for begin, end in pairwise(ends)]


REWRITTEN: dict[str, Callable[..., Any]] = {
    "argmin": lambda params, x: jax.lax.argmax(-x, params["axes"][0], params["index_dtype"]),
    "clamp": lambda _, low, x, high: jnp.minimum(jnp.maximum(x, low), high),
    "conv_general_dilated": convolution,
    "dot_general": product,
    "exp2": lambda _, x: jnp.power(x.dtype.type(2), x),
    "expm1": lambda _, x: jnp.exp(x) - x.dtype.type(1),
    "integer_pow": power,
    "log1p": lambda _, x: jnp.log(x + x.dtype.type(1)),
    "ne": lambda _, x, y: jnp.logical_not(x == y),
    "pad": padded,
    "reduce_and": lambda params, x: jnp.min(x.astype(jnp.int32), params["axes"]) > np.int32(0),
    "reduce_or": lambda params, x: jnp.max(x.astype(jnp.int32), params["axes"]) > np.int32(0),
    "rsqrt": lambda _, x: x.dtype.type(1) / jnp.sqrt(x),
    "split": parts,
    "square": lambda _, x: x * x,
    "stack": lambda params, *parts: jnp.concatenate(
        [jnp.expand_dims(array, params["axis"]) for array in parts], params["axis"]
    ),
}
"""Primitives that are written with others, so that no format needs them."""


def is_rewritten(name: str, params: Any, inputs: Sequence[Value]) -> bool:
    """Returns whether a primitive is written with others; transposed or grouped convolutions and gaps are not."""
    if name == "dot_general":
        n = len(params["dimension_numbers"][1][0])
        return params["dimension_numbers"] != of_matrices(n) or {len(array.shape) for array in inputs} != {n + 2}
    if name == "conv_general_dilated":
        return params["feature_group_count"] * params["batch_group_count"] * max(params["lhs_dilation"]) == 1
    if name == "pad":
        return all(low >= 0 and high >= 0 and not gap for low, high, gap in params["padding_config"])
    return name in REWRITTEN


class Value:
    """An array: its shape, in which the free size of the batch is symbolic, its dtype, and its numbers if constant."""

    def __init__(self, shape: Sequence[int], dtype: DTypeLike, data: np.ndarray | None = None) -> None:
        self.shape, self.dtype, self.data = tuple(shape), np.dtype(dtype), data

    @property
    def sizes(self) -> tuple[int, ...]:
        """The shape, with -1 for the free size of the batch."""
        return tuple(size if isinstance(size, int) else -1 for size in self.shape)


class Operation(NamedTuple):
    """One primitive of JAX."""

    primitive: Any
    inputs: tuple[Value, ...]
    outputs: tuple[Value, ...]
    params: dict[str, Any]
    where: str
    """The line that asked for it, outside of JAX; empty if unknown."""

    @property
    def name(self) -> str:
        """Name of the primitive."""
        return self.primitive.name


class TracedProgram(NamedTuple):
    """A function of arrays as operations in the order of their execution."""

    inputs: tuple[Value, ...]
    draws: tuple[tuple[str, Value], ...]
    """Inputs that replace what the function drew, with their distributions: ``normal``, or ``uniform`` in [0, 1)."""
    operations: tuple[Operation, ...]
    outputs: tuple[Value, ...]

    def __call__(self, *arrays: AnyArray) -> list[Any]:
        """Returns the outputs for inputs and draws, computed by JAX; it may be compiled."""
        values: dict[Value, Any] = dict(zip(self.arguments, arrays, strict=True))
        for operation in self.operations:
            inputs = [values[value] if value.data is None else jnp.asarray(value.data) for value in operation.inputs]
            results = operation.primitive.bind(*inputs, **operation.params)
            outputs = results if operation.primitive.multiple_results else [results]
            values |= zip(operation.outputs, outputs, strict=True)
        return [values[value] if value.data is None else jnp.asarray(value.data) for value in self.outputs]

    @property
    def arguments(self) -> tuple[Value, ...]:
        """Inputs, then draws."""
        return (*self.inputs, *(value for _, value in self.draws))

    def ending_in(self, outputs: Sequence[Value]) -> TracedProgram:
        """Returns the program of other outputs, without the operations that these do not need."""
        needed, operations = {*outputs}, []
        for operation in reversed(self.operations):
            if not needed.isdisjoint(operation.outputs):
                needed |= {*operation.inputs}
                operations.append(operation)
        draws = tuple((draw_name, value) for draw_name, value in self.draws if value in needed)
        return TracedProgram(self.inputs, draws, tuple(reversed(operations)), tuple(outputs))


def unsupported(operation: Operation, target: str, detail: str = "") -> ValueError:
    """Returns the error for an operation that has no translation."""
    where = f" ({operation.where})" if operation.where else ""
    return ValueError(
        f"the policy cannot be exported to {target}: JAX's primitive {operation.name!r}{where} has no translation there"
        f"{detail}; write that part with other operations, or export to stablehlo, which holds all of them"
    )


def trace(function: Callable[..., Any], *examples: object, draws: bool = False) -> TracedProgram:
    """Returns a function of arrays as a program.

    Args:
        function: of arrays, which returns a pytree of arrays.
        examples: pytrees of the shapes and dtypes of its arguments.
        draws: whether the last argument is a PRNG key, ``uint32 (..., 2)``, which is no input of the program.

    Raises:
        ValueError: if it draws random numbers in another way than by ``jax.random.normal``, ``uniform``, ``gumbel``,
            ``categorical`` and the like.
    """
    closed = jax.make_jaxpr(function)(*examples)
    tracing = _Tracing()
    leaves = [Value(variable.aval.shape, variable.aval.dtype) for variable in closed.jaxpr.invars]
    constants = [Value(np.shape(variable), variable.dtype, np.asarray(variable)) for variable in closed.consts]
    outputs = tracing.inline(closed.jaxpr, [*constants, *leaves])
    inputs = tuple(leaves[:-1] if draws else leaves)
    program = TracedProgram(inputs, tuple(tracing.draws), tuple(tracing.operations), ()).ending_in(outputs)
    for operation in program.operations:
        if not {*operation.inputs}.isdisjoint({*leaves} - {*inputs}):
            raise unsupported(operation, "a file", ": it draws random numbers that cannot be an input")
    return program


class _Tracing:
    """The operations of a function that have been found so far."""

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.draws: list[tuple[str, Value]] = []
        self.where = ""
        """The line that called the function whose operations are added."""

    def inline(self, jaxpr: Any, arguments: Sequence[Value]) -> list[Value]:
        """Adds the operations of a jaxpr with these constants and arguments, and returns its outputs."""
        values: dict[Any, Value] = dict(zip([*jaxpr.constvars, *jaxpr.invars], arguments, strict=True))

        def read(atom: object) -> Value:
            return _constant(atom) if isinstance(atom, core.Literal) else values[atom]

        for equation in jaxpr.eqns:
            outputs = self.add(equation, [read(atom) for atom in equation.invars])
            values |= zip(equation.outvars, outputs, strict=True)
        return [read(atom) for atom in jaxpr.outvars]

    def add(self, equation: Any, inputs: Sequence[Value]) -> Sequence[Value]:
        """Adds an operation and returns its outputs."""
        name, params = equation.primitive.name, equation.params
        if name in IDENTITIES or (name == "convert_element_type" and inputs[0].dtype == params["new_dtype"]):
            return inputs
        if params.get("name") in DRAWS and "jaxpr" in params:
            return self.draw(DRAWS[params["name"]], equation.outvars[0].aval, inputs[1:])
        inner = next((params[key] for key in INLINED if key in params), None)
        if is_rewritten(name, params, inputs):
            examples = [jax.ShapeDtypeStruct(value.shape, value.dtype) for value in inputs]
            inner = jax.make_jaxpr(partial(REWRITTEN[name], params))(*examples)
        before, where = self.where, _line(equation.source_info) or self.where
        if inner is not None and name not in ("scan", "while", "cond"):
            consts = getattr(inner, "consts", ())
            constants = [Value(np.shape(value), value.dtype, np.asarray(value)) for value in consts]
            self.where = where
            outputs_of_inner = self.inline(getattr(inner, "jaxpr", inner), [*constants, *inputs])
            self.where = before
            return outputs_of_inner
        avals = [value.aval for value in equation.outvars]
        sizes = [aval.size for aval in avals]
        is_static = all(isinstance(size, int) for size in sizes) and not any("random" in str(a.dtype) for a in avals)
        if is_static and all(value.data is not None for value in inputs):
            largest = max([LARGEST_FOLD, *(value.data.size for value in inputs)])  # type: ignore[union-attr]
            if all(size <= largest for size in sizes) and not str(name).startswith("random"):
                outputs_of_inner = equation.primitive.bind(*[jnp.asarray(value.data) for value in inputs], **params)
                arrays = outputs_of_inner if equation.primitive.multiple_results else [outputs_of_inner]
                return [Value(array.shape, array.dtype, np.asarray(array)) for array in arrays]
        outputs = tuple(Value(aval.shape, _dtype(aval)) for aval in avals)
        self.operations.append(Operation(equation.primitive, tuple(inputs), outputs, params, where))
        return outputs

    def draw(self, draw_name: str, aval: Any, bounds: Sequence[Value]) -> Sequence[Value]:
        """Returns an input in the place of numbers that are drawn; uniform ones are scaled to their bounds."""
        drawn = Value([size for i, size in enumerate(aval.shape) if i == 0 or size != 1], np.float32)
        self.draws.append((draw_name, drawn))

        def scaled(u: Any, *bounds: Any) -> Any:
            u = u.reshape(aval.shape)
            if draw_name == "normal":
                return u
            low, high = (jnp.broadcast_to(value, aval.shape).astype(jnp.float32) for value in bounds)
            number = low + u * (high - low)
            return number if aval.dtype == number.dtype else jnp.floor(number).astype(aval.dtype)

        bounds = bounds if draw_name == "uniform" else ()
        examples = [jax.ShapeDtypeStruct(value.shape, value.dtype) for value in (drawn, *bounds)]
        return self.inline(jax.make_jaxpr(scaled)(*examples).jaxpr, [drawn, *bounds])


def _constant(literal: Any) -> Value:
    array = np.asarray(literal.val, literal.aval.dtype)
    return Value(array.shape, array.dtype, array)


def _dtype(aval: Any) -> Any:
    """Returns the dtype of an array; that of its bits for a PRNG key."""
    return np.uint32 if jax.dtypes.issubdtype(aval.dtype, jax.dtypes.prng_key) else aval.dtype


def _line(source_info: Any) -> str:
    """Returns the innermost line outside of installed packages and rejeu that made an operation."""
    package = Path(__file__).resolve().parents[1]
    for frame in getattr(source_info.traceback, "frames", ()):
        path = Path(frame.file_name)
        if "site-packages" not in path.parts and package not in path.parents and path.is_file():
            return f"{path.name}, line {frame.line_num}, in {frame.function_name}"
    return ""
