"""Observation and action spaces: leaves, checks, scaling of actions, and descriptions in JSON."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import DTypeLike

from rejeu.core.types import Action, AnyArray, JsonObject, Observation, PyTree
from rejeu.core.validation import choice

POLICIES = ("MlpPolicy", "MultiInputPolicy", "CnnPolicy")
"""Names of policies; each is for some observations."""
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
MAX_NUMBERS = 2**20
"""Upper limit on the numbers and choices of a space in a file, unless the file is large enough to hold networks for more: a
damaged file must not exhaust the memory."""
MAX_LEAVES = 1024
"""Upper limit on the parts of a Dict or Tuple in a file."""
UNBOUNDED = 1e10
"""Actions with a bound of at least this size, such as the largest float32, count as unbounded."""
VDOT_SIZE = 2**13
"""Number of elements up to which an array is checked by its square; beyond it BLAS would use its threads."""
INVALID = (ArithmeticError, AssertionError, AttributeError, LookupError, RecursionError, TypeError, ValueError)
"""Exceptions that an invalid description of a space can cause."""


@dataclass(frozen=True)
class Leaf:
    """One array of an observation: static and hashable, so that a network can hold it."""

    path: str
    """Path in the observation, such as ``"camera.left"``; empty if the observation is an array."""
    kind: Literal["continuous", "image", "categorical", "binary"]
    """Meaning of the numbers; ``image`` is a uint8 array with three axes."""
    shape: tuple[int, ...]
    """Of one observation, without the batch axis."""
    dtype: str
    """As stored and passed to the network, of 32 bits at most; see :func:`stored_dtype`."""
    sizes: tuple[int, ...] = ()
    """For ``categorical``: number of values of each component."""
    starts: tuple[int, ...] = ()
    """For ``categorical``: the smallest value of each component."""

    @property
    def n_features(self) -> int:
        """Length of the leaf when it is flattened and one-hot encoded."""
        return sum(self.sizes) if self.kind == "categorical" else int(np.prod(self.shape, dtype=int))

    @property
    def nbytes(self) -> int:
        """Bytes of one observation of this leaf."""
        return int(np.prod(self.shape, dtype=int)) * np.dtype(self.dtype).itemsize


def leaves(space: spaces.Space, path: str = "") -> tuple[Leaf, ...]:
    """Returns the leaves of a space in the order in which JAX flattens its observations (Dict keys sorted).

    Raises:
        TypeError: for spaces that are not fixed-size arrays (Text, Graph, Sequence, OneOf), and for a Dict or Tuple that
            holds nothing.
    """
    if isinstance(space, spaces.Dict | spaces.Tuple) and not len(space.spaces):
        where = f" at {path!r}" if path else ""
        raise TypeError(f"the observation space{where} is {space}, which holds nothing; give it a part or leave it out")
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return tuple(leaf for key in _keys(space) for leaf in leaves(space.spaces[key], f"{path}.{key}".lstrip(".")))
    if isinstance(space, spaces.Box):
        is_image = space.dtype == np.uint8 and len(space.shape) in (3, 4)
        return (Leaf(path, "image" if is_image else "continuous", space.shape, stored_dtype(space)),)
    check_32_bits(space)
    if isinstance(space, spaces.Discrete):
        return (Leaf(path, "categorical", (), "int32", (int(space.n),), (int(space.start),)),)
    if isinstance(space, spaces.MultiDiscrete):
        sizes = tuple(int(n) for n in space.nvec.ravel())
        starts = tuple(int(s) for s in np.broadcast_to(space.start, space.nvec.shape).ravel())
        return (Leaf(path, "categorical", space.nvec.shape, "int32", sizes, starts),)
    if isinstance(space, spaces.MultiBinary):
        return (Leaf(path, "binary", space.shape, "int8"),)
    where = f" at {path!r}" if path else ""
    raise TypeError(
        f"the observation space{where} is {space}; expected Box, Discrete, MultiDiscrete or MultiBinary, in any nesting "
        "of Dict and Tuple: wrap the environment with gymnasium.wrappers.TransformObservation"
    )


def groups(leaves: tuple[Leaf, ...], share_goals: bool = True) -> list[int | None]:
    """Returns the index of each leaf's moments in the statistics of normalization, None for leaves that are not normalized.

    With ``share_goals`` the achieved and the desired goal have the same: hindsight replaces one by the other, and their
    difference must keep its meaning.
    """
    indices: dict[str, int] = {}
    result: list[int | None] = []
    for leaf in leaves:
        if leaf.kind != "continuous":
            result.append(None)
            continue
        name = "goal" if share_goals and leaf.path in ("achieved_goal", "desired_goal") else f"leaf {leaf.path}"
        result.append(indices.setdefault(name, len(indices)))
    return result


def structure(space: spaces.Space) -> PyTree:
    """Returns the tree structure of one observation of ``space``."""
    import jax  # here, so that worker processes start without it

    return jax.tree.structure(plain(space, space))


def flat_keys(tree_structure: PyTree) -> list[str] | None:
    """Returns the keys, in the order of :func:`leaves`, where observations are dicts of arrays and nothing deeper.

    None for any other structure. Reading such a dict by its keys is several times faster than flattening it as a tree.
    """
    import jax

    skeleton = jax.tree.unflatten(tree_structure, range(tree_structure.num_leaves))
    is_flat = isinstance(skeleton, dict) and all(isinstance(child, int) for child in skeleton.values())
    return list(skeleton) if is_flat else None


def narrow(dtype: DTypeLike | None) -> str:
    """Returns the name of a dtype of 32 bits at most: 64-bit floats and integers become 32-bit."""
    name = np.dtype(dtype).name
    return {"float64": "float32", "int64": "int32", "uint64": "uint32", "bool": "int8"}.get(name, name)


def stored_dtype(space: spaces.Box) -> str:
    """Returns the name of the dtype in which numbers of a Box are stored: ``float32`` if its bounds need integers of 64 bits.

    >>> stored_dtype(spaces.Box(0, 255, (1,), np.int64)), stored_dtype(spaces.Box(0, 2**45, (1,), np.int64))
    ('int32', 'float32')
    """
    name = narrow(space.dtype)
    if name == space.dtype.name or name[0] not in "iu":
        return name
    limits = np.iinfo(name)
    return name if (space.low >= limits.min).all() and (space.high <= limits.max).all() else "float32"


def check_32_bits(space: spaces.Space) -> None:
    """Raises ``TypeError`` for choices with numbers that integers of 32 bits cannot hold."""
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        last = space.start + (space.n if isinstance(space, spaces.Discrete) else space.nvec) - 1
        if np.min(space.start) < np.iinfo(np.int32).min or np.max(last) > np.iinfo(np.int32).max:
            raise TypeError(
                f"{space} has numbers beyond 32 bits; let it start at 0, and subtract its start in a wrapper"
            )


@functools.cache
def limits(leaf: Leaf) -> tuple[np.ndarray, np.ndarray]:
    """Returns the smallest and the largest numbers of choices or bits."""
    if leaf.kind == "binary":
        return np.zeros(leaf.shape, int), np.ones(leaf.shape, int)
    low = np.reshape(leaf.starts, leaf.shape)
    return low, low + np.reshape(leaf.sizes, leaf.shape) - 1


def keeps_values(array: np.ndarray, dtype: DTypeLike) -> bool:
    """Returns whether casting to ``dtype`` keeps the values, except for the precision of floats."""
    if array.dtype.kind not in "fiub":
        return False
    if np.dtype(dtype).kind == "f" or np.can_cast(array.dtype, dtype):
        return True
    with np.errstate(invalid="ignore", over="ignore"):
        return bool((array.astype(dtype) == array).all())


def as_stored(value: object, leaf: Leaf) -> np.ndarray:
    """Returns one or many values of a leaf as an array of its dtype; copies only if needed.

    Raises:
        ValueError: if that dtype cannot hold them, or if they are none of the choices.
    """
    array, is_choice = np.asarray(value), leaf.kind in ("categorical", "binary")
    if (
        array.dtype != leaf.dtype
        and not (is_choice and array.dtype.kind in "iub")
        and not keeps_values(array, leaf.dtype)
    ):
        fix = "; multiply by 255 first if the numbers lie in [0, 1]" if leaf.kind == "image" else ""
        raise ValueError(f"the dtype {array.dtype}, and {leaf.dtype} cannot hold the numbers{fix}")
    is_one = array.ndim == 0 and leaf.kind == "categorical"
    if is_choice and not (is_one and 0 <= array.item() - leaf.starts[0] < leaf.sizes[0]):  # ten times as fast as NumPy
        low, high = limits(leaf)
        if (outside := (array < low) | (array > high)).any():
            raise ValueError(f"the number {array[outside].flat[0]}, expected {low.min()} to {high.max()}")
    if array.dtype != leaf.dtype:
        with np.errstate(over="ignore"):  # infinite numbers are told as such
            array = array.astype(leaf.dtype)
    return array


def is_finite(array: np.ndarray) -> bool:
    """Returns whether all numbers are finite. For small arrays the square is the fastest check."""
    if array.dtype.kind != "f":
        return True
    if array.size <= VDOT_SIZE and math.isfinite(np.vdot(array, array)):
        return True
    return bool(np.isfinite(array).all())


def parts(space: spaces.Space, observation: Observation) -> list[Observation]:
    """Returns the parts of an observation, one for each of :func:`leaves`, in their order; of the space itself its leaves.

    Raises:
        KeyError: if a key of the space is missing.
        ValueError: if a tuple has another length than in the space.
    """
    if isinstance(space, spaces.Dict):
        return [leaf for key in sorted(space.spaces) for leaf in parts(space.spaces[key], observation[key])]
    if isinstance(space, spaces.Tuple):
        return [leaf for subspace, obs in zip(space.spaces, observation, strict=True) for leaf in parts(subspace, obs)]
    return [observation]


def plain(space: spaces.Space, observation: Observation) -> Observation:
    """Returns an observation as plain dicts and tuples, nested like ``space``; its arrays are not copied.

    JAX sorts the keys of a dict, but keeps the order of an ``OrderedDict`` (which highway-env returns), and distinguishes
    lists from tuples. The order of :func:`leaves` must not depend on that.

    Raises:
        KeyError: if a key of the space is missing.
    """
    if isinstance(space, spaces.Dict):
        return {key: plain(subspace, observation[key]) for key, subspace in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(plain(subspace, obs) for subspace, obs in zip(space.spaces, observation, strict=True))
    return observation


def cast(space: spaces.Space, space_leaves: tuple[Leaf, ...], observation: Observation) -> Observation:
    """Returns a batch of observations as plain dicts and tuples of arrays of the stored dtypes; copies only if needed.

    Raises:
        ValueError: if these cannot hold them; see :func:`as_stored`.
    """
    import jax

    arrays, tree = jax.tree.flatten(plain(space, observation))
    return jax.tree.unflatten(tree, [as_stored(a, leaf) for a, leaf in zip(arrays, space_leaves, strict=True)])


def check_policy(policy: str, space: spaces.Space, normalize_images: bool = True) -> None:
    """Raises ``ValueError`` if there is no such policy, or if it does not fit the observations of ``space``.

    Without ``normalize_images`` arrays of three axes are images, whatever their type.
    """
    choice("policy", policy, POLICIES)
    if policy == "MlpPolicy" and isinstance(space, spaces.Dict):
        raise ValueError("policy='MlpPolicy' does not fit a Dict observation; use 'MultiInputPolicy'")
    if policy == "MultiInputPolicy" and not isinstance(space, spaces.Dict | spaces.Tuple):
        raise ValueError(f"policy='MultiInputPolicy' needs a Dict or Tuple observation, got {space}; use 'MlpPolicy'")
    if not any(leaf.n_features for leaf in leaves(space)):
        raise ValueError(f"the observation space is {space}, which holds nothing; show the agent one number at least")
    images = [leaf.kind == "image" or (len(leaf.shape) == 3 and not normalize_images) for leaf in leaves(space)]
    if policy == "CnnPolicy" and not any(images):
        raise ValueError(f"policy='CnnPolicy' needs a uint8 image observation, got {space}; use 'MlpPolicy'")


def check_goal_space(space: spaces.Space, nested: bool = False) -> None:
    """Raises ``ValueError`` unless ``space`` is a goal environment's: hindsight needs the two goals, each one array.

    With ``nested`` goals may be a Dict or Tuple.
    """
    keys = list(space.spaces) if isinstance(space, spaces.Dict) else None
    missing = [key for key in GOAL_KEYS if keys is None or key not in keys]
    if missing:
        has = f"a Dict with the keys {sorted(keys)}" if keys is not None else str(space)
        raise ValueError(
            f"hindsight replay needs a Dict observation with {', '.join(GOAL_KEYS)}, but {', '.join(missing)} "
            f"is missing from {has}; use a goal environment or replay_buffer_class=None"
        )
    assert isinstance(space, spaces.Dict)
    if space["achieved_goal"] != space["desired_goal"]:
        raise ValueError(
            f"achieved_goal {space['achieved_goal']} and desired_goal {space['desired_goal']} must be the same space, "
            "because hindsight puts the one in the other's place"
        )
    if isinstance(space["achieved_goal"], spaces.Dict | spaces.Tuple) and not nested:
        raise ValueError(
            f"achieved_goal is {space['achieved_goal']}, and hindsight needs goals that are one array; wrap the environment "
            "with rejeu.FlatGoals, which keeps compute_reward as it is: rejeu.FlatGoals(env), or --wrapper rejeu:FlatGoals"
        )


def check_box_action(space: spaces.Space, algorithm: str) -> spaces.Box:
    """Returns ``space`` if it is a finite Box with one axis or more.

    Raises:
        ValueError: otherwise, naming what to use instead.
    """
    if not isinstance(space, spaces.Box):
        raise wrong_action(space, algorithm, "Box", "use DQN" if isinstance(space, spaces.Discrete) else "")
    check_not_empty(space)
    if not bounded(space).all():
        raise ValueError(
            f"{algorithm} needs finite action bounds, got low={space.low.tolist()}, high={space.high.tolist()}; "
            "wrap the environment with gymnasium.wrappers.RescaleAction or declare the bounds it really has"
        )
    if space.dtype.kind == "f" and not (space.high > space.low).all():
        raise ValueError(
            f"every action bound must satisfy low < high, got low={space.low.tolist()}, high={space.high.tolist()}"
        )
    return space


def check_discrete_action(space: spaces.Space, algorithm: str) -> int:
    """Returns the number of actions of a Discrete space, whatever its ``start``.

    Raises:
        ValueError: for another space, naming what to use instead.
    """
    if not isinstance(space, spaces.Discrete):
        raise wrong_action(space, algorithm, "Discrete", "use SAC or TD3" if isinstance(space, spaces.Box) else "")
    return int(space.n)


def wrong_action(space: spaces.Space, algorithm: str, expected: str, advice: str) -> ValueError:
    """Returns the error for actions that are not ``expected``, with advice for these, if there is any."""
    wrapped = f"wrap the environment in a gymnasium.ActionWrapper with a {expected} action space"
    instead = f"for this environment {advice}" if advice else wrapped
    return ValueError(f"{algorithm} needs a {expected} action space, got {space}; {instead}")


def check_action(space: spaces.Space, algorithm: str) -> spaces.Space:
    """Returns ``space`` if a stochastic policy can act in it: a Box of floats, Discrete, MultiDiscrete, MultiBinary.

    Or any nesting of Dict and Tuple of these.

    Raises:
        ValueError: otherwise, naming what to do instead.
    """
    if isinstance(space, spaces.Box):
        check_not_empty(space)
        if space.dtype.kind != "f":
            raise ValueError(f"{algorithm} needs Box actions of floats, got {space}; use MultiDiscrete")
        if not (space.high > space.low).all():
            raise ValueError(
                f"every action bound must satisfy low < high, got low={space.low.tolist()}, high={space.high.tolist()}"
            )
    elif isinstance(space, spaces.Dict | spaces.Tuple) and len(space.spaces):
        for subspace in members(space):
            check_action(subspace, algorithm)
    elif not isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        raise ValueError(
            f"{algorithm} needs a Box, Discrete, MultiDiscrete or MultiBinary action space, or a Dict or Tuple of these, "
            f"got {space}; wrap the environment in a gymnasium.ActionWrapper"
        )
    return space


def check_not_empty(space: spaces.Box) -> None:
    """Raises ``ValueError`` if actions have no component."""
    if not action_dimension(space):
        raise ValueError(
            f"the action space {space} has no component, so there is nothing to choose; give it one or more"
        )


def bounded(space: spaces.Box) -> np.ndarray:
    """Returns which components have two bounds that are finite, also for practical purposes; others are not scaled.

    >>> bounded(spaces.Box(np.float32([-1.0, -3e38, 0.0]), np.float32([1.0, 3e38, np.inf]))).tolist()
    [True, False, False]
    """
    return (np.abs(space.low.astype(np.float64)) < UNBOUNDED) & (np.abs(space.high.astype(np.float64)) < UNBOUNDED)


def action_dimension(space: spaces.Box) -> int:
    """Returns the number of components of one action."""
    return int(np.prod(space.shape, dtype=int))


def members(space: spaces.Dict | spaces.Tuple) -> list[spaces.Space]:
    """Returns the spaces of a Dict or Tuple, in the order of the numbers of an algorithm's action."""
    return [space.spaces[key] for key in _keys(space)]


def _keys(space: spaces.Dict | spaces.Tuple) -> list[Any]:
    return sorted(space.spaces) if isinstance(space, spaces.Dict) else [*range(len(space.spaces))]


def action_width(space: spaces.Space) -> int:
    """Returns the length of an algorithm's action: one number for each component, choice or bit."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return sum(map(action_width, members(space)))
    return int(np.prod(space.shape or (), dtype=int))


def nested_action(
    space: spaces.Dict | spaces.Tuple, action: Action, scale: Callable[[spaces.Space, Action], Action]
) -> Action:
    """Returns actions ``(batch, action_width)`` of a Dict or Tuple as one, each part by ``scale(part's space, numbers)``.

    The arrays are of NumPy or of JAX.
    """
    actions, begin = list[Any](), 0
    for subspace in members(space):
        numbers = action[:, begin : begin + action_width(subspace)]
        begin += action_width(subspace)
        actions.append(scale(subspace, numbers[:, 0] if isinstance(subspace, spaces.Discrete) else numbers))
    return dict(zip(_keys(space), actions, strict=True)) if isinstance(space, spaces.Dict) else tuple(actions)


def rows(action: Action) -> Action:
    """Returns a batch of actions as a sequence of single ones: an array as it is, of a Dict or Tuple a list."""
    if isinstance(action, dict):
        parts = zip(*map(rows, action.values()), strict=True)
        return [dict(zip(action, row, strict=True)) for row in parts]
    return [*zip(*map(rows, action), strict=True)] if isinstance(action, tuple) else action


def scale_action(space: spaces.Space, action: Action, xp: ModuleType = np) -> Action:
    """Returns actions in the range of the environment from those of an algorithm.

    Box: from [-1, 1] to [low, high], ``(batch, action_dim)`` to ``(batch, *shape)``; actions are clipped, and components
    without finite bounds are not scaled. Of a Box of integers, each number from low to high gets an equal part of [-1, 1].
    Discrete and MultiDiscrete: from 0 to n - 1 to the numbers of the space. MultiBinary: the bits. Dict and Tuple: from the
    numbers of all parts, ``float32 (batch, action_width)``, to a dict or tuple of the parts' arrays.

    With ``xp=jax.numpy`` everything has 32 bits, and the last bit may differ.

    >>> scale_action(spaces.Box(-2.0, 2.0, (1,)), np.array([[0.25], [3.0]])).tolist()
    [[0.5], [2.0]]
    """
    return action_scaler(space, xp)(action)


def action_scaler(space: spaces.Space, xp: ModuleType = np) -> Callable[[Action], Action]:
    """Returns :func:`scale_action` for one space."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return lambda action: nested_action(space, action, lambda member, numbers: scale_action(member, numbers, xp))
    shape, dtype = (-1, *(space.shape or ())), space.dtype if xp is np else narrow(space.dtype)
    if isinstance(space, spaces.Box):
        return box_scaler(space, shape, dtype if xp is np else stored_dtype(space), xp)
    if xp is not np:
        check_32_bits(space)
    if isinstance(space, spaces.Discrete):
        first = int(space.start)
        return lambda action: action.astype(dtype) + first
    if isinstance(space, spaces.MultiDiscrete):
        starts = np.broadcast_to(space.start, space.nvec.shape)[None].astype(dtype)
        return lambda action: (action.reshape(shape) + starts).astype(dtype)
    if isinstance(space, spaces.MultiBinary):
        return lambda action: action.reshape(shape).astype(dtype)
    raise TypeError(f"cannot scale actions of {space}")


def box_scaler(
    space: spaces.Box, shape: tuple[int, ...], dtype: DTypeLike | None, xp: ModuleType
) -> Callable[[Action], Action]:
    """Returns :func:`scale_action` for a Box."""
    if space.dtype == np.float32 and (space.low == -1.0).all() and (space.high == 1.0).all():
        return lambda action: action.reshape(shape).clip(-1.0, 1.0)
    real = np.float64 if xp is np else np.float32
    low, high = space.low[None].astype(np.float64), space.high[None].astype(np.float64)
    ends = low.astype(real), high.astype(real)
    if space.dtype.kind != "f":
        half = (0.5 * (high - low + 1.0)).astype(real)
        return lambda action: xp.floor(ends[0] + (action.reshape(shape) + 1.0) * half).clip(*ends).astype(dtype)
    low, high = np.where(bounded(space), low, -1.0), np.where(bounded(space), high, 1.0)
    middle, half = (0.5 * (low + high)).astype(real), (0.5 * (high - low)).astype(real)
    if xp is np:  # the order of the operations decides the last bit, which results for a seed depend on
        return lambda action: (low + (action.reshape(shape) + 1.0) * half).clip(*ends).astype(dtype)
    return lambda action: (middle + action.reshape(shape) * half).clip(*ends).astype(dtype)


def limited(space: spaces.Space, share: float) -> spaces.Space:
    """Returns the middle ``share`` of the range of each component of Box actions; with 1 the space itself.

    Raises:
        ValueError: if a range has no middle, because it is not that of a Box of finite floats.

    >>> limited(spaces.Box(-1.0, 3.0, (1,)), 0.5)
    Box(0.0, 2.0, (1,), float32)
    """
    if share == 1.0:
        return space
    if not isinstance(space, spaces.Box) or space.dtype.kind != "f" or not bounded(space).all():
        raise ValueError(f"action_share={share} needs Box actions with finite bounds, got {space}; leave it out")
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    middle, half = 0.5 * (low + high), 0.5 * share * (high - low)
    return spaces.Box((middle - half).astype(space.dtype), (middle + half).astype(space.dtype), dtype=space.dtype.type)


def unscale_action(space: spaces.Space, action: np.ndarray) -> np.ndarray:
    """Returns actions of an algorithm from those in the range of the environment: the inverse of :func:`scale_action`.

    ``space`` is a Box, Discrete, MultiDiscrete or MultiBinary, ``action`` ``(batch, *shape)``. Actions outside the bounds of a
    Box are outside [-1, 1]; if both bounds are equal, they are 0.

    >>> unscale_action(spaces.Box(0.0, 4.0, (1,)), np.array([[3.0]])).tolist()
    [[0.5]]
    """
    if isinstance(space, spaces.Discrete):
        return (action - space.start).astype(np.int32)
    if isinstance(space, spaces.MultiDiscrete | spaces.MultiBinary):
        first = space.start if isinstance(space, spaces.MultiDiscrete) else 0
        return (action - first).astype(np.int32).reshape(len(action), -1)
    assert isinstance(space, spaces.Box)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    half = np.where(bounded(space), 0.5 * (high - low), 1.0)
    middle = np.where(bounded(space), low + half, 0.0)
    scaled = (action - middle) / np.where(half > 0, half, 1.0)
    return scaled.astype(np.float32).reshape(len(action), -1)


def random_action(space: spaces.Space, n: int, rng: Any, mask: AnyArray = None) -> AnyArray:
    """Returns ``n`` uniformly random actions in the algorithm's range (see :func:`scale_action`).

    With ``mask``, ``bool (n, n_actions)``, the actions are Discrete and among the allowed ones.

    Raises:
        TypeError: for a space of which no agent chooses.
    """
    if mask is not None:
        return nth_allowed(mask, rng.integers(mask.sum(axis=-1), dtype=np.int32))
    if isinstance(space, spaces.Box):
        return rng.uniform(-1.0, 1.0, (n, int(np.prod(space.shape)))).astype(np.float32)
    if isinstance(space, spaces.Discrete):
        return rng.integers(int(space.n), size=n, dtype=np.int32)
    if isinstance(space, spaces.MultiDiscrete):
        return rng.integers(space.nvec.ravel(), size=(n, space.nvec.size), dtype=np.int32)
    if isinstance(space, spaces.MultiBinary):
        return rng.integers(2, size=(n, int(np.prod(space.shape))), dtype=np.int32)
    if isinstance(space, spaces.Dict | spaces.Tuple) and len(space.spaces):
        parts = [random_action(subspace, n, rng).reshape(n, -1) for subspace in members(space)]
        return np.concatenate(parts, axis=-1).astype(np.float32)
    raise TypeError(f"the actions are {space}; agents choose Box, Discrete, MultiDiscrete, MultiBinary, Dict and Tuple")


def nth_allowed(mask: AnyArray, n: AnyArray) -> AnyArray:
    """Returns the actions that are the ``n``-th allowed ones, counted from 0; arrays of NumPy or of JAX.

    >>> nth_allowed(np.array([[False, True, True]]), np.array([1])).tolist()
    [2]
    """
    return (mask.cumsum(axis=-1) > n[:, None]).argmax(axis=-1).astype(np.int32)


def check_env_actions(space: spaces.Space, action: np.ndarray, owner: str) -> None:
    """Checks actions ``(n, ...)`` in the range of the environment.

    ``owner`` names their source in the message.

    Raises:
        ValueError: if one is not in the space, up to rounding.
    """
    if not action.size:
        return
    if isinstance(space, spaces.Box):
        valid = bool(np.isfinite(action).all() and (action >= space.low).all() and (action <= space.high).all())
    else:
        start = 0 if isinstance(space, spaces.MultiBinary) else getattr(space, "start", 0)
        n = space.n if isinstance(space, spaces.Discrete) else getattr(space, "nvec", 2)
        valid = bool((action >= start).all() and (action < np.add(start, n)).all())
    if not valid:
        raise ValueError(f"{owner} has actions from {action.min()} to {action.max()}, expected {space}")


def same(space: spaces.Space, compared: spaces.Space, bounds: bool) -> bool:
    """Returns whether two spaces hold arrays of the same structure, shapes and dtypes, and the same bounds if asked.

    Backends declare different observation bounds for the same environment, and nothing depends on them. Bounds are compared as
    ``float32``: MuJoCo's actions have this dtype in Gymnasium, and ``float64`` in EnvPool.
    """
    if bounds:
        return describe(space, single=True) == describe(compared, single=True)
    return leaves(space) == leaves(compared)


def describe(space: spaces.Space, single: bool = False) -> JsonObject:
    """Returns a description of a space in JSON values; infinite bounds are strings. With ``single`` floats are float32."""
    if isinstance(space, spaces.Dict):
        return {"Dict": {key: describe(subspace, single) for key, subspace in sorted(space.spaces.items())}}
    if isinstance(space, spaces.Tuple):
        return {"Tuple": [describe(subspace, single) for subspace in space.spaces]}
    if isinstance(space, spaces.Box):
        dtype = space.dtype
        if single if dtype.kind == "f" else stored_dtype(space) != "float32":
            dtype = np.dtype(stored_dtype(space))
        low, high = (_bounds(bound, dtype) for bound in (space.low, space.high))
        return {"Box": {"low": low, "high": high, "shape": list(space.shape), "dtype": dtype.name}}
    if isinstance(space, spaces.Discrete):
        return {"Discrete": {"n": int(space.n), "start": int(space.start)}}
    if isinstance(space, spaces.MultiDiscrete):
        start = np.broadcast_to(space.start, space.nvec.shape)
        return {"MultiDiscrete": {"nvec": space.nvec.tolist(), "start": start.tolist()}}
    if isinstance(space, spaces.MultiBinary):
        return {"MultiBinary": {"shape": list(space.shape)}}
    raise TypeError(f"cannot describe the space {space}")


def rebuild(description: object, largest: int = MAX_NUMBERS) -> spaces.Space:
    """Returns the space that :func:`describe` described: the inverse, over a fixed set of names.

    Args:
        description: JSON values.
        largest: upper limit on the numbers and choices of all its parts together.

    Raises:
        ValueError: if the description is not one that :func:`describe` writes, or is of a larger space.
    """
    remaining = largest

    def build(description: Any) -> spaces.Space:
        nonlocal remaining
        ((name, body),) = description.items()
        if name in ("Dict", "Tuple") and len(body) > MAX_LEAVES:
            raise ValueError(f"{len(body)} parts, expected {MAX_LEAVES} at most")
        if name == "Dict":
            return spaces.Dict({key: build(subspace) for key, subspace in body.items()})
        if name == "Tuple":
            return spaces.Tuple([build(subspace) for subspace in body])
        size = {"Discrete": "n", "MultiDiscrete": "nvec"}.get(name)
        remaining -= sum(np.ravel(body[size]).tolist()) if size else math.prod(body["shape"])
        if remaining < 0:
            raise ValueError(f"{largest - remaining} numbers, expected {largest} at most")
        if name == "Box" and np.dtype(str(body["dtype"])).kind in "fiu":
            dtype, shape = np.dtype(body["dtype"]), tuple(body["shape"])
            low, high = (np.broadcast_to(_bound(body[end], dtype), shape) for end in ("low", "high"))
            return spaces.Box(low, high, shape, dtype.type)
        if name == "Discrete":
            return spaces.Discrete(body["n"], start=body["start"])
        if name == "MultiDiscrete":
            return spaces.MultiDiscrete(body["nvec"], start=body["start"])
        if name == "MultiBinary":
            return spaces.MultiBinary(body["shape"])
        raise ValueError(f"{str(name)[:40]!r}")

    try:
        return build(description)
    except INVALID as error:
        raise ValueError(f"not the description of a space: {error}") from None


def _bound(value: object, dtype: np.dtype) -> np.ndarray:
    """Returns a bound of a Box; of integers the nearest one of the dtype."""
    bound = np.asarray(value, np.float64)
    if dtype.kind == "f":
        return bound.astype(dtype)
    limits = np.iinfo(dtype)
    # Floats may round beyond the largest.
    nearest = [min(max(int(number), limits.min), limits.max) for number in bound.ravel()]
    return np.array(nearest, dtype).reshape(bound.shape)


def _bounds(bounds: np.ndarray, dtype: DTypeLike | None) -> Any:
    """Returns one number if all bounds are equal, else a nested list; infinities as the strings ``inf`` and ``-inf``."""
    with np.errstate(over="ignore"):
        values = bounds.astype(dtype).astype(np.float64)
    numbers = np.array([v if np.isfinite(v) else str(v) for v in values.ravel().tolist()], object).reshape(values.shape)
    return numbers.flat[0] if values.size and (values == values.flat[0]).all() else numbers.tolist()


def as_batch(observation: Observation, space: spaces.Space, leaves: Sequence[Leaf]) -> tuple[Observation, bool]:
    """Returns observations as a batch of arrays of the right types, and whether it was a single observation.

    The arguments and errors are those of :func:`batch_arrays`.
    """
    arrays, single = batch_arrays(observation, space, leaves)
    return structure(space).unflatten(arrays), single


def batch_arrays(
    observation: Observation, space: spaces.Space, leaves: Sequence[Leaf]
) -> tuple[list[np.ndarray], bool]:
    """Returns the parts of observations as batches of the right types, and whether it was a single observation.

    Args:
        observation: one of ``space``, or a batch with a leading axis; arrays, or lists of numbers.
        space: the observation space.
        leaves: of ``space``.

    Raises:
        ValueError: if structure or shapes do not match, the parts are batches of different sizes, or numbers are not finite
            or cannot be what the space declares.
    """
    try:
        arrays = [np.asarray(leaf_values) for leaf_values in parts(space, observation)]
        if not {array.dtype.kind for array in arrays} <= {*"biuf"}:
            raise TypeError("there is something else than numbers")
        single = arrays[0].ndim == len(leaves[0].shape)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(
            f"the observation has the structure {described(observation)}, expected {space}, or a batch of it: "
            f"{' '.join(str(error).split())[:200]}"
        ) from None
    if not single and len({array.shape[:1] for array in arrays}) > 1:
        raise ValueError(
            f"the parts of the observations are batches of {[a.shape[:1] for a in arrays]}, not of one size"
        )
    for i, leaf in enumerate(leaves):
        array = arrays[i]
        try:
            if (array.shape if single else array.shape[1:]) != leaf.shape:
                raise ValueError(f"shape {array.shape}, expected {leaf.shape}, or a batch of it")
            arrays[i] = as_stored(array, leaf)
            if not is_finite(arrays[i]):
                raise ValueError("numbers that are NaN or infinite, expected finite numbers")
        except ValueError as error:
            raise ValueError(f"the observation{f' of {leaf.path!r}' if leaf.path else ''} has {error}") from None
    return [array[None] if single else array for array in arrays], single


def described(observation: Observation) -> str:
    """Returns the structure of an invalid observation, in words.

    >>> described({"goal": [0.0], "place": None}), described((1, 2))
    ('dict(goal: list, place: NoneType)', 'tuple(int, int)')
    """
    if isinstance(observation, Mapping):
        return f"dict({', '.join(f'{key}: {type(value).__name__}' for key, value in observation.items())})"
    if isinstance(observation, tuple):
        return f"tuple({', '.join(type(value).__name__ for value in observation)})"
    return type(observation).__name__
