"""Runs of one program that differ in numeric hyperparameters, which are traced numbers in it."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jax import Array

from rejeu.core import Algorithm, Explorer


@dataclass(frozen=True)
class Variants:
    """Makes the algorithm from its hyperparameters. Hashable by identity of the function."""

    make: Callable[[Any], tuple[Algorithm, Explorer]]
    """Returns the algorithm of a configuration, and how it explores."""

    def applied(self, program: Any, hyper: dict[str, Array]) -> Any:
        """Returns a program for the hyperparameters ``float32[]`` of one run."""
        config = changed(program.config, hyper)
        algorithm, explorer = self.make(config)
        return dataclasses.replace(program, algorithm=algorithm, explorer=explorer, config=config)


def changed(config: Any, hyper: dict[str, Array]) -> Any:
    """Returns a configuration with traced numbers, whose checks are left out, since they need the values."""
    copied = copy.copy(config)
    kinds = {field.name: str(field.type) for field in dataclasses.fields(config)}
    for name, value in hyper.items():
        is_schedule = "Schedule" in kinds[name]
        object.__setattr__(copied, name, (lambda progress, value=value: value) if is_schedule else value)
    return copied
