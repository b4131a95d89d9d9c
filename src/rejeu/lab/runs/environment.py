"""The environment of a command: named on the command line, or recorded in a run folder.

The command line may import code: ``my_env:Walk-v0``, ``my_env.py``, ``--wrapper my_env:Shaped``. A file may not: from a run
folder come only ids that are already registered, with keyword arguments that are plain numbers, booleans and words.
Everything else must be typed again, and the error says what. So all modules that are imported by name, of environments,
wrappers and algorithms, are imported here.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from rejeu.checkpoints.model_files import trained_on
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import checkpoint
from rejeu.core.errors import CheckpointError
from rejeu.envs.functional import REGISTRY
from rejeu.envs.make import VectorEnv, WorkerOptions, make_vector
from rejeu.envs.registry import is_plain_id, maker
from rejeu.envs.rendering import make_rendering_env
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.runs.config import EnvironmentOptions, RunConfig, merged, read_folder


def find_id(name: str) -> str:
    """Returns the id of an environment that was named on the command line; imports the module before a colon, or a file.

    Raises:
        ValueError: if the module does not register it.
        ImportError: if there is no such module.
    """
    if not name.endswith(".py") and ":" not in name:
        if name not in gym.registry and Path(f"{name}.py").is_file():
            raise ValueError(f"no environment is called {name!r}; did you mean the file {name}.py?")
        return name
    before = set(gym.registry)
    if name.endswith(".py") or ".py:" in name:
        stem, _, env_id = name.rpartition(".py")
        env_id, source = env_id.removeprefix(":"), f"{stem}.py"
    else:
        source, _, env_id = name.partition(":")
    if not source:
        raise ValueError(f"{name!r} must be MODULE:ID, such as my_env:Walk-v0")
    module = import_source(source)
    new = set(gym.registry) - before
    new |= {key for key, spec in gym.registry.items() if module_of(spec.entry_point) == module.__name__}
    new |= {key for key, entry in REGISTRY.items() if getattr(entry.entry_point, "__module__", None) == module.__name__}
    if env_id in gym.registry:
        return env_id
    names = " and ".join(sorted(new))
    if not env_id and len(new) == 1:
        return names
    if not new and any("pettingzoo." in str(getattr(value, "__module__", "")) for value in vars(module).values()):
        raise ValueError(f"{source} has an environment of several agents, as PettingZoo's, and rejeu trains one agent")
    if not new:
        raise ValueError(
            f"{source} registers no environment; add gymnasium.register('Walk-v0', '{module.__name__}:Walk', "
            "max_episode_steps=...) to it, with the name of your class"
        )
    if not env_id:
        raise ValueError(f"{source} registers {names}; name one of them: {source}:{min(new)}")
    raise ValueError(f"{source} registers {names}, not {env_id!r}")


def module_of(entry_point: object) -> str | None:
    """Returns the module of an environment's entry point: a class, a function, or ``MODULE:NAME``."""
    return entry_point.partition(":")[0] if isinstance(entry_point, str) else getattr(entry_point, "__module__", None)


def find_wrapper(name: str) -> Callable[[Any], Any]:
    """Returns the wrapper ``module:Class`` or ``file.py:Class``: anything that takes an environment.

    Raises:
        ValueError: if there is none.
        ImportError: if there is no such module.
    """
    source, colon, attribute = name.rpartition(":")
    if not colon or not source or not attribute:
        raise ValueError(f"--wrapper {name!r} must be MODULE:CLASS, such as gymnasium.wrappers:FlattenObservation")
    module = import_source(source)
    wrapper = getattr(module, attribute, None)
    if not callable(wrapper):
        raise ValueError(f"--wrapper {name!r}: {source} has no class or function {attribute!r}")
    return wrapper


def import_source(source: str) -> Any:
    """Returns the module of this name, or of a Python file whose name ends in ``.py``; see the two functions below.

    Raises:
        ImportError: if there is none, or if its code raises an error.
    """
    try:
        return import_file(Path(source)) if source.endswith(".py") else import_module(source)
    except (ImportError, FileNotFoundError):
        raise
    except Exception as error:
        raise ImportError(f"{source} cannot be imported: {type(error).__name__}: {error}") from error


def import_module(name: str) -> Any:
    """Returns a module, also of the current folder; installed ones come first.

    Raises:
        ImportError: if there is none.
    """
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.append(os.getcwd())
    importlib.invalidate_caches()
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise
        raise ModuleNotFoundError(
            f"there is no module {name!r} in {os.getcwd()} or among the installed packages"
        ) from None


def import_file(path: Path) -> Any:
    """Returns the module of a Python file, under the file's name, so that worker processes can import it as well.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if another module has its name, or no module can have it.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    if "." in path.stem:
        raise ImportError(f"the name of a module has no dot; rename {path} to {path.stem.replace('.', '_')}.py")
    folder = str(path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    importlib.invalidate_caches()
    module = importlib.import_module(path.stem)
    if Path(getattr(module, "__file__", None) or "").resolve() != path.resolve():
        raise ImportError(f"another module is called {path.stem}; rename {path}")
    return module


DEFAULT_WORKERS = WorkerOptions()
"""All environments step together; lost workers are not restarted."""


@dataclass(frozen=True)
class Environment:
    """The id of an environment, and how it is made."""

    env_id: str
    """Id in Gymnasium's registry, or one that only EnvPool knows."""
    run: RunConfig
    """How it was named: as typed, with keyword arguments, wrappers and what ``--import`` named."""
    wrappers: tuple[Callable[[Any], Any], ...] = ()
    """The wrappers, imported, innermost first."""

    def make(self, **more: Any) -> gym.Env:
        """Returns a new one; ``more`` are further keyword arguments, such as ``render_mode``."""
        return Wrapped(maker(self.env_id, **{**self.run.env_kwargs, **more}), self.wrappers)()

    def vector(
        self, n_envs: int, backend: str, seed: int | None, workers: WorkerOptions = DEFAULT_WORKERS
    ) -> VectorEnv:
        """Returns ``n_envs`` of them; the arguments are those of :func:`rejeu.make_vector`.

        Raises:
            ValueError: for ``envpool`` with wrappers or keyword arguments, which it does not take.
        """
        if self.wrappers and backend == "envpool":
            raise ValueError("the envpool backend takes no wrappers; use --backend gymnasium")
        kwargs = self.run.env_kwargs
        make = Wrapped(maker(self.env_id, **kwargs), self.wrappers) if self.wrappers else self.env_id
        of_env = {} if self.wrappers else kwargs
        return make_vector(make, n_envs, backend, seed, **workers._asdict(), **of_env)  # type: ignore[arg-type]

    def rendering(self) -> gym.Env:
        """Returns a new one that renders to arrays.

        Raises:
            ValueError: if it cannot.
        """
        return make_rendering_env(self.make, self.env_id)

    @property
    def is_plain(self) -> bool:
        """Whether it is an id and nothing else, so that EnvPool may step it."""
        return not self.run.env_kwargs and not self.wrappers

    def __str__(self) -> str:
        parts = [f"{key}={value!r}" for key, value in self.run.env_kwargs.items()]
        text = self.env_id + (f" ({', '.join(parts)})" if parts else "")
        return text + "".join(f", {name}" for name in self.run.wrappers)


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


def from_arguments(env: str, options: EnvironmentOptions) -> Environment:
    """Returns the environment that was named on the command line; imports its module.

    Raises:
        ValueError: if there is none, with the nearest; or for an invalid wrapper or keyword argument.
        ImportError: if a module cannot be imported.
    """
    for name in options.imports:
        import_source(name)
    kwargs = merged(options.env_kwargs, {}, "--env-kwargs")
    wrappers = tuple(find_wrapper(name) for name in options.wrappers)
    run = RunConfig(env=env, env_kwargs=kwargs, wrappers=options.wrappers, imports=options.imports)
    return Environment(find_id(env), run, wrappers)


def from_run(run: RunConfig, where: object, options: RunOptions) -> Environment:
    """Returns the environment of a run: what the command line says, else what its folder says.

    Args:
        run: as the folder or the model has it.
        where: the folder or file that names it, for messages.
        options: of the command line; ``--env`` replaces everything, keyword arguments alone replace those of the same name.

    Raises:
        CheckpointError: if something must be typed again, with the options to type.
        ValueError: as for :func:`from_arguments`.
    """
    if options.env is not None:
        return from_arguments(options.env, options)
    if not is_plain_id(run.env):
        raise CheckpointError(
            f"{where} names the environment {str(run.env)[:60]!r}, and no file may name what is imported; name it "
            "yourself on the command line: --env ID"
        )
    typed = merged(options.env_kwargs, {}, "--env-kwargs")
    recorded = {key: value for key, value in run.env_kwargs.items() if key not in typed}
    kwargs = {**recorded, **typed}
    wrappers = () if options.wrappers else run.wrappers
    if RunConfig(env=run.typed, env_kwargs=recorded, wrappers=wrappers).names_code:
        raise RunConfig(env=run.typed, env_kwargs=kwargs, wrappers=options.wrappers or wrappers).refusal(where)
    description = RunConfig(env=run.env, env_kwargs=kwargs, wrappers=options.wrappers, imports=options.imports)
    return Environment(run.env, description, tuple(find_wrapper(name) for name in options.wrappers))


def environment_of(model: Path, options: RunOptions) -> Environment:
    """Returns the environment for a model: what the command line says, else what the file and its run folder say.

    Raises:
        CheckpointError: if they do not say, if it must be typed again, or if the file is not a model.
        ValueError: if there is no such environment.
    """
    if options.env is not None:
        return from_arguments(options.env, options)
    header = checkpoint.read_header(model, "agent")
    for folder in map(RunFolder, (model.parent, model.parent.parent)):
        is_of_run = folder.config.is_file() and (model in (folder.best, folder.agent) or model.parent == folder.models)
        if is_of_run and (config := read_folder(folder)).env == header.get("env_id"):
            return from_run(config, folder.path, options)
    env_id, env_kwargs = trained_on(header) or (header.get("env_id", ""), {})
    return from_run(RunConfig(env=env_id, env_kwargs=env_kwargs), model, options)
