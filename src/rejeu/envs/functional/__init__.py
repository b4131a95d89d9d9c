"""Environments as pure functions of JAX, which a training program can contain.

:class:`FunctionalEnv` is the interface, :func:`make` makes an environment by its id, such as ``jax/CartPole-v1``, and
:func:`register` adds one. :mod:`rejeu.envs.functional.vector` steps many at once.
"""

import importlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from rejeu.envs.functional.registry import REGISTRY, Entry, MakeDrawing, make

if TYPE_CHECKING:
    from rejeu.envs.functional.protocol import FunctionalEnv, GoalEnv

__all__ = ["FunctionalEnv", "GoalEnv", "make", "register"]


def register(
    env_id: str,
    kind: "Callable[..., FunctionalEnv]",
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
    entry = Entry(kind, max_episode_steps, reward_threshold, drawing)
    if REGISTRY.get(env_id, entry) != entry:
        raise ValueError(f"{env_id} is registered already; choose another name or version")
    REGISTRY[env_id] = entry
    register_with_gymnasium()


def register_with_gymnasium() -> None:
    """Registers with Gymnasium what is not registered yet."""
    for env_id, entry in REGISTRY.items():
        if env_id not in gym.registry:
            gym.register(
                env_id,
                "rejeu.envs.functional.gym_env:GymnasiumEnv",
                max_episode_steps=entry.max_episode_steps,
                reward_threshold=entry.reward_threshold,
                kwargs={"env": env_id},
            )


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Imports a class when it is first used, so that registering environments alone does not import JAX."""
        if name not in __all__:
            raise AttributeError(f"module 'rejeu.envs.functional' has no attribute {name!r}")
        return getattr(importlib.import_module("rejeu.envs.functional.protocol"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
