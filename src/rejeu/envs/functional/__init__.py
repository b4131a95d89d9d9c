"""Environments as pure functions of JAX, which a training program can contain.

:class:`FunctionalEnv` is the interface, :func:`make` makes an environment by its id, and :func:`register` adds one.
:mod:`rejeu.envs.functional.vector` steps many at once.

>>> make("jax/Pendulum-v1", g=9.81).g
9.81
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import gymnasium as gym

from rejeu.core.validation import nearest

if TYPE_CHECKING:
    from rejeu.envs.canvas import Drawing
    from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv

__all__ = ["FunctionalEnv", "GoalEnv", "make", "register"]

MakeDrawing = Callable[["FunctionalEnv", str], "Drawing"]
"""Returns the drawing of an environment for a render mode, ``"rgb_array"`` or ``"human"``."""


class FunctionalSpec(NamedTuple):
    """A registered environment."""

    entry_point: str | Callable[..., FunctionalEnv]
    """Its class, or module and name of one of rejeu's, which is imported when it is made."""
    max_episode_steps: int | None = None
    """The time limit with default arguments, if it only truncates: Gymnasium's wrapper then applies it. None if the
    environment has its own."""
    reward_threshold: float | None = None
    """The return at which it counts as solved, None if there is none."""
    drawing: str | MakeDrawing | None = None
    """The function that returns its drawing, or one of rejeu's by module and name; None if it cannot be drawn."""


REGISTRY: dict[str, FunctionalSpec] = {
    "jax/CartPole-v1": FunctionalSpec(f"{__name__}.cart_pole:CartPole", 500, 475.0, f"{__name__}.drawing:cart_pole"),
    "jax/Pendulum-v1": FunctionalSpec(f"{__name__}.pendulum:Pendulum", 200, None, f"{__name__}.drawing:pendulum"),
    "jax/MountainCar-v0": FunctionalSpec(
        f"{__name__}.mountain_car:MountainCar", 200, -110.0, f"{__name__}.drawing:mountain_car"
    ),
    "jax/MountainCarContinuous-v0": FunctionalSpec(
        f"{__name__}.mountain_car:MountainCarContinuous", 999, 90.0, f"{__name__}.drawing:mountain_car"
    ),
    "jax/Acrobot-v1": FunctionalSpec(f"{__name__}.acrobot:Acrobot", 500, -100.0, f"{__name__}.drawing:acrobot"),
    "jax/Ball-v0": FunctionalSpec(f"{__name__}.ball:Ball", None, None, f"{__name__}.drawing:ball"),
    "jax/PointMaze-v0": FunctionalSpec(f"{__name__}.point_maze:PointMaze", 200, None, f"{__name__}.drawing:Maze"),
    "jax/BitFlipping-v0": FunctionalSpec(
        f"{__name__}.bit_flipping:BitFlipping", None, None, f"{__name__}.drawing:Bits"
    ),
    "jax/Parking-v0": FunctionalSpec(f"{__name__}.parking:Parking", 500, None, f"{__name__}.drawing:ParkingLot"),
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
        raise ValueError(f"no environment in JAX is called {env_id!r}; {nearest(env_id, REGISTRY, n=2)}")
    entry_point = imported(REGISTRY[env_id].entry_point)
    return entry_point(**kwargs)


def imported(value: object) -> Any:
    """Returns the object that one of our own strings names, and other values unchanged."""
    return pkgutil.resolve_name(value) if isinstance(value, str) else value


def register(
    env_id: str,
    kind: Callable[..., FunctionalEnv],
    *,
    max_episode_steps: int | None = None,
    reward_threshold: float | None = None,
    drawing: MakeDrawing | None = None,
) -> None:
    """Registers an environment under an id, also with Gymnasium.

    Args:
        env_id: begins with ``jax/`` and ends with a version, such as ``jax/Walk-v0``.
        kind: the class, or a function that returns an environment; called with the arguments of :func:`make`.
        max_episode_steps: the time limit with default arguments. ``kind`` must then have this argument.
        reward_threshold: the return at which it counts as solved, None if there is none.
        drawing: a function that returns its drawing, given the environment and the render mode; None if it has none.

    Raises:
        ValueError: if the id does not begin with ``jax/``, or belongs to another environment.
    """
    if not env_id.startswith("jax/"):
        raise ValueError(f"env_id={env_id!r} must begin with 'jax/', such as jax/Walk-v0")
    entry = FunctionalSpec(kind, max_episode_steps, reward_threshold, drawing)
    if REGISTRY.get(env_id, entry) != entry:
        raise ValueError(f"{env_id} is registered already; choose another name or version")
    REGISTRY[env_id] = entry
    register_with_gymnasium()


def register_with_gymnasium() -> None:
    """Registers with Gymnasium what is not registered yet."""
    for env_id, entry in REGISTRY.items():
        if env_id not in gym.registry:
            limits = {name: getattr(entry, name) for name in ("max_episode_steps", "reward_threshold")}
            gym.register(env_id, "rejeu.envs.functional.gym_env:GymnasiumEnv", **limits, kwargs={"env": env_id})


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Imports a class when it is first used, so that registering environments alone does not import JAX."""
        if name not in __all__:
            raise AttributeError(f"module 'rejeu.envs.functional' has no attribute {name!r}")
        return pkgutil.resolve_name(f"rejeu.envs.functional.protocol:{name}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
