"""The description of a run. The command line, ``config.json``, sweeps and processes read and write it.

Each field is declared once: its type with its range, its default, and how the command line shows it. As asked for, None
stands for what the preset or the environment decides; ``config.json`` has every field as it was decided. A :class:`Task` says
what a process is to do with a run, ``rejeu --task FILE``, so that no value becomes a word of a command line.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import chain
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from msgspec import Meta

from rejeu.checkpoints.run_folder import RunFolder, newest_inside
from rejeu.core import atomic
from rejeu.core.errors import CheckpointError, installed
from rejeu.core.records import (
    Count,
    Duration,
    EnvCount,
    Malformed,
    Positive,
    Seed,
    convert,
    json_text,
    read_json,
    shown,
)
from rejeu.core.types import Settings
from rejeu.core.validation import with_value
from rejeu.logs.formatting import LOGS, quoted

PACKAGES = ("rejeu", "jax", "jaxlib", "numpy", "equinox", "optax", "gymnasium", "envpool", "highway-env")
"""Those whose versions matter for a run."""


def assigned(assignments: Iterable[str], option: str = "--set") -> Settings:
    """Returns the values of assignments by their names, which are dotted where they reach into a nested mapping.

    Args:
        assignments: as typed.
        option: the option that they belong to, for messages.

    Raises:
        ValueError: for an assignment without ``=`` or without a name.

    >>> assigned(["policy_kwargs.net_arch=[64,64]", "gamma=0.9"])
    {'policy_kwargs.net_arch': [64, 64], 'gamma': 0.9}
    """
    result = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not all(name.strip().split(".")):
            example = "learning_rate=1e-3" if option == "--set" else "sigma=2"
            raise ValueError(f"{option} {assignment!r} must be name=value, such as {example}")
        result[name.strip()] = value(text)
    return result


def merged(values: Mapping[str, object], before: Mapping[str, object], option: str = "--set") -> Settings:
    """Returns ``before`` with the values set; a dotted name reaches into a nested mapping.

    Raises:
        TypeError: for a dotted name that reaches into something else than a mapping.

    >>> merged({"policy_kwargs.net_arch": [64, 64], "gamma": 0.9}, {"policy_kwargs": {"layer_norm": True}})
    {'policy_kwargs': {'layer_norm': True, 'net_arch': [64, 64]}, 'gamma': 0.9}
    """
    result = dict(before)
    for name, value in values.items():
        result = with_value(result, name.split("."), value, f"{option} {name}")
    return result


def assignment_words(option: str, values: Mapping[str, object]) -> list[str]:
    """Returns values as an option of the command line.

    >>> assignment_words("--set", {"gamma": 0.9, "policy_kwargs.net_arch": [8]})
    ['--set', 'gamma=0.9', 'policy_kwargs.net_arch=[8]']
    """
    return [option, *(f"{name}={written(value)}" for name, value in values.items())] if values else []


def value(text: str) -> Any:
    """Returns the value of a text: JSON, else a Python literal, else the text itself.

    >>> [value(text) for text in ("1e-3", '[1,"episode"]', "(1, 'episode')", "False", "HerReplayBuffer")]
    [0.001, [1, 'episode'], (1, 'episode'), False, 'HerReplayBuffer']
    """
    for parse in (json.loads, ast.literal_eval):
        try:
            return parse(text)
        except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError):
            continue
    return text


def written(setting: object) -> str:
    """Returns the text from which :func:`value` reads this, if there is one.

    >>> [value(written(setting)) for setting in (2, "8x8", True, [1, "a"], "2")]
    [2, '8x8', True, [1, 'a'], '2']
    """
    return setting if isinstance(setting, str) and value(setting) == setting else json.dumps(setting, default=str)


R = TypeVar("R", bound="RunConfig")
MAX_BYTES = 2**20
"""Upper limit on the size of a ``config.json``, and of the file of a task."""
MAX_WORD = 10_000
"""Upper limit on the length of a word of a command that is shown, in characters."""
MAX_EPISODES = 10_000
"""Upper limit on the episodes of an evaluation while training."""


WORDS_OF_THEIR_OWN = ("env", "env_kwargs", "wrappers", "imports", "hyperparameters")
"""Fields that are not one option with its value."""


class Topic(StrEnum):
    """The list of a help text that an option is in; the title of the list."""

    FIRST = "options"
    ENVIRONMENT = "environment"
    TRAINING = "training"
    EVALUATION = "evaluation"
    OUTPUT = "output"


class Shown(NamedTuple):
    """How the command line shows a field."""

    metavar: str = ""
    """Empty for a flag."""
    name: str = ""
    """Without dashes; empty for the name of the field."""
    help: str = ""
    """Used where the field has no docstring."""
    is_positional: bool = False


class Option(NamedTuple):
    """A field of a dataclass as an option or a positional argument of the command line."""

    field: str
    name: str
    """With its dashes; of a positional argument its metavar."""
    shown: Shown
    type: Any
    """That of the value: ``bool``, ``int``, ``float``, ``str``, ``Path``, ``dict``, ``tuple`` or a ``Literal``."""
    item: Any
    """The type of one word: ``type``, or that of an element of a tuple."""
    group: Topic
    limits: dict[str, float]
    """Of a number: ``ge``, ``gt`` and ``le``."""
    default: Any
    """None where the value is made anew each time."""
    is_required: bool

    @property
    def takes_many(self) -> bool:
        """Whether it takes all words up to the next option; a positional argument, all further positional words."""
        return self.shown.metavar.endswith("...")


Name = Annotated[str, Meta(max_length=300)]
Key = Annotated[str, Meta(pattern=r"^[A-Za-z_][\w.]{0,199}\Z")]
"""A name that cannot be taken for an option of the command line."""


@dataclass(frozen=True, kw_only=True)
class EnvironmentOptions:
    """How an environment is made. Abstract: options of the commands that use one."""

    env_kwargs: Annotated[dict[Key, Any], Shown("NAME=VALUE ..."), Topic.ENVIRONMENT] = field(default_factory=dict)
    """Keyword arguments of the environment: sigma=2 map_name=8x8."""
    wrappers: Annotated[tuple[str, ...], Shown("MODULE:CLASS", "wrapper"), Topic.ENVIRONMENT] = ()
    """Wrap it in this gymnasium.Wrapper, such as gymnasium.wrappers:FlattenObservation; repeat for several, inner first."""
    imports: Annotated[tuple[str, ...], Shown("MODULE", "import"), Topic.ENVIRONMENT] = ()
    """Import this module or Python file first: one that registers algorithms or environments; repeat for several."""

    def as_words(self, *env: str) -> list[str]:
        """Returns them as words of a command line after ``env``, the words that name the environment.

        Without these only modules are imported.
        """
        words = [*env, *assignment_words("--env-kwargs", self.env_kwargs)]
        words += chain.from_iterable(("--wrapper", name) for name in self.wrappers)
        imports = chain.from_iterable(("--import", name) for name in self.imports)
        return [*(words if env else ()), *imports]


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Where a run began that is a branch of another."""

    run: str
    """Folder of the other run."""
    step: Count
    """Environment step of its checkpoint."""
    changes: dict[Key, Any] = field(default_factory=dict)
    """Hyperparameters that are not the other run's, by dotted name."""

    def words(self) -> list[str]:
        """Returns the words of the command line that begins the same branch.

        >>> Origin(run="runs/a", step=500, changes={"gamma": 0.9}).words()
        ['branch', 'runs/a', '--at', '500', '--set', 'gamma=0.9']
        """
        return ["branch", self.run, "--at", str(self.step), *assignment_words("--set", self.changes)]


@dataclass(frozen=True, kw_only=True)
class RunConfig(EnvironmentOptions):
    """The description of a run."""

    env: Annotated[str, Shown("ENV", is_positional=True)]
    """Id of an environment, such as parking-v0; or my_env:MyEnv-v0 or my_env.py, which is imported."""
    algorithm: Annotated[str | None, Shown("NAME", "algo")] = None
    """Algorithm; by default the preset's, else one that fits the actions and the length of the run."""
    preset: Annotated[str | bool | None, Shown("NAME"), Topic.TRAINING] = None
    """Use this preset, small or another name, or a file such as the preset.json of rejeu tune, in the place of rejeu's own."""
    steps: Annotated[Positive | None, Shown("N")] = None
    """Environment steps to take, over all environments; by default the preset's, else 100000."""
    minutes: Annotated[Duration | None, Shown("M")] = None
    """Train for this long instead."""
    n_envs: Annotated[EnvCount | None, Shown("N", "envs")] = None
    """Environments stepped at once; by default the preset's, else 1."""
    backend: Annotated[Name | None, Shown("NAME"), Topic.ENVIRONMENT] = None
    """auto, envpool, gymnasium, gymnasium-async, jax or ray; by default the preset's, else auto."""
    restart_workers: Annotated[int, Meta(ge=0), Shown("N"), Topic.ENVIRONMENT] = 0
    """With --backend gymnasium-async or ray: how many workers that crashed, hung or were lost are restarted."""
    ray: Annotated[str | None, Shown("ADDRESS"), Topic.ENVIRONMENT] = None
    """With --backend ray: HOST:PORT of the cluster, or auto; by default RAY_ADDRESS, else Ray on this machine."""
    env_cpus: Annotated[Annotated[float, Meta(ge=0, le=10_000)] | None, Shown("N"), Topic.ENVIRONMENT] = None
    """With --backend ray: CPUs for each environment, a fraction if it mostly waits; by default 1, or 0 without --ray."""
    device: Annotated[str, Shown("NAME"), Topic.TRAINING] = "auto"
    """auto, cpu or gpu; auto is the device that JAX chooses, a GPU if it has one."""
    seed: Annotated[Seed | None, Shown("N")] = None
    """Seeds everything; by default a random one."""
    hyperparameters: Annotated[dict[Key, Any], Shown("NAME=VALUE ...", "set")] = field(default_factory=dict)
    """Hyperparameters, dotted where nested: "policy_kwargs.net_arch=[64,64]" "train_freq=[1,'episode']"."""
    success_threshold: Annotated[float | None, Shown("RETURN"), Topic.EVALUATION] = None
    """Return from which on an episode counts as a success; by default what the environment reports or declares."""
    video_every: Annotated[Positive | None, Shown("N"), Topic.OUTPUT] = None
    """Environment steps between two videos of the policy, in the folder videos; by default none are recorded."""
    checkpoint_minutes: Annotated[Annotated[float, Meta(ge=0)] | None, Shown("M"), Topic.OUTPUT] = 5.0
    """Minutes between two checkpoints, from which rejeu resume continues; 0 for none."""
    keep_checkpoints: Annotated[Positive, Shown("N"), Topic.OUTPUT] = 2
    """How many checkpoints are kept, the newest; rejeu branch begins from any of them."""
    evaluate_every: Annotated[Positive | None, Shown("N"), Topic.EVALUATION] = None
    """Environment steps between two evaluations; by default the preset's, else 5000."""
    evaluate_episodes: Annotated[Annotated[int, Meta(ge=1, le=MAX_EPISODES)] | None, Shown("N"), Topic.EVALUATION] = (
        None
    )
    """Episodes of each evaluation; by default the preset's, else 20."""
    log: Annotated[tuple[Name, ...], Shown("NAME ..."), Topic.OUTPUT] = ()
    """Log to these too: json, tensorboard, wandb, mlflow, trackio. metrics.csv is always written."""

    env_argument: str = ""
    """How the environment was named on the command line, if that is not its id. It is never imported."""
    policy: str = ""
    """Empty where the environment decides."""
    origin: Origin | None = None
    """None of a run that began with its first step."""

    def __post_init__(self) -> None:
        if self.steps is not None and self.minutes is not None:
            raise ValueError(f"steps={self.steps} and minutes={self.minutes:g} exclude each other; give one of them")

    @property
    def is_long(self) -> bool:
        """Whether it is to take 100,000 steps, which is the default, or 20 minutes; see :func:`choose_algorithm`."""
        return (self.steps or 100_000) >= 100_000 if self.minutes is None else self.minutes >= 20

    @property
    def typed(self) -> str:
        """The environment as it was named on the command line."""
        return self.env_argument or self.env

    @property
    def names_code(self) -> bool:
        """Whether its environment is imported, or made with more than numbers and words, which no file may ask for."""
        from rejeu.envs.registry import are_plain, is_plain_id  # Gymnasium takes longer than all that --help needs

        return not is_plain_id(self.typed) or bool(self.wrappers) or not are_plain(self.env_kwargs)

    def refusal(self, where: object) -> CheckpointError:
        """Returns the error for a file that names code which nobody has typed, with the options to type."""
        options = self.again()
        return CheckpointError(
            f"{where} names an environment that is imported or made with more than numbers, which no file may ask for; "
            f"if you trust it, repeat the command, such as rejeu studio, "
            f"and name it again:{options if len(options) < 500 else ' --env ENV'}"
        )

    def environment_words(self, option: bool = False) -> list[str]:
        """Returns the words of a command line that make the environment.

        Args:
            option: whether the command takes the environment as ``--env``, and needs it only if a file may not name it.

        >>> RunConfig(env="my_env.py", env_kwargs={"g": 9.8}).environment_words(option=True)
        ['--env', 'my_env.py', '--env-kwargs', 'g=9.8']
        """
        words = ["--env", self.typed] if option else [self.typed]
        return self.as_words(*(words if not option or (self.env and self.names_code) else ()))

    def again(self) -> str:
        """Returns the options with which ``rejeu evaluate RUN`` and the like make the environment, a space before each.

        >>> RunConfig(env="CartPole-v1", imports=("my_algorithm.py",)).again()
        ' --import my_algorithm.py'
        """
        return "".join(f" {quoted(shown(word, MAX_WORD))}" for word in self.environment_words(option=True))

    def words(self) -> list[str]:
        """Returns the words of the command line that begins this run: ``rejeu`` is followed by them.

        >>> RunConfig(env="CartPole-v1", algorithm="PPO", n_envs=8, hyperparameters={"gamma": 0.9}).words()
        ['train', 'CartPole-v1', '--algo', 'PPO', '--envs', '8', '--set', 'gamma=0.9']
        """
        if self.origin is not None:
            return [*self.origin.words(), *self.environment_words(option=True)]
        words = ["train", *self.environment_words()]
        for option in options(RunConfig):
            value = getattr(self, option.field)
            if option.field in WORDS_OF_THEIR_OWN or value == option.default or isinstance(value, bool):
                continue
            words.append(option.name)
            text = repr(value).removesuffix(".0") if isinstance(value, float) else str(value)
            words += value if isinstance(value, tuple) else [text]
        return [*words, *assignment_words("--set", self.hyperparameters)]


@dataclass(frozen=True, kw_only=True)
class DecidedRun(RunConfig):
    """The description of a run of which nothing is left to the preset or the environment; ``config.json`` is one."""

    algorithm: str
    preset: bool
    """Whether the hyperparameters are those of a preset, except where the command line changed them."""
    hyperparameters: dict[Key, Any]
    """All of them, defaults included."""
    seed: Seed
    n_envs: EnvCount
    backend: Name
    """The backend that stepped the environments; never ``auto``."""
    policy: str
    evaluate_every: Positive
    evaluate_episodes: Annotated[int, Meta(ge=1, le=MAX_EPISODES)]
    device: Annotated[str, Meta(pattern="^(auto|cpu|gpu)$")] = "auto"
    """The device that was asked for; the run can be resumed and its models loaded on any."""
    log: tuple[Annotated[str, Meta(pattern=f"^({'|'.join(LOGS)})$")], ...] = ()


@dataclass(frozen=True, kw_only=True)
class Task:
    """A run to begin, or to continue. Who writes its file answers for what it imports; see :attr:`RunConfig.names_code`."""

    folder: str
    """The run folder."""
    run: RunConfig
    resume: bool = False
    """Whether it is continued from its newest checkpoint, or its files are completed; else it begins."""
    no_report: bool = False
    no_video: bool = False


def options(schema: type) -> Iterator[Option]:
    """Yields the fields of the dataclass ``schema`` that the command line shows: flags, and those with a :class:`Shown`.

    A :class:`Topic` next to it is the list of the help that it is in.
    """
    hints = get_type_hints(schema, include_extras=True)
    for entry in dataclasses.fields(schema):
        hint, marks = unmarked(hints[entry.name])
        shown_as = next((mark for mark in marks if isinstance(mark, Shown)), Shown() if hint is bool else None)
        if shown_as is None:
            continue
        if get_origin(hint) in (Union, UnionType):
            hint, inner = unmarked(get_args(hint)[0])  # None and others are no words
            marks = [*marks, *inner]
        value_type = get_origin(hint) if get_origin(hint) in (tuple, dict) else hint
        numbers = [(key, getattr(mark, key)) for mark in marks if isinstance(mark, Meta) for key in ("ge", "gt", "le")]
        has_default = entry.default is not dataclasses.MISSING
        yield Option(
            field=entry.name,
            name=shown_as.metavar if shown_as.is_positional else f"--{(shown_as.name or entry.name).replace('_', '-')}",
            shown=shown_as,
            type=value_type,
            item=unmarked(get_args(hint)[0])[0] if value_type is tuple else hint,
            group=next((mark for mark in marks if isinstance(mark, Topic)), Topic.FIRST),
            limits={key: limit for key, limit in numbers if limit is not None},
            default=entry.default if has_default else None,
            is_required=not has_default and entry.default_factory is dataclasses.MISSING,
        )


def unmarked(hint: object) -> tuple[Any, list[Any]]:
    """Returns a type without its annotations, and these."""
    return (get_args(hint)[0], [*get_args(hint)[1:]]) if get_origin(hint) is Annotated else (hint, [])


def read(path: Path) -> DecidedRun:
    """Returns the description of a run from its ``config.json``.

    Raises:
        CheckpointError: if the file is damaged.
        OSError: if it cannot be read.
    """
    try:
        return convert(read_json(path, MAX_BYTES), DecidedRun)
    except (Malformed, CheckpointError) as error:
        raise CheckpointError(f"{path} is damaged: {shown(error, 1000)}") from None


def read_folder(folder: RunFolder) -> DecidedRun:
    """Returns the description of the run in a folder.

    Raises:
        FileNotFoundError: if it is not a run folder.
        CheckpointError: if the file is damaged.
    """
    if not folder.config.is_file():
        raise FileNotFoundError(
            f"{folder.path} is no run folder: it holds no {folder.config.name}{newest_inside(folder.path)}"
        )
    return read(folder.config)


def write(path: Path, config: DecidedRun) -> None:
    """Writes ``config.json``, with the versions of what ran."""
    atomic.write(path, json_text({**dataclasses.asdict(config), "versions": versions()}, 2))


def write_task(path: Path, task: Task) -> None:
    """Writes the file of a task."""
    atomic.write(path, json_text(task))


def read_task(path: Path) -> Task:
    """Returns the task in a file.

    Raises:
        CheckpointError, ValueError: if it is damaged.
    """
    return convert(read_json(path, MAX_BYTES), Task)


def versions() -> dict[str, str | None]:
    """Returns the versions of Python and of the packages that matter for a run, None for those that are not installed."""
    return {"python": platform.python_version(), **{package: installed(package) for package in PACKAGES}}
