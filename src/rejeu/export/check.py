"""Files compared with ``predict`` on recorded observations, one at a time, and their latency."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np

from rejeu.core.types import AnyArray
from rejeu.export.contract import Policy
from rejeu.export.program import Value

LARGEST_DIFFERENCE = 1e-5
"""A file whose actions differ by more is not kept, unless the program itself differs from double precision. Of an action with
bounds in halves of its range, if these are above 1; of one without bounds relative to its size, if that is above 1."""
ROUNDING = 16.0
"""How much more a file may differ from ``predict`` than its program in float32 from the same in double precision: formats sum
in another order."""
OBSERVATIONS = 1000
DECISIVE = ("argmax", "floor", "gt")
"""Primitives that make whole numbers of others."""


class SeenSteps(NamedTuple):
    """Observations, in the order in which a policy saw them, and its actions."""

    inputs: dict[str, np.ndarray]
    """By the names of the policy's inputs, ``(n, *shape)``; without the state."""
    actions: np.ndarray
    """Of ``predict``, ``(n, *shape)``."""
    source: str
    """Where they are from, such as the id of an environment."""


class Check(NamedTuple):
    """How a file compares with ``predict``."""

    n: int
    """Number of observations."""
    source: str
    """Where they are from."""
    difference: float
    """The largest between two numbers of actions; of whole numbers 0, unless two choices are not equally good."""
    ties: int
    """Number of observations with another choice, of two whose values differ by less than 1e-5."""
    p50: float
    """Median time for one observation, in microseconds."""
    p99: float
    """The time that 99 % of the calls need at most."""
    allowed: float = LARGEST_DIFFERENCE
    """The difference up to which a file is kept."""

    def __str__(self) -> str:
        ties = f", {self.ties} ties" if self.ties else ""
        return (
            f"largest difference from predict {self.difference:.2g}{ties} ({self.n:,} observations, {self.source}); "
            f"{self.p50:.3g} us for an observation, 99 % within {self.p99:.3g} us"
        )


Run = Callable[[Mapping[str, np.ndarray]], tuple[np.ndarray, np.ndarray]]
"""Returns actions ``(n, *shape)`` and times in seconds ``(n,)`` for inputs ``(n, *shape)`` in order."""


def compare(policy: Policy, recording: SeenSteps, run: Run) -> Check:
    """Returns how a file compares with ``predict``.

    Args:
        policy: what was exported, for one observation at a time.
        recording: what it is compared with.
        run: of the file.
    """
    actions, seconds = run(recording.inputs)
    expected = recording.actions
    p50, p99 = (float(1e6 * np.percentile(seconds, q)) for q in (50, 99))
    if expected.dtype.kind != "f":
        differing = (actions != expected).reshape(len(actions), -1).any(axis=1)
        ties = [is_tie(policy, recording.inputs, int(i)) for i in np.flatnonzero(differing)]
        return Check(len(actions), recording.source, 0.0 if all(ties) else 1.0, sum(ties), p50, p99)
    low, high = (np.asarray(bound, np.float64) for bound in (policy.outputs[0].low, policy.outputs[0].high))
    with np.errstate(invalid="ignore"):
        half = np.where(np.isfinite(low) & np.isfinite(high), 0.5 * (high - low), np.abs(expected))
    far = lambda x, y: float((np.abs(x - y.astype(np.float64)) / np.maximum(half, 1.0)).max(initial=0.0))  # noqa: E731
    difference, allowed = far(actions, expected), LARGEST_DIFFERENCE
    if difference > LARGEST_DIFFERENCE:  # where large numbers cancel, or are clipped
        computed_actions = [one_by_one(policy, computed(policy, wide))(recording.inputs)[0] for wide in (False, True)]
        allowed = max(allowed, ROUNDING * far(*computed_actions))
    return Check(len(actions), recording.source, difference, 0, p50, p99, allowed)


def computed(policy: Policy, in_double: bool) -> Callable[[dict[str, np.ndarray]], Mapping[str, AnyArray]]:
    """Returns a policy as a function from inputs to outputs by name, in double precision or as it is."""
    wide = lambda x: x.astype(np.float64) if in_double and x.dtype == np.float32 else x  # noqa: E731
    operations = []
    for operation in policy.program.operations:
        params = {k: np.dtype("f8") if in_double and is_float32(v) else v for k, v in operation.params.items()}
        inputs = tuple(
            value if value.data is None else Value(value.shape, value.dtype, wide(value.data))
            for value in operation.inputs
        )
        operations.append(operation._replace(inputs=inputs, params=params))
    program = policy.program._replace(operations=tuple(operations))
    run = jax.jit(lambda *arrays: program(*arrays))

    def call(inputs: dict[str, np.ndarray]) -> Mapping[str, AnyArray]:
        with jax.enable_x64(in_double):
            results = run(*(wide(inputs[port.name]) for port in policy.inputs))
            return {port.name: np.asarray(result) for port, result in zip(policy.outputs, results, strict=True)}

    return call


def is_float32(param: object) -> bool:
    """Returns whether a parameter of a primitive is the dtype float32."""
    return isinstance(param, np.dtype | type) and param in (np.dtype("f4"), np.float32)


def is_tie(policy: Policy, inputs: Mapping[str, np.ndarray], row: int) -> bool:
    """Returns whether the best choices for an observation are equally good, up to 1e-5.

    A policy with memory is taken at the start of an episode, so there only such ties are seen.
    """
    decisive = [step for step in policy.program.operations if step.name in DECISIVE]
    observation = {name: array[row][None] for name, array in inputs.items()}
    arrays = [observation.get(port.name, np.zeros((1, *port.shape), port.dtype)) for port in policy.inputs]
    inputs_of_decisions = policy.program.ending_in([operation.inputs[0] for operation in decisive])(*arrays)
    for operation, value in zip(decisive, map(np.asarray, inputs_of_decisions), strict=True):
        allowed = LARGEST_DIFFERENCE * max(1.0, float(np.abs(value[np.abs(value) < 1e8]).max(initial=0.0)))
        if operation.name == "argmax":
            first, second = np.moveaxis(np.sort(value, axis=operation.params["axes"][0]), -1, 0)[[-1, -2]]
            distance = first - second
        else:
            distance = np.abs(value - np.round(value)) if operation.name == "floor" else np.abs(value)
        if (distance < allowed).any():
            return True
    return False


def one_by_one(policy: Policy, call: Callable[[dict[str, np.ndarray]], Mapping[str, AnyArray]]) -> Run:
    """Returns the run of a function from inputs to outputs by name, which is given one observation at a time."""
    state = policy.of("state")

    def run(inputs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        memory = {port.name: np.zeros((1, *port.shape), port.dtype) for port in state}
        actions, seconds = [], []
        n = len(next(iter(inputs.values())))
        for i in range(-1, n):  # the first once more, to compile
            row = {name: array[max(i, 0)][None] for name, array in inputs.items()}
            start = time.perf_counter()
            results = {name: np.asarray(result) for name, result in call(row | memory).items()}
            if i >= 0:
                seconds.append(time.perf_counter() - start)
                actions.append(results["action"][0])
                memory = {port.name: results[f"next_{port.name}"] for port in state}
        return np.array(actions), np.array(seconds)

    return run
