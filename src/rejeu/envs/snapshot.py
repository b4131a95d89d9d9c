"""The whole state of a running environment, taken out and put back, so that a run resumes in the middle of an episode.

It can be saved where it is known what an environment remembers: Gymnasium's classic control and MuJoCo environments, the
ball, and any environment or wrapper with the two methods ::

    get_state() -> a dict of numbers, texts, lists, tuples, dicts and arrays
    set_state(state)

which then answer for themselves and everything inside, random numbers included; around them, the wrappers of Gymnasium and
rejeu that are listed here, and wrappers with the two methods ``get_wrapper_state`` and ``set_wrapper_state``, which answer
for the wrapper alone. It cannot be saved of Box2D and highway-env, whose worlds are not plain data.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import wrappers
from gymnasium.envs import classic_control

from rejeu.envs.ball.ball import Ball
from rejeu.envs.mask_wrapper import MaskInObservation

STATELESS = (
    wrappers.ClipAction,
    wrappers.ClipReward,
    wrappers.DtypeObservation,
    wrappers.FilterObservation,
    wrappers.FlattenObservation,
    wrappers.GrayscaleObservation,
    wrappers.RescaleAction,
    wrappers.RescaleObservation,
    wrappers.ReshapeObservation,
    wrappers.ResizeObservation,
    wrappers.TransformAction,
    wrappers.TransformObservation,
    wrappers.TransformReward,
    MaskInObservation,
)
"""Wrappers that remember nothing from step to step."""
REMEMBERED: dict[type, tuple[str, ...]] = {
    wrappers.TimeLimit: ("_elapsed_steps",),
    wrappers.OrderEnforcing: ("_has_reset",),
    wrappers.PassiveEnvChecker: (),
    wrappers.RecordEpisodeStatistics: ("episode_count", "episode_returns", "episode_lengths"),
    classic_control.CartPoleEnv: ("state", "steps_beyond_terminated"),
    classic_control.MountainCarEnv: ("state",),
    classic_control.Continuous_MountainCarEnv: ("state",),
    classic_control.PendulumEnv: ("state", "last_u"),
    classic_control.AcrobotEnv: ("state",),
}
"""Attributes that hold all that wrappers and environments remember, beside the random numbers of the latter."""
SIZES: dict[type, int] = {
    classic_control.CartPoleEnv: 4,
    classic_control.MountainCarEnv: 2,
    classic_control.Continuous_MountainCarEnv: 2,
    classic_control.PendulumEnv: 2,
    classic_control.AcrobotEnv: 4,
}
"""How many numbers the ``state`` of an environment is."""
MUJOCO = "gymnasium.envs.mujoco."
OPTIONAL = ("state", "steps_beyond_terminated", "last_u", "_elapsed_steps")
"""Attributes that may be None, or not be there yet."""
ABSENT = "absent"
"""Stands for an attribute that is not there yet, as ``last_u`` before the first step."""


def state_of(env: gym.Env) -> list[Any] | None:
    """Returns what each layer remembers, outermost first, None if one of them cannot be carried.

    >>> env = gym.make("MountainCar-v0")
    >>> first, _ = env.reset(seed=0)
    >>> state = state_of(env)
    >>> after = env.step(2)[0]
    >>> restore(env, state)
    >>> bool((env.step(2)[0] == after).all())
    True
    """
    layers: list[Any] = []
    layer: gym.Env = env
    while True:
        if answers_for_itself(layer):
            return [*layers, layer.get_state()]  # type: ignore[attr-defined]
        kind = type(layer)
        if kind in STATELESS:
            layers.append({})
        elif saves_itself(layer):
            layers.append(layer.get_wrapper_state())  # type: ignore[attr-defined]
        elif kind in REMEMBERED:
            layers.append({name: getattr(layer, name, ABSENT) for name in REMEMBERED[kind]})
        elif not is_mujoco(layer):
            return None
        if not isinstance(layer, gym.Wrapper):
            layers.append({**(_mujoco_state(layer) if is_mujoco(layer) else layers.pop()), "rng": _rng(layer)})
            return _copied(layers)
        layer = layer.env


def restore(env: gym.Env, layers: list[Any]) -> None:
    """Puts back what :func:`state_of` returned.

    Raises:
        ValueError: if the environment has other layers.
    """
    layer, left = env, list(layers)
    while True:
        if not left or not isinstance(left[0], dict):
            raise ValueError(f"the state is of another environment than {env}")
        state = left.pop(0)
        if answers_for_itself(layer):
            layer.set_state(state)  # type: ignore[attr-defined]
        elif saves_itself(layer):
            layer.set_wrapper_state(state)  # type: ignore[attr-defined]
        elif type(layer) in STATELESS or type(layer) in REMEMBERED:
            expected = {*REMEMBERED.get(type(layer), ())} | ({"rng"} if not isinstance(layer, gym.Wrapper) else set())
            if {*state} != expected:
                raise ValueError(
                    f"the state of {type(layer).__name__} has {sorted(state)}, expected {sorted(expected)}"
                )
            for name in REMEMBERED.get(type(layer), ()):
                _check_form(layer, name, state[name])
                if not (isinstance(state[name], str) and state[name] == ABSENT):
                    setattr(layer, name, state[name])
            if isinstance(layer, wrappers.PassiveEnvChecker):  # which checked it where the run began
                vars(layer).update({name: True for name in vars(layer) if name.startswith("checked_")})
        elif is_mujoco(layer):
            _put_mujoco(layer, state)
        else:
            raise ValueError(f"{type(layer).__name__} has no state that can be put back")
        if answers_for_itself(layer) or not isinstance(layer, gym.Wrapper):
            break
        layer = layer.env
    if left:
        raise ValueError(f"the state is of another environment than {env}")
    if not answers_for_itself(layer) and state["rng"] is not None:
        layer.unwrapped.np_random.bit_generator.state = state["rng"]


def check_count(states: Any, n_envs: int) -> None:
    """Raises ``ValueError`` unless ``states`` is a list with one entry per environment."""
    if not isinstance(states, list) or len(states) != n_envs:
        raise ValueError(f"the states are not those of {n_envs} environments")


def is_over(env: gym.Env) -> bool:
    """Returns whether an environment must be reset before it can be stepped, as far as its layers say so."""
    layer = env
    while isinstance(layer, gym.Wrapper):
        if saves_itself(layer) and getattr(layer, "needs_reset", False):
            return True
        if isinstance(layer, wrappers.OrderEnforcing) and not layer._has_reset:
            return True
        if isinstance(layer, wrappers.TimeLimit) and layer._elapsed_steps is None:
            return True
        layer = layer.env
    return layer.over if isinstance(layer, Ball) else type(layer) in SIZES and getattr(layer, "state", None) is None


def _check_form(layer: gym.Env, name: str, value: Any) -> None:
    """Raises ``ValueError`` unless an attribute of a layer may have this value, which comes from a file."""
    if name in OPTIONAL and (value is None or (isinstance(value, str) and value == ABSENT)):
        return
    if name == "state":  # an array, or after some steps a tuple of numbers
        whole = isinstance(value, np.ndarray) or (isinstance(value, tuple) and all(map(is_number, value)))
        fits = whole and np.shape(value) == (SIZES[type(layer)],) and bool(np.isfinite(value).all())
    elif name == "_has_reset":
        fits = isinstance(value, bool)
    else:
        fits = is_number(value) or (name == "episode_returns" and isinstance(value, np.ndarray) and value.size == 1)
    if not fits:
        raise ValueError(f"{name} of {type(layer).__name__} cannot be {str(value)[:40]!r}")


def is_number(value: Any) -> bool:
    """Returns whether a value is a real number."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def answers_for_itself(layer: gym.Env) -> bool:
    """Returns whether an environment or wrapper has ``get_state`` and ``set_state`` of its own."""
    has = callable(getattr(type(layer), "get_state", None)) and callable(getattr(type(layer), "set_state", None))
    return has and not is_mujoco(layer)  # whose set_state is of another form


def saves_itself(layer: gym.Env) -> bool:
    """Returns whether this is a wrapper with ``get_wrapper_state`` and ``set_wrapper_state``."""
    methods = (getattr(type(layer), f"{verb}_wrapper_state", None) for verb in ("get", "set"))
    return isinstance(layer, gym.Wrapper) and all(map(callable, methods))


def is_mujoco(layer: gym.Env) -> bool:
    """Returns whether an environment is one of Gymnasium's own on MuJoCo."""
    return type(layer).__module__.startswith(MUJOCO)


def _mujoco_state(env: Any) -> dict[str, Any]:
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.zeros(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, state, kind)
    return {"integration": state}


def _put_mujoco(env: Any, state: dict[str, Any]) -> None:
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    given = state.get("integration")
    if not isinstance(given, np.ndarray) or given.shape != (mujoco.mj_stateSize(env.model, kind),):
        raise ValueError(f"the state is of another model than {type(env).__name__}'s")
    mujoco.mj_setState(env.model, env.data, given, kind)
    mujoco.mj_forward(env.model, env.data)
    mujoco.mj_setState(env.model, env.data, given, kind)  # what the solver starts from was moved by mj_forward


def _rng(env: gym.Env) -> Any:
    return None if env._np_random is None else env._np_random.bit_generator.state


def _copied(layers: Any) -> Any:
    if isinstance(layers, dict):
        return {key: _copied(value) for key, value in layers.items()}
    if isinstance(layers, list | tuple):
        return type(layers)(_copied(value) for value in layers)
    return layers.copy() if isinstance(layers, np.ndarray) else layers
