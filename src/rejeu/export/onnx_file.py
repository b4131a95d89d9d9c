"""Programs as ONNX models, by the package ``onnx`` alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike

from rejeu.core.errors import requires
from rejeu.core.types import JsonObject
from rejeu.export import PRIMITIVES
from rejeu.export.check import Run, one_by_one
from rejeu.export.contract import Exportable, Policy
from rejeu.export.program import Operation, Value, unsupported

with requires("export to ONNX", "onnx", "export"):
    import onnx
    from onnx import helper, numpy_helper

OPSET, IR_VERSION = 18, 8
"""Of December 2022; ONNX Runtime reads them since version 1.14."""
TO_THE_END = np.iinfo(np.int64).max

REDUCTIONS = {"reduce_max": "ReduceMax", "reduce_min": "ReduceMin", "reduce_sum": "ReduceSum"}


class Graph:
    """The nodes and constants of a model that have been made so far."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []
        self.names: dict[Value, str] = {}
        self.narrow: dict[Value, str] = {}
        """Of broadcast arrays: the name of one with axes of length 1 in the place of repetitions."""
        self.batch = ""
        """Name of the size of the batch, ``int64 (1,)``; empty until it is needed."""
        self._constants: dict[bytes, str] = {}

    def node(self, operator: str, inputs: Sequence[str], **attributes: Any) -> str:
        """Adds a node and returns the name of its output."""
        name = f"/v{len(self.nodes)}"  # which no key of an observation is called
        self.nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def constant(self, array: ArrayLike) -> str:
        """Adds a constant and returns its name; equal ones are stored once."""
        array = np.asarray(array)
        key = repr((array.dtype, array.shape)).encode() + array.tobytes()
        if key not in self._constants:
            self._constants[key] = name = f"/c{len(self.initializers)}"
            self.initializers.append(numpy_helper.from_array(array, name))
        return self._constants[key]

    def name(self, value: Value) -> str:
        """Returns the name of an array in its full shape."""
        if value.data is not None:
            return self.constant(value.data)
        if value not in self.names:
            self.names[value] = self.node("Expand", [self.narrow[value], self.shape(value)])
        return self.names[value]

    def loose(self, value: Value) -> str:
        """Returns the name of an array that broadcasts to its shape."""
        return self.narrow.get(value) or self.name(value)

    def shape(self, value: Value) -> str:
        """Returns the name of an array's shape, ``int64 (n_axes,)``."""
        sizes = value.sizes
        if -1 not in sizes:
            return self.constant(np.array(sizes, np.int64))
        parts = [self.batch if size == -1 else self.constant(np.array([size], np.int64)) for size in sizes]
        return self.node("Concat", parts, axis=0)

    def reshape(self, name: str, sizes: Sequence[int]) -> str:
        """Returns the name of an array in another shape; -1 for the size of the batch."""
        return self.node("Reshape", [name, self.constant(np.array(sizes, np.int64))])

    def cast(self, name: str, dtype: DTypeLike) -> str:
        """Returns the name of an array in another dtype."""
        return self.node("Cast", [name], to=helper.np_dtype_to_tensor_dtype(np.dtype(dtype)))


def add(graph: Graph, operation: Operation) -> None:
    """Adds the nodes of one operation."""
    name, inputs, outputs = operation.name, operation.inputs, operation.outputs
    if name == "broadcast_in_dim":
        sizes = [1] * len(outputs[0].shape)
        for axis, size in zip(operation.params["broadcast_dimensions"], inputs[0].sizes, strict=True):
            sizes[axis] = size
        graph.narrow[outputs[0]] = graph.reshape(graph.name(inputs[0]), sizes)
    elif name in PRIMITIVES or name == "convert_element_type":
        has_shape = any(value.shape == outputs[0].shape and value not in graph.narrow for value in inputs)
        names = [graph.loose(value) if has_shape else graph.name(value) for value in inputs]
        graph.names[outputs[0]] = elementwise(graph, operation, names)
    elif name in REDUCTIONS:
        axes = graph.constant(np.array(operation.params["axes"], np.int64))
        graph.names[outputs[0]] = graph.node(REDUCTIONS[name], [graph.name(inputs[0]), axes], keepdims=0)
    elif name in STRUCTURAL:
        graph.names[outputs[0]] = STRUCTURAL[name](graph, operation, [graph.name(value) for value in inputs])
    else:
        raise unsupported(operation, "ONNX")


Make = Callable[[Graph, Operation, list[str]], str]
"""Adds the nodes of an operation whose inputs have these names, and returns the name of its output."""


def elementwise(graph: Graph, operation: Operation, names: list[str]) -> str:
    """An operation on each element by itself."""
    name, params = operation.name, operation.params
    if name == "convert_element_type":
        return graph.cast(names[0], params["new_dtype"])
    operator = PRIMITIVES[name].get("onnx")
    if name == "select_n":
        names[1:] = reversed(names[1:])
    is_other = name == "select_n" and (len(names) != 3 or operation.inputs[0].dtype != bool)
    if operator is None or is_other or (name == "round" and int(params["rounding_method"]) != 1):
        raise unsupported(operation, "ONNX")
    return graph.node(operator, names, **({"fmod": 1} if name == "rem" else {}))


def sliced(graph: Graph, operation: Operation, names: list[str]) -> str:
    """A part of an array."""
    params, shape = operation.params, operation.inputs[0].sizes
    ends = [TO_THE_END if size == -1 else end for size, end in zip(shape, params["limit_indices"], strict=True)]
    steps = params["strides"] or [1] * len(ends)
    parts = (params["start_indices"], ends, range(len(ends)), steps)
    return graph.node("Slice", [names[0], *(graph.constant(np.array([*bounds], np.int64)) for bounds in parts)])


def argmax(graph: Graph, operation: Operation, names: list[str]) -> str:
    """The index of the first of the largest elements."""
    index = graph.node("ArgMax", names, axis=operation.params["axes"][0], keepdims=0)
    return graph.cast(index, operation.params["index_dtype"])


def reshaped(graph: Graph, operation: Operation, names: list[str]) -> str:
    """An array in another shape."""
    return graph.reshape(names[0], operation.outputs[0].sizes)


STRUCTURAL: dict[str, Make] = {
    "argmax": argmax,
    "concatenate": lambda g, op, n: g.node("Concat", n, axis=op.params["dimension"]),
    "dot_general": lambda g, op, n: g.node("MatMul", n),
    "expand_dims": reshaped,
    "reshape": reshaped,
    "slice": sliced,
    "squeeze": reshaped,
    "transpose": lambda g, op, n: g.node("Transpose", n, perm=op.params["permutation"]),
}
"""Primitives that move or combine elements."""


def onnx_run(policy: Policy, content: bytes) -> Run | None:
    """Returns the run of an ONNX model; None without ONNX Runtime."""
    try:
        import onnxruntime
    except ImportError:
        return None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    names = [port.name for port in policy.outputs]
    return one_by_one(policy, lambda inputs: dict(zip(names, session.run(names, inputs), strict=True)))


def write(policy: Policy, card: JsonObject) -> bytes:
    """Returns the model of a policy, with the card in its metadata."""
    graph, program = Graph(), policy.program
    size = "batch" if policy.batch is None else policy.batch
    inputs = []
    for port, value in zip(policy.inputs, program.arguments, strict=True):
        graph.names[value] = port.name
        dtype = helper.np_dtype_to_tensor_dtype(np.dtype(port.dtype))
        inputs.append(helper.make_tensor_value_info(port.name, dtype, [size, *port.shape]))
    shape = graph.node("Shape", [policy.inputs[0].name])
    graph.batch = graph.node("Slice", [shape, *(graph.constant(np.array([i], np.int64)) for i in (0, 1))])
    for operation in program.operations:
        add(graph, operation)
    outputs = []
    for port, value in zip(policy.outputs, program.outputs, strict=True):
        dtype = helper.np_dtype_to_tensor_dtype(np.dtype(port.dtype))
        graph.nodes.append(helper.make_node("Cast", [graph.name(value)], [port.name], to=dtype))
        outputs.append(helper.make_tensor_value_info(port.name, dtype, [size, *port.shape]))
    onnx_graph = helper.make_graph(graph.nodes, "policy", inputs, outputs, graph.initializers)
    opset = [helper.make_opsetid("", OPSET)]
    model = helper.make_model(onnx_graph, opset_imports=opset, ir_version=IR_VERSION, producer_name="rejeu")
    helper.set_model_props(model, {"rejeu": json.dumps(card)})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def files(source: Exportable) -> tuple[tuple[bytes, ...], Run | None]:
    """Returns the model, and its run for one observation at a time."""
    content = write(source.policy, source.card)
    return (content,), onnx_run(source.single, content if source.is_general else write(source.single, source.card))
