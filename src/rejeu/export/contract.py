"""The inputs and outputs of a policy: its program with names, shapes, dtypes and bounds, and the card about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, ShapeDtypeStruct, export

from rejeu.core import spaces
from rejeu.core.algorithm import Algorithm, Clock, Masked, PyTree
from rejeu.core.spaces import Leaf
from rejeu.core.types import JsonObject
from rejeu.exploration import explorer as exploration
from rejeu.export.program import TracedProgram, trace

Role = Literal["observation", "action_mask", "state", "episode_start", "noise", "action"]
CARD_VERSION = 1
"""Version of the layout of cards."""


class Port(NamedTuple):
    """An input or output."""

    name: str
    role: Role
    shape: tuple[int, ...]
    """Without the batch axis."""
    dtype: str
    low: Any = None
    """Smallest values as of :func:`rejeu.core.spaces.describe`; None without bounds."""
    high: Any = None
    """Largest values, likewise."""
    drawn: str = ""
    """For noise: ``normal`` (standard) or ``uniform`` (in [0, 1)), independent numbers in each step."""

    def to_json(self) -> JsonObject:
        """Returns it as JSON values, without what is not given."""
        return {key: value for key, value in self._asdict().items() if value not in (None, "")}


class FrameStack(NamedTuple):
    """Observations that are stacks of frames, the newest last."""

    n: int
    """Frames of a stack."""
    axes: tuple[int | None, ...]
    """Of each leaf: the axis of its frames, from the end; None for a leaf that is no stack."""
    zeros: bool = False
    """Whether a stack is filled up with zeros at the start of an episode, else with its first frame."""

    def newest(self, i: int, array: Any) -> Any:
        """Returns the newest frame of leaf ``i``, with any further axes before."""
        axis = self.axes[i]
        if axis is None:
            return array
        width = array.shape[axis] // self.n
        frame = jnp.split(array, [array.shape[axis] - width], axis)[1]
        return frame.squeeze(axis) if width == 1 and axis != -1 else frame

    def pushed(self, i: int, stack: Any, frame: Any, start: Any) -> Any:
        """Returns the stack of leaf ``i`` after another frame, or the first one of an episode."""
        axis = self.axes[i]
        assert axis is not None
        frame = frame if frame.ndim == stack.ndim else jnp.expand_dims(frame, axis)
        older = jnp.split(stack, [frame.shape[axis]], axis)[1]
        first = jnp.zeros_like(older) if self.zeros else jnp.concatenate([frame] * (self.n - 1), axis)
        return jnp.concatenate([jnp.where(start, first, older), frame], axis)

    def begins_with_zeros(self, arrays: list[Any]) -> bool:
        """Returns whether these first observations of episodes, by leaf, hold zeros besides the newest frame."""
        empty = self._replace(zeros=True)
        firsts = [(i, first) for i, axis in enumerate(self.axes) if axis is not None for first in arrays[i]]
        return all(np.array_equal(empty.pushed(i, first, self.newest(i, first), True), first) for i, first in firsts)


def frame_stack_of(leaves: tuple[Leaf, ...], n: int) -> FrameStack:
    """Returns how observations of whole stacks are made of frames: along a first axis of length ``n``, else along channels.

    Raises:
        ValueError: if ``n`` is no number of frames, or a leaf cannot be such a stack.
    """
    axes: list[int | None] = []
    for leaf in leaves:
        shape = leaf.shape or (1,)
        is_first = shape[0] == n or (leaf.kind == "image" and shape[0] == min(shape))
        axis = -len(shape) if is_first else -1
        if isinstance(n, bool) or n < 2 or shape[axis] % n:
            raise ValueError(
                f"frame_stack={n!r} does not fit {leaf.path or 'observations'} of the shape {list(leaf.shape)}"
            )
        axes.append(axis)
    return FrameStack(n, tuple(axes))


class Policy(NamedTuple):
    """A policy as a program. Every array has a leading batch axis."""

    program: TracedProgram
    inputs: tuple[Port, ...]
    """In the order of the program's arguments: observation, then ``action_mask``, state and ``episode_start``, noise."""
    outputs: tuple[Port, ...]
    """The action, then the next state."""
    batch: int | None
    """Observations at once; None for any number."""

    def of(self, role: Role) -> list[Port]:
        """Returns the inputs of a role."""
        return [port for port in self.inputs if port.role == role]


class Exportable(NamedTuple):
    """The source of the files of a format."""

    policy: Policy
    single: Policy
    """The policy for one observation at a time."""
    card: JsonObject
    """About it."""
    observation_space: gym.Space
    action_space: gym.Space
    stem: str = "policy"
    """Name of the files without suffix."""
    env_id: str | None = None
    """Of the environment that it was trained on, None if that was given as an object."""
    env_kwargs: Mapping[str, Any] = MappingProxyType({})
    """Of this environment."""

    @property
    def is_general(self) -> bool:
        """Whether the policy itself takes one observation."""
        return self.policy.batch in (None, 1)


def policy_of(
    algorithm: Algorithm,
    actor: PyTree,
    observation_space: gym.Space,
    action_space: gym.Space,
    mask: Leaf | None,
    batch: int | None = None,
    noise: bool = False,
    stack: FrameStack | None = None,
) -> Policy:
    """Returns the policy of an algorithm from raw observations to actions of the environment.

    Args:
        algorithm: with normalization, if there is any.
        actor: the weights.
        observation_space: of the environment.
        action_space: of the environment.
        mask: of the allowed actions, None for policies without.
        batch: number of observations at once, None for a free number.
        noise: sample from the policy, with the random numbers as inputs; else its mode.
        stack: of which frames observations are made; the inputs are single frames then, and the stacks a part of the state.

    Raises:
        ValueError: if a free batch size or the drawing cannot be expressed, or ``noise`` is for a deterministic policy.
    """
    leaves, structure = spaces.leaves(observation_space), spaces.structure(observation_space)
    size = export.symbolic_shape("batch")[0] if batch is None else batch
    has_memory = algorithm.recall is not None
    explorer = exploration.plain(algorithm)
    memory, carry_structure = jax.tree.flatten(explorer.init(actor, 1))
    n_carry, stacked = len(memory), [i for i, axis in enumerate(stack.axes) if axis is not None] if stack else []
    memory += [np.zeros((1, *leaves[i].shape), leaves[i].dtype) for i in stacked]
    has_state = bool(memory)
    parts = [*spaces.parts(observation_space, observation_space)]
    if stack:
        for i in stacked:
            low, high = (np.asarray(stack.newest(i, array)) for array in (parts[i].low, parts[i].high))
            parts[i] = gym.spaces.Box(low, high, dtype=parts[i].dtype)
    scale = spaces.action_scaler(action_space, jnp)

    def act(obs: list[Array], mask: Array | None, memory: list[Array], start: Any, key: Any) -> list[Array]:
        frames = zip(stacked, memory[n_carry:], strict=True)
        stacks = [stack.pushed(i, value, obs[i], start) for i, value in frames if stack]
        obs = [stacks[stacked.index(i)] if i in stacked else value for i, value in enumerate(obs)]
        arrays: PyTree = jax.tree.unflatten(structure, [value[None] for value in obs])
        arrays = arrays if mask is None else Masked(arrays, mask[None])
        before = jax.tree.unflatten(carry_structure, [value[None] for value in memory[:n_carry]])
        after: PyTree = ()
        if noise:
            ended = jnp.ones(1, bool) if start is None else start[None]
            action, after = explorer.act(before, actor, arrays, ended, key, Clock(np.uint32(0), 0, 1.0))
        elif has_memory:
            action, after = algorithm.recall(before, actor, arrays, start[None])  # type: ignore[misc]
        else:
            action = algorithm.exploit(actor, arrays)
        return [scale(action)[0], *(value[0] for value in jax.tree.leaves(after) if has_memory), *stacks]

    example = lambda shape, dtype: ShapeDtypeStruct((size, *shape), dtype)  # noqa: E731
    arguments = (
        [
            example(space.shape if i in stacked else leaf.shape, leaf.dtype)
            for i, (leaf, space) in enumerate(zip(leaves, parts, strict=True))
        ],
        None if mask is None else example(mask.shape, bool),
        [example(array.shape[1:], array.dtype) for array in memory],
        example((), bool) if has_state else None,
        example((2,), np.uint32) if noise else None,
    )
    program = trace(jax.vmap(act), *arguments, draws=noise)
    if noise and not program.draws:
        raise ValueError("noise=True is for policies that are sampled from; this one always returns the same action")
    inputs = [
        Port(leaf.path or "observation", "observation", tuple(example.shape[1:]), leaf.dtype, *bounds(space))
        for leaf, space, example in zip(leaves, parts, arguments[0], strict=True)
    ]
    state = [Port(f"state_{i}", "state", array.shape[1:], str(array.dtype)) for i, array in enumerate(memory)]
    inputs += [] if mask is None else [Port("action_mask", "action_mask", mask.shape, "bool")]
    inputs += [*state, Port("episode_start", "episode_start", (), "bool")] if has_state else []
    for i, (draw_name, value) in enumerate(program.draws):
        inputs.append(Port(f"noise_{i}", "noise", value.shape[1:], str(value.dtype), drawn=draw_name))
    is_integer = isinstance(action_space, gym.spaces.Discrete | gym.spaces.MultiDiscrete)
    dtype = "int64" if is_integer else str(program.outputs[0].dtype)
    action = Port("action", "action", action_space.shape or (), dtype, *bounds(action_space))
    outputs = (action, *(array._replace(name=f"next_{array.name}") for array in state))
    return Policy(program, distinct(inputs, {array.name for array in outputs}), outputs, batch)


def distinct(ports: Sequence[Port], used_names: set[str]) -> tuple[Port, ...]:
    """Returns ports, observations first, whose names differ from each other and from those taken, by underscores."""
    result = []
    for port in ports:
        name = port.name
        while name in used_names:
            name += "_"
        used_names.add(name)
        result.append(port._replace(name=name))
    return tuple(result)


def bounds(space: gym.Space) -> tuple[Any, Any]:
    """Returns the smallest and the largest values of an array of a space, in JSON values."""
    ((space_name, body),) = spaces.describe(space).items()
    if space_name == "Box":
        return body["low"], body["high"]
    if space_name == "MultiBinary":
        return 0, 1
    start, n = np.asarray(body["start"]), np.asarray(body["n" if space_name == "Discrete" else "nvec"])
    return start.tolist(), (start + n - 1).tolist()
