"""Environments in JAX by id.

>>> make("jax/Pendulum-v1", g=9.81).g
9.81
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rejeu.envs.canvas import Drawing
    from rejeu.envs.functional.protocol import FunctionalEnv

OWN = __name__.rpartition(".")[0]
MakeDrawing = Callable[["FunctionalEnv", str], "Drawing"]
"""Returns the drawing of an environment for a render mode, ``"rgb_array"`` or ``"human"``."""


class Entry(NamedTuple):
    """A registered environment."""

    kind: str | Callable[..., FunctionalEnv]
    """Its class, or module and name of one of rejeu's, which is imported when it is made."""
    max_episode_steps: int | None = None
    """The time limit with default arguments, if it only truncates: Gymnasium's wrapper then applies it. None if the
    environment has its own."""
    reward_threshold: float | None = None
    """The return at which it counts as solved, None if there is none."""
    drawing: str | MakeDrawing | None = None
    """The function that returns its drawing, or one of rejeu's by module and name; None if it cannot be drawn."""


REGISTRY: dict[str, Entry] = {
    "jax/CartPole-v1": Entry(f"{OWN}.cart_pole:CartPole", 500, 475.0, f"{OWN}.drawing:cart_pole"),
    "jax/Pendulum-v1": Entry(f"{OWN}.pendulum:Pendulum", 200, None, f"{OWN}.drawing:pendulum"),
    "jax/MountainCar-v0": Entry(f"{OWN}.mountain_car:MountainCar", 200, -110.0, f"{OWN}.drawing:mountain_car"),
    "jax/MountainCarContinuous-v0": Entry(
        f"{OWN}.mountain_car:MountainCarContinuous", 999, 90.0, f"{OWN}.drawing:mountain_car"
    ),
    "jax/Acrobot-v1": Entry(f"{OWN}.acrobot:Acrobot", 500, -100.0, f"{OWN}.drawing:acrobot"),
    "jax/Ball-v0": Entry(f"{OWN}.ball:Ball", None, None, f"{OWN}.drawing:ball"),
    "jax/PointMaze-v0": Entry(f"{OWN}.point_maze:PointMaze", 200, None, f"{OWN}.drawing:Maze"),
    "jax/BitFlipping-v0": Entry(f"{OWN}.bit_flipping:BitFlipping", None, None, f"{OWN}.drawing:Bits"),
    "jax/Parking-v0": Entry(f"{OWN}.parking:Parking", 500, None, f"{OWN}.drawing:ParkingLot"),
}
"""The environments by id."""


def is_functional(env_id: object) -> bool:
    """Returns whether an environment in JAX has this id."""
    return env_id in REGISTRY


def make(env_id: str, **kwargs: Any) -> FunctionalEnv:
    """Returns the environment with this id; ``kwargs`` are its parameters.

    Raises:
        ValueError: if there is none, with the nearest.
    """
    if env_id not in REGISTRY:
        near = difflib.get_close_matches(env_id, REGISTRY, n=2, cutoff=0.4)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(REGISTRY)}"
        raise ValueError(f"no environment in JAX is called {env_id!r}; {hint}")
    kind = _imported(REGISTRY[env_id].kind)
    return kind(**kwargs)


def without_limit(env_id: str) -> dict[str, None]:
    """Returns the arguments that make an environment without the limit that Gymnasium's wrapper applies."""
    return {"max_episode_steps": None} if env_id in REGISTRY and REGISTRY[env_id].max_episode_steps else {}


def drawing_of(env_id: str) -> MakeDrawing | None:
    """Returns the function that returns an environment's drawing, None if it has none."""
    return _imported(REGISTRY[env_id].drawing) if env_id in REGISTRY else None


def _imported(value: Any) -> Any:
    """Returns the object that one of our own strings names, and other values unchanged."""
    if not isinstance(value, str):
        return value
    module, _, name = value.partition(":")
    return getattr(importlib.import_module(module), name)
