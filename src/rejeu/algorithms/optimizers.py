"""The optimizers that the setting ``optimizer`` names, and how one of your own is used.

Algorithms keep the learning rate apart, because it may follow a schedule: an optimizer here turns gradients into a
direction, and :func:`rejeu.core.algorithm.descend` subtracts ``learning_rate`` times that direction. An Optax optimizer of
your own is created with the learning rate 1 and used in the same way::

    rejeu.SAC("MlpPolicy", env, optimizer="adamw")
    rejeu.SAC("MlpPolicy", env, optimizer=optax.lamb)
    rejeu.SAC("MlpPolicy", env, optimizer=functools.partial(optax.adamw, weight_decay=1e-2))
    rejeu.SAC("MlpPolicy", env, optimizer=optax.chain(optax.clip(1.0), optax.adabelief(1.0)))
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import optax

from rejeu.core.algorithm import Clipped, Elementwise, Optimizer
from rejeu.core.types import Settings

WEIGHT_DECAY = 1e-4
"""Decoupled weight decay of ``"adamw"``, which is multiplied by the learning rate as well."""
RMSPROP_DECAY = 0.99
"""Share of RMSprop's running mean of squared gradients that stays at each step."""


def adamw(**settings: float) -> optax.GradientTransformation:
    """Returns Adam with decoupled weight decay (Loshchilov and Hutter 2019, arXiv 1711.05101)."""
    return optax.chain(optax.scale_by_adam(**settings), optax.add_decayed_weights(WEIGHT_DECAY))


OPTIMIZERS: dict[str, Callable[..., optax.GradientTransformation]] = {
    "adam": optax.scale_by_adam,
    "adamw": adamw,
    "nadam": partial(optax.scale_by_adam, nesterov=True),
    "radam": optax.scale_by_radam,
    "amsgrad": optax.scale_by_amsgrad,
    "lion": lambda **settings: optax.scale_by_lion(),
    "rmsprop": lambda **settings: optax.scale_by_rms(RMSPROP_DECAY),
    "sgd": lambda **settings: optax.identity(),
}
"""The values of ``optimizer`` by name; those that are variants of Adam take an algorithm's settings ``b1`` and ``eps``."""
DEFAULTS: dict[str, Settings] = {"adamw": {"weight_decay": WEIGHT_DECAY}, "rmsprop": {"decay": RMSPROP_DECAY}}
"""Settings of an optimizer that is given as a dict, where they differ from Optax's."""


class Named(NamedTuple):
    """An optimizer by its name, with settings that a file contains: ``{"name": "adamw", "weight_decay": 1e-2}``."""

    name: str
    settings: tuple[tuple[str, object], ...]
    """Arguments of the Optax transformation (``b1``, ``b2``, ``eps``, ``decay``), and ``weight_decay`` and ``momentum``."""

    def make(self, **adam: float) -> optax.GradientTransformation:
        """Returns the transformation; ``adam`` are the algorithm's settings of Adam, which its own replace."""
        settings = DEFAULTS.get(self.name, {}) | dict(self.settings)
        weight_decay, momentum = settings.pop("weight_decay", 0.0), settings.pop("momentum", 0.0)
        rules = {"rmsprop": optax.scale_by_rms, "lion": optax.scale_by_lion, "adamw": optax.scale_by_adam}
        rule = rules.get(self.name, OPTIMIZERS[self.name])
        is_adam = self.name in ("adam", "adamw", "nadam", "radam", "amsgrad")
        steps = [rule(**(adam | settings if is_adam else settings))]
        steps += [optax.trace(momentum)] if momentum else []
        decays = [optax.add_decayed_weights(weight_decay)] if weight_decay else []
        return optax.chain(*steps, *decays) if self.name in ("adamw", "lion") else optax.chain(*decays, *steps)


def parse(key: str, value: object) -> Any:
    """Returns the setting ``optimizer``, checked.

    Raises:
        ValueError: for an unknown name.
        TypeError: for anything but a name, a dict of a name and settings, an Optax transformation or a function that returns
            one.
    """
    if isinstance(value, optax.GradientTransformation):
        return value
    if isinstance(value, Named):
        return value
    if isinstance(value, Mapping) and isinstance(value.get("name"), str):
        settings = tuple((name, setting) for name, setting in value.items() if name != "name")
        optimizer = Named(parse(key, value["name"]), settings)
        optimizer.make()  # raises for a setting that it does not have
        return optimizer
    if isinstance(value, str):
        if value.lower() not in OPTIMIZERS:
            raise ValueError(
                f"{key}={value!r} is unknown; choose one of {', '.join(OPTIMIZERS)}, or give an Optax optimizer"
            )
        return value.lower()
    if callable(value) and isinstance(value(1.0), optax.GradientTransformation):
        return value
    raise TypeError(
        f"{key}={value!r} must be one of {', '.join(OPTIMIZERS)}, an Optax optimizer such as optax.lamb, or one that was "
        "created with the learning rate 1"
    )


def make(optimizer: Any, max_norm: float | None = None, max_value: float | None = None, **adam: float) -> Optimizer:
    """Returns a transformation from gradients to directions, without a learning rate.

    :func:`rejeu.core.algorithm.descend` applies it.

    Args:
        optimizer: what :func:`parse` returned.
        max_norm: largest Euclidean norm of the gradient of all parameters; larger gradients are scaled down. None: no
            limit.
        max_value: largest absolute value of each component, applied before. None: no limit.
        adam: the algorithm's settings of Adam (``b1``, ``eps``); an optimizer of your own has its own.
    """
    transformation = _unlimited(optimizer, **adam)
    return transformation if max_norm is None and max_value is None else Clipped(transformation, max_value, max_norm)


def _unlimited(optimizer: Any, **adam: float) -> optax.GradientTransformation:
    if isinstance(optimizer, Named):
        return optimizer.make(**adam)
    if isinstance(optimizer, str):
        return Elementwise(*OPTIMIZERS[optimizer](**adam))
    transformation = optimizer if isinstance(optimizer, optax.GradientTransformation) else optimizer(1.0)
    return optax.chain(transformation, optax.scale(-1.0))  # Optax adds updates; the direction is subtracted


def name(optimizer: object) -> str:
    """Returns the name under which a file mentions an optimizer of the user's own."""
    function = optimizer.func if isinstance(optimizer, partial) else optimizer
    return getattr(function, "__name__", type(function).__name__)
