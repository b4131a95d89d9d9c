"""Programs as arrays of NumPy's ``.npz``, for :func:`rejeu.load_policy`: constants, and the operations in JSON."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from jax.export import is_symbolic_dim

from rejeu.core import spaces
from rejeu.core.types import JsonObject
from rejeu.export.check import Run, one_by_one
from rejeu.export.contract import Exportable
from rejeu.export.numpy_policy import FUNCTIONS, POLICY, parse
from rejeu.export.program import Operation, TracedProgram, unsupported


def described(program: TracedProgram) -> tuple[JsonObject, list[np.ndarray]]:
    """Returns a program in JSON values, and its constants, which have the first numbers.

    Raises:
        ValueError: if NumPy has no function for one of its operations.
    """
    values = [*program.arguments, *(value for step in program.operations for value in (*step.inputs, *step.outputs))]
    constants = [*dict.fromkeys(value for value in (*values, *program.outputs) if value.data is not None)]
    numbers = {value: i for i, value in enumerate(dict.fromkeys([*constants, *values]))}

    def listed(values: Any) -> list[int]:
        return [numbers[value] for value in values]

    operations = program.operations
    steps = [[name_of(value), listed(value.inputs), listed(value.outputs), parameters(value)] for value in operations]
    description = {"inputs": listed(program.arguments), "operations": steps, "outputs": listed(program.outputs)}
    return description, [value.data for value in constants if value.data is not None]


def name_of(operation: Operation) -> str:
    """Returns the name of an operation in a file."""
    return "matmul" if operation.name == "dot_general" else operation.name


def parameters(operation: Operation) -> JsonObject:
    """Returns the parameters of an operation that are JSON values, with -1 for the free size of the batch."""
    rounding = operation.params.get("rounding_method", 1)
    if name_of(operation) not in FUNCTIONS or int(rounding) != 1:
        raise unsupported(operation, "npz")
    return {key: value for key, param in operation.params.items() if (value := plain(param)) is not None}


def plain(param: Any) -> Any:
    """Returns a parameter as JSON values; None for others."""
    if isinstance(param, tuple | list):
        return [plain(item) for item in param]
    if isinstance(param, np.dtype | type):
        return np.dtype(param).name
    if is_symbolic_dim(param):
        return -1
    return int(param) if isinstance(param, int | np.integer) else None


def content_of(source: Exportable) -> tuple[JsonObject, list[np.ndarray]]:
    """Returns the content of a file: JSON values and constants."""
    program, constants = described(source.policy.program)
    observations, actions = map(spaces.describe, (source.observation_space, source.action_space))
    content = {"card": source.card, "observation_space": observations, "action_space": actions, "program": program}
    return content, constants


def files(source: Exportable) -> tuple[tuple[bytes, ...], Run]:
    """Returns the file, and its run for one observation at a time."""
    content, constants = content_of(source)
    text = np.frombuffer(json.dumps(content, allow_nan=False).encode(), np.uint8)
    file, ports = io.BytesIO(), source.policy.inputs
    np.savez(file, **{POLICY: text}, **{f"c{i}": constant for i, constant in enumerate(constants)})  # type: ignore[arg-type]
    policy = parse(file.getvalue())
    names = [port.name for port in source.policy.outputs]

    def call(inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return dict(zip(names, policy.program(1, [inputs[port.name] for port in ports]), strict=True))

    return (file.getvalue(),), one_by_one(source.single, call)
