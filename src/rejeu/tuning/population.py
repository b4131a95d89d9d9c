"""Population-based training: which member copies which, and how its hyperparameters change.

Source: Jaderberg et al. 2017, "Population Based Training of Neural Networks" (arXiv 1711.09846). The members of a population
train in rounds. After each round the worst quarter copies networks, optimizers, replay buffer and hyperparameters of the best
quarter (truncation selection), and then each copied hyperparameter is perturbed.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from rejeu.algorithms.search import FIXED_AT_START, Choice, Dimension, NearOne, SearchSpace, Uniform
from rejeu.errors import CheckpointError
from rejeu.io import atomic
from rejeu.io.records import Count, Malformed, convert, read_json, shown
from rejeu.tuning import plan as plans, space as spaces
from rejeu.tuning.plan import Plan

FACTORS = (0.8, 1.25)
"""Factors of a perturbation."""
SHIFT = 0.1
"""Share of its range by which a uniform hyperparameter is shifted."""
SELECTED = 4
"""The worst and the best 1 / 4 of the members are selected."""
INITIAL, DECISIONS = range(10, 12)
"""Streams of random numbers: of the first hyperparameters, of the decisions after each round."""
MAX_BYTES = 2**24


@dataclass(frozen=True, kw_only=True)
class Population:
    """The settings of a population."""

    plan: Plan
    """What its members have in common. ``trials`` is their number, ``evaluate_every`` the steps of a round."""
    rounds: Annotated[int, Meta(ge=1, le=100_000)]

    @property
    def members(self) -> int:
        """Number of members."""
        return self.plan.trials

    def step(self, n_rounds: int) -> int:
        """Returns the environment step of each member after so many rounds."""
        return n_rounds * self.plan.evaluate_every

    def initial(self) -> list[dict[str, Any]]:
        """Returns the first hyperparameters of all members; the first member has those of the default, where it has any."""
        rng = np.random.default_rng([self.plan.seed, INITIAL])
        found = [{name: sample(one, rng) for name, one in self.plan.search_space.items()} for _ in range(self.members)]
        return [{**found[0], **plans.default_values(self.plan)}, *found[1:]]


@dataclass(frozen=True)
class Decision:
    """The decision about one member after a round."""

    score: float | None
    """Mean return or success rate of the evaluation at the end of the round; None if the member failed."""
    values: dict[str, Any]
    """Its hyperparameters in that round."""
    parent: Count | None
    """The member that it copies; None if it continues."""
    next_values: dict[str, Any]
    """Its hyperparameters in the next round."""


def make(rounds: int, round_steps: int, members: int, **options: Any) -> Population:
    """Returns the settings of a population; ``options`` are those of :func:`rejeu.tuning.plan.make`.

    Raises:
        ValueError: for fewer than two members, or a hyperparameter that cannot change while a run trains.
    """
    if members < 2:
        raise ValueError(f"members={members} must be at least 2: the worst copy the best")
    asked = {*(options.get("search") or {}), *options.get("only", ())}
    for name in asked:
        if is_fixed(name):
            raise ValueError(f"{name} cannot change while a run trains; leave it out, or set it for all members")
    plan = plans.make(trials=members, steps=rounds * round_steps, evaluate_every=round_steps, final_seeds=0, **options)
    space = {name: one for name, one in plan.space.items() if not is_fixed(name)}
    if not space:
        raise ValueError(
            f"there is nothing to search for {plan.algorithm}; give a range, such as learning_rate=1e-4..1e-2"
        )
    return Population(plan=dataclasses.replace(plan, space=space), rounds=rounds)


def is_fixed(name: str) -> bool:
    """Returns whether a hyperparameter cannot change while a run trains."""
    return name.split(".")[0] in FIXED_AT_START


def sample(dimension: Dimension, rng: np.random.Generator) -> Any:
    """Returns a random value of a dimension, a plain Python value."""
    if isinstance(dimension, Choice):
        return dimension.values[rng.integers(len(dimension.values))]
    low, high = dimension.low, dimension.high
    if dimension.is_whole:
        return int(rng.integers(int(low), int(high) + 1))
    if isinstance(dimension, Uniform):
        return float(rng.uniform(low, high))
    if isinstance(dimension, NearOne):
        return within(dimension, 1 - math.exp(rng.uniform(math.log(1 - high), math.log(1 - low))))
    return within(dimension, math.exp(rng.uniform(math.log(low), math.log(high))))


def perturbed(dimension: Dimension, value: Any, rng: np.random.Generator) -> Any:
    """Returns a neighboring value: of a choice the one before or after it, of a uniform range one shifted by a tenth of it.

    Of a logarithmic range, the value (or its distance from 1) is multiplied by 0.8 or 1.25. Whole numbers move by 1 at least.
    """
    up = bool(rng.integers(2))
    if isinstance(dimension, Choice):
        place = [json.dumps(one) for one in dimension.values].index(json.dumps(value)) + (1 if up else -1)
        return dimension.values[min(max(place, 0), len(dimension.values) - 1)]
    if isinstance(dimension, Uniform):
        return within(dimension, value + (SHIFT if up else -SHIFT) * (dimension.high - dimension.low))
    factor = FACTORS[up]
    if dimension.is_whole:
        moved = max(round(value * factor), value + 1) if up else min(round(value * factor), value - 1)
        return int(within(dimension, moved))
    if isinstance(dimension, NearOne):
        return within(dimension, 1 - (1 - value) * factor)
    return within(dimension, value * factor)


def within(dimension: Any, value: float) -> float:
    """Returns the nearest value in a range."""
    return min(max(value, dimension.low), dimension.high)


def decide(
    scores: Sequence[float | None], values: Sequence[Mapping[str, Any]], space: SearchSpace, rng: np.random.Generator
) -> list[Decision]:
    """Returns the decision about each member after a round.

    The worst quarter copies a random one of the best quarter, as do all that failed.

    Raises:
        ValueError: if all members failed.
    """
    finite = {i: score for i, score in enumerate(scores) if score is not None and math.isfinite(score)}
    if not finite:
        raise ValueError("all members failed; see their logs")
    order = sorted(finite, key=lambda i: (-finite[i], i))
    n = max(len(scores) // SELECTED, 1)
    best = order[:n]
    worst = {*[i for i in range(len(scores)) if i not in finite], *order[max(len(order) - n, n) :]}
    found = []
    for i, own in enumerate(values):
        parent = best[rng.integers(len(best))] if i in worst else None
        copied = own if parent is None else values[parent]
        moved = copied if parent is None else {name: perturbed(space[name], copied[name], rng) for name in copied}
        found.append(Decision(finite.get(i), dict(own), parent, dict(moved)))
    return found


def write(content: Any, path: Path) -> None:
    """Writes a population or the decisions of a round as JSON."""
    plain = [dataclasses.asdict(one) for one in content] if isinstance(content, list) else dataclasses.asdict(content)
    with atomic.replacing(path) as file:
        file.write((json.dumps(plain, indent=1, allow_nan=False) + "\n").encode())


def read(path: Path) -> Population:
    """Returns the population of a file, which is untrusted.

    Raises:
        FileNotFoundError: if it is not there.
        CheckpointError: if it is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path.parent} is no folder of rejeu pbt: it holds no {path.name}")
    try:
        found = convert(read_json(path, MAX_BYTES), Population)
        plans.check(found.plan, path)
        return found
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{path} is damaged: {shown(error, 1000)}") from None


def read_decisions(path: Path, population: Population) -> list[Decision]:
    """Returns the decisions after a round; the file is untrusted.

    Raises:
        CheckpointError: if it is damaged.
    """
    try:
        found = convert(read_json(path, MAX_BYTES), list[Decision])
        space = population.plan.search_space
        if len(found) != population.members:
            raise Malformed(f"it has {len(found)} members instead of {population.members}")
        for one in found:
            for values in (one.values, one.next_values):
                if values.keys() != space.keys() or not all(space[name].contains(values[name]) for name in space):
                    raise Malformed(f"{str(values)[:100]} does not lie in the search space")
            if one.parent is not None and one.parent >= population.members:
                raise Malformed(f"there is no member {one.parent}")
        return found
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{path} is damaged: {shown(error, 1000)}") from None


def hyperparameters(population: Population, values: Mapping[str, Any]) -> dict[str, Any]:
    """Returns all hyperparameters of a member."""
    return spaces.applied(population.plan.fixed, values)
