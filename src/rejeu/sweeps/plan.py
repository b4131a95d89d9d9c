"""Plans of sweeps: a TOML file, or the same as a dict, becomes a list of checked jobs.

A plan is untrusted: sizes are bounded, and nothing that it names is imported. A mistake is one line with its place.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym

from rejeu import presets, spaces, validation
from rejeu.agents import AGENTS, find_agent
from rejeu.envs.make import make_vector
from rejeu.envs.registry import are_plain, is_plain_id, maker, register
from rejeu.io.records import shown
from rejeu.reporting.logging import require
from rejeu.sweeps.jobs import MAX_JOBS, Job, Options, flat, job_name
from rejeu.sweeps.resources import Resources
from rejeu.validation import unknown_name, whole

MAX_BYTES = 2**16
"""Upper limit on the size of a plan."""
MAX_LINES = 1000
"""Upper limit on the lines of a plan."""
MAX_DEPTH = 12
"""Upper limit on nested tables and lists."""
OWN = ("environments", "algorithms", "settings", "seeds", "first_seed", "threads", "resources", "env_kwargs")
OPTIONS = tuple(one.name for one in dataclasses.fields(Options))
Place = tuple[str, ...]


class PlanError(ValueError):
    """A plan is invalid. The message has the file, the line, what was received and what was expected."""


@dataclass(frozen=True)
class Source:
    """A plan as text or as a dict, for messages that say where something is."""

    name: str
    text: str | None = None
    """The TOML text; None for a dict."""

    def where(self, place: Place) -> str:
        """Returns the file and the line of a key, or its path in a dict."""
        if self.text is None:
            return f"{self.name}, {'.'.join(place)}" if place else self.name
        return f"{self.name}, line {line_of(self.text, place)}"

    def error(self, place: Place, problem: object) -> PlanError:
        """Returns an error about the key at a place."""
        return PlanError(f"{self.where(place)}: {' '.join(str(problem).split())}")


class Environment(NamedTuple):
    """An environment of a plan."""

    label: str
    env_id: str
    kwargs: dict[str, Any]
    algorithms: tuple[str | None, ...]
    options: Options
    place: Place


class Spaces(NamedTuple):
    """The spaces of an environment."""

    observation: gym.Space
    action: gym.Space


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The jobs of a sweep, and what each needs."""

    jobs: tuple[Job, ...]
    threads: int | None = None
    """Threads of each run; None for its share of the cores."""
    resources: Resources = field(default_factory=Resources)


def read_plan(plan: str | Path | Mapping[str, Any]) -> tuple[Plan, str | None]:
    """Returns a checked plan, and its text if it is a file.

    Args:
        plan: path of a TOML file, or its content as a dict.

    Raises:
        PlanError: for a mistake, with its line.
        OSError: if the file cannot be read.
    """
    if isinstance(plan, Mapping):
        return parse(plan, Source("plan")), None
    path = Path(plan)
    if not path.is_file():
        raise FileNotFoundError(f"there is no plan {path}")
    if path.stat().st_size > MAX_BYTES:
        raise PlanError(f"{path} has more than {MAX_BYTES:,} bytes, the most of a plan")
    try:
        text = path.read_bytes().decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise PlanError(f"{path} is not UTF-8 text; a plan is a TOML file") from None
    if text.count("\n") > MAX_LINES:
        raise PlanError(f"{path} has more than {MAX_LINES:,} lines, the most of a plan")
    try:
        content = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        problem, _, place = str(error).partition(" (at ")
        line = re.search(r"line (\d+)", place)
        at = f"line {line[1]}" if line else f"line {text.rstrip().count(chr(10)) + 1}"
        raise PlanError(f"{path}, {at}: {problem[:200]}; expected TOML, such as steps = 20000") from None
    return parse(content, Source(str(path), text)), text


def line_of(text: str, place: Place) -> int:
    r"""Returns the line in which the value at a place begins, or that of the table around it.

    >>> line_of("steps = 10\n[settings.fast]\n\ngamma = [\n0.9]", ("settings", "fast", "gamma"))
    4
    """
    lines = text.splitlines(keepends=True)
    for n in range(len(place), 0, -1):
        first = 1
        for last in range(1, len(lines) + 1):
            try:
                found = tomllib.loads("".join(lines[:last]))
            except tomllib.TOMLDecodeError:
                continue  # the value continues in the next line
            if is_in(found, place[:n]):
                return first
            first = last + 1
    return 1


def is_in(content: Any, place: Place) -> bool:
    """Returns whether nested tables have a value at this place."""
    for key in place:
        if not isinstance(content, Mapping) or key not in content:
            return False
        content = content[key]
    return True


def parse(content: Mapping[str, Any], source: Source) -> Plan:
    """Returns the jobs of a plan: environments x algorithms x settings x seeds.

    Raises:
        PlanError: for a mistake.
    """
    check_values(content, source, ())
    check_names(content, (*OWN, *OPTIONS), source, (), "a plan")
    options = read_options(content, {}, source, ())
    algorithms = read_algorithms(content.get("algorithms", [None]), source, ("algorithms",))
    environments = list(read_environments(content, options, algorithms, source))
    seeds = read_seeds(content, source)
    settings = read_table(content.get("settings", {"": {}}), source, ("settings",))
    resources = read_resources(content.get("resources", {}), source)
    threads = None
    if "threads" in content:
        threads = checked(source, ("threads",), whole, "threads", content["threads"], 1, 1024)
    count = sum(len(one.algorithms) for one in environments) * len(settings) * len(seeds)
    if count > MAX_JOBS:
        raise source.error((), f"there are {count:,} runs, expected up to {MAX_JOBS:,}")
    jobs: list[Job] = []
    for environment in environments:
        found = find_spaces(environment, source)
        for algorithm, (name, setting) in itertools.product(environment.algorithms, settings.items()):
            hyperparameters = of_algorithm(setting, algorithm, source, ("settings", name))
            if hyperparameters is None:
                continue
            chosen = choose_algorithm(environment, algorithm, found, source)
            check_hyperparameters(environment, chosen, hyperparameters, found, source, ("settings", name))
            for seed in seeds:
                label = name if len(settings) > 1 or name else ""
                jobs.append(
                    Job(
                        name=job_name(environment.label, chosen, label, seed),
                        env=environment.env_id,
                        seed=seed,
                        env_kwargs=environment.kwargs,
                        algorithm=chosen,
                        setting=name,
                        hyperparameters=dict(flat(hyperparameters)),
                        options=environment.options,
                    )
                )
    if not jobs:
        raise source.error((), "there is nothing to train; does every setting exclude every algorithm?")
    check_unique(jobs, source)
    for log in {name for job in jobs for name in job.options.log}:
        checked(source, ("log",), require, (log,))
    return Plan(jobs=tuple(jobs), threads=threads, resources=resources)


def checked(source: Source, place: Place, function: Any, *arguments: Any, **keywords: Any) -> Any:
    """Returns ``function(...)``; an invalid value becomes an error with its place."""
    try:
        return function(*arguments, **keywords)
    except PlanError:
        raise
    except (ValueError, TypeError, ArithmeticError, ImportError, OSError, gym.error.Error, AssertionError) as error:
        raise source.error(place, error or type(error).__name__) from None


def check_values(value: Any, source: Source, place: Place) -> None:
    """Raises ``PlanError`` for a value that JSON does not have, such as a date or NaN, and for deep nesting."""
    if len(place) > MAX_DEPTH:
        raise source.error(place, f"it is nested more than {MAX_DEPTH} levels deep")
    if isinstance(value, Mapping):
        for key, one in value.items():
            if not isinstance(key, str):
                raise source.error(place, f"the name {key!r} must be a string")
            check_values(one, source, (*place, key))
    elif isinstance(value, list | tuple):
        for one in value:
            check_values(one, source, place if not isinstance(one, list | tuple) else (*place, ""))
    elif isinstance(value, float) and not math.isfinite(value):
        raise source.error(place, f"{place[-1]}={value} must be a finite number")
    elif value is not None and not isinstance(value, str | bool | int | float):
        raise source.error(
            place, f"{place[-1]}={shown(value)} must be a number, a string, true, false, a list or a table"
        )


def check_names(given: Iterable[str], known: Sequence[str], source: Source, place: Place, owner: str) -> None:
    """Raises ``PlanError`` for a name that is not known, with the nearest."""
    for key in given:
        if key not in known:
            raise source.error((*place, key), unknown_name(key, known, owner))


def read_table(value: Any, source: Source, place: Place) -> Mapping[str, Mapping[str, Any]]:
    """Returns a table of tables."""
    if not isinstance(value, Mapping):
        raise source.error(place, f"{place[-1]}={shown(value)} must be a table: [{place[-1]}.NAME]")
    if not value:
        raise source.error(place, f"{place[-1]} is empty; name at least one, or leave it out")
    for name, one in value.items():
        if not isinstance(one, Mapping):
            raise source.error((*place, name), f"{name}={shown(one)} must be a table: [{place[-1]}.{name}]")
    return value


def read_options(content: Mapping[str, Any], base: Mapping[str, Any], source: Source, place: Place) -> Options:
    """Returns the options in a table; those of ``base`` where it has none."""
    given = {key: content[key] for key in OPTIONS if key in content}
    for key, value in given.items():
        checked(source, (*place, key), Options, **{key: value})
    if "steps" in given or "minutes" in given:
        base = {key: value for key, value in base.items() if key not in ("steps", "minutes")}
    return checked(source, (*place, *list(given)[-1:]), Options, **{**base, **given})


def read_algorithms(value: Any, source: Source, place: Place) -> tuple[str | None, ...]:
    """Returns the names of algorithms."""
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list | tuple) or not values:
        raise source.error(place, f"algorithms={shown(value)} must be a list of names, such as ['SAC', 'TD3']")
    names: list[str | None] = []
    for one in values:
        if one is not None and not isinstance(one, str):
            raise source.error(place, f"algorithms contains {shown(one)}, expected names such as 'SAC'")
        names.append(None if one is None else checked(source, place, find_agent, one).algorithm.Config.name)
    if len({*names}) < len(names):
        raise source.error(place, f"algorithms={names} names one twice")
    return tuple(names)


def read_environments(
    content: Mapping[str, Any], options: Options, algorithms: tuple[str | None, ...], source: Source
) -> Iterator[Environment]:
    """Yields the environments of a plan: a list of ids, or a table of tables with options of their own."""
    place: Place = ("environments",)
    value = content.get("environments")
    if not value:
        raise source.error(
            place if "environments" in content else (), "a plan needs environments = ['Pendulum-v1', ...]"
        )
    if isinstance(value, str):
        value = [value]
    if isinstance(value, list | tuple):
        if any(not isinstance(one, str) for one in value):
            raise source.error(place, f"environments={shown(value)} must be a list of ids, such as ['Pendulum-v1']")
        if len({*value}) < len(value):
            raise source.error(place, f"environments={shown(value)} names one twice")
        value = {one: {} for one in value}
        places = dict.fromkeys(value, place)
    else:
        value = read_table(value, source, place)
        places = {label: (*place, label) for label in value}
    shared = read_kwargs(content, source, ())
    for label, table in value.items():
        where = places[label]
        check_names(table, ("id", "algorithms", "env_kwargs", *OPTIONS), source, where, f"the environment {label}")
        env_id = table.get("id", label)
        if not is_plain_id(env_id) or str(env_id).endswith(".py"):
            raise source.error(
                where,
                f"{shown(env_id)} is not the id of an environment, and no file may name a module; import it on the command "
                "line, rejeu sweep PLAN --import MODULE, and write its id here",
            )
        base = dataclasses.asdict(options)
        own = (
            read_algorithms(table["algorithms"], source, (*where, "algorithms"))
            if "algorithms" in table
            else algorithms
        )
        kwargs = {**shared, **read_kwargs(table, source, where)}
        yield Environment(label, env_id, kwargs, own, read_options(table, base, source, where), where)


def read_kwargs(table: Mapping[str, Any], source: Source, place: Place) -> dict[str, Any]:
    """Returns the keyword arguments of an environment."""
    given = table.get("env_kwargs", {})
    if not isinstance(given, Mapping):
        raise source.error((*place, "env_kwargs"), f"env_kwargs={shown(given)} must be a table")
    for key, value in given.items():
        if not are_plain({key: value}):
            raise source.error(
                (*place, "env_kwargs", key),
                f"{key}={shown(value)} must be a number up to a million, a word, true or false",
            )
    return dict(given)


def read_seeds(content: Mapping[str, Any], source: Source) -> list[int]:
    """Returns the seeds: a list, or as many as ``seeds`` says from ``first_seed`` on."""
    value = content.get("seeds", 1)
    first = checked(source, ("first_seed",), whole, "first_seed", content.get("first_seed", 0), 0, 2**32 - 1 - MAX_JOBS)
    if isinstance(value, list | tuple):
        if "first_seed" in content:
            raise source.error(("first_seed",), "first_seed and a list of seeds exclude each other; give one of them")
        seeds = [checked(source, ("seeds",), whole, "seeds", one, 0, 2**32 - 1) for one in value]
        if not seeds or len({*seeds}) < len(seeds):
            raise source.error(("seeds",), f"seeds={shown(value)} must be a number, or a list of different seeds")
        return seeds
    return [first + i for i in range(checked(source, ("seeds",), whole, "seeds", value, 1, 1000))]


def read_resources(value: Any, source: Source) -> Resources:
    """Returns what a run needs on a cluster."""
    place: Place = ("resources",)
    if not isinstance(value, Mapping):
        raise source.error(place, f"resources={shown(value)} must be a table: [resources]")
    names = validation.field_names(Resources)
    check_names(value, names, source, place, "resources")
    for key, one in value.items():
        checked(source, (*place, key), Resources, **{key: one})
    return Resources(**value)


def of_algorithm(
    setting: Mapping[str, Any], algorithm: str | None, source: Source, place: Place
) -> dict[str, Any] | None:
    """Returns the hyperparameters of a setting for an algorithm: its own, and those in the table of the algorithm's name.

    None if the setting is for other algorithms.
    """
    if "algorithms" in setting:
        names = read_algorithms(setting["algorithms"], source, (*place, "algorithms"))
        if algorithm not in names:
            return None
    common = {key: value for key, value in setting.items() if key != "algorithms" and key not in AGENTS}
    own = setting.get(algorithm, {}) if algorithm is not None else {}
    if not isinstance(own, Mapping):
        raise source.error((*place, str(algorithm)), f"{algorithm}={shown(own)} must be a table")
    return {**common, **own}


def find_spaces(environment: Environment, source: Source) -> Spaces:
    """Makes an environment once, and returns its spaces."""

    def make() -> Spaces:
        env: Any
        if register(environment.env_id):
            env = maker(environment.env_id, **environment.kwargs)()
        else:
            backend = "envpool" if environment.options.backend == "envpool" else "auto"
            env = make_vector(environment.env_id, 1, backend, **environment.kwargs)  # type: ignore[arg-type]
        try:
            return Spaces(env.observation_space, env.action_space)
        finally:
            env.close()

    found: Spaces = checked(source, environment.place, make)
    return found


def find_preset(environment: Environment, algorithm: str | None, source: Source) -> presets.Preset | None:
    """Returns the preset of the plan's file, else that of the environment, None if there is none."""
    path = environment.options.preset
    if path is None:
        return presets.find(environment.env_id, algorithm)
    found: presets.Preset = checked(source, ("preset",), presets.read, path)
    if algorithm not in (None, found.algorithm):
        raise source.error(("preset",), f"{path} is a preset of {found.algorithm}, not of {algorithm}")
    return found


def choose_algorithm(environment: Environment, algorithm: str | None, found: Spaces, source: Source) -> str:
    """Returns the algorithm, by default that of the preset, or the one that fits the actions."""
    if algorithm is not None:
        return algorithm
    preset = find_preset(environment, None, source)
    if preset is not None:
        return preset.algorithm
    kind = type(found.action).__name__
    if kind not in presets.ALGORITHM_FOR:
        raise source.error(environment.place, f"no algorithm here takes the actions {found.action}")
    return presets.ALGORITHM_FOR[kind]


def check_hyperparameters(
    environment: Environment, algorithm: str, given: Mapping[str, Any], found: Spaces, source: Source, place: Place
) -> None:
    """Builds the algorithm for the environment's spaces, as ``rejeu train`` would, without training.

    Raises:
        PlanError: for an unknown or invalid hyperparameter, or if the algorithm does not take such spaces.
    """
    kind = AGENTS[algorithm]
    names = validation.field_names(kind.algorithm.Config)

    def spot(key: str) -> Place:
        own = (*place, algorithm, *key.split("."))
        return own if is_in_source(source, own) else (*place, *key.split("."))

    for key in given:
        if key not in names:
            raise source.error(spot(key), unknown_name(key, names, algorithm))
    base = find_preset(environment, algorithm, source) or presets.default(environment.env_id, algorithm)
    try:
        config = validation.build(kind.algorithm.Config, merged(base.hyperparameters, given))
    except (ValueError, TypeError) as error:
        words = re.findall(r"\w+", str(error))[:1]
        key = next((name for name, _ in flat(given) if name.split(".")[-1] in words), next(iter(given), ""))
        raise source.error(spot(key) if key else environment.place, error) from None
    nested = isinstance(found.observation, gym.spaces.Dict | gym.spaces.Tuple)
    agent = kind.__new__(kind)

    def build() -> None:
        agent.configure("MultiInputPolicy" if nested else "MlpPolicy", config, seed=0)
        agent.build(found.observation, found.action)
        if getattr(config, "hindsight", None) is not None:
            spaces.check_goal_space(found.observation)

    checked(source, (*place,) if given else environment.place, build)


def is_in_source(source: Source, place: Place) -> bool:
    """Returns whether the text of a plan has a value at this place."""
    return source.text is not None and is_in(tomllib.loads(source.text), place)


def merged(base: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Returns ``base`` with the given values; tables are merged.

    >>> merged({"policy_kwargs": {"layer_norm": True}}, {"policy_kwargs": {"net_arch": [8]}})
    {'policy_kwargs': {'layer_norm': True, 'net_arch': [8]}}
    """
    result = dict(base)
    for key, value in given.items():
        before = result.get(key)
        both = isinstance(before, Mapping) and isinstance(value, Mapping) and value
        result[key] = merged(before, value) if both else value  # type: ignore[arg-type]
    return result


def check_unique(jobs: Sequence[Job], source: Source) -> None:
    """Raises ``PlanError`` if two runs would have the same folder."""
    names: set[str] = set()
    for job in jobs:
        if job.name.lower() in names:
            raise source.error((), f"two runs would be called {job.name}; give settings and environments other names")
        names.add(job.name.lower())
