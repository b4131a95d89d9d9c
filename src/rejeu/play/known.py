"""Default keys of known environments, and short names of some environments."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

import gymnasium as gym

from rejeu.play import keys
from rejeu.play.keys import KeyMap

SHORT_NAMES = {"car": "CarRacing-v3", "mountain": "MountainCar-v0", "lunar": "LunarLander-v3"}
"""Short names of ids, not case-sensitive."""

KNOWN: dict[str, dict[str, tuple[Any, str]]] = {
    env_id: {key: tuple(entry) for key, entry in entries.items()}
    for env_id, entries in tomllib.loads((resources.files(__package__) / "keys.toml").read_text("utf-8")).items()
}
"""Actions and descriptions of the keys, by id."""
KNOWN |= {f"jax/{env_id}": KNOWN[env_id] for env_id in [*KNOWN] if env_id.startswith(("Cart", "Mountain", "Pendulum"))}
KNOWN |= {"jax/Parking-v0": KNOWN["parking-v0"], "jax/Ball-v0": KNOWN["rejeu/Ball-v0"]}
OTHER_ACTIONS = {
    "LunarLander-v3": "LunarLanderContinuous-v3",
    "LunarLanderContinuous-v3": "LunarLander-v3",
}
"""Environments whose keys an environment has with other arguments."""


def full_name(name: str) -> str:
    """Returns the id of a short name, and other names unchanged.

    Raises:
        ValueError: if it is similar to a short name, but neither a short name nor an id.

    >>> full_name("Mountain"), full_name("CartPole-v1")
    ('MountainCar-v0', 'CartPole-v1')
    """
    if name.lower() not in SHORT_NAMES and name not in gym.registry:
        near = difflib.get_close_matches(name.lower(), SHORT_NAMES, n=1, cutoff=0.7)
        if near:
            raise ValueError(f"unknown environment {name!r}; did you mean {near[0].capitalize()}?")
    return SHORT_NAMES.get(name.lower(), name)


def known_keys(env_id: str, space: gym.Space) -> dict[str, tuple[Any, str]] | None:
    """Returns the entry of ``KNOWN`` for an environment, None if there is none that fits its action space.

    Arguments of an environment may change its actions, such as ``continuous=True`` of the lander and ``dimension=3`` of the
    ball.
    """
    for name in (env_id, OTHER_ACTIONS.get(env_id)):
        entry = KNOWN.get(name or "")
        if entry is not None and fits(space, {key: action for key, (action, _) in entry.items()}):
            return entry
    return None


def fits(space: gym.Space, actions: Mapping[str, Any]) -> bool:
    """Returns whether actions by keys are actions of a space."""
    try:
        keys.bind(space, actions)
    except ValueError:
        return False
    return True


def keys_for(env_id: str, space: gym.Space, own: Mapping[str, Any] | None = None) -> KeyMap:
    """Returns the key map of an environment: its default keys, or those of its action space, updated by ``own``.

    Raises:
        ValueError: if the action space has no keys, or ``own`` does not match it.

    >>> [binding.label for binding in keys_for("MountainCar-v0", gym.spaces.Discrete(3)).bindings]
    ['left', 'right']
    """
    own = dict(own or {})
    labels: list[tuple[Any, str]] = []
    known = known_keys(env_id, space)
    if known is not None:
        actions = {key: action for key, (action, _) in known.items()}
        labels = [(action, label) for key, (action, label) in known.items() if key != keys.NONE]
    elif own and isinstance(space, gym.spaces.Box) and space.low.size > len(keys.AXIS_KEYS):
        actions = {}
    else:
        actions, labels = keys.default_actions(space), keys.default_labels(space)
    return keys.bind(space, {**actions, **own}, labels)
