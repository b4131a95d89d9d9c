"""Programs as StableHLO, by ``jax.export``: a zip file of the module, JAX's own form of it, and the card."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable

import jax
import numpy as np
from jax import Array, ShapeDtypeStruct, export

from rejeu.core.types import JsonObject
from rejeu.export.check import Run, one_by_one
from rejeu.export.contract import Exportable, Policy

MODULE, EXPORTED, CARD = "module.mlir.bc", "exported.jax", "card.json"
"""Names in the zip file: StableHLO as portable bytecode, the bytes for ``jax.export.deserialize``, the contract."""


def write(policy: Policy, card: JsonObject) -> bytes:
    """Returns the zip file of a policy. The module takes and returns arrays in the order of the card.

    Raises:
        ValueError: if a part of it is a function of Python that JAX calls back.
    """

    def act(inputs: dict[str, Array]) -> dict[str, Array]:
        results = policy.program(*(inputs[port.name] for port in policy.inputs))
        return {port.name: result for port, result in zip(policy.outputs, results, strict=True)}

    pairs = zip(policy.inputs, policy.program.arguments, strict=True)
    examples = {port.name: ShapeDtypeStruct(value.shape, value.dtype) for port, value in pairs}
    try:
        exported = export.export(jax.jit(act), platforms=["cpu", "cuda", "tpu"])(examples)
    except NotImplementedError as error:
        raise ValueError(
            f"the policy cannot be exported to stablehlo ({error}); write the part that calls Python with operations of JAX"
        ) from None
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(MODULE, exported.mlir_module_serialized)
        file.writestr(EXPORTED, bytes(exported.serialize()))
        file.writestr(CARD, json.dumps(card, indent=1))
    return content.getvalue()


def read(content: bytes) -> Callable[[dict[str, np.ndarray]], dict[str, Array]]:
    """Returns the policy of a zip file, as a function from inputs by name to outputs by name."""
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        exported = export.deserialize(bytearray(file.read(EXPORTED)))
    return jax.jit(exported.call)


def files(source: Exportable) -> tuple[tuple[bytes, ...], Run]:
    """Returns the zip file, and its run for one observation at a time."""
    content = write(source.policy, source.card)
    single = content if source.is_general else write(source.single, source.card)
    return (content,), one_by_one(source.single, read(single))
