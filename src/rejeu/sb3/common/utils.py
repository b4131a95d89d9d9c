"""Seeds, schedules, devices, and checks of observations and spaces."""

from __future__ import annotations

import os
import platform
import random
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import numpy as np
from gymnasium import spaces

from rejeu.core import schedules
from rejeu.core.schedules import Exponential, Linear, TableSchedule
from rejeu.core.types import Observation, Settings
from rejeu.sb3.modules import passes_on

TABLE_INTERVALS = 1_000
"""Intervals of the table by which a file contains a function given as a schedule."""


def set_random_seed(seed: int, using_cuda: bool = False) -> None:
    """Seeds the global generators of Python and NumPy, as agents of ``rejeu.sb3`` do with their ``seed``.

    They learn from generators of their own. ``using_cuda`` is accepted and ignored.
    """
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - the global generator is what is meant


@dataclass(frozen=True)
class ConstantSchedule:
    """A schedule that has one value throughout the run."""

    val: float

    def __call__(self, _: float) -> float:
        return self.val


class FloatSchedule:
    """A number, or a function of the remaining progress, as a function of the remaining progress that returns a float.

    >>> FloatSchedule(0.2)(0.5), FloatSchedule(lambda remaining: 3 * remaining)(0.5)
    (0.2, 1.5)
    """

    def __init__(self, value_schedule: Any) -> None:
        if isinstance(value_schedule, FloatSchedule):
            value_schedule = value_schedule.value_schedule
        self.value_schedule: Any = (
            value_schedule if callable(value_schedule) else ConstantSchedule(float(value_schedule))
        )

    def __call__(self, progress_remaining: float) -> float:
        return float(self.value_schedule(progress_remaining))

    def __repr__(self) -> str:
        return f"FloatSchedule({self.value_schedule})"


@dataclass(frozen=True)
class LinearSchedule:
    """A straight line from ``start`` to ``end``, reached when ``end_fraction`` of the run is done, and constant after.

    >>> LinearSchedule(1.0, 0.1, end_fraction=0.5)(0.75)
    0.55
    """

    start: float
    """Value at the beginning of the run."""
    end: float
    """Value from ``end_fraction`` of the run on."""
    end_fraction: float
    """Share of the run over which the value moves, in (0, 1]."""

    def __call__(self, progress_remaining: Any) -> Any:
        return self.to_linear()(1.0 - progress_remaining)

    def to_linear(self) -> Linear:
        """Returns the line as a function of the progress."""
        return Linear(self.start, self.end, self.end_fraction)


get_linear_fn, constant_fn, get_schedule_fn = LinearSchedule, ConstantSchedule, FloatSchedule


def of_progress(value: object) -> Any:
    """Returns a schedule of the remaining progress as one of the progress, as data; anything else unchanged.

    A function becomes a table of its values at every thousandth of the run, which a model file contains.
    """
    if isinstance(value, FloatSchedule):
        value = value.value_schedule
    if isinstance(value, ConstantSchedule):
        return float(value.val)
    if isinstance(value, LinearSchedule):
        return value.to_linear()
    if isinstance(value, Linear | Exponential | TableSchedule) or not callable(value):
        return value
    values = [float(value(1.0 - i / TABLE_INTERVALS)) for i in range(TABLE_INTERVALS + 1)]
    return values[0] if len(set(values)) == 1 else TableSchedule(tuple(values))


def of_remaining(value: Any) -> Any:
    """Returns a number or schedule of the progress as a function of the remaining progress: the inverse of the above."""
    if isinstance(value, Linear):
        return LinearSchedule(value.start, value.end, value.fraction)
    return (lambda remaining: schedules.at(value, 1.0 - remaining)) if callable(value) else ConstantSchedule(value)


class Device(str):
    """The name of a device, with the attribute ``type`` that scripts read."""

    @property
    def type(self) -> str:
        """``"cpu"`` or ``"cuda"``; of ``"auto"`` JAX's default."""
        return "cuda" if (jax.default_backend() if self == "auto" else self) in ("gpu", "cuda") else "cpu"


def get_device(device: object = "auto") -> Device:
    """Returns the device of a name; ``"auto"`` and ``"cuda"`` are the CPU where JAX has no GPU."""
    return Device("cuda" if jax.default_backend() == "gpu" and Device(device).type == "cuda" else "cpu")


class Tensor(np.ndarray):
    """A NumPy array with the methods of PyTorch's tensors that scripts end their expressions with.

    Scripts that import PyTorch can give it to PyTorch's functions, which return tensors of theirs.
    """

    @classmethod
    def of(cls, array: object) -> Tensor:
        """Returns an array, or a JAX array, as one of this class."""
        return np.asarray(array).view(cls)

    def __array_wrap__(self, array: object, context: object = None, return_scalar: bool = False) -> Any:
        """Returns results as arrays of this class, also a mean or a sum of all values."""
        return np.asarray(array).view(type(self))

    @property
    def device(self) -> Device:  # type: ignore[override]
        """The CPU."""
        return Device("cpu")

    def numpy(self) -> np.ndarray:
        """Returns a plain array."""
        return self.view(np.ndarray)

    def to(self, *args: object, **kwargs: Any) -> Tensor:
        """Returns itself."""
        return self

    detach = cpu = to

    def mean(self, axis: Any = None, *args: Any, dim: Any = None, **kwargs: Any) -> Any:
        """Returns means over an axis, which PyTorch calls ``dim``."""
        return super().mean(axis if dim is None else dim, *args, **kwargs)

    def sum(self, axis: Any = None, *args: Any, dim: Any = None, **kwargs: Any) -> Any:
        """Returns sums over an axis, which PyTorch calls ``dim``."""
        return super().sum(axis if dim is None else dim, *args, **kwargs)

    clone = np.ndarray.copy

    @classmethod
    def __torch_function__(
        cls, function: Callable[..., Any], types: object, args: tuple[Any, ...] = (), kwargs: Settings | None = None
    ) -> Any:
        """Returns the result of a function of PyTorch's, which calls this where an argument is of this class."""
        torch = sys.modules["torch"]
        as_torch = lambda x: torch.as_tensor(np.asarray(x)) if isinstance(x, cls) else x  # noqa: E731
        in_torch = jax.tree.map(as_torch, (args, kwargs or {}))
        return function(*in_torch[0], **in_torch[1])


def explained_variance(y_pred: np.ndarray, y_true: np.ndarray) -> float:
    """Returns ``1 - Var(y_true - y_pred) / Var(y_true)``, NaN if ``y_true`` is constant."""
    variance = float(np.var(y_true))
    return float("nan") if variance == 0 else float(1.0 - np.var(y_true - y_pred) / variance)


def get_latest_run_id(log_path: str | Path = "", log_name: str = "") -> int:
    """Returns the highest k of the folders ``{log_name}_{k}`` in ``log_path``, 0 if there is none."""
    name = re.compile(re.escape(log_name) + r"_(\d+)")
    run_ids = (name.fullmatch(path.name) for path in Path(log_path).glob("*"))
    return max((int(match[1]) for match in run_ids if match), default=0)


def configure_logger(
    verbose: int = 0, tensorboard_log: str | Path | None = None, tb_log_name: str = "", reset_num_timesteps: bool = True
) -> Any:
    """Returns the logger of an agent with these arguments; a run that continues keeps its folder."""
    from rejeu.sb3.common import logger as loggers  # which needs what callbacks do

    folder, names = os.getenv("SB3_LOGDIR"), ["stdout"] * (verbose >= 1)
    if tensorboard_log is not None:
        k = get_latest_run_id(tensorboard_log, tb_log_name) + reset_num_timesteps
        folder, names = str(Path(tensorboard_log) / f"{tb_log_name}_{k}"), [*names, "tensorboard"]
    return loggers.Logger(folder, [loggers.make_output_format(name, folder or ".") for name in names])


def update_learning_rate(optimizer: Any, learning_rate: float) -> None:
    """Sets the learning rate of an optimizer of PyTorch's; an agent's is its attribute ``learning_rate``."""
    for group in optimizer.param_groups:
        group["lr"] = learning_rate


def check_for_correct_spaces(env: Any, observation_space: gym.Space, action_space: gym.Space) -> None:
    """Raises ``ValueError`` if the spaces of an environment are others."""
    for name, space in (("Observation", observation_space), ("Action", action_space)):
        if space != (env_space := getattr(env, f"{name.lower()}_space")):
            raise ValueError(f"{name} spaces do not match: {space} != {env_space}")


def is_vectorized_observation(observation: Observation, observation_space: gym.Space) -> bool:
    """Returns whether an observation is a batch of observations of the space.

    Raises:
        ValueError: if it is neither a batch nor a single one, or some parts of a Dict are batches and others not.
    """
    if isinstance(observation_space, spaces.Dict):
        parts = [is_vectorized_observation(observation[key], space) for key, space in observation_space.spaces.items()]
        if len(set(parts)) > 1:
            raise ValueError(f"some parts of the observation are batches and others are not: {observation_space}")
        return parts[0]
    if not isinstance(observation_space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        raise ValueError(
            f"the observation must be of a Box, Discrete, MultiDiscrete, MultiBinary or Dict space, not {observation_space}"
        )
    shape, expected = np.shape(observation), observation_space.shape or ()
    if shape == expected:
        return False
    if shape[1:] == expected and len(shape) == len(expected) + 1:
        return True
    raise ValueError(
        f"Unexpected observation shape {shape} for {type(observation_space).__name__} environment, please use {expected} "
        f"or (n_env, {', '.join(map(str, expected))}) for the observation shape"
    )


is_vectorized_box_observation = is_vectorized_discrete_observation = is_vectorized_observation
is_vectorized_dict_observation = is_vectorized_multibinary_observation = is_vectorized_observation
is_vectorized_multidiscrete_observation = is_vectorized_observation


def safe_mean(arr: Any) -> float:
    """Returns the mean, NaN of nothing."""
    return float("nan") if len(arr) == 0 else float(np.mean(arr))


def polyak_update(params: Iterable[np.ndarray], target_params: Iterable[np.ndarray], tau: float) -> None:
    """Moves arrays, in place, by the share ``tau`` of the way to others."""
    for value, target in zip(params, target_params, strict=True):
        target += np.asarray(tau * (value - target), target.dtype)


def get_parameters_by_name(model: Any, included_names: Iterable[str]) -> list[Any]:
    """Returns the parameters of a policy, or of a part of one, whose names contain one of these."""
    return [value for name, value in model.state_dict().items() if any(pattern in name for pattern in included_names)]


def obs_as_tensor(obs: Observation, device: object = "auto") -> Any:
    """Returns observations as arrays, which is what stands for tensors here."""
    return {key: Tensor.of(leaf) for key, leaf in obs.items()} if isinstance(obs, Mapping) else Tensor.of(obs)


def should_collect_more_steps(train_freq: Any, num_collected_steps: int, num_collected_episodes: int) -> bool:
    """Returns whether fewer steps or episodes than ``train_freq`` says have been taken."""
    unit = getattr(train_freq.unit, "value", train_freq.unit)
    return (num_collected_steps if unit == "step" else num_collected_episodes) < train_freq.frequency


def get_system_info(print_info: bool = True) -> tuple[dict[str, str], str]:
    """Returns the versions of Python and of the packages that matter, as a dict and as text."""
    names = ("rejeu", "jax", "numpy", "gymnasium")
    info = {"OS": f"{platform.platform()} {platform.version()}", "Python": platform.python_version()}
    info |= {name: metadata.version(name) for name in names} | {"GPU Enabled": str(jax.default_backend() == "gpu")}
    text = "".join(f"- {key}: {value}\n" for key, value in info.items())
    if print_info:
        print(text)
    return info, text


passes_on(__name__)
