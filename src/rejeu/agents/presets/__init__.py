"""Tuned hyperparameters as data (``presets.toml``), their form as a file, and their measured results (``results.json``).

``rejeu tune`` writes a preset to a file, which is untrusted data, and ``rejeu train --preset`` uses it. ``scripts/figures.py``
writes the results.

>>> find("parking-v0").algorithm
'SAC'
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import msgspec
from msgspec import Meta

from rejeu.core import atomic
from rejeu.core.errors import CheckpointError
from rejeu.core.records import EnvCount, Malformed, Positive, convert, json_text, read_json, shown

MAX_BYTES = 2**20
"""Upper limit on the size of a file."""
Name = Annotated[str, Meta(min_length=1, max_length=200)]


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Tuned settings of one algorithm for one environment."""

    env_id: Name
    """Id of the environment."""
    algorithm: Name
    """Name of the algorithm, a key of ``rejeu.AGENTS``."""
    hyperparameters: Mapping[str, object] = field(hash=False)
    """Hyperparameters that differ from the algorithm's defaults, as keyword arguments of the agent; read-only."""
    n_envs: EnvCount
    """Number of parallel environments."""
    name: Annotated[str, Meta(max_length=200)] = ""
    """The name of the settings, such as ``Rainbow``, for ``--preset`` with any environment; empty if they have none.
    They are used only by this name."""
    total_steps: Positive
    """Environment steps of a full run, over all environments."""
    evaluate_every: Positive
    """Environment steps between two evaluations."""
    evaluate_episodes: Annotated[int, Meta(ge=1, le=10_000)]
    """Episodes of each evaluation."""
    backend: Annotated[str, Meta(pattern="^(auto|envpool|gymnasium|gymnasium-async|jax)$")] = "auto"
    """Backend of the environments, as for ``make_vector``."""
    success_threshold: float | None = None
    """Least return of a successful episode where the environment does not report success; None: its reward threshold.
    Evaluations are ranked by success first, so a threshold that good policies miss half of the time ranks by luck."""
    source: Annotated[str, Meta(max_length=1000)] = ""
    """Origin of the hyperparameters."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hyperparameters", MappingProxyType(dict(self.hyperparameters)))


def built_in() -> tuple[Preset, ...]:
    """Returns the presets of rejeu, in the order of ``presets.toml``."""
    text = resources.files("rejeu.agents.presets").joinpath("presets.toml").read_text(encoding="utf-8")
    return tuple(convert(table, Preset) for table in tomllib.loads(text)["preset"])


def write(preset: Preset, path: str | Path) -> Path:
    """Writes a preset to a JSON file and returns its path.

    Raises:
        TypeError: if a hyperparameter is not a JSON value, such as a network of your own.
    """
    try:
        text = json_text(preset, 2)
    except (TypeError, ValueError) as error:
        raise TypeError(f"the preset of {preset.env_id} has hyperparameters that a file cannot hold: {error}") from None
    return atomic.write(Path(path), text)


def read(path: str | Path) -> Preset:
    """Returns the preset of a file. The hyperparameters are checked by the algorithm that they are given to.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is damaged, or something else than a preset.
    """
    path = Path(path)
    if not path.is_file():
        names = ", ".join(dict.fromkeys(preset.name for preset in every() if preset.name))
        raise FileNotFoundError(
            f"there is no preset file {path}; rejeu tune writes one as preset.json, and presets with a name are {names}"
        )
    try:
        return convert(read_json(path, MAX_BYTES), Preset)
    except (Malformed, CheckpointError) as error:
        raise CheckpointError(f"{path} is no preset: {shown(error, 1000)}") from None


@dataclass(frozen=True, kw_only=True)
class PresetResult:
    """The result of an algorithm in an environment, over several seeds."""

    env_id: str
    """Id of the environment."""
    algorithm: str
    """Name of the algorithm."""
    preset: str
    """Name of the preset; empty for that of the environment."""
    setting: str
    """The setting that was not as in the preset, such as ``"sigma=1"``; empty if nothing was."""
    measure: str
    """``"mean return"`` or ``"success rate"``."""
    mean: float
    """Mean over the seeds."""
    low: float
    """Lower end of the 95 % confidence interval of the mean return; of success rates the lowest of a seed."""
    high: float
    """Upper end, or the highest of a seed."""
    seeds: int
    """Number of seeds."""
    episodes: int
    """Episodes of the evaluation of each seed."""
    budget: str
    """The steps or minutes of each seed, such as ``"20,000 steps"``."""
    seconds: tuple[float, float]
    """Shortest and longest training of a seed."""
    command: str
    """The command that measures it."""

    def __str__(self) -> str:
        """The result in a few words."""
        seeds = f"{self.seeds} seed{'s' * (self.seeds > 1)}"
        return ", ".join(filter(None, (f"{self.measure} {self.figures}", seeds, self.setting)))

    @property
    def figures(self) -> str:
        """Mean and spread.

        >>> find_result("Pendulum-v1", "TD3").figures
        '-156.2 (-158.2 to -154.2)'
        """
        show = _percent if self.measure == "success rate" else _number
        if self.low == self.high:
            return show(self.mean)
        return f"{show(self.mean)} ({show(self.low).removesuffix(' %')} to {show(self.high)})"


def _number(number: float) -> str:
    """Returns a return with one decimal, or with two if it is below 1."""
    return f"{number:.{1 if abs(number) >= 1 else 2}f}"


def _percent(share: float) -> str:
    return f"{100 * share:.1f}".removesuffix(".0") + " %"


@cache
def results() -> tuple[PresetResult, ...]:
    """Returns every result; of several for one preset the first is of the preset as it is."""
    content = resources.files("rejeu.agents.presets").joinpath("results.json").read_bytes()
    return msgspec.json.decode(content, type=tuple[PresetResult, ...])


def find_result(env_id: str, algorithm: str, name: str = "") -> PresetResult | None:
    """Returns the first result of an algorithm in an environment, with the preset of this name; None if there is none."""
    key = env_id, algorithm, name
    return next((result for result in results() if (result.env_id, result.algorithm, result.preset) == key), None)


ALL: tuple[Preset, ...] = built_in()
"""Every preset of rejeu. The first one of an environment without a name is the one that ``rejeu train`` uses."""

registered: dict[str, tuple[Preset, ...]] = {}
"""Presets of algorithms that are not rejeu's, by the name of the algorithm; see :func:`register`."""

TWINS = {
    "jax/Parking-v0": "parking-v0",
    "jax/Ball-v0": "rejeu/Ball-v0",
    **{f"jax/{name}": name for name in ("Acrobot-v1", "CartPole-v1", "Pendulum-v1", "MountainCar-v0")},
}
"""Environments in JAX that are equal to another environment, whose presets they have."""

COMBINED = ("MultiDiscrete", "MultiBinary", "Dict", "Tuple")
ALGORITHM_FOR = {"Box": "SAC", "Discrete": "DQN", **dict.fromkeys(COMBINED, "PPO")}
"""The default algorithm of an environment without a preset, by the class of its action space."""
FOR_LONG_RUNS = "XQC"
"""The one for vectors and Box actions in runs of 100,000 steps or 20 minutes; see docs/choosing.md."""


def register(algorithm: str, presets: tuple[Preset, ...]) -> None:
    """Adds presets of an algorithm that is not rejeu's; see :func:`rejeu.register`."""
    registered[algorithm] = presets


def every() -> tuple[Preset, ...]:
    """Returns the presets of rejeu, and after them those that were registered."""
    return (*ALL, *(preset for presets in registered.values() for preset in presets))


def named(name: str, env_id: str, algorithm: str | None = None) -> Preset | None:
    """Returns the preset of that name, of several that of the algorithm and of the environment, or None if there is none.

    >>> named("Rainbow", "Acrobot-v1").algorithm
    'DQN'
    """
    presets = [preset for preset in every() if preset.name.lower() == name.lower() != ""]
    return max(presets, key=lambda preset: (preset.algorithm == algorithm, preset.env_id == env_id), default=None)


def small(algorithm: str) -> Mapping[str, object]:
    """Returns the hyperparameters of an algorithm's preset ``small``, which is for any environment; empty if it has none."""
    return next((p.hyperparameters for p in every() if (p.name, p.algorithm) == ("small", algorithm)), {})


def default(env_id: str, algorithm: str, hyperparameters: Mapping[str, object] = MappingProxyType({})) -> Preset:
    """Returns a preset of the algorithm's defaults and ``hyperparameters``, for an environment that has no preset."""
    return Preset(
        env_id=env_id,
        algorithm=algorithm,
        hyperparameters=hyperparameters,
        n_envs=1,
        total_steps=100_000,
        evaluate_every=5_000,
        evaluate_episodes=20,
        source="the algorithm's defaults",
    )


def find(env_id: str, algorithm: str | None = None) -> Preset | None:
    """Returns the preset of an environment, the first one or that of ``algorithm``, or None if there is none.

    An environment in JAX that equals another one has its presets. Those with a name are found by :func:`named` alone.

    >>> find("jax/Parking-v0").backend
    'jax'
    """
    presets = [preset for preset in every() if preset.env_id == env_id and not preset.name]
    match = next((preset for preset in presets if algorithm in (None, preset.algorithm)), None)
    if match is not None or env_id not in TWINS:
        return match
    twin = find(TWINS[env_id], algorithm)
    return twin and dataclasses.replace(twin, env_id=env_id, backend="jax", source=f"the preset of {twin.env_id}")
