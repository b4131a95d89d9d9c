"""The environment of a command: named on the command line, or recorded in a run folder.

The command line may import code: ``my_env:Walk-v0``, ``my_env.py``, ``--wrapper my_env:Shaped``. A file may not: from a run
folder come only ids that are already registered, with keyword arguments that are plain numbers, booleans and words.
Everything else must be typed again, and the error says what.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import gymnasium as gym

from rejeu.cli.commands import RunOptions
from rejeu.cli.importing import find_id, find_wrapper, imports
from rejeu.envs.make import VectorEnv, WorkerOptions, make_vector
from rejeu.envs.registry import are_plain, maker, register
from rejeu.envs.rendering import make_rendering_env
from rejeu.errors import CheckpointError
from rejeu.io import checkpoint
from rejeu.runs.config import DecidedRun, EnvironmentOptions
from rejeu.runs.folder import RunFolder, read_config
from rejeu.runs.values import assignment_words, merged, quoted

DEFAULT_WORKERS = WorkerOptions()
"""All environments step together; lost workers are not restarted."""


@dataclass(frozen=True)
class Environment:
    """The id of an environment, and how it is made."""

    env_id: str
    """Id in Gymnasium's registry, or one that only EnvPool knows."""
    typed: str
    """As typed."""
    kwargs: Mapping[str, Any]
    """Keyword arguments of the environment."""
    wrapper_names: tuple[str, ...]
    """As typed, innermost first."""
    wrappers: tuple[Callable[[Any], Any], ...]
    """The same, imported."""
    modules: tuple[str, ...] = ()
    """What ``--import`` named, as typed."""

    def make(self, **more: Any) -> gym.Env:
        """Returns a new one; ``more`` are further keyword arguments, such as ``render_mode``."""
        return Wrapped(maker(self.env_id, **{**self.kwargs, **more}), self.wrappers)()

    def vector(
        self, n_envs: int, backend: str, seed: int | None, workers: WorkerOptions = DEFAULT_WORKERS
    ) -> VectorEnv:
        """Returns ``n_envs`` of them; the arguments are those of :func:`rejeu.make_vector`.

        Raises:
            ValueError: for ``envpool`` with wrappers or keyword arguments, which it does not take.
        """
        if not self.wrappers:
            return make_vector(
                self.env_id, n_envs, backend, seed, **workers._asdict(), **self.kwargs  # type: ignore[arg-type]
            )  # fmt: skip
        if backend == "envpool":
            raise ValueError("the envpool backend takes no wrappers; use --backend gymnasium")
        make = Wrapped(maker(self.env_id, **self.kwargs), self.wrappers)
        return make_vector(make, n_envs, backend, seed, **workers._asdict())  # type: ignore[arg-type]

    def rendering(self) -> gym.Env:
        """Returns a new one that renders to arrays.

        Raises:
            ValueError: if it cannot.
        """
        return make_rendering_env(self.make, self.env_id)

    @property
    def is_plain(self) -> bool:
        """Whether it is an id and nothing else, so that EnvPool may step it."""
        return not self.kwargs and not self.wrappers

    def is_registered(self) -> bool:
        """Returns whether Gymnasium has it, and not EnvPool alone."""
        return register(self.env_id)

    def options(self) -> str:
        """Returns what ``rejeu evaluate RUN`` and the like need to make it again, and to import; empty if the id is enough.

        >>> Environment("Walk-v0", "my_env:Walk-v0", {"g": 9.8}, (), ()).options()
        ' --env my_env:Walk-v0 --env-kwargs g=9.8'
        >>> Environment("Walk-v0", "Walk-v0", {}, (), (), modules=("my_algorithm.py",)).options()
        ' --import my_algorithm.py'
        """
        recorded = not imports(self.typed) and not self.wrapper_names and are_plain(dict(self.kwargs))
        made = "" if recorded else options(self.typed, self.kwargs, self.wrapper_names)
        return made + "".join(f" --import {quoted(name)}" for name in self.modules)

    def __str__(self) -> str:
        parts = [f"{key}={value!r}" for key, value in self.kwargs.items()]
        text = self.env_id + (f" ({', '.join(parts)})" if parts else "")
        return text + "".join(f", {name}" for name in self.wrapper_names)


@dataclass(frozen=True)
class Wrapped:
    """Makes an environment and wraps it; it can be sent to a worker process."""

    make: Callable[[], Any]
    wrappers: tuple[Callable[[Any], Any], ...]

    def __call__(self) -> Any:
        env = self.make()
        for wrapper in self.wrappers:
            env = wrapper(env)
        return env


def options(typed: str, kwargs: Mapping[str, Any], wrapper_names: Iterable[str]) -> str:
    """Returns an environment as options of a command line, with a space before each."""
    words = ["--env", typed]
    words += assignment_words("--env-kwargs", kwargs)
    words += chain.from_iterable(("--wrapper", name) for name in wrapper_names)
    return "".join(f" {quoted(word)}" for word in words)


def from_arguments(env: str, given: EnvironmentOptions) -> Environment:
    """Returns the environment that was named on the command line; imports its module.

    Raises:
        ValueError: if there is none, with the nearest; or for an invalid wrapper or keyword argument.
        ImportError: if a module cannot be imported.
    """
    kwargs = merged(given.env_kwargs, {}, "--env-kwargs")
    wrappers = tuple(find_wrapper(name) for name in given.wrappers)
    return Environment(find_id(env), env, kwargs, given.wrappers, wrappers, given.imports)


def from_run(
    env_id: Any,
    env_argument: str,
    kwargs: Mapping[str, Any],
    wrapper_names: Iterable[str],
    run: Path,
    given: RunOptions,
) -> Environment:
    """Returns the environment of a run: what the command line says, else what the run folder says.

    Args:
        env_id: as the folder or the model has it.
        env_argument: how it was named when the run began.
        kwargs: its keyword arguments.
        wrapper_names: its wrappers.
        run: the folder or file, for messages.
        given: the command line; ``--env`` replaces everything, keyword arguments alone replace those of the same name.

    Raises:
        CheckpointError: if something must be typed again, with the options to type.
        ValueError: as for :func:`from_arguments`.
    """
    if given.env is not None:
        return from_arguments(given.env, given)
    if not isinstance(env_id, str) or imports(env_id) or not re.fullmatch(r"[\w./-]{1,200}", env_id):
        raise CheckpointError(
            f"{run} names the environment {str(env_id)[:60]!r}, and no file may name what is imported; name it yourself: "
            "--env ID"
        )
    own = merged(given.env_kwargs, {}, "--env-kwargs")
    kept = {key: value for key, value in kwargs.items() if key not in own}
    wrapper_names = tuple(given.wrappers or wrapper_names)
    if imports(env_argument or env_id) or (wrapper_names and not given.wrappers) or not are_plain(kept):
        again = options(env_argument or env_id, {**kept, **own}, wrapper_names)
        raise CheckpointError(
            f"{run} was trained on an environment that is imported or made with more than numbers, which no file may ask "
            f"for; if you trust it, name it again:{again if len(again) < 500 and again.isprintable() else ' --env ENV'}"
        )
    wrappers = tuple(find_wrapper(name) for name in given.wrappers)
    return Environment(env_id, env_id, {**kept, **own}, given.wrappers, wrappers, given.imports)


def environment_of(model: Path, given: RunOptions) -> Environment:
    """Returns the environment for a model: what the command line says, else what the file and its run folder say.

    Raises:
        CheckpointError: if they do not say, if it must be typed again, or if the file is not a model.
        ValueError: if there is no such environment.
    """
    if given.env is not None:
        return from_arguments(given.env, given)
    env_id = recorded_id(model)
    folder = RunFolder(model.parent)
    if model in (folder.best, folder.agent) and folder.config.is_file():
        config = read_config(folder)
        if config.env == env_id:
            return of_run(folder, config, given)
    return from_run(env_id, "", {}, (), model, given)


def recorded_id(model: Path) -> Any:
    """Returns the id of the environment of a model file, unchecked; None if it has none.

    Raises:
        CheckpointError: if the file is not a model.
    """
    return checkpoint.read_header(model, "agent").get("env_id")


def of_run(folder: RunFolder, config: DecidedRun, given: RunOptions) -> Environment:
    """Returns the environment of a run: what the command line says, else what its configuration says."""
    return from_run(config.env, config.env_argument, config.env_kwargs, config.wrappers, folder.path, given)
