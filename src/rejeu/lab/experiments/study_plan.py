"""The plan of a study: environment, algorithm, search space and limits, as ``study.json`` in the study folder."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from rejeu.agents import AGENTS, agent_of_file, find_agent, presets
from rejeu.agents.presets import Preset
from rejeu.algorithms import config as configs
from rejeu.algorithms.search import HINDSIGHT, Choice, Dimension, SearchSpace
from rejeu.core import validation
from rejeu.core.errors import CheckpointError
from rejeu.core.records import Seed, convert, json_text
from rejeu.core.types import Settings
from rejeu.lab.experiments import folder as folders, space as spaces
from rejeu.lab.runs.config import RunConfig

FILE = "study.json"
MAX_BYTES = 2**20
"""Upper limit on the size of a ``study.json``."""
MAX_TRIALS = 100_000
MIN_FINAL_SEEDS = 5
"""Least number of seeds of a comparison. Bootstrap intervals of fewer are too narrow: with three seeds, one in five
comparisons of equal settings would find a difference."""
EVALUATIONS = 10
"""Evaluations of a trial, unless their interval is given."""
SAMPLING, TRIALS, FINAL = range(3)
"""Streams of random numbers: of the sampler, of the seeds of trials, of the seeds of the final comparison."""

OF_DEFAULT = {"n_envs", "backend", "evaluate_every", "evaluate_episodes"}
"""Fields of a preset that are settings of a study."""

Pruner = Literal["median", "halving", "none"]
Measure = Literal["return", "success"]


@dataclass(frozen=True, kw_only=True)
class StudyPlan:
    """The settings of a study. Everything that a repetition needs, except for the number of workers."""

    default: Preset
    """The preset that the winner is compared with and every training shares: environment, algorithm, steps and evaluations.

    Its hyperparameters are those of the given preset or of rejeu's; empty for the algorithm's defaults."""
    env_argument: str = ""
    """How the environment was named on the command line, if not by its id; never imported because a file says so."""
    env_kwargs: Settings = field(default_factory=dict)
    """Keyword arguments of the environment."""
    wrappers: tuple[str, ...] = ()
    """Names of its wrappers, innermost first."""
    fixed: Settings
    """Hyperparameters of every trial, before those that are searched: of the default, with what the user set."""
    space: dict[str, str]
    """Where the others are searched, as ``--search`` takes it."""
    trials: Annotated[int, Meta(ge=1, le=MAX_TRIALS)] = 30
    trial_seeds: Annotated[int, Meta(ge=1, le=1000)] = 1
    """Seeds of each trial, whose evaluations are averaged."""
    final_seeds: Annotated[int, Meta(ge=0, le=1000)] = 5
    """Fresh seeds on which the winner is compared with the default; 0 for no comparison."""
    seed: Seed = 0
    """Determines what is sampled and the seeds of all trainings."""
    pruner: Pruner = "median"
    measure: Measure = "return"
    """The objective: the mean return of the last evaluation, or its success rate."""
    checkpoint_minutes: Annotated[float, Meta(ge=0, le=1e6)] = 5.0

    def __post_init__(self) -> None:
        if 0 < self.final_seeds < MIN_FINAL_SEEDS:
            raise ValueError(
                f"final_seeds={self.final_seeds} cannot tell luck from a difference; give {MIN_FINAL_SEEDS} or more, or 0"
            )

    @property
    def run(self) -> RunConfig:
        """The environment of all trainings."""
        kwargs, wrappers = self.env_kwargs, self.wrappers
        return RunConfig(env=self.default.env_id, env_argument=self.env_argument, env_kwargs=kwargs, wrappers=wrappers)

    @property
    def search_space(self) -> dict[str, Dimension]:
        """Where hyperparameters are searched, by name."""
        return {name: spaces.dimension_of(text) for name, text in self.space.items()}

    @property
    def configuration(self) -> Settings:
        """All hyperparameters before those that are searched, as JSON."""
        config_class = AGENTS[self.default.algorithm].algorithm.Config
        return configs.to_json(validation.build(config_class, self.fixed))

    @property
    def column(self) -> str:
        """The column of ``evaluations.csv`` that is maximized."""
        return {"return": "mean_return", "success": "success_rate"}[self.measure]

    def sampler_seed(self, index: int) -> int:
        """Returns the seed with which the parameters of a trial are sampled."""
        return self._numbers(1, SAMPLING, index)[0]

    def seeds(self, index: int) -> list[int]:
        """Returns the seeds of the trainings of a trial. They are even."""
        return [number & ~1 for number in self._numbers(self.trial_seeds, TRIALS, index)]

    def fresh_seeds(self) -> list[int]:
        """Returns the seeds of the final comparison. They are odd, so that no trial has one of them."""
        return [number | 1 for number in self._numbers(self.final_seeds, FINAL)]

    def _numbers(self, n: int, *key: int) -> list[int]:
        return np.random.SeedSequence([self.seed, *key]).generate_state(max(n, 1)).tolist()[:n]

    def preset(self, hyperparameters: Mapping[str, object], source: str) -> Preset:
        """Returns a preset with these hyperparameters and what all trainings of the study have in common."""
        return dataclasses.replace(self.default, hyperparameters=hyperparameters, source=source)


def make(
    env_id: str,
    algorithm: str | None = None,
    *,
    preset: Preset | None = None,
    fixed: Mapping[str, object] | None = None,
    search: SearchSpace | None = None,
    only: tuple[str, ...] = (),
    steps: int | None = None,
    **others: Any,
) -> StudyPlan:
    """Returns the plan of a study, completed by the preset or the defaults, after all checks that need no training.

    ``fixed`` are hyperparameters that are set instead of searched, and ``others`` are further fields of the plan, None for
    what the preset or the default decides. The rest is as for :func:`rejeu.tune`.

    Raises:
        ValueError: for an unknown algorithm, an empty space, or a value out of range.
        TypeError: for a hyperparameter that the algorithm does not have, with the nearest one, or one that JSON does not have.
    """
    name = None if algorithm is None else find_agent(algorithm).algorithm.Config.name
    base = preset or presets.find(env_id, name)
    if base is None and name is None:
        raise ValueError(f"{env_id} has no preset; name the algorithm to tune, such as --algo PPO")
    base = base or presets.default(env_id, str(name))
    fixed = {key: configs.value_to_json(value) for key, value in (fixed or {}).items()}
    values = {**base.hyperparameters, **fixed}
    space = choose_space(base.algorithm, values, fixed, search or {}, only)
    total = validation.whole("steps", steps or base.total_steps, least=1)
    settings = {key: value for key, value in others.items() if value is not None}
    usual: Settings = {"name": "", "evaluate_every": max(total // EVALUATIONS, 1)}
    if settings.get("env_kwargs") or settings.get("wrappers"):
        usual["backend"] = "auto"
    of_default = usual | {key: settings.pop(key) for key in OF_DEFAULT & settings.keys()}
    default = dataclasses.replace(base, env_id=env_id, total_steps=total, **of_default)
    texts = {key: str(dimension) for key, dimension in space.items()}
    try:  # as it is read again, so that a study begins and goes on with the same
        plan = StudyPlan(default=default, fixed=values, space=texts, **settings)
        return convert(json.loads(json_text(plan)), StudyPlan)
    except CheckpointError as error:
        raise ValueError(str(error)) from None
    except TypeError as error:
        raise TypeError(f"a study takes only hyperparameters that JSON can express: {error}") from None


def choose_space(
    algorithm: str,
    values: Mapping[str, object],
    fixed: Mapping[str, object],
    search: SearchSpace,
    only: tuple[str, ...],
) -> SearchSpace:
    """Returns the search space of a study, in which every extreme value is known to be valid.

    A choice that the algorithm declares gets the value of the default as well, so that the first trial has it.

    Raises:
        ValueError: if nothing is left to search, or a value is out of range.
        TypeError: for a name that the algorithm does not have.
    """
    config_class = AGENTS[algorithm].algorithm.Config
    config = validation.build(config_class, values)
    declared: dict[str, Dimension] = dict(getattr(config_class, "search_space", {}))
    if getattr(config, "hindsight", None) is not None:
        declared |= HINDSIGHT
    defaults = configs.to_json(config)
    for name, dimension in declared.items():
        default = spaces.value_of(defaults, name)
        if isinstance(dimension, Choice) and default is not None and not dimension.contains(default):
            declared[name] = Choice((*dimension.values, default))
    space = {name: dimension for name, dimension in declared.items() if not is_set(fixed, name)} | dict(search)
    for name in only:
        if name not in space:
            raise ValueError(validation.unknown_name(name, space, f"the search space of {algorithm}"))
    space = {name: dimension for name, dimension in space.items() if not only or name in only}
    check_ends(config_class, values, space)
    if not space:
        raise ValueError(f"there is nothing to search for {algorithm}; give a range, such as learning_rate=1e-4..1e-2")
    return space


def is_set(fixed: Mapping[str, object], name: str) -> bool:
    """Returns whether the user set the hyperparameter of a dotted name."""
    head, _, inner_name = name.partition(".")
    inner = fixed.get(head)
    return head in fixed and (not inner_name or not isinstance(inner, Mapping) or is_set(inner, inner_name))


def read(path: Path) -> StudyPlan:
    """Returns the plan of a ``study.json``, which is untrusted.

    Raises:
        FileNotFoundError: if it is not there.
        CheckpointError: if it is damaged, or names an algorithm that is not registered.
    """

    def check(plan: StudyPlan) -> None:
        check_ends(agent_of_file(plan.default.algorithm, path).algorithm.Config, plan.fixed, plan.search_space)

    return folders.read(path, StudyPlan, MAX_BYTES, check)


def check_ends(config_class: type, values: Mapping[str, object], space: SearchSpace) -> None:
    """Raises ``ValueError`` or ``TypeError`` if an extreme value of a space is invalid, where the others are ``values``."""
    for name, dimension in space.items():
        for value in dimension.ends():
            validation.build(config_class, spaces.applied(values, {name: value}))


def difference(plan: StudyPlan, new_plan: StudyPlan) -> str:
    """Returns the first setting in which two plans differ and which a study cannot change, as text; empty if none does."""
    before, after = ({**vars(study.default), **vars(study), "default": None} for study in (plan, new_plan))
    for name, value in before.items():
        if name not in ("trials", "final_seeds", "checkpoint_minutes") and value != after[name]:
            option = name.removeprefix("total_")  # --steps
            return f"another study: {option} is {str(value)[:100]} there, not {str(after[name])[:100]}"
    return ""
