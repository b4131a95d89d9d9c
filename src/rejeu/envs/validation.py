"""The values that environments may return: what is accepted, how it is converted and written into batches, and faults.

Every function named ``*_fault`` returns one sentence that says what was received, what was expected and how to fix it, or
None where nothing is wrong. Those functions run once something has failed, and in :func:`rejeu.check_env`; while all is well,
the loops pay for a few comparisons only.

Accepted although the space declares something else: other dtypes whose values are kept, NumPy's scalars, and 0 and 1 as
booleans.
"""

from __future__ import annotations

import copy
import inspect
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import DTypeLike

from rejeu.core.errors import BadEnvironmentError
from rejeu.core.spaces import Leaf, as_stored, cast, keeps_values, leaves, limits, parts
from rejeu.core.types import Action, Info, Observation, PyTree, Settings

FLAGS = frozenset((bool, np.bool_))
"""Types of ``terminated`` and ``truncated``."""
NUMBERS = frozenset((float, int, np.float64, np.float32, np.int64, np.int32))
"""Types of rewards that need no conversion."""
LARGEST = float(np.finfo(np.float32).max)
"""The largest reward that float32 can hold."""
STEP_VALUES = "(obs, reward, terminated, truncated, info)"
FAR = 10.0
"""Warn if an observation is outside its bounds by more than this multiple of their distance."""
LEAST_CHANGE = 1e-4
"""Smallest change of a number in a step that must not be lost."""
TERMINATED_AND_TRUNCATED = (
    "terminated says that the task itself ended, truncated that a time limit cut the episode off; return both as bools"
)


def to_array(value: object, leaf: Leaf) -> np.ndarray:
    """Returns one value of a leaf as an array of its shape and dtype.

    Raises:
        ValueError: if the shape differs, or for values of :func:`rejeu.core.spaces.as_stored`.
    """
    array = np.asarray(value)
    if array.shape != leaf.shape:
        raise ValueError(f"shape {array.shape}")
    return as_stored(array, leaf)


def convert_step(result: Any) -> tuple[Observation, float, bool, bool, Info]:
    """Returns the five values that ``step`` returned, with reward and flags as Python scalars.

    Raises any exception if they are invalid; :func:`step_fault` then describes what is wrong.
    """
    obs, reward, terminated, truncated, info = result
    # A copy of the info, because an environment may empty its only dict at the next reset.
    return obs, to_reward(reward), to_bool(terminated), to_bool(truncated), {**info}


def to_reward(reward: Any) -> float:
    """Returns a reward as a float; arrays of one number are accepted, None and strings are not.

    Raises:
        OverflowError: if it is finite and beyond ``LARGEST``.
        TypeError, ValueError: if it is not a number.
    """
    if type(reward) in NUMBERS:
        number = float(reward)
    elif reward is None or isinstance(reward, str | bytes):
        raise TypeError("not a number")
    else:
        number = float(np.asarray(reward, np.float64).reshape(()) if np.size(reward) == 1 else reward)
    if LARGEST < abs(number) < math.inf:
        raise OverflowError("more than a float32 holds")
    return number


def to_bool(flag: Any) -> bool:
    """Returns ``terminated`` or ``truncated`` as a bool; zeros and ones are accepted, None and strings are not.

    Raises:
        TypeError, ValueError: if it is neither.
    """
    if type(flag) in FLAGS:
        return bool(flag)
    if flag is None or isinstance(flag, str | bytes) or np.size(flag) != 1:
        raise TypeError("not a bool")
    number = np.asarray(flag).reshape(())
    if number.dtype.kind not in "fiub" or number not in (0, 1):
        raise ValueError("not a bool")
    return bool(number)


def make_writer(space: spaces.Space, stores: Sequence[np.ndarray]) -> Callable[[int, Any], None]:
    """Returns ``put(i, observation)``, which writes one observation into row ``i`` of each of the ``stores``.

    ``stores`` hold the leaves of ``space`` in the order of :func:`rejeu.core.spaces.leaves`, ``(n_envs, *leaf.shape)``, of the
    kept dtypes. Values of another dtype are cast if only precision is lost. ``put`` raises any exception for an invalid
    observation; :func:`observation_fault` then describes what is wrong.
    """
    slots = [
        (store, leaf, math.prod(leaf.shape), subspace.dtype if is_free(leaf, subspace) else None, np.ndarray)
        for store, leaf, subspace in zip(stores, leaves(space), parts(space, space), strict=True)
    ]
    store, leaf, size, dtype, array = slots[0]

    def put_array(i: int, obs: Observation) -> None:
        # As many numbers as are expected can only be broadcast from shapes with leading ones, which is harmless.
        if type(obs) is not array or obs.size != size or obs.dtype is not dtype:
            obs = to_array(obs, leaf)
        store[i] = obs

    def put_parts(i: int, obs: Observation) -> None:
        for (store, leaf, size, dtype, array), value in zip(slots, parts(space, obs), strict=True):
            if type(value) is not array or value.size != size or value.dtype is not dtype:
                value = to_array(value, leaf)
            store[i] = value

    return put_parts if isinstance(space, spaces.Dict | spaces.Tuple) else put_array


def is_free(leaf: Leaf, space: spaces.Space) -> bool:
    """Returns whether a leaf holds every value of the space's dtype, which then needs no look."""
    return isinstance(space, spaces.Box) and (leaf.dtype[0] == "f" or np.can_cast(space.dtype, leaf.dtype))


def called_reset(env: gym.Env, seed: int | None = None, options: Info | None = None) -> Any:
    """Returns the result of ``reset``, given ``seed`` and ``options`` only if they are not None.

    Raises:
        BadEnvironmentError: if it does not accept a seed, or not this one.
    """
    arguments = {key: value for key, value in (("seed", seed), ("options", options)) if value is not None}
    try:
        return env.reset(**arguments)  # type: ignore[arg-type]
    except Exception as error:
        if (fault := seed_fault(env, seed, options, error)) is not None:
            raise BadEnvironmentError(fault) from error
        raise


def seed_fault(env: gym.Env, seed: int | None, options: Info | None, error: Exception) -> str | None:
    """Describes why ``reset`` raised an error because of its seed; None if the seed is not the reason."""
    if seed is None:
        return None
    if isinstance(error, TypeError) and (fault := arguments_fault(env)) is not None:
        return fault
    if not _resets(env, {} if options is None else {"options": options}):
        return None
    return (
        f"reset(seed={seed}) raised {type(error).__name__}: {error}, and reset without a seed does not; accept every seed "
        "from 0 to 2**31 - 2, of which rejeu chose this one, or give one seed for each environment: "
        "rejeu.make_vector(env, 2, seed=[0, 1])"
    )


def _resets(env: gym.Env, arguments: Settings) -> bool:
    """Returns whether an environment can be reset without a seed."""
    try:
        env.reset(**arguments)
    except Exception:  # whatever it raises
        return False
    return True


def reset_env(env: gym.Env, seed: int | None = None, options: Info | None = None) -> tuple[Observation, Info]:
    """Resets an environment and returns the observation and the info; see :func:`called_reset`.

    Raises:
        BadEnvironmentError: if it does not accept a seed, or does not return an observation of its space and a dict.
    """
    result = called_reset(env, seed, options)
    if (fault := reset_fault(result, env.observation_space)) is not None:
        raise BadEnvironmentError(fault)
    return result


def step_env(env: gym.Env, action: Action) -> tuple[Observation, float, bool, bool, Info]:
    """Steps an environment and returns the result, with numbers as Python scalars.

    Raises:
        BadEnvironmentError: if ``step`` does not return the five values, or the observation does not match its space.
    """
    result = env.step(action)
    if (fault := step_fault(result, env.observation_space)) is not None:
        raise BadEnvironmentError(fault)
    return convert_step(result)


def copy_observation(space: spaces.Space, obs: Observation) -> Any:
    """Returns a copy of a valid observation, in which every leaf can be cast to the declared dtype."""
    if isinstance(space, spaces.Dict):
        return {key: copy_observation(subspace, obs[key]) for key, subspace in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(copy_observation(subspace, value) for subspace, value in zip(space.spaces, obs, strict=True))
    dtype = np.dtype(space.dtype)
    if isinstance(obs, np.ndarray) and np.can_cast(obs.dtype, dtype, "same_kind"):
        return obs.copy()
    return copy.deepcopy(obs) if np.isscalar(obs) else np.asarray(obs).astype(dtype)


def to_batch(space: spaces.Space, space_leaves: tuple[Leaf, ...], n_envs: int, obs: Observation) -> Any:
    """Returns the observations of a vector environment, converted by :func:`rejeu.core.spaces.cast`.

    Raises:
        BadEnvironmentError: with the description only, if they are not ``(n_envs, *leaf.shape)`` at every leaf.
    """
    try:
        arrays = cast(space, space_leaves, obs)
    except Exception as error:  # any exception of NumPy for a value of the wrong type or shape
        raise BadEnvironmentError(
            f"observations as {describe_value(obs)}, expected a batch of {space}: {error}"
        ) from error
    for leaf, array in zip(space_leaves, parts(space, arrays), strict=True):
        if array.shape != (n_envs, *leaf.shape):
            raise BadEnvironmentError(
                f"{leaf_name(leaf.path)} of all environments of shape {array.shape}, expected {(n_envs, *leaf.shape)}; one "
                "row for each environment"
            )
    return arrays


def to_vector(name: str, values: object, n_envs: int, dtype: DTypeLike) -> np.ndarray:
    """Returns the rewards or flags that a vector environment returned, ``dtype (n_envs,)``.

    Raises:
        BadEnvironmentError: with the description only, if they are not numbers of that shape.
    """
    array = np.asarray(values)
    if array.shape != (n_envs,) or array.dtype.kind not in ("fiub" if dtype == np.float32 else "iub"):
        wanted = "numbers" if dtype == np.float32 else "bools"
        raise BadEnvironmentError(f"{name} as {describe_value(values)}, expected {wanted} of shape ({n_envs},)")
    with np.errstate(over="ignore"):
        vector = array.astype(dtype, copy=False)
    if dtype == np.float32 and not math.isfinite(np.vdot(vector, vector)):
        large = array[np.isinf(vector) & np.isfinite(array)]
        if large.size:
            raise BadEnvironmentError(reward_fault(large[0].item()))
    return vector


def environment_fault(env: Any, expected: str = "a gymnasium.Env") -> str | None:
    """Describes why an object is not a Gymnasium environment."""
    if isinstance(env, gym.Env):
        missing = [name for name in ("observation_space", "action_space") if not hasattr(env, name)]
        name = type(env.unwrapped).__name__
        return f"{name} has no {' and no '.join(missing)}; set it in __init__" if missing else None
    name, fix = type(env).__name__, "derive its class from gymnasium.Env"
    if callable(env):
        name = f"the {'class' if isinstance(env, type) else 'function'} {getattr(env, '__name__', name)}"
        fix = "call it"
    elif isinstance(env, str):
        fix = f"make it: gymnasium.make({env!r:.60})"
    elif hasattr(env, "possible_agents"):
        name += ", an environment of several agents as PettingZoo's"
        fix = "rejeu trains one: derive a class from gymnasium.Env in which one of them acts, and the others are its world"
    elif hasattr(env, "action_spec"):
        name += ", as dm_control's"
        fix = "wrap it: shimmy.DmControlCompatibilityV0(env)"
    elif hasattr(env, "num_envs") or hasattr(env, "n_envs"):
        name += ", several environments as one"
        fix = "give a single one"
    elif hasattr(env, "reset") and hasattr(env, "step"):
        fix += ", or wrap it, if it is of the old package gym or in its style: rejeu.OldEnvironment(env)"
    return f"env must be {expected}, got {name}; {fix}"


def arguments_fault(env: gym.Env) -> str | None:
    """Describes which of an environment and its wrappers cannot be reset with a seed, or with the options of a wrapper."""
    layer: Any = env
    while layer is not None:
        parameters = inspect.signature(layer.reset).parameters
        needed = ("seed",) if layer is env else ("seed", "options")  # of which wrappers pass on both
        missing = [name for name in needed if name not in parameters]
        if missing and all(parameter.kind is not parameter.VAR_KEYWORD for parameter in parameters.values()):
            return (
                f"{type(layer).__name__}.reset({', '.join(parameters)}) takes no {missing[0]}, expected "
                "reset(*, seed=None, options=None); add the arguments, and call super().reset(seed=seed) in it"
            )
        layer = getattr(layer, "env", None) if isinstance(layer, gym.Wrapper) else None
    return None


def reset_fault(result: object, space: spaces.Space) -> str | None:
    """Describes what is wrong with what ``reset`` returned."""
    if not isinstance(result, tuple) or len(result) != 2 or not isinstance(result[1], dict):
        only = observation_fault(space, result) is None
        got = "the observation only" if only else f"{describe_value(result)}"
        return f"reset returned {got}, expected (obs, info); return obs, {{}} if there is nothing to say"
    fault = observation_fault(space, result[0])
    return None if fault is None else f"reset returned {fault}"


def step_fault(result: object, space: spaces.Space) -> str | None:
    """Describes what is wrong with what ``step`` returned."""
    return next((fault for _, fault in step_faults(result, space)), None)


def step_faults(result: object, space: spaces.Space, strict: bool = False) -> Iterator[tuple[str, str]]:
    """Yields everything that is wrong with what ``step`` returned, after the name of the value that it is in.

    ``step`` stands for the observation and for the whole. For ``strict`` see :func:`reward_fault` and :func:`flag_fault`.
    """
    if not isinstance(result, tuple) or len(result) != 5:
        got = f"{len(result)} values" if isinstance(result, tuple) else describe_value(result)
        old = " as in the old package gym" if isinstance(result, tuple) and len(result) == 4 else ""
        yield "step", f"step returned {got}{old}, expected {STEP_VALUES}; {TERMINATED_AND_TRUNCATED}"
        return
    obs, reward, terminated, truncated, info = result
    for name, fault in (
        ("step", observation_fault(space, obs)),
        ("reward", reward_fault(reward, strict)),
        ("terminated", flag_fault("terminated", terminated, strict)),
        ("truncated", flag_fault("truncated", truncated, strict)),
        ("info", info_fault(info)),
    ):
        if fault is not None:
            yield name, f"step returned {fault}"


def reward_fault(reward: Any, strict: bool = False) -> str | None:
    """Describes what is wrong with a reward; if ``strict``, an array of one number and what is not finite are wrong too.

    The loops look at whether rewards are finite themselves, all of a step at once.
    """
    fix = "expected one finite number; return float(reward)"
    if reward is None:
        return "the reward None, expected one finite number; is a return value missing on some way through step?"
    if np.size(reward) != 1 or (strict and np.ndim(reward) > 0):
        hint = "sum or average it: float(reward.sum())" if np.size(reward) > 1 else "return float(reward[0])"
        return f"a reward of shape {np.shape(reward)}, expected one finite number; {hint}"
    try:
        number = to_reward(reward)
    except OverflowError:
        return f"the reward {reward!r:.40}, beyond {LARGEST:.3g}, the largest that float32 holds; scale rewards down"
    except (TypeError, ValueError):
        return f"the reward {describe_value(reward)}, {fix}"
    if strict and not np.isfinite(number):
        return f"the reward {reward}, {fix}, and look for divisions by zero"
    return None


def info_fault(info: object) -> str | None:
    """Describes what is wrong with an info."""
    if isinstance(info, dict):
        return None
    return f"the info {describe_value(info)}, expected a dict; return {{}} if there is nothing to say"


def flag_fault(name: str, flag: object, strict: bool = False) -> str | None:
    """Describes what is wrong with ``terminated`` or ``truncated``; if ``strict``, zeros and ones are wrong too."""
    try:
        to_bool(flag)
        fits = not strict or type(flag) in FLAGS
    except (TypeError, ValueError):
        fits = False
    if fits:
        return None
    hint = " (is the info in its place, as in the old package gym?)" if isinstance(flag, dict) else ""
    return f"{name}={flag!r:.80} of type {type(flag).__name__}{hint}, expected a bool; {TERMINATED_AND_TRUNCATED}"


def observation_fault(space: spaces.Space, obs: Observation, path: str = "", strict: bool = False) -> str | None:
    """Describes what is wrong with the structure, shape or dtype of one observation.

    Args:
        space: the declared space.
        obs: the value that was returned.
        path: where it sits in the whole observation.
        strict: whether anything else than the declared dtype, a key too many or a list for an array is wrong as well; in
            training these are cast, ignored and turned into arrays.
    """
    name = leaf_name(path)
    if isinstance(space, spaces.Dict):
        keys = sorted(space.spaces)
        if not isinstance(obs, Mapping):
            return f"{name} as {describe_value(obs)}, expected a dict with the keys {', '.join(keys)}"
        missing = [key for key in keys if key not in obs]
        extra = [str(key) for key in obs if key not in space.spaces] if strict else []
        if missing or extra:
            fix = f"add {', '.join(missing)}" if missing else f"declare or leave out {', '.join(extra)}"
            return f"{name} with the keys {', '.join(sorted(map(str, obs)))}, expected {', '.join(keys)}; {fix}"
        inner = [(key, space.spaces[key], obs[key]) for key in keys]
    elif isinstance(space, spaces.Tuple):
        n = len(space.spaces)
        if not isinstance(obs, tuple | list) or len(obs) != n:
            got = f"{len(obs)} parts" if isinstance(obs, tuple | list) else describe_value(obs)
            return f"{name} as {got}, expected a tuple of {n} parts"
        inner = [(str(i), subspace, value) for i, (subspace, value) in enumerate(zip(space.spaces, obs, strict=True))]
    else:
        return _array_fault(space, obs, name, strict)
    faults = (observation_fault(subspace, value, f"{path}.{key}".lstrip("."), strict) for key, subspace, value in inner)
    return next((fault for fault in faults if fault is not None), None)


def _array_fault(space: spaces.Space, obs: Observation, name: str, strict: bool) -> str | None:
    """Describes what is wrong with one array of an observation."""
    (leaf,) = leaves(space)
    try:
        array = np.asarray(obs)
    except ValueError:
        return f"{name} as {describe_value(obs)}, expected an array of shape {leaf.shape}"
    if array.dtype.kind not in "fiub":
        return f"{name} as {describe_value(obs)}, expected numbers of shape {leaf.shape} and dtype {space.dtype}"
    if array.shape != leaf.shape:
        has_size = array.size == math.prod(leaf.shape)
        fix = f"return it with .reshape({leaf.shape})" if has_size else "return the declared shape"
        return f"{name} of shape {array.shape}, expected {leaf.shape}; {fix}, or declare {array.shape} in the space"
    if not keeps_values(array, leaf.dtype):
        with np.errstate(invalid="ignore", over="ignore"):
            at = tuple(np.argwhere(array.astype(leaf.dtype) != array)[0].tolist())
        fix = "multiply by 255 first if the numbers lie in [0, 1], or " if leaf.kind == "image" else ""
        fix += f"declare Box(..., dtype=np.{'float32' if array.dtype.kind == 'f' else array.dtype})"
        if array.dtype == space.dtype:
            fix = "declare the bounds that it really has"
        held = f"{name} of dtype {array.dtype}, expected {leaf.dtype if array.dtype == space.dtype else space.dtype}"
        return f"{held}, which cannot hold {array[at]}{_place(at)}; {fix}"
    if not strict and leaf.kind in ("categorical", "binary") and (outside := bounds_fault(space, obs)) is not None:
        return outside[1].replace(leaf_name(""), name, 1)
    if strict and isinstance(space, spaces.Box) and array.dtype != space.dtype:
        return f"{name} of dtype {array.dtype}, expected {space.dtype}; return it with .astype(np.{space.dtype})"
    if strict and not isinstance(space, spaces.Discrete) and not isinstance(obs, np.ndarray | np.generic):
        return f"{name} as {describe_value(obs)}, expected an array; return np.array(..., np.{space.dtype})"
    return None


def nonfinite_fault(space: spaces.Space, obs: Observation) -> str | None:
    """Describes which number of one observation of the right structure is not finite."""
    for leaf, value in zip(leaves(space), parts(space, obs), strict=True):
        array = np.asarray(value)
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            at = tuple(np.argwhere(~np.isfinite(array))[0].tolist())
            number = f"{leaf_name(leaf.path)} with {array[at]}{_place(at)}"
            return f"{number}, expected finite numbers; look for divisions by zero and overflows"
    return None


def bounds_fault(space: spaces.Space, obs: Observation) -> tuple[Literal["error", "warning"], str] | None:
    """Describes which number of one observation of the right structure lies outside of the declared bounds.

    A warning for a Box, whose bounds networks never see; an error for choices and bits, which would have no place in one.
    """
    for leaf, subspace, value in zip(leaves(space), parts(space, space), parts(space, obs), strict=True):
        array = np.asarray(value)
        if isinstance(subspace, spaces.Box):
            low, high = subspace.low, subspace.high
        else:
            low, high = limits(leaf)
        outside = np.argwhere((array < low) | (array > high))
        if len(outside):
            at = tuple(outside[0].tolist())
            more = f" (and {len(outside) - 1} more)" if len(outside) > 1 else ""
            return "warning" if leaf.kind in ("continuous", "image") else "error", (
                f"{leaf_name(leaf.path)} with {array[at]}{_place(at)}{more}, outside of the declared bounds "
                f"[{low[at]}, {high[at]}]; declare the bounds that it really has, or clip it"
            )
    return None


def far_outside(space: spaces.Space, obs: Observation) -> str | None:
    """Describes which number of a batch of observations lies far outside of the declared bounds.

    Far is ``FAR`` times the distance of the two bounds. Images cannot lie outside, and what is unbounded is not looked at.
    """
    for leaf, subspace, array in zip(leaves(space), parts(space, space), parts(space, obs), strict=True):
        if leaf.kind != "continuous":
            continue
        assert isinstance(subspace, spaces.Box)
        low, high = subspace.low.astype(np.float64), subspace.high.astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            width = high - low
            outside = np.argwhere(((array < low - FAR * width) | (array > high + FAR * width)) & (width > 0))
        if len(outside):
            env, *at = outside[0].tolist()
            where = tuple(at)
            return (
                f"{leaf_name(leaf.path)} with {array[env, *where]:.4g}{_place(where)} in environment {env}, far outside of "
                f"the declared bounds [{subspace.low[where]:.4g}, {subspace.high[where]:.4g}]"
            )
    return None


def lost_change(space: spaces.Space, before: PyTree, after: PyTree) -> str | None:
    """Describes which number of an observation changed in a step, and not in float32; None if there is none.

    Changes of less than ``LEAST_CHANGE`` do not count: they are the rounding of simulations.
    """
    for leaf, old, new in zip(leaves(space), parts(space, before), parts(space, after), strict=True):
        old, new = np.asarray(old), np.asarray(new)
        if leaf.kind == "continuous" and new.dtype.itemsize > 4:
            with np.errstate(over="ignore", invalid="ignore"):
                is_same = old.astype(np.float32) == new.astype(np.float32)
                lost = np.argwhere((np.abs(new.astype(np.float64) - old) > LEAST_CHANGE) & is_same)
            if len(lost):
                at = tuple(lost[0].tolist())
                return (
                    f"{leaf_name(leaf.path)} went from {old[at]} to {new[at]}{_place(at)} in a step, and networks compute "
                    f"with float32, which holds both as {np.float32(new[at])}; subtract an offset, or scale it"
                )
    return None


def _place(at: tuple[int, ...]) -> str:
    return f" at index {at[0] if len(at) == 1 else at}" if at else ""


def leaf_name(path: str) -> str:
    """Returns the name of a leaf of an observation for a message."""
    return f"the observation under {path!r}" if path else "the observation"


def describe_value(value: object) -> str:
    """Returns a description of a value: its type, and its shape or beginning."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape} and dtype {value.dtype}"
    if isinstance(value, tuple | list):
        return f"a {type(value).__name__} of {len(value)} values"
    if isinstance(value, Mapping):
        return f"a dict with the keys {', '.join(map(str, value))}"
    return "None" if value is None else f"{value!r:.80} of type {type(value).__name__}"


def with_location(env_id: str, env: int | None, n_steps: int, fault: str) -> str:
    """Returns a message that starts with the environment, its index in the vector (None: unknown), and the step.

    >>> with_location("Walk", 2, 7, "step returned 4 values")
    'Walk, environment 2, step 7: step returned 4 values'
    """
    where = "one of the environments" if env is None else f"environment {env}"
    when = f"step {n_steps}" if n_steps else "the first reset"
    return f"{env_id}, {where}, {when}: {fault}"


def id_of(env: gym.Env) -> str:
    """Returns the id of an environment, or the name of its class."""
    return env.spec.id if env.spec is not None else type(env.unwrapped).__name__
