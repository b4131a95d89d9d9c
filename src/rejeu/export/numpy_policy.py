"""Exported policies in NumPy: the operations of a traced program, one after the other, in processes without JAX."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejeu.core import spaces
from rejeu.core.errors import CheckpointError
from rejeu.core.records import WRONG, brief, is_sparse, parse_json
from rejeu.core.types import JsonObject, Observation, PyTree
from rejeu.export import PRIMITIVES

POLICY = "policy"
"""Name of the array with everything but the constants: JSON in UTF-8."""
MOST_NUMBERS = 2**26
"""Upper limit on the numbers that a policy computes for one observation: a damaged file must not exhaust the memory."""
Params = Mapping[str, Any]
Function = Callable[..., Any]
"""Of the number of observations, the primitive's parameters, and its inputs."""


def broadcast(n: int, params: Params, x: np.ndarray) -> np.ndarray:
    """An array that is repeated along axes."""
    shape = [n if size == -1 else size for size in params["shape"]]
    sizes = [1] * len(shape)
    for axis, size in zip(params["broadcast_dimensions"], x.shape, strict=True):
        sizes[axis] = size
    return x.reshape(sizes) if sizes == shape else np.broadcast_to(x.reshape(sizes), shape)


def sliced(n: int, params: Params, x: np.ndarray) -> np.ndarray:
    """A part of an array."""
    ends = (None if end == -1 else end for end in params["limit_indices"])
    strides = params.get("strides") or [1] * x.ndim
    return x[tuple(map(slice, params["start_indices"], ends, strides))]


def selected(n: int, params: Params, index: np.ndarray, *cases: np.ndarray) -> np.ndarray:
    """For each element one of several cases."""
    return np.where(index, *reversed(cases)) if index.dtype == bool else np.choose(index, cases)


def reduction(function: Function) -> Function:
    """Returns a sum, or the like, over axes."""
    return lambda n, params, x: function(x, axis=tuple(params["axes"])).astype(x.dtype)


def elementwise(function: Function) -> Function:
    """Returns an operation on each element by itself."""
    return lambda n, params, *inputs: function(*inputs)


def divided(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A quotient, of integers towards zero."""
    return x / y if x.dtype.kind == "f" else (x - np.fmod(x, y)) // y


ELEMENTWISE: dict[str, Function] = {
    **{name: elementwise(getattr(np, row["numpy"])) for name, row in PRIMITIVES.items() if "numpy" in row},
    "div": elementwise(divided),
    "erf": elementwise(np.vectorize(math.erf, otypes=[np.float32])),
    "logistic": elementwise(lambda x: 1 / (1 + np.exp(-x))),
    "select_n": selected,
}
FUNCTIONS: dict[str, Function] = {
    **ELEMENTWISE,
    "argmax": lambda n, params, x: x.argmax(params["axes"][0]).astype(params["index_dtype"]),
    "broadcast_in_dim": broadcast,
    "concatenate": lambda n, params, *parts: np.concatenate(parts, params["dimension"]),
    "convert_element_type": lambda n, params, x: x.astype(params["new_dtype"]),
    "matmul": lambda n, params, x, y: x @ y,
    **{f"reduce_{name}": reduction(getattr(np, name)) for name in ("max", "min", "sum")},
    "reshape": lambda n, params, x: x.reshape(params["new_sizes"]),
    "slice": sliced,
    "squeeze": lambda n, params, x: x.squeeze(tuple(params["dimensions"])),
    "transpose": lambda n, params, x: x.transpose(params["permutation"]),
}
"""Primitives of JAX in NumPy."""


def count(name: str, params: Params, inputs: Sequence[np.ndarray]) -> int:
    """Returns about how many numbers an operation computes, from the shapes of its inputs."""
    if name == "broadcast_in_dim":
        return math.prod(map(abs, params["shape"]))
    if name == "matmul":
        return inputs[0].size * inputs[1].shape[-1] // 256  # multiplications are cheap
    if name in ELEMENTWISE:
        return math.prod(np.broadcast_shapes(*(array.shape for array in inputs)))
    return sum(array.size for array in inputs)


class ArrayOperation(NamedTuple):
    """An operation on arrays, which are named by numbers."""

    name: str
    inputs: list[int]
    outputs: list[int]
    params: dict[str, Any]

    def run(self, n: int, values: dict[int, np.ndarray]) -> None:
        """Adds the outputs for ``n`` observations to the known arrays."""
        values[self.outputs[0]] = FUNCTIONS[self.name](n, self.params, *[values[i] for i in self.inputs])


class NumpyProgram:
    """A traced program that NumPy computes."""

    def __init__(
        self, description: Mapping[str, Any], constants: Sequence[np.ndarray], examples: Sequence[np.ndarray]
    ) -> None:
        """Reads what :func:`rejeu.export.npz_file.described` returns, and computes what depends on constants alone.

        ``examples`` are inputs for one observation.

        Raises:
            ValueError: if it computes too many numbers for one observation.
        """
        self._inputs, self._outputs = description["inputs"], description["outputs"]
        self._constants, self._steps = dict(enumerate(constants)), []
        values, numbers_left = self._known(examples), MOST_NUMBERS
        for step in (ArrayOperation(*fields) for fields in description["operations"]):
            numbers_left -= count(step.name, step.params, [values[i] for i in step.inputs])
            if numbers_left < 0:
                raise ValueError(f"it computes more than {MOST_NUMBERS} numbers for one observation")
            with np.errstate(all="ignore"):
                step.run(1, values)
            if self._constants.keys() >= {*step.inputs} and -1 not in step.params.get("shape", ()):
                self._constants |= {i: values[i] for i in step.outputs}
            else:
                self._steps.append(step)

    def __call__(self, n: int, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Returns the outputs for ``n`` observations."""
        values = self._known(arrays)
        with np.errstate(all="ignore"):
            for step in self._steps:
                step.run(n, values)
        return [values[i] for i in self._outputs]

    def _known(self, arrays: Sequence[np.ndarray]) -> dict[int, np.ndarray]:
        return self._constants | dict(zip(self._inputs, arrays, strict=True))


class NumpyPolicy:
    """The deterministic policy of an agent."""

    def __init__(self, content: Mapping[str, Any], constants: Sequence[np.ndarray], largest: int) -> None:
        """Builds the policy from its description and constants; ``largest`` limits the numbers of a space."""
        self.card: JsonObject = content["card"]
        """Where it is from, and what it takes and returns; see ``docs/deployment.md``."""
        described = content["observation_space"], content["action_space"]
        self.observation_space, self.action_space = (spaces.rebuild(space, largest) for space in described)
        roles = [port["role"] for port in self.card["inputs"]]
        self.takes_masks = "action_mask" in roles
        self._leaves, self._n_states = spaces.leaves(self.observation_space), roles.count("state")
        zeros = [np.zeros((1, *port["shape"]), port["dtype"]) for port in self.card["inputs"]]
        n_leaves = len(self._leaves)
        self._state = zeros[n_leaves + self.takes_masks :][: self._n_states]
        self.program = NumpyProgram(content["program"], constants, zeros)
        action = self.program(1, zeros)[0]
        if action.shape != (1, *(self.action_space.shape or ())) or not np.isfinite(action).all():
            raise ValueError("its actions have another shape, or are not finite")

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
        action_masks: Any = None,
    ) -> tuple[np.ndarray, PyTree]:
        """Returns the actions of the agent's ``predict(deterministic=True)``, and the state for the next call.

        Args:
            observation: one observation, or a batch with a leading axis.
            state: of a recurrent policy from the last call, None at first; returned unchanged by others.
            episode_start: where an episode starts, ``bool (batch,)``, for recurrent policies; None: where ``state`` is None.
            deterministic: must be True.
            action_masks: which actions are allowed, ``bool (batch, n)`` or ``(n,)``, if the agent takes them; None allows all.

        Raises:
            ValueError: if the shapes do not match, or ``deterministic`` is False.
        """
        if not deterministic:
            raise ValueError("a policy in NumPy is deterministic; leave out deterministic=False, or use rejeu.load")
        if action_masks is not None and not self.takes_masks:
            raise ValueError("this policy takes no action_masks")
        arrays, is_single = spaces.batch_arrays(observation, self.observation_space, self._leaves)
        n = len(arrays[0])
        if self.takes_masks:
            shape = (n, *self.card["inputs"][len(arrays)]["shape"])
            arrays.append(np.broadcast_to(np.asarray(True if action_masks is None else action_masks, bool), shape))
        if self._n_states:
            start = state is None if episode_start is None else episode_start
            arrays += [np.repeat(memory, n, axis=0) for memory in self._state] if state is None else state
            arrays.append(np.broadcast_to(np.asarray(start, bool), n))
        action, *after = self.program(n, arrays)
        action = action.astype(self.action_space.dtype)
        return (action[0] if is_single else action), tuple(after) if self._n_states else state


def parse(content: bytes) -> NumpyPolicy:
    """Returns the policy of the content of a file.

    Raises:
        ValueError: if it is not valid, or others of :data:`rejeu.core.records.WRONG`.
    """
    with zipfile.ZipFile(io.BytesIO(content)) as file:
        members = file.infolist()
        if any(member.compress_type for member in members) or sum(member.file_size for member in members) > len(
            content
        ):
            raise ValueError("it is compressed, or its members overlap")
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        description = parse_json(arrays[POLICY].tobytes())
        constants = [arrays[f"c{i}"] for i in range(len(arrays.files) - 1)]
    return NumpyPolicy(description, constants, max(spaces.MAX_NUMBERS, len(content)))


def read(path: Path) -> NumpyPolicy:
    """Returns the policy of a file that ``rejeu export --to npz`` has written. No code from the file is run.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if the file is damaged.
    """
    try:
        if is_sparse(path):
            raise ValueError("it is nearly empty, with holes")
        return parse(path.read_bytes())
    except (*WRONG, EOFError, zipfile.BadZipFile) as error:
        reason = "it holds pickles, which are not read" if "pickle" in str(error) else brief(error)
        raise CheckpointError(
            f"{path} is damaged, or not written by rejeu export --to npz ({reason}); export the model again"
        ) from None
