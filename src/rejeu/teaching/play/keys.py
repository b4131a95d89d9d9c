"""Key maps from held keys to Discrete or Box actions, and the keys of known environments (``keys.toml``).

A map is written as ``{keys: action}``: ``{"a": 0, "d": 2, "none": 1}`` for Discrete actions, ``{"w": [1, 0], "a": [0,
-1]}`` for Box actions. ``a+w`` is both keys together, ``none`` is no key. Keys have SDL's names: ``a``, ``7``, ``left``,
``space``, ``left shift``. Arrow keys are equivalent to a, d, w and s unless they are bound themselves.
"""

from __future__ import annotations

import difflib
import math
import string
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.core.types import Action
from rejeu.core.validation import nearest

ARROWS = {"left": "a", "right": "d", "up": "w", "down": "s"}
"""The key that an arrow key is equivalent to, unless it is bound."""
OPPOSITES = (("a", "d"), ("s", "w"), ("left", "right"), ("down", "up"))
"""Pairs of keys that cancel in Discrete action spaces."""
AXIS_KEYS = (("a", "d"), ("s", "w"), ("j", "l"), ("k", "i"))
"""Keys for the low and high end of the first, second, ... component of a Box action."""
CONTROLS = {"r": "restart", "p": "pause", "space": "pause", "escape": "close", "q": "close"}
"""Keys of the window. Only the space bar can be bound to an action, and then it no longer pauses."""
NONE = "none"
"""No key, in a map."""
WAIT = "wait"
"""In place of an action for ``none``: the environment waits until a key is held."""
NAMES = frozenset(
    [
        *(string.ascii_lowercase + string.digits + ",.;'-=[]\\/`"),
        *(*ARROWS, "space", "return", "tab", "backspace", "left shift", "right shift", "left ctrl", "right ctrl"),
    ]
)
"""Names of all keys that can be bound, and of those of the window."""


class Binding(NamedTuple):
    """The action of a key, or of several keys held together."""

    keys: frozenset[str]
    """One key, or several that are held together."""
    action: Action
    """An integer for Discrete actions, a flat tuple of numbers for Box actions."""
    label: str
    """Description for the window."""


@dataclass(frozen=True)
class KeyMap:
    """Keys for Discrete or Box actions.

    Discrete: opposite keys cancel. If keys of several actions are held, the actions alternate step by step. Box: the
    contributions of the held keys are added and clipped to the bounds.
    """

    space: gym.spaces.Discrete | gym.spaces.Box
    bindings: tuple[Binding, ...]
    idle: tuple[Any, ...]
    """Discrete: actions without a key, which alternate; empty to wait for a key. Box: the action without a key."""

    @property
    def names(self) -> frozenset[str]:
        """All keys with an action, arrow keys included."""
        return frozenset().union(*(equivalent_keys(binding, self.bindings) for binding in self.bindings))

    def action(self, held: Iterable[str], step: int) -> Action:
        """Returns the action at a step of the episode (from 0) in the space's shape and dtype, None to wait.

        >>> keys = bind(gym.spaces.Discrete(4), {"a": 1, "w": 2, "d": 3, "none": 0})
        >>> [int(keys.action(held, step=0)) for held in (["left"], ["a", "d"], [])]
        [1, 0, 0]
        >>> [int(keys.action(["a", "w"], step)) for step in range(4)]
        [1, 2, 1, 2]
        >>> keys = bind(gym.spaces.Box(-1, 1, (2,)), {"w": [1, 0], "a": [0, -1], "d": [0, 1]})
        >>> keys.action(["up", "left"], step=0).tolist(), keys.action(["w", "a", "d"], step=0).tolist()
        ([1.0, -1.0], [1.0, 0.0])
        """
        pressed = _canonical(held, self.bindings)
        if isinstance(self.space, gym.spaces.Box):
            added = (np.subtract(binding.action, self.idle) for binding in _active(pressed, self.bindings))
            total = sum(added, np.array(self.idle)).reshape(self.space.shape)
            return np.clip(total, self.space.low, self.space.high).astype(self.space.dtype)
        for pair in OPPOSITES:
            if pressed.issuperset(pair) and not any(binding.keys.issuperset(pair) for binding in self.bindings):
                pressed -= set(pair)
        actions = [binding.action for binding in _active(pressed, self.bindings)] or self.idle
        return np.int64(actions[step % len(actions)]) if actions else None


def bind(space: gym.Space, actions: Mapping[str, Action], labels: Iterable[tuple[Any, str]] = ()) -> KeyMap:
    """Returns the key map of an action space.

    Args:
        space: the action space.
        actions: actions by keys. A Box action with one component may be a number. ``none`` may be a list of Discrete actions
            that alternate, or ``"wait"``. The default is to wait for Discrete actions, and for Box actions 0, or the middle
            of bounds that exclude 0.
        labels: ``(action, label)`` pairs with descriptions. The default description is the action itself.

    Raises:
        ValueError: for unknown keys, actions outside the space, and spaces that are neither Discrete nor Box.
    """
    if not isinstance(space, gym.spaces.Discrete | gym.spaces.Box):
        raise ValueError(f"the action space {space} cannot be played by hand; expected Discrete or Box")
    is_discrete = isinstance(space, gym.spaces.Discrete)
    convert: Callable[[Any, str, Any], Any] = _discrete if is_discrete else _box
    descriptions = {convert(space, label, action): label for action, label in labels}
    by_keys: dict[frozenset[str], Binding] = {}
    for name, action in actions.items():
        if name != NONE:
            held = _keys(name)
            converted = convert(space, name, action)
            label = descriptions.get(converted, f"action {converted}" if is_discrete else _text(action))
            by_keys[held] = Binding(held, converted, label)
    bindings = tuple(by_keys.values())
    if isinstance(space, gym.spaces.Box):
        resting = _resting(space) if NONE not in actions else _box(space, NONE, actions[NONE])
        return KeyMap(space, bindings, resting)
    idle = actions.get(NONE, WAIT)
    turns = [] if idle == WAIT else idle if isinstance(idle, list | tuple) else [idle]
    return KeyMap(space, bindings, tuple(_discrete(space, NONE, action) for action in turns))


def default_keys(space: gym.Space) -> dict[str, tuple[Any, str]]:
    """Returns actions and descriptions by keys for an action space, as in :data:`KNOWN`; an empty description for the default.

    Box: a/d for the first component, s/w for the second, j/l and k/i for the third and fourth, to -1 and 1 without bounds.
    Discrete: the number keys; a/d for two actions; a/d and no key for three actions; a, s, d, w for the first four of more.

    Raises:
        ValueError: for a Box space with more than four components.

    >>> {key: action for key, (action, _) in default_keys(gym.spaces.Discrete(3)).items()}
    {'0': 0, '1': 1, '2': 2, 'a': 0, 'd': 2, 'none': 1}
    >>> default_keys(gym.spaces.Box(-2.0, 2.0, (1,)))
    {'a': ([-2.0], 'number 1 down'), 'd': ([2.0], 'number 1 up')}
    """
    if isinstance(space, gym.spaces.Discrete):
        first, n = int(space.start), int(space.n)
        letters = {"a": 0, "d": 2, NONE: 1} if n == 3 else dict(zip("ad" if n < 4 else "asdw", range(n), strict=False))
        numbers = {str(i): i for i in range(min(n, 10))}
        return {key: (first + i, "") for key, i in (numbers | letters).items()}
    if not isinstance(space, gym.spaces.Box):
        return {}
    resting = _resting(space)
    if len(resting) > len(AXIS_KEYS):
        example = ",".join(["1"] + ["0"] * (len(resting) - 1))
        raise ValueError(
            f"there are default keys for {len(AXIS_KEYS)} components, but the actions have {len(resting)}; bind keys with "
            f"--keys a=[{example}] ..."
        )
    entries: dict[str, tuple[Any, str]] = {}
    for i, keys in enumerate(AXIS_KEYS[: len(resting)]):
        for key, bounds, step, side in zip(keys, (space.low, space.high), (-1.0, 1.0), ("down", "up"), strict=True):
            bound = float(bounds.reshape(-1)[i])
            action = [*resting[:i], bound if math.isfinite(bound) else resting[i] + step, *resting[i + 1 :]]
            entries[key] = action, f"number {i + 1} {side}"
    return entries


def equivalent_keys(binding: Binding, bindings: tuple[Binding, ...]) -> frozenset[str]:
    """Returns the keys of a binding and the equivalent arrow keys."""
    bound = {key for peer in bindings for key in peer.keys}
    return binding.keys | {arrow for arrow, key in ARROWS.items() if key in binding.keys and arrow not in bound}


def _canonical(held: Iterable[str], bindings: tuple[Binding, ...]) -> set[str]:
    """Returns the held keys, with unbound arrow keys replaced by the equivalent letters."""
    bound = {key for binding in bindings for key in binding.keys}
    return {key if key in bound else ARROWS.get(key, key) for key in held}


def _active(pressed: set[str], bindings: tuple[Binding, ...]) -> list[Binding]:
    """Returns the active bindings. A binding of several keys overrides those of some of its keys."""
    fitting = [binding for binding in bindings if binding.keys <= pressed]
    return [binding for binding in fitting if not any(binding.keys < larger.keys for larger in fitting)]


def _keys(name: str) -> frozenset[str]:
    keys = [key.strip().lower() for key in name.split("+")]
    for key in keys:
        if key not in NAMES:
            hint = nearest(key, sorted(NAMES), "valid keys are letters, digits, left, right, up, down, space, ...")
            raise ValueError(f"unknown key {key!r}; {hint}")
        if key in CONTROLS and key != "space":
            raise ValueError(f"the key {key!r} cannot be bound: it is reserved for the window ({CONTROLS[key]})")
    return frozenset(keys)


def _discrete(space: gym.spaces.Discrete, name: str, action: Action) -> int:
    if isinstance(action, bool) or not isinstance(action, int | np.integer) or not space.contains(np.int64(action)):
        last = int(space.start + space.n - 1)
        raise ValueError(f"{name}={_text(action)} must be an integer from {int(space.start)} to {last}")
    return int(action)


def _box(space: gym.spaces.Box, name: str, action: Action) -> tuple[float, ...]:
    numbers = action if isinstance(action, list | tuple) else [action]
    low, high = space.low.reshape(-1).tolist(), space.high.reshape(-1).tolist()
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in numbers) or len(numbers) != len(low):
        raise ValueError(f"{name}={_text(action)} must be {len(low)} number{'s' if len(low) > 1 else ''}, as in [0.5]")
    for x, lower, upper in zip(numbers, low, high, strict=True):
        if not (math.isfinite(x) and lower <= x <= upper):
            raise ValueError(f"{name}={_text(action)} is outside the action space, which is from {low} to {high}")
    return tuple(map(float, numbers))


def _resting(space: gym.spaces.Box) -> tuple[float, ...]:
    ends = zip(space.low.reshape(-1).tolist(), space.high.reshape(-1).tolist(), strict=True)
    return tuple(
        0.0 if low <= 0 <= high else (low + high) / 2 if math.isfinite(high - low) else low for low, high in ends
    )


def _text(action: Action) -> str:
    return "[" + ", ".join(map(_text, action)) + "]" if isinstance(action, list | tuple) else str(action)


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


def fits(space: gym.Space, actions: Mapping[str, Action]) -> bool:
    """Returns whether actions by keys are actions of a space."""
    try:
        bind(space, actions)
    except ValueError:
        return False
    return True


def keys_for(env_id: str, space: gym.Space, custom: Mapping[str, Action] | None = None) -> KeyMap:
    """Returns the key map of an environment: its default keys, or those of its action space, updated by ``custom``.

    Raises:
        ValueError: if the action space has no keys, or ``custom`` does not match it.

    >>> [binding.label for binding in keys_for("MountainCar-v0", gym.spaces.Discrete(3)).bindings]
    ['left', 'right']
    """
    entries = known_keys(env_id, space)
    if entries is None:
        is_wide = isinstance(space, gym.spaces.Box) and space.low.size > len(AXIS_KEYS)
        entries = {} if custom and is_wide else default_keys(space)
    labels = [(action, label) for key, (action, label) in entries.items() if label and key != NONE]
    return bind(space, {**{key: action for key, (action, _) in entries.items()}, **(custom or {})}, labels)
