"""Environments by id: the package that registers it, the extra that installs it, and similar ids."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import re
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from rejeu.core.errors import MissingExtra, requires
from rejeu.core.validation import nearest

PLAIN_ID = re.compile(r"(?=.{1,200}$)([\w-]+/)?[\w.-]*(?<!\.py)(?<!\.)", re.IGNORECASE)
"""Pattern of ids that are looked up: a name, after a namespace or none. An id with a colon makes Gymnasium import a module."""
PLAIN_WORD = re.compile(r"[\w-]{0,60}")
"""Pattern of strings that are neither paths nor importable."""
LARGEST = 1e6
"""Largest number in the arguments of an environment from a file. Larger ones could allocate any amount of memory."""
MAKES_OWN = frozenset(("id", "env_id", "render_mode", "disable_env_checker", "vectorization_mode"))
"""Arguments of ``gymnasium.make`` itself."""
ENVPOOL_SIZE = "about 770 MB with its assets"
"""Disk space of EnvPool 1.2.5, including the asset packages that it depends on."""
MIRRORED = frozenset(("gymnasium", "ale_py", "highway_env", "gymnasium_robotics", "minigrid", "vizdoom"))
"""Packages whose environments EnvPool has."""
MOST_KWARGS = 100
"""Maximum number of keyword arguments of an environment from a file."""


class Provider(NamedTuple):
    """A package whose import registers environments, and rejeu's extra that installs it (empty if there is none)."""

    module: str
    package: str
    extra: str


PROVIDERS: dict[tuple[str, ...], Provider] = {
    (
        "parking-", "highway-", "merge-", "roundabout-", "intersection-", "racetrack-", "exit-", "two-way-", "u-turn-",
        "lane-keeping-",
    ): Provider("highway_env", "highway-env", "parking"),
    ("ALE/",): Provider("ale_py", "ale-py", ""),
    ("MinAtar/",): Provider("minatar", "MinAtar", ""),
    ("rejeu/ParkingHard-",): Provider("highway_env", "highway-env", "parking"),
    ("Fetch", "Hand", "PointMaze", "AntMaze", "Adroit", "FrankaKitchen"): Provider(
        "gymnasium_robotics", "gymnasium-robotics", "robotics"
    ),
    ("MiniGrid-", "BabyAI-"): Provider("minigrid", "minigrid", ""),
    ("dm_control/",): Provider("shimmy", '"shimmy[dm-control]"', ""),
    ("Meta-World/",): Provider("metaworld", "metaworld", ""),
    ("Panda",): Provider("panda_gym", "panda-gym", ""),
}  # fmt: skip
"""Packages that register environments, by the prefixes of their ids."""

NEEDS = {
    "Box2D": Provider("Box2D", "box2d", "box2d"),
    "box2d": Provider("Box2D", "box2d", "box2d"),
    "mujoco": Provider("mujoco", "mujoco", "mujoco"),
    "pygame": Provider("pygame", "pygame", "parking"),
    "flax": Provider("flax", "flax", ""),
}
"""Packages that Gymnasium's own environments import when they are made."""


def provider(env_id: str) -> Provider | None:
    """Returns the package that registers ``env_id``, or None if Gymnasium itself does."""
    return next((p for prefixes, p in PROVIDERS.items() if env_id.startswith(prefixes)), None)


def register(env_id: str) -> bool:
    """Imports the package that registers ``env_id``; returns whether Gymnasium knows the id now."""
    source = provider(env_id)
    if source is not None and importlib.util.find_spec(source.module) is not None:
        if not env_id.startswith("Adroit"):
            _without_notice(source.module)
        module = importlib.import_module(source.module)
        if source.module == "gymnasium_robotics":
            gym.register_envs(module)
            _compare_joints()
        elif source.module == "minatar" and env_id not in gym.registry:
            importlib.import_module("minatar.gym").register_envs()
    return env_id in gym.registry or ":" in env_id


def has_package(env_id: str) -> bool:
    """Returns whether a package other than EnvPool registers ``env_id``, installed or not."""
    return register(env_id) or provider(env_id) is not None


def _compare_joints() -> None:
    """Lets Gymnasium-Robotics tell kinds of joints, which equal no NumPy integer any more in MuJoCo 3.12 and later."""
    mujoco = importlib.import_module("mujoco")
    joint_types = SimpleNamespace(**{name: int(joint) for name, joint in mujoco.mjtJoint.__members__.items()})
    utils = importlib.import_module("gymnasium_robotics.utils.mujoco_utils")
    utils.mujoco = SimpleNamespace(**{**vars(mujoco), "mjtJoint": joint_types})  # type: ignore[attr-defined]


def _without_notice(module: str) -> None:
    """Suppresses the notices that Farama's packages print at their first import."""
    try:
        from farama_notifications import notifications
    except ImportError:
        return
    notifications.pop(module, None)


def is_plain_id(env_id: object) -> bool:
    """Returns whether a file may name this environment: it is an id that is looked up, and no module or file to import.

    >>> is_plain_id("rejeu/Ball-v0"), is_plain_id("my_env:Walk-v0"), is_plain_id("models/evil.py"), is_plain_id("//host/x")
    (True, False, False, False)
    """
    return isinstance(env_id, str) and PLAIN_ID.fullmatch(env_id) is not None


def are_plain(env_kwargs: object) -> bool:
    """Returns whether these keyword arguments of an environment are allowed in a file.

    Booleans, words, and numbers up to a million are allowed. Paths and importable names are not.

    >>> are_plain({"sigma": 2.0, "map_name": "8x8"}), are_plain({"xml_file": "/tmp/evil.xml"}), are_plain({"n": 10**9})
    (True, False, False)
    """
    return (
        isinstance(env_kwargs, dict)
        and len(env_kwargs) <= MOST_KWARGS
        and all(isinstance(key, str) and key.isidentifier() and len(key) <= 60 for key in env_kwargs)
        and MAKES_OWN.isdisjoint(env_kwargs)
        and all(_is_plain(value) for value in env_kwargs.values())
    )


def _is_plain(value: object) -> bool:
    if isinstance(value, str):
        return PLAIN_WORD.fullmatch(value) is not None
    return isinstance(value, bool | int | float) and -LARGEST <= value <= LARGEST  # False for NaN


def make_env(env_id: str, **kwargs: Any) -> gym.Env:
    """Returns ``gymnasium.make(env_id)`` without its passive checker, after importing the package that registers the id.

    Raises:
        ValueError: if the environment is unknown, with similar names.
        MissingExtra: if a package that it needs is not installed.
    """
    if not register(env_id):
        source = provider(env_id)
        if source is not None and source.extra and importlib.util.find_spec(source.module) is None:
            raise MissingExtra(f"the environment {env_id}", source.package, source.extra)
        raise ValueError(unknown_environment(env_id))
    try:
        return gym.make(env_id, disable_env_checker=True, **kwargs)
    except (gym.error.DeprecatedEnv, gym.error.DependencyNotInstalled, ImportError) as error:
        need = next((p for name, p in NEEDS.items() if name in str(error)), None)
        missing = need is not None and importlib.util.find_spec(need.module) is None
        if need and missing and isinstance(error, gym.error.DependencyNotInstalled | ModuleNotFoundError):
            raise MissingExtra(f"the environment {env_id}", need.package, need.extra) from None
        if newer := newer_version(env_id):
            raise ValueError(
                f"{env_id} is an old version that cannot be made any more ({error}); use {newer}"
            ) from None
        raise


def maker(env_id: str, **kwargs: Any) -> Callable[[], gym.Env]:
    """Returns a function that makes the environment. It can be pickled, and includes the registration."""
    return partial(_make_of_spec, env_id, gym.registry.get(env_id), **kwargs)


def _make_of_spec(env_id: str, spec: EnvSpec | None, /, **kwargs: Any) -> gym.Env:
    if spec is not None and not register(env_id):
        gym.registry[env_id] = spec
    return make_env(env_id, **kwargs)


def unknown_environment(env_id: str) -> str:
    """Returns the error message for an unknown id, with what to install, or similar ids."""
    short = re.sub(r"(NoFrameskip|Deterministic)-v\d+$", "-v5", env_id.removeprefix("ALE/"))
    elsewhere = f"EnvPool has {short}: backend='envpool' (--backend envpool)" if in_envpool(short) else ""
    if short != env_id:
        also = f"; {elsewhere}" if elsewhere else ""
        old = "" if env_id.startswith("ALE/") else f", where it is called ALE/{short}"
        return f"{env_id} is of the package ale-py{old}, which is not installed: pip install ale-py{also}"
    if newer := newer_version(env_id):
        return f"{env_id} is an old version that Gymnasium no longer has; use {newer}"
    source = provider(env_id)
    if source is not None and importlib.util.find_spec(source.module) is None:
        text = f"{env_id} is of the package {source.module}, which is not installed: pip install {source.package}"
        return "; ".join(filter(None, (text, elsewhere)))
    if elsewhere:
        return f"Gymnasium has no {env_id}, so it cannot be drawn or stepped by Gymnasium; {elsewhere}"
    env_ids = {*gym.registry, "parking-v0", "FetchReach-v4", "FetchPush-v4"}
    hint = nearest(env_id, env_ids, "rejeu list shows the environments that have presets", n=3)
    return f"no environment is called {env_id!r}; {hint}"


def newer_version(env_id: str) -> str | None:
    """Returns the id of the newest registered version of an environment, None if this one is the newest or has no version.

    >>> newer_version("LunarLander-v2"), newer_version("LunarLander-v3"), newer_version("LunarLander")
    ('LunarLander-v3', None, None)
    """
    name, dash, version = env_id.rpartition("-v")
    if not dash or not version.isdecimal():
        return None
    versions = [key.rpartition("-v")[2] for key in gym.registry if key.rpartition("-v")[0] == name]
    newest = max((int(text) for text in versions if text.isdecimal()), default=-1)
    return f"{name}-v{newest}" if newest > int(version) else None


def import_envpool() -> Any:
    """Returns the module ``envpool``, which knows all its environments; the code of a game is imported when it is made.

    ``import envpool`` takes half a second for every game and Matplotlib, only to register ids, which is done alone here.

    Raises:
        MissingExtra: if it is not installed, or a library of the system is missing.
    """
    with requires("backend='envpool'", f"EnvPool ({ENVPOOL_SIZE})", "envpool"):
        if "envpool" in sys.modules or not (tables := _tables_of_envpool()):
            return importlib.import_module("envpool")
        _forget_envpool()  # what an import that failed elsewhere left behind
        sys.modules["envpool.entry"] = ModuleType("envpool.entry")
        try:
            envpool = importlib.import_module("envpool")
            for name, path in tables.items():
                spec = importlib.util.spec_from_file_location(name, path)
                assert spec is not None
                assert spec.loader is not None
                sys.modules[name] = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(sys.modules[name])
        except (ImportError, OSError):
            _forget_envpool()
            raise
        return envpool


def _forget_envpool() -> None:
    """Removes EnvPool's modules after an import that failed, because EnvPool refuses to register a game twice."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "envpool"]:
        del sys.modules[name]


def usable_envpool() -> Any:
    """Returns the module ``envpool``, or None where it cannot be imported; warns if it is installed nevertheless."""
    try:
        return import_envpool()
    except MissingExtra as error:
        if is_envpool_installed():
            warnings.warn(f"{error}; Gymnasium's environments are used instead", UserWarning, stacklevel=2)
        return None


def _tables_of_envpool() -> dict[str, Path]:
    """Returns the files of the modules that EnvPool's entry imports, by name; none if it does more than to import such."""
    package = importlib.util.find_spec("envpool")
    entry = Path(package.origin).with_name("entry.py") if package is not None and package.origin else None
    if entry is None or not entry.is_file():
        return {}
    statements = ast.parse(entry.read_text(encoding="utf-8")).body[1:]  # the first is the docstring
    names = [alias.name for statement in statements if isinstance(statement, ast.Import) for alias in statement.names]
    files = {name: entry.parents[1].joinpath(*name.split(".")).with_suffix(".py") for name in names}
    are_tables = all(path.name == "registration.py" and path.is_file() for path in files.values())
    return files if are_tables and all(isinstance(statement, ast.Import) for statement in statements) else {}


def is_envpool_installed() -> bool:
    """Returns whether EnvPool is installed, without importing it."""
    return importlib.util.find_spec("envpool") is not None


def in_envpool(env_id: str) -> bool:
    """Returns whether EnvPool can be used and has an environment of this id.

    An id of the user's own code is not looked up, which would take a second.
    """
    spec = gym.registry.get(env_id)
    source = None if spec is None else spec.entry_point
    package = (source if isinstance(source, str) else getattr(source, "__module__", "")).partition(".")[0]
    if source is not None and package not in MIRRORED:
        return False
    envpool = usable_envpool()
    return envpool is not None and env_id in envpool.list_all_envs()
