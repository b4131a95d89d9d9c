"""Which action the keys held down stand for: pure maps, for Discrete and for Box actions.

A map is written as ``{keys: action}``: ``{"a": 0, "d": 2, "none": 1}`` for Discrete actions, ``{"w": [1, 0], "a": [0,
-1]}`` for Box actions. ``a+w`` is the two keys together, ``none`` stands for nothing held. Keys are named as SDL names
them: ``a``, ``7``, ``left``, ``space``, ``left shift``. The arrows do what a, d, w and s do unless they are bound
themselves.
"""

from __future__ import annotations

import difflib
import math
import string
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

ARROWS = {"left": "a", "right": "d", "up": "w", "down": "s"}
"""What an arrow stands for where it is not bound itself."""
OPPOSITES = (("a", "d"), ("s", "w"), ("left", "right"), ("down", "up"))
"""Pairs of keys that cancel where each is a Discrete action."""
AXIS_KEYS = (("a", "d"), ("s", "w"), ("j", "l"), ("k", "i"))
"""Keys of the first, second, ... number of a Box action: its low end and its high end."""
CONTROLS = {"r": "restart", "p": "pause", "space": "pause", "escape": "close", "q": "close"}
"""What the window itself understands. Of these only the space bar can be bound, and then it no longer pauses."""
NONE = "none"
"""Stands for no key in a map."""
WAIT = "wait"
"""In place of an action for ``none``: the environment stands still until a key is held."""
NAMES = frozenset(
    [
        *(string.ascii_lowercase + string.digits + ",.;'-=[]\\/`"),
        *(*ARROWS, "space", "return", "tab", "backspace", "left shift", "right shift", "left ctrl", "right ctrl"),
    ]
)
"""Keys that may be bound, and those of the window."""


class Binding(NamedTuple):
    """What some keys held together do."""

    keys: frozenset[str]
    """One key, or several that count only together."""
    action: Any
    """An integer for Discrete actions; the numbers of a Box action, flattened, as a tuple."""
    label: str
    """For the window: what it does, in a word or two."""


@dataclass(frozen=True)
class DiscreteKeys:
    """Keys for Discrete actions.

    Opposite keys cancel. Of several actions whose keys are held each has its turn, a step at a time, so that two engines
    that cannot fire in one step fire in alternation.
    """

    bindings: tuple[Binding, ...]
    idle: tuple[int, ...]
    """Actions while nothing is held, taken in turn; empty: the environment waits for a key."""

    @property
    def names(self) -> frozenset[str]:
        """Every key that means something, arrows included."""
        return frozenset().union(*(spellings(binding, self.bindings) for binding in self.bindings))

    def action(self, held: Iterable[str], step: int) -> np.int64 | None:
        """Returns the action in a step of an episode, counted from 0; None to wait.

        >>> keys = bind(gym.spaces.Discrete(4), {"a": 1, "w": 2, "d": 3, "none": 0})
        >>> [int(keys.action(held, step=0)) for held in (["left"], ["a", "d"], [])]
        [1, 0, 0]
        >>> [int(keys.action(["a", "w"], step)) for step in range(4)]
        [1, 2, 1, 2]
        """
        pressed = _canonical(held, self.bindings)
        for pair in OPPOSITES:
            if pressed.issuperset(pair) and not any(binding.keys.issuperset(pair) for binding in self.bindings):
                pressed -= set(pair)
        chosen = [binding.action for binding in _active(pressed, self.bindings)] or self.idle
        return np.int64(chosen[step % len(chosen)]) if chosen else None


@dataclass(frozen=True)
class BoxKeys:
    """Keys for Box actions: what the keys held add to the action at rest is summed, and kept within the bounds."""

    bindings: tuple[Binding, ...]
    rest: tuple[float, ...]
    """The action while nothing is held."""
    space: gym.spaces.Box

    @property
    def names(self) -> frozenset[str]:
        """Every key that means something, arrows included."""
        return frozenset().union(*(spellings(binding, self.bindings) for binding in self.bindings))

    def action(self, held: Iterable[str], step: int) -> np.ndarray:
        """Returns the action, of the space's shape and dtype; ``step`` is of no account.

        >>> keys = bind(gym.spaces.Box(-1, 1, (2,)), {"w": [1, 0], "a": [0, -1], "d": [0, 1]})
        >>> keys.action(["up", "left"], step=0).tolist(), keys.action(["w", "a", "d"], step=0).tolist()
        ([1.0, -1.0], [1.0, 0.0])
        """
        rest = np.array(self.rest)
        total = rest.copy()
        for binding in _active(_canonical(held, self.bindings), self.bindings):
            total += np.array(binding.action) - rest
        shaped = total.reshape(self.space.shape)
        return np.clip(shaped, self.space.low, self.space.high).astype(self.space.dtype)


KeyMap = DiscreteKeys | BoxKeys


def bind(space: gym.Space, actions: Mapping[str, Any], labels: Iterable[tuple[Any, str]] = ()) -> KeyMap:
    """Returns the map for a space that ``actions`` describes; see the module.

    Args:
        space: of one action.
        actions: by keys. Of a Box action with one number that number will do. ``none`` may hold several Discrete actions
            to be taken in turn, or ``"wait"``; without it Discrete actions wait, and Box actions are 0, or in the middle
            of bounds that leave 0 out.
        labels: ``(action, label)`` pairs that say what some actions do; of others the action itself is shown.

    Raises:
        ValueError: for unknown keys, actions outside the space, and spaces that are neither Discrete nor Box.
    """
    if not isinstance(space, gym.spaces.Discrete | gym.spaces.Box):
        raise ValueError(f"the actions {space} cannot be played by hand; Discrete and Box actions can")
    is_discrete = isinstance(space, gym.spaces.Discrete)
    convert: Callable[[Any, str, Any], Any] = _discrete if is_discrete else _box
    said = {convert(space, label, action): label for action, label in labels}
    by_keys: dict[frozenset[str], Binding] = {}
    for name, action in actions.items():
        if name != NONE:
            held = _keys(name)
            converted = convert(space, name, action)
            label = said.get(converted, f"action {converted}" if is_discrete else _text(action))
            by_keys[held] = Binding(held, converted, label)
    bindings = tuple(by_keys.values())
    if isinstance(space, gym.spaces.Box):
        rest = _resting(space) if NONE not in actions else _box(space, NONE, actions[NONE])
        return BoxKeys(bindings, rest, space)
    idle = actions.get(NONE, WAIT)
    turns = [] if idle == WAIT else idle if isinstance(idle, list | tuple) else [idle]
    return DiscreteKeys(bindings, tuple(_discrete(space, NONE, action) for action in turns))


def default_actions(space: gym.Space) -> dict[str, Any]:
    """Returns a map for a space of which nothing else is known.

    Box: a/d for the first number, s/w for the second, j/l and k/i for the third and fourth; to -1 and 1 where there is no
    bound. Discrete: the number keys, and a/d for two actions, a/d and the middle one for nothing with three, a, s, d, w
    for the first four of more.

    Raises:
        ValueError: for more than four numbers, which need a map of their own.

    >>> default_actions(gym.spaces.Discrete(3))
    {'0': 0, '1': 1, '2': 2, 'a': 0, 'd': 2, 'none': 1}
    >>> default_actions(gym.spaces.Box(-2.0, 2.0, (1,)))
    {'a': [-2.0], 'd': [2.0]}
    """
    if isinstance(space, gym.spaces.Discrete):
        first, n = int(space.start), int(space.n)
        numbers = {str(i): first + i for i in range(min(n, 10))}
        if n == 3:
            return {**numbers, "a": first, "d": first + 2, NONE: first + 1}
        return {**numbers, **{key: first + i for i, key in enumerate("ad" if n < 4 else "asdw") if i < n}}
    if not isinstance(space, gym.spaces.Box):
        return {}
    rest = _resting(space)
    if len(rest) > len(AXIS_KEYS):
        example = ",".join(["1"] + ["0"] * (len(rest) - 1))
        raise ValueError(
            f"an action of {len(rest)} numbers is more than the keys by default reach ({len(AXIS_KEYS)}); bind keys "
            f"yourself: --keys a=[{example}] ..."
        )
    actions: dict[str, Any] = {}
    for i, keys in enumerate(AXIS_KEYS[: len(rest)]):
        for key, bounds, step in zip(keys, (space.low, space.high), (-1.0, 1.0), strict=True):
            bound = float(bounds.reshape(-1)[i])
            actions[key] = [*rest[:i], bound if math.isfinite(bound) else rest[i] + step, *rest[i + 1 :]]
    return actions


def default_labels(space: gym.Space) -> list[tuple[Any, str]]:
    """Returns what is shown of those of :func:`default_actions` that are not numbers of a Discrete space.

    >>> default_labels(gym.spaces.Discrete(2)), default_labels(gym.spaces.Box(-2, 2, (1,)))
    ([], [([-2.0], 'number 1 down'), ([2.0], 'number 1 up')])
    """
    if not isinstance(space, gym.spaces.Box):
        return []
    sides = {key: (i, side) for i, pair in enumerate(AXIS_KEYS) for key, side in zip(pair, ("down", "up"), strict=True)}
    return [(action, f"number {sides[key][0] + 1} {sides[key][1]}") for key, action in default_actions(space).items()]


def spellings(binding: Binding, bindings: tuple[Binding, ...]) -> frozenset[str]:
    """Returns the keys that a binding is reached by: its own, and the arrows that stand for them."""
    bound = {key for other in bindings for key in other.keys}
    return binding.keys | {arrow for arrow, key in ARROWS.items() if key in binding.keys and arrow not in bound}


def _canonical(held: Iterable[str], bindings: tuple[Binding, ...]) -> set[str]:
    """Returns the keys held, the arrows as the letters they stand for unless they are bound."""
    bound = {key for binding in bindings for key in binding.keys}
    return {key if key in bound else ARROWS.get(key, key) for key in held}


def _active(pressed: set[str], bindings: tuple[Binding, ...]) -> list[Binding]:
    """Returns the bindings in force; one of several keys takes the place of those of some of its keys."""
    fitting = [binding for binding in bindings if binding.keys <= pressed]
    return [one for one in fitting if not any(one.keys < other.keys for other in fitting)]


def _keys(name: str) -> frozenset[str]:
    keys = [key.strip().lower() for key in name.split("+")]
    for key in keys:
        if key not in NAMES:
            near = difflib.get_close_matches(key, sorted(NAMES), n=1, cutoff=0.6)
            hint = f"did you mean {near[0]}?" if near else "letters, digits, left, right, up, down, space, ... are keys"
            raise ValueError(f"no key is called {key!r}; {hint}")
        if key in CONTROLS and key != "space":
            raise ValueError(f"the key {key!r} cannot be bound: it is the window's own ({CONTROLS[key]})")
    return frozenset(keys)


def _discrete(space: gym.spaces.Discrete, name: str, action: Any) -> int:
    if isinstance(action, bool) or not isinstance(action, int | np.integer) or not space.contains(np.int64(action)):
        last = int(space.start + space.n - 1)
        raise ValueError(f"{name}={_text(action)} must be a whole number from {int(space.start)} to {last}")
    return int(action)


def _box(space: gym.spaces.Box, name: str, action: Any) -> tuple[float, ...]:
    numbers = action if isinstance(action, list | tuple) else [action]
    low, high = space.low.reshape(-1).tolist(), space.high.reshape(-1).tolist()
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in numbers) or len(numbers) != len(low):
        raise ValueError(f"{name}={_text(action)} must be {len(low)} number{'s' if len(low) > 1 else ''}, as in [0.5]")
    for x, least, most in zip(numbers, low, high, strict=True):
        if not (math.isfinite(x) and least <= x <= most):
            raise ValueError(f"{name}={_text(action)} is outside the actions, which are from {low} to {high}")
    return tuple(map(float, numbers))


def _resting(space: gym.spaces.Box) -> tuple[float, ...]:
    ends = zip(space.low.reshape(-1).tolist(), space.high.reshape(-1).tolist(), strict=True)
    return tuple(
        0.0 if low <= 0 <= high else (low + high) / 2 if math.isfinite(high - low) else low for low, high in ends
    )


def _text(action: Any) -> str:
    return "[" + ", ".join(map(_text, action)) + "]" if isinstance(action, list | tuple) else str(action)
