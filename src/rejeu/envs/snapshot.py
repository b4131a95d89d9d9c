"""Snapshots of running environments, so that a run resumes in the middle of an episode.

Supported are Gymnasium's classic control and MuJoCo environments, ``rejeu/Ball-v0``, the wrappers of Gymnasium and
rejeu in :data:`REMEMBERED`, and any environment or wrapper with the two methods ::

    get_state() -> a dict of numbers, strings, lists, tuples, dicts and arrays
    set_state(state)

They must include the state of all wrapped environments and of the random number generators. The methods
``get_wrapper_state`` and ``set_wrapper_state`` of a wrapper concern only the wrapper itself. Box2D and highway-env are
not supported, because their state is not plain data.
"""

from __future__ import annotations

import copy
import types
import warnings
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal

import gymnasium as gym
import msgspec
import numpy as np
from gymnasium import wrappers
from gymnasium.envs import classic_control
from gymnasium.envs.registration import EnvSpec
from msgspec import Meta

from rejeu.core.errors import DivergedError
from rejeu.core.records import brief, encode
from rejeu.core.types import JsonObject

ABSENT = "absent"
"""Value of an attribute that does not exist yet, such as ``last_u`` before the first step."""
Integer = int | None | Literal["absent"]
Number = float | None | Literal["absent"]


def numbers(n: int) -> Any:
    """Returns the type of an attribute with ``n`` finite numbers, or None or missing before the first reset."""
    finite = Annotated[float, Meta(ge=-1e300, le=1e300)]
    return Annotated[list[finite], Meta(min_length=n, max_length=n)] | None | Literal["absent"]


REMEMBERED: dict[type, dict[str, Any]] = {
    wrappers.ClipAction: {},
    wrappers.ClipReward: {},
    wrappers.DtypeObservation: {},
    wrappers.FilterObservation: {},
    wrappers.FlattenObservation: {},
    wrappers.GrayscaleObservation: {},
    wrappers.PassiveEnvChecker: {},
    wrappers.RescaleAction: {},
    wrappers.RescaleObservation: {},
    wrappers.ReshapeObservation: {},
    wrappers.ResizeObservation: {},
    wrappers.TransformAction: {},
    wrappers.TransformObservation: {},
    wrappers.TransformReward: {},
    wrappers.TimeLimit: {"_elapsed_steps": Integer},
    wrappers.OrderEnforcing: {"_has_reset": bool},
    wrappers.RecordEpisodeStatistics: {
        "episode_count": int,
        "episode_returns": float | Annotated[list[float], Meta(min_length=1, max_length=1)],
        "episode_lengths": int,
    },
    classic_control.CartPoleEnv: {"state": numbers(4), "steps_beyond_terminated": Integer},
    classic_control.MountainCarEnv: {"state": numbers(2)},
    classic_control.Continuous_MountainCarEnv: {"state": numbers(2)},
    classic_control.PendulumEnv: {"state": numbers(2), "last_u": Number},
    classic_control.AcrobotEnv: {"state": numbers(4)},
}
"""Attributes with the full state of wrappers and environments, except for random numbers, and their types in a file."""
MUJOCO = "gymnasium.envs.mujoco."
MOST_OBJECTS, MOST_ITEMS, MOST_NUMBERS = 10_000, 1_000, 2**14
"""Upper limits of a fingerprint: its objects, the last items of each, and the numbers of an array, which is sampled."""
PLAIN = bool, int, float, str, bytes, np.generic, type(None)
COLLECTIONS = dict, list, tuple, set, deque
FIXED = type, types.ModuleType, gym.Space, EnvSpec
"""Types whose objects no step changes."""


def state_of(env: gym.Env) -> list[Any] | None:
    """Returns the state of each layer, outermost first; None if one of them is not supported.

    >>> env = gym.make("MountainCar-v0")
    >>> first, _ = env.reset(seed=0)
    >>> state = state_of(env)
    >>> after = env.step(2)[0]
    >>> restore(env, state)
    >>> bool((env.step(2)[0] == after).all())
    True
    """
    layers = [*layers_of(env)]
    states = [_state(layer) for layer in layers]
    if any(state is None for state in states):
        return None
    if not answers_for_itself(layers[-1]):
        states[-1]["rng"] = None if layers[-1]._np_random is None else layers[-1]._np_random.bit_generator.state
    return copy.deepcopy(states)


def layers_of(env: gym.Env) -> Iterator[Any]:
    """Yields wrappers, outermost first, and the environment, up to the first layer that answers for the rest."""
    layer: Any = env
    while isinstance(layer, gym.Wrapper) and not answers_for_itself(layer):
        yield layer
        layer = layer.env
    yield layer


def _state(layer: Any) -> Any:
    """Returns the state of a layer without its random numbers, None if it is not supported."""
    if answers_for_itself(layer):
        return _answer(layer.get_state)
    if saves_itself(layer):
        return _answer(layer.get_wrapper_state)
    if type(layer) in REMEMBERED:
        return {name: getattr(layer, name, ABSENT) for name in REMEMBERED[type(layer)]}
    return _mujoco_state(layer) if is_mujoco(layer) else None


def _answer(get: Callable[[], Any]) -> JsonObject | None:
    """Returns the state of an environment by its method; None, with a warning, if that is no dict of plain data.

    Some environments have a method of that name for other purposes.
    """
    try:
        encode(state := get(), {}, "the state")
        if not isinstance(state, dict):
            raise TypeError(f"the state is of type {type(state).__name__}, expected a dict")
    except Exception as error:  # the environment can raise anything
        warnings.warn(f"{get.__qualname__}: {brief(error)}; a resumed run begins new episodes", stacklevel=2)
        return None
    return state


def restore(env: gym.Env, layers: list[Any]) -> None:
    """Restores the state that :func:`state_of` returned.

    Raises:
        DivergedError: if the environment's own method fails.
        ValueError: if the environment has other layers, or the state is invalid.
    """
    env_layers = [*layers_of(env)]
    if len(layers) != len(env_layers) or not all(isinstance(state, dict) for state in layers):
        raise ValueError(f"the state is of another environment than {env}")
    for layer, state in zip(env_layers, layers, strict=True):
        _restore(layer, state)
    if not answers_for_itself(env_layers[-1]) and layers[-1]["rng"] is not None:
        env_layers[-1].np_random.bit_generator.state = layers[-1]["rng"]


def _restore(layer: Any, state: JsonObject) -> None:
    """Restores the state of a layer without its random numbers."""
    if answers_for_itself(layer) or saves_itself(layer):
        put = layer.set_state if answers_for_itself(layer) else layer.set_wrapper_state
        try:
            put(state)
        except Exception as error:  # the environment can raise anything
            raise DivergedError(f"{put.__qualname__}: {brief(error)}") from error
    elif type(layer) in REMEMBERED:
        types = REMEMBERED[type(layer)]
        check_types(layer, state, types if isinstance(layer, gym.Wrapper) else {**types, "rng": Any})
        for name in types:
            if not (isinstance(state[name], str) and state[name] == ABSENT):
                setattr(layer, name, state[name])
        if isinstance(layer, wrappers.PassiveEnvChecker):  # the environment was checked at the start of the run
            vars(layer).update({name: True for name in vars(layer) if name.startswith("checked_")})
    elif is_mujoco(layer):
        _put_mujoco(layer, state)
    else:
        raise ValueError(f"{type(layer).__name__} does not support snapshots")


def check_count(states: object, n_envs: int) -> None:
    """Raises ``ValueError`` unless ``states`` is a list with one entry per environment."""
    if not isinstance(states, list) or len(states) != n_envs:
        raise ValueError(f"the states are not those of {n_envs} environments")


def is_over(env: gym.Env) -> bool:
    """Returns whether an environment must be reset before the next step, as far as its layers report it."""
    *outer, layer = layers_of(env)
    for wrapper in outer:
        if saves_itself(wrapper) and getattr(wrapper, "needs_reset", False):
            return True
        if isinstance(wrapper, wrappers.OrderEnforcing) and not wrapper._has_reset:
            return True
        if isinstance(wrapper, wrappers.TimeLimit) and wrapper._elapsed_steps is None:
            return True
    if answers_for_itself(layer):
        return bool(getattr(layer, "needs_reset", False))
    return "state" in REMEMBERED.get(type(layer), {}) and getattr(layer, "state", None) is None


def check_types(layer: gym.Env, state: Mapping[str, object], types: Mapping[str, object]) -> None:
    """Checks attributes of an environment or wrapper that were read from a file.

    Raises:
        ValueError: if names differ, or a value has the wrong type.
    """
    if {*state} != {*types}:
        raise ValueError(f"the state of {type(layer).__name__} has {sorted(state)}, expected {sorted(types)}")
    for name, value_type in types.items():
        try:
            msgspec.convert(np.asarray(state[name]).tolist(), value_type)
        except msgspec.ValidationError as error:
            value = str(state[name])[:40]
            raise ValueError(f"{name} of {type(layer).__name__} cannot be {value!r}: {error}") from None


def answers_for_itself(layer: gym.Env) -> bool:
    """Returns whether an environment or wrapper defines ``get_state`` and ``set_state``."""
    has = callable(getattr(type(layer), "get_state", None)) and callable(getattr(type(layer), "set_state", None))
    return has and not is_mujoco(layer)  # MuJoCo's set_state has a different signature


def saves_itself(layer: gym.Env) -> bool:
    """Returns whether this is a wrapper with ``get_wrapper_state`` and ``set_wrapper_state``."""
    methods = (getattr(type(layer), f"{verb}_wrapper_state", None) for verb in ("get", "set"))
    return isinstance(layer, gym.Wrapper) and all(map(callable, methods))


def is_mujoco(layer: gym.Env) -> bool:
    """Returns whether an environment is one of Gymnasium's MuJoCo environments."""
    return type(layer).__module__.startswith(MUJOCO)


def _mujoco_state(env: Any) -> JsonObject:
    import mujoco

    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.zeros(mujoco.mj_stateSize(env.model, spec))
    mujoco.mj_getState(env.model, env.data, state, spec)
    return {"integration": state}


def _put_mujoco(env: Any, state: JsonObject) -> None:
    import mujoco

    spec = mujoco.mjtState.mjSTATE_INTEGRATION
    numbers = state.get("integration")
    if not isinstance(numbers, np.ndarray) or numbers.shape != (mujoco.mj_stateSize(env.model, spec),):
        raise ValueError(f"the state is of another model than {type(env).__name__}'s")
    mujoco.mj_setState(env.model, env.data, numbers, spec)
    mujoco.mj_forward(env.model, env.data)
    mujoco.mj_setState(env.model, env.data, numbers, spec)  # mj_forward changed the warm start of the solver


def fingerprint(env: Any) -> int:
    """Returns a number that differs after environments, or a vector of them, were stepped or reset.

    It is computed from all numbers, strings and arrays within the Python objects that are reached from ``env``, the nearest
    ones first. What only objects of other languages hold is not seen; counters of wrappers such as ``TimeLimit`` are.
    """
    visited, waiting, digest = dict[int, Any](), deque([env]), 0  # seen keeps objects, so that no other gets their id
    while waiting and len(visited) < MOST_OBJECTS:
        value, content = waiting.popleft(), b""
        if isinstance(value, PLAIN):
            content = repr(value).encode()
        elif isinstance(value, np.ndarray) and value.dtype.kind != "O":
            content = value.ravel()[:: 1 + value.size // MOST_NUMBERS].tobytes()
        elif id(value) not in visited and not isinstance(value, FIXED):
            visited[id(value)], content = value, type(value).__qualname__.encode()
            items = [len(value), *value] if isinstance(value, COLLECTIONS) else []
            items += value.values() if isinstance(value, dict) else []
            is_generator = isinstance(value, np.random.Generator)
            inside = value.bit_generator.state if is_generator else getattr(value, "__dict__", {})
            waiting.extend([*items[-MOST_ITEMS:], *inside.values()])
        digest = zlib.crc32(content, digest)
    return digest
