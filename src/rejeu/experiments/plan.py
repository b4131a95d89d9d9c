"""Plans of sweeps: a TOML file, or the same as a dict, becomes a list of checked jobs.

Nothing that a plan names is imported, and its size is bounded. A mistake is one line with its place.
"""

from __future__ import annotations

import itertools
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym

from rejeu import devices, presets, spaces, validation
from rejeu.agents import AGENTS, find_agent
from rejeu.envs.make import BACKENDS, make_vector
from rejeu.envs.registry import are_plain, is_plain_id, maker, register
from rejeu.experiments.jobs import FILES, MAX_JOBS, Job, Resources, flat, job_name
from rejeu.io.records import convert, is_deep, shown
from rejeu.reporting.logging import check_logs, require
from rejeu.runs.config import RENAMED, RunConfig, options
from rejeu.runs.values import merged
from rejeu.validation import choice, flag, unknown_name, whole

MAX_BYTES, MAX_LINES, MAX_LINE, MAX_DEPTH = 2**16, 1000, 5000, 12
"""Upper limits of a plan: bytes, lines, characters of a line, nested tables and lists."""
OWN_OF_JOBS = ("env", "env_kwargs", "wrappers", "imports", "algorithm", "seed", "hyperparameters")
"""Fields of a run that a plan names in another way, or not at all."""
OWN = ("environments", "algorithms", "settings", "seeds", "first_seed", "threads", "resources", "env_kwargs")
OPTIONS = (*(one.shown.name or one.field for one in options(RunConfig) if one.field not in OWN_OF_JOBS), *FILES)
"""Options of a plan, which are those of ``rejeu train``."""
Place = tuple[str, ...]
KEY = re.compile(r"\"([^\"\\]*)\"|'([^']*)'|([\w-]+)")
KEYS = rf"(?P<keys>(?:{KEY.pattern})(?:\s*[.]\s*(?:{KEY.pattern}))*)"
NAMED = re.compile(rf"\s*(?P<header>\[+\s*)?{KEYS}\s*(?(header)\]+\s*(#|$)|=)")
"""A line that names a table or a key, without escapes."""


class PlanError(ValueError):
    """A plan is invalid. The message has the file, the line, what was received and what was expected."""


@dataclass(frozen=True)
class Source:
    """A plan as text or as a dict, for messages that say where something is."""

    name: str
    text: str | None = None
    """The TOML text; None for a dict."""

    def error(self, place: Place, problem: object) -> PlanError:
        """Returns an error about the key at a place."""
        if self.text is not None:
            where = f"{self.name}, line {line_of(self.text, place)}"
        else:
            where = f"{self.name}, {'.'.join(place)}" if place else self.name
        return PlanError(f"{where}: {shown(' '.join(str(problem).split()), 1000)}")

    def checked(self, place: Place, function: Any, *arguments: Any, **keywords: Any) -> Any:
        """Returns ``function(...)``; an invalid value becomes an error with its place."""
        try:
            return function(*arguments, **keywords)
        except PlanError:
            raise
        except (ValueError, TypeError, ArithmeticError, ImportError, OSError, gym.error.Error, AssertionError) as error:
            raise self.error(place, error or type(error).__name__) from None

    def check_names(self, given: Iterable[str], known: Sequence[str], place: Place, owner: str) -> None:
        """Raises ``PlanError`` for a name that is not known, with the nearest."""
        for key in given:
            if key not in known:
                raise self.error((*place, key), unknown_name(key, known, owner))

    def table(self, value: Any, place: Place, of_tables: bool = True) -> Mapping[str, Any]:
        """Returns a table that is not empty, by default one of tables."""
        if not isinstance(value, Mapping) or (of_tables and not value):
            raise self.error(place, f"{place[-1]}={shown(value)} must be a table: [{'.'.join(place)}]")
        for name, one in value.items() if of_tables else ():
            self.table(one, (*place, name), of_tables=False)
        return value


class Environment(NamedTuple):
    """An environment of a plan, and its spaces."""

    label: str
    env_id: str
    kwargs: dict[str, Any]
    algorithms: tuple[str | None, ...]
    options: dict[str, Any]
    """Options of the runs, by their names in :class:`RunConfig`, and those about their files."""
    place: Place
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
        text = path.read_bytes().decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError:
        raise PlanError(f"{path} is not UTF-8 text; a plan is a TOML file") from None
    lines = text.split("\n")
    if len(lines) > MAX_LINES or max(map(len, lines)) > MAX_LINE:
        raise PlanError(f"{path} has more than {MAX_LINES:,} lines, or one of more than {MAX_LINE:,} characters")
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        problem, _, place = str(error).partition(" (at ")
        line = re.search(r"line (\d+)", place)
        number = line[1] if line else text.rstrip().count("\n") + 1
        raise PlanError(f"{path}, line {number}: {problem[:200]}; expected TOML, such as steps = 20000") from None
    return parse(content, Source(str(path), text)), text


def line_of(text: str, place: Place) -> int:
    r"""Returns the line that names most of a place: its key, or the table around it where that is not certain.

    >>> line_of("steps = 10\n[settings.fast]\n\ngamma = [\n0.9]", ("settings", "fast", "gamma"))
    4
    """
    found, most = 1, 0
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        named = NAMED.match(line)
        keys = tuple("".join(parts) for parts in KEY.findall(named["keys"])) if named else ()
        if line.lstrip().startswith("["):
            table = keys or ("",)  # unknown: its name has escapes, or this is a row of a list
        else:
            keys = (*table, *keys)
        n = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], zip(keys, place, strict=False)))
        if named and n > most:
            found, most = number, n
    return found


def parse(content: Mapping[str, Any], source: Source) -> Plan:
    """Returns the jobs of a plan: environments x algorithms x settings x seeds.

    Raises:
        PlanError: for a mistake.
    """
    if is_deep(content, MAX_DEPTH):
        raise source.error((), f"it is nested more than {MAX_DEPTH} levels deep")
    check_values(content, source, ())
    source.check_names(content, (*OWN, *OPTIONS), (), "a plan")
    settings = source.table(content.get("settings", {"": {}}), ("settings",))
    seeds = read_seeds(content, source)
    resources = source.table(content.get("resources", {}), ("resources",), of_tables=False)
    source.check_names(resources, validation.field_names(Resources), ("resources",), "resources")
    for key, one in resources.items():
        source.checked(("resources", key), Resources, **{key: one})
    threads = content.get("threads")
    if threads is not None:
        threads = source.checked(("threads",), whole, "threads", threads, 1, 1024)
    environments = list(read_environments(content, source))
    count = sum(len(one.algorithms) for one in environments) * len(settings) * len(seeds)
    if count > MAX_JOBS:
        raise source.error((), f"there are {count:,} runs, expected up to {MAX_JOBS:,}")
    jobs: dict[str, Job] = {}
    for job in expanded(environments, settings, seeds, source):
        if jobs.setdefault(job.name.lower(), job) is not job:
            raise source.error((), f"two runs would be called {job.name}; give settings and environments other names")
    if not jobs:
        raise source.error((), "there is nothing to train; does every setting exclude every algorithm?")
    for log in {name for job in jobs.values() for name in job.run.log}:
        source.checked(("log",), require, (log,))
    return Plan(jobs=tuple(jobs.values()), threads=threads, resources=Resources(**resources))


def expanded(
    environments: Iterable[Environment], settings: Mapping[str, Any], seeds: Sequence[int], source: Source
) -> Iterator[Job]:
    """Yields the job of each combination, after its hyperparameters were checked."""
    for environment in environments:
        for algorithm, (name, setting) in itertools.product(environment.algorithms, settings.items()):
            place = ("settings", name)
            own = source.table(setting.get(algorithm, {}), (*place, str(algorithm)), of_tables=False)
            if "algorithms" in setting and algorithm not in read_algorithms(
                setting["algorithms"], source, (*place, "algorithms")
            ):
                continue
            common = {key: value for key, value in setting.items() if key != "algorithms" and key not in AGENTS}
            chosen = algorithm or choose_algorithm(environment, source)
            places = {**dict.fromkeys(common, place), **dict.fromkeys(own, (*place, str(algorithm)))}
            check_hyperparameters(environment, chosen, {**common, **own}, places, source)
            for seed in seeds:
                run = RunConfig(
                    env=environment.env_id,
                    seed=seed,
                    env_kwargs=environment.kwargs,
                    algorithm=chosen,
                    hyperparameters=dict(flat({**common, **own})),
                    **{key: value for key, value in environment.options.items() if key not in FILES},
                )
                files = {key: value for key, value in environment.options.items() if key in FILES}
                yield Job(name=job_name(environment.label, chosen, name, seed), run=run, setting=name, **files)


def check_values(value: Any, source: Source, place: Place) -> None:
    """Raises ``PlanError`` for a value that JSON does not have, such as a date or NaN."""
    if isinstance(value, Mapping):
        for key, one in value.items():
            if not isinstance(key, str):
                raise source.error(place, f"the name {key!r} must be a string")
            check_values(one, source, (*place, key))
    elif isinstance(value, list | tuple):
        for one in value:
            check_values(one, source, place)
    elif isinstance(value, float) and not math.isfinite(value):
        raise source.error(place, f"{place[-1]}={value} must be a finite number")
    elif value is not None and not isinstance(value, str | bool | int | float):
        kinds = "a number, a string, true, false, a list or a table"
        raise source.error(place, f"{place[-1]}={shown(value)} must be {kinds}")


def read_options(content: Mapping[str, Any], base: Mapping[str, Any], source: Source, place: Place) -> dict[str, Any]:
    """Returns the options in a table; those of the table ``base`` where it has none."""
    given = {key: content[key] for key in OPTIONS if key in content}
    kept = {key: base[key] for key in OPTIONS if key in base}
    if "steps" in given or "minutes" in given:
        kept = {key: value for key, value in kept.items() if key not in ("steps", "minutes")}
    found = {
        RENAMED.get(key, key): source.checked((*place, key), read_option, key, value)
        for key, value in {**kept, **given}.items()
    }
    of_run = {key: value for key, value in found.items() if key not in FILES}
    source.checked((*place, *list(given)[-1:]), RunConfig, env="", **of_run)
    return found


def read_option(key: str, value: Any) -> Any:
    """Returns the value of an option; a whole number may be written as 1e6.

    Raises:
        ValueError, TypeError: for an invalid value.
    """
    if key in FILES:
        return flag(key, value)
    if key in ("backend", "device") and value is not None:
        choice(key, value, BACKENDS if key == "backend" else devices.NAMES)
    if key in ("preset", "arrivals") and not isinstance(value, str | None):
        raise TypeError(f"{key}={value!r} must be the path of a file")
    if key == "ray" and value not in (None, "auto"):
        raise ValueError(
            f"ray={value!r} must be 'auto': no file may name what is connected to; set RAY_ADDRESS=HOST:PORT"
        )
    if key == "log":
        return check_logs(key, value)
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    name = RENAMED.get(key, key)
    return getattr(convert({"env": "", name: value}, RunConfig), name)


def read_algorithms(value: Any, source: Source, place: Place) -> tuple[str | None, ...]:
    """Returns the names of algorithms."""
    values = [value] if isinstance(value, str) else value
    if not isinstance(values, list | tuple) or not values or not all(isinstance(one, str) for one in values):
        raise source.error(place, f"algorithms={shown(value)} must be a list of names, such as ['SAC', 'TD3']")
    found = [source.checked(place, find_agent, one, is_typed=False) for one in values]
    names = tuple(agent.algorithm.Config.name for agent in found)
    if len({*names}) < len(names):
        raise source.error(place, f"algorithms={shown(names)} names one twice")
    return names


def read_environments(content: Mapping[str, Any], source: Source) -> Iterator[Environment]:
    """Yields the environments of a plan: a list of ids, or a table of tables with options of their own."""
    place: Place = ("environments",)
    value = content.get("environments")
    if not value:
        raise source.error(place, "a plan needs environments = ['Pendulum-v1', ...]")
    read_options(content, {}, source, ())
    shared = read_kwargs(content, source, ())
    algorithms: tuple[str | None, ...] = (None,)
    if "algorithms" in content:
        algorithms = read_algorithms(content["algorithms"], source, ("algorithms",))
    ids = [value] if isinstance(value, str) else value
    if isinstance(ids, list | tuple):
        if any(not isinstance(one, str) for one in ids) or len({*ids}) < len(ids):
            what = "names one twice" if all(isinstance(one, str) for one in ids) else "must be a list of ids"
            raise source.error(place, f"environments={shown(value)} {what}, expected such as ['Pendulum-v1']")
        tables, places = {one: dict[str, Any]() for one in ids}, dict.fromkeys(ids, place)
    else:
        tables = dict(source.table(value, place))
        places = {label: (*place, label) for label in tables}
    for label, table in tables.items():
        where = places[label]
        source.check_names(table, ("id", "algorithms", "env_kwargs", *OPTIONS), where, f"the environment {label}")
        env_id = table.get("id", label)
        if not is_plain_id(env_id) or str(env_id).endswith(".py"):
            raise source.error(
                where,
                f"{shown(env_id)} is not the id of an environment, and no file may name a module; import it on the command "
                "line, rejeu sweep PLAN --import MODULE, and write its id here",
            )
        own = algorithms
        if "algorithms" in table:
            own = read_algorithms(table["algorithms"], source, (*where, "algorithms"))
        kwargs = {**shared, **read_kwargs(table, source, where)}
        chosen = read_options(table, content, source, where)
        found = source.checked(where, find_spaces, env_id, kwargs, chosen.get("backend"))
        yield Environment(label, env_id, kwargs, own, chosen, where, *found)


def read_kwargs(table: Mapping[str, Any], source: Source, place: Place) -> dict[str, Any]:
    """Returns the keyword arguments of an environment."""
    given = source.table(table.get("env_kwargs", {}), (*place, "env_kwargs"), of_tables=False)
    for key, value in given.items():
        if not are_plain({key: value}):
            problem = f"{key}={shown(value)} must be a number up to a million, a word, true or false"
            raise source.error((*place, "env_kwargs", key), problem)
    return dict(given)


def read_seeds(content: Mapping[str, Any], source: Source) -> list[int]:
    """Returns the seeds: a list, or as many as ``seeds`` says from ``first_seed`` on."""
    value, most = content.get("seeds", 1), 2**32 - 1
    first = source.checked(("first_seed",), whole, "first_seed", content.get("first_seed", 0), 0, most - MAX_JOBS)
    if not isinstance(value, list | tuple):
        return [first + i for i in range(source.checked(("seeds",), whole, "seeds", value, 1, 1000))]
    if "first_seed" in content:
        raise source.error(("first_seed",), "first_seed and a list of seeds exclude each other; give one of them")
    seeds = [source.checked(("seeds",), whole, "seeds", one, 0, most) for one in value]
    if not seeds or len({*seeds}) < len(seeds):
        raise source.error(("seeds",), f"seeds={shown(value)} must be a number, or a list of different seeds")
    return seeds


def find_spaces(env_id: str, kwargs: Mapping[str, Any], backend: str | None) -> tuple[gym.Space, gym.Space]:
    """Makes an environment once, and returns its spaces of observations and actions."""
    if register(env_id):
        env: Any = maker(env_id, **kwargs)()
    else:
        env = make_vector(env_id, 1, "envpool" if backend == "envpool" else "auto", **kwargs)
    try:
        return env.observation_space, env.action_space
    finally:
        env.close()


def find_preset(environment: Environment, algorithm: str | None, source: Source) -> presets.Preset | None:
    """Returns the preset of the plan's file, else that of the environment, None if there is none."""
    path = environment.options.get("preset")
    if path is None:
        return presets.find(environment.env_id, algorithm)
    found: presets.Preset = source.checked(("preset",), presets.read, path)
    if algorithm not in (None, found.algorithm):
        raise source.error(("preset",), f"{path} is a preset of {found.algorithm}, not of {algorithm}")
    return found


def choose_algorithm(environment: Environment, source: Source) -> str:
    """Returns the algorithm of the preset, or the one that fits the actions."""
    preset, kind = find_preset(environment, None, source), type(environment.action).__name__
    if preset is None and kind not in presets.ALGORITHM_FOR:
        raise source.error(environment.place, f"no algorithm here takes the actions {environment.action}")
    return presets.ALGORITHM_FOR[kind] if preset is None else preset.algorithm


def check_hyperparameters(
    environment: Environment, algorithm: str, given: Mapping[str, Any], places: Mapping[str, Place], source: Source
) -> None:
    """Builds the algorithm for the environment's spaces, as ``rejeu train`` would, without training.

    Raises:
        PlanError: for an unknown or invalid hyperparameter, or if the algorithm does not take such spaces.
    """
    kind = AGENTS[algorithm]
    names = validation.field_names(kind.algorithm.Config)
    for key in given:
        source.check_names([key], names, places[key], algorithm)
    base = find_preset(environment, algorithm, source) or presets.default(environment.env_id, algorithm)
    try:
        config = validation.build(kind.algorithm.Config, merged(dict(flat(given)), base.hyperparameters))
    except (ValueError, TypeError) as error:
        words = re.findall(r"\w+", str(error))[:1]
        key = next((name for name, _ in flat(given) if name.split(".")[-1] in words), next(iter(given), ""))
        head = key.split(".")
        raise source.error((*places[head[0]], *head) if key else environment.place, error) from None
    nested = isinstance(environment.observation, gym.spaces.Dict | gym.spaces.Tuple)
    agent = kind.__new__(kind)

    def build() -> None:
        agent.configure("MultiInputPolicy" if nested else "MlpPolicy", config, seed=0)
        agent.build(environment.observation, environment.action)
        if getattr(config, "hindsight", None) is not None:
            spaces.check_goal_space(environment.observation)

    source.checked(next(iter(places.values()), environment.place), build)
