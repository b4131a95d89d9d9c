"""Agents: environments, a learner and a buffer behind the methods of Stable-Baselines3, found by the names of algorithms."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym

from rejeu.agents import presets as all_presets
from rejeu.agents.agent import Agent as Agent
from rejeu.agents.named import *  # noqa: F403
from rejeu.agents.named import BUILT_IN
from rejeu.agents.off_policy import OffPolicyAgent as OffPolicyAgent
from rejeu.agents.on_policy import OnPolicyAgent as OnPolicyAgent
from rejeu.agents.presets import Preset
from rejeu.algorithms import config as configs
from rejeu.checkpoints.run_folder import find_model
from rejeu.core import checkpoint
from rejeu.core.errors import CheckpointError
from rejeu.core.records import shown
from rejeu.core.validation import nearest

A = TypeVar("A", bound=type[Agent])

AGENTS: dict[str, type[Agent]] = dict(BUILT_IN)
"""Every agent by the name of its algorithm; :func:`register` adds to it."""

ENTRY_POINTS = "rejeu.algorithms"
"""Group of entry points by which an installed package offers algorithms to ``rejeu train --algo NAME``."""


def register(agent: A, presets: Iterable[Preset] = ()) -> A:
    """Makes an agent of your own known by the name of its algorithm, and returns it.

    :func:`rejeu.load` and the commands then find it, and ``rejeu train`` uses its presets. A later registration of the same
    name replaces the earlier one, as when a notebook cell is run again.

    Args:
        agent: a subclass of :class:`rejeu.OffPolicyAgent` or :class:`rejeu.OnPolicyAgent`.
        presets: tuned settings of this algorithm for some environments.

    Raises:
        ValueError: if the agent has no configuration with a name, rejeu has an algorithm of this name, or a preset is for
            another algorithm.
    """
    config = getattr(getattr(agent, "algorithm", None), "Config", None)
    if not getattr(config, "name", "") or "__dataclass_fields__" not in vars(config):
        raise ValueError(
            f"{agent.__name__} needs a class attribute algorithm = SimpleNamespace(Config=Config, make=make), in which Config "
            "is a @dataclass(frozen=True, kw_only=True) with name: ClassVar[str] = NAME"
        )
    name = agent.algorithm.Config.name
    if name in BUILT_IN and agent is not BUILT_IN[name]:
        raise ValueError(f"rejeu has an algorithm {name!r}; choose another Config.name")
    tuned = tuple(presets)
    for preset in tuned:
        if preset.algorithm != name:
            raise ValueError(f"the preset of {preset.env_id} is for {preset.algorithm!r}, not {name!r}")
    AGENTS[name] = agent
    if name not in BUILT_IN:
        configs.registered[name] = config
    all_presets.register(name, tuned)
    return agent


def find_agent(name: str, is_typed: bool = True) -> type[Agent]:
    """Returns the agent of a name, in any case of letters.

    A name that is not registered is looked up among the entry points ``rejeu.algorithms`` of installed packages.

    Args:
        name: of the algorithm.
        is_typed: whether the user typed it. A name in a file imports nothing: only what is imported already is found.

    Raises:
        ValueError: if there is no such algorithm, with the nearest name or what to import.
    """
    names = {key.lower(): key for key in AGENTS}
    if name.lower() in names:
        return AGENTS[names[name.lower()]]
    if (entry := entry_point(name)) is not None:
        if not (is_typed or entry.module in sys.modules):
            raise ValueError(f"{name} is not registered, and no file may name what is imported; {advice(entry)}")
        agent = entry.load()
        return agent if agent in AGENTS.values() else register(agent)
    hint = nearest(name, AGENTS)
    raise ValueError(f"no algorithm is called {name!r}; {hint}; --import MODULE imports one that registers others")


def agent_of_file(name: object, path: str | Path) -> type[Agent]:
    """Returns the agent that a file names. Imports nothing: an agent that is not registered is an error.

    Raises:
        CheckpointError: if it is not registered; the message says what to import.
    """
    if isinstance(name, str):
        with suppress(ValueError):
            return find_agent(name, is_typed=False)
    hint = advice(entry_point(name) if isinstance(name, str) else None)
    raise CheckpointError(
        f"{path} contains an agent of {str(name)[:40]!r}, which is not registered; {hint}; there are {', '.join(AGENTS)}"
    )


def advice(entry: metadata.EntryPoint | None) -> str:
    """Returns the advice to import the module of an algorithm that is not registered."""
    if entry is None:
        return "import the module that registers it (--import MODULE)"
    return f"import {entry.module} (--import {entry.module})"


def entry_point(name: str) -> metadata.EntryPoint | None:
    """Returns the entry point of an algorithm that an installed package offers, without importing it."""
    offered = metadata.entry_points(group=ENTRY_POINTS)
    return next((entry for entry in offered if entry.name.lower() == name.lower()), None)


def modules_of(algorithm: str, imports: Iterable[str]) -> tuple[str, ...]:
    """Returns the modules that another process must import to know an algorithm: ``imports``, else that of its entry point.

    Raises:
        ValueError: if it is not registered, or in this process only, such as one of a notebook.
    """
    modules = tuple(imports)
    if modules or find_agent(algorithm, is_typed=False) in BUILT_IN.values():
        return modules
    if (entry := entry_point(algorithm)) is not None:
        return (entry.module,)
    raise ValueError(
        f"{algorithm} is registered in this program only, and each run is a process of its own; write the algorithm into a "
        "file, and name that: imports=['my_algorithm.py'], or --import my_algorithm.py"
    )


def find_preset(env_id: str, algorithm: str | None, path: str | Path | None) -> Preset | None:
    """Returns the preset of a name or a file, else that of the environment and the algorithm, None if there is none.

    Raises:
        CheckpointError: if the algorithm of the file is not registered.
        ValueError: if it is a preset of another algorithm.
    """
    if path is None:
        return all_presets.find(env_id, algorithm)
    preset = all_presets.named(str(path), env_id, algorithm) or all_presets.read(path)
    agent_of_file(preset.algorithm, path)
    if algorithm not in (None, preset.algorithm):
        raise ValueError(f"the preset {path} is for {preset.algorithm}, not for {algorithm}; leave out one of them")
    if preset.env_id != env_id and not preset.name:
        warnings.warn(f"the preset {path} was made for {shown(preset.env_id)}", UserWarning, stacklevel=2)
    return preset


def choose_algorithm(
    preset: Preset | None, env_id: str, observations: gym.Space, actions: gym.Space, is_long: bool = False
) -> str:
    """Returns the algorithm of a preset, else the default for the spaces.

    Raises:
        ValueError: if there is none.
    """
    if preset is not None:
        return preset.algorithm
    name = type(actions).__name__
    if name not in all_presets.ALGORITHM_FOR:
        supported = ", ".join(f"{name} takes {space}" for space, name in all_presets.ALGORITHM_FOR.items())
        raise ValueError(f"{env_id} has the actions {actions}, which no algorithm here takes; {supported}")
    is_vector = isinstance(observations, gym.spaces.Box) and len(observations.shape) == 1
    return all_presets.FOR_LONG_RUNS if name == "Box" and is_vector and is_long else all_presets.ALGORITHM_FOR[name]


def load(path: str | Path, env: Any = None, **changes: Any) -> Agent:
    """Returns the agent of a model file or a run folder, whatever its algorithm; see :meth:`Agent.load`.

    Raises:
        CheckpointError: also if the algorithm is not registered; the message says what to import.
    """
    path = find_model(path)
    agent = agent_of_file(checkpoint.read_header(path, "agent").get("algorithm"), path)
    return agent.load(path, env, **changes)
