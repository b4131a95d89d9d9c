"""Base classes of Stable-Baselines3's vector environments and of their wrappers.

``step`` returns observations, rewards, dones and infos. Where an episode ended, the environment is reset within the step:
the observation is the first of the next episode, ``info["terminal_observation"]`` is the last of the ended one, and
``info["TimeLimit.truncated"]`` says whether only a time limit ended it. Agents accept such an environment and read the
true next observations from the infos.
"""

from __future__ import annotations

import copy
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from operator import methodcaller
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import concatenate, create_empty_array

from rejeu.core.errors import requires
from rejeu.core.types import Action, Info, Observation
from rejeu.envs.rendering import check_renders, rgb_frame
from rejeu.envs.workers.process import call_method
from rejeu.logs.formatting import counted

TERMINAL_OBSERVATION = "terminal_observation"
"""Key of the info that holds the last observation of an episode."""
TIME_LIMIT_TRUNCATED = "TimeLimit.truncated"
"""Key of the info that says whether only a time limit ended the episode."""
VecEnvIndices = int | Iterable[int] | None
"""Which environments: one, several, or None for all."""
VecEnvObs = Any
"""Observations ``(num_envs, ...)``: an array, or a dict or tuple of arrays."""
VecEnvStepReturn = tuple[VecEnvObs, np.ndarray, np.ndarray, list[Info]]
"""Observations, rewards ``float32 (num_envs,)``, dones ``bool (num_envs,)`` and infos."""


class VecEnv(ABC):
    """``num_envs`` environments that are reset within the step that ends an episode. Abstract.

    Subclass it to wrap a simulator that steps many environments at once; agents accept an instance as ``env``.

    Args:
        num_envs: number of environments.
        observation_space: observation space of one environment.
        action_space: action space of one environment.
    """

    metadata: dict[str, Any]
    """Metadata of the environments."""
    render_mode: str | None
    """Render mode that the environments were made with."""

    def __init__(self, num_envs: int, observation_space: gym.Space, action_space: gym.Space) -> None:
        self.num_envs = num_envs
        self.observation_space, self.action_space = observation_space, action_space
        self.metadata, self.render_mode = {}, None
        self.reset_infos: list[Info] = [{} for _ in range(num_envs)]
        """Info returned by the last ``reset`` of each environment."""
        self._seeds: list[int | None] = [None] * num_envs
        self._options: list[Info | None] = [None] * num_envs

    @abstractmethod
    def reset(self) -> Observation:
        """Resets every environment and returns the observations ``(num_envs, ...)``."""

    @abstractmethod
    def step_async(self, actions: Action) -> None:
        """Starts a step with one action for each environment."""

    @abstractmethod
    def step_wait(self) -> VecEnvStepReturn:
        """Waits for the step started by :meth:`step_async`; returns the same as :meth:`step`."""

    @abstractmethod
    def close(self) -> None:
        """Closes the environments."""

    @abstractmethod
    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Returns an attribute of each environment."""

    @abstractmethod
    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        """Sets an attribute of each environment."""

    @abstractmethod
    def env_method(
        self, method_name: str, *method_args: object, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of each environment and returns the results."""

    @abstractmethod
    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Returns for each environment whether it is wrapped in that class."""

    def __repr__(self) -> str:
        spaces = f"observations {self.observation_space}, actions {self.action_space}"
        return f"<{type(self).__name__}: {counted(self.num_envs, 'environment')}, {spaces}>"

    def step(self, actions: Action) -> VecEnvStepReturn:
        """Steps every environment and returns observations, rewards, dones and infos.

        Where an episode ended, the observation is the first of the next episode, and ``info["terminal_observation"]`` is
        the last of the ended one. ``info["TimeLimit.truncated"]`` says whether only a time limit ended it.

        Args:
            actions: one for each environment, within the action space.
        """
        self.step_async(actions)
        return self.step_wait()

    def has_attr(self, attr_name: str) -> bool:
        """Returns whether the environments have the attribute."""
        try:
            self.get_attr(attr_name)
        except AttributeError:
            return False
        return True

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds the next :meth:`reset`: environment i gets ``seed + i``. Returns the seeds."""
        first = int(np.random.SeedSequence().generate_state(1)[0] >> 1) if seed is None else int(seed)
        self._seeds = [first + i for i in range(self.num_envs)]
        return list(self._seeds)

    def set_options(self, options: Info | Sequence[Info] | None = None) -> None:
        """Sets the options of the next :meth:`reset`: one dict for all environments, or one for each."""
        one_for_all = options is None or isinstance(options, dict)
        each: list[Any] = [options] * self.num_envs if one_for_all else list(options or ())
        self._options = copy.deepcopy(each)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns an image of each environment, ``uint8 (height, width, 3)``.

        Raises:
            NotImplementedError: if the class does not implement it.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define get_images, so it cannot be rendered")

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """Returns the images of all environments as one, ``uint8 (height, width, 3)``, or shows it and returns None.

        Args:
            mode: ``"rgb_array"`` returns the image, ``"human"`` shows it in a window; None, and with a warning any other,
                uses the mode that the environments were made with. If that is no mode for it, a warning says so.
        """
        if mode not in (None, "rgb_array", "human"):
            warnings.warn(f"render(mode={mode!r}): the mode is {self.render_mode!r}", UserWarning, stacklevel=2)
            mode = None
        mode = self.render_mode if mode is None else mode
        if mode == "human" and self.render_mode == "human":
            self.env_method("render")
            return None
        if self.render_mode != "rgb_array":
            warnings.warn(
                f"render(mode={mode!r}) shows nothing: the environments were made with render_mode={self.render_mode!r}; "
                "make them with render_mode='rgb_array'",
                UserWarning,
                stacklevel=2,
            )
            return None
        image = tile_images([image_of_env for image_of_env in self.get_images() if image_of_env is not None])
        if mode == "rgb_array":
            return image
        show(image)
        return None

    @property
    def unwrapped(self) -> VecEnv:
        """The vector environment without its wrappers."""
        return self.venv.unwrapped if isinstance(self, VecEnvWrapper) else self

    def _reset_seeds(self) -> None:
        self._seeds = [None] * self.num_envs

    def _reset_options(self) -> None:
        self._options = [None] * self.num_envs

    def _check_count(self, actions: Action) -> None:
        if len(actions) < self.num_envs:
            raise ValueError(f"step got {len(actions)} actions for {self.num_envs} environments")
        if len(actions) > self.num_envs:
            warnings.warn(
                f"step got {len(actions)} actions for {self.num_envs} environments and takes the first; give an array "
                "with one row for each environment",
                UserWarning,
                stacklevel=4,
            )

    def _get_indices(self, indices: VecEnvIndices) -> list[int]:
        is_index = isinstance(indices, int | np.integer)
        indices_chosen: Any = range(self.num_envs) if indices is None else [indices] if is_index else indices
        return [range(self.num_envs)[i] for i in indices_chosen]


class SingleEnvs(VecEnv):
    """A vector of Gymnasium environments, in this process or in others. Abstract."""

    @abstractmethod
    def _call(self, indices: VecEnvIndices, function: Callable[..., Any], *arguments: object) -> list[Any]:
        """Returns ``function(env, *arguments)`` of some environments."""

    def get_images(self) -> list[np.ndarray]:
        check_renders(self)
        return self._call(None, rgb_frame)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return self._call(indices, methodcaller("get_wrapper_attr", attr_name))

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        """Sets an attribute of each environment.

        It is set where it exists, also inside wrappers. (Stable-Baselines3 sets it on the outermost wrapper, where the
        environment itself does not see it.)
        """
        self._call(indices, methodcaller("set_wrapper_attr", attr_name, value))

    def env_method(
        self, method_name: str, *method_args: object, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        return self._call(indices, call_method, method_name, method_args, method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return self._call(indices, is_wrapped, wrapper_class)

    def _stepped(self, answers: Iterable[object]) -> VecEnvStepReturn:
        """Returns the results of :func:`rejeu.envs.workers.process.step_and_reset` for each environment as one result."""
        obs, rewards, terminated, truncated, infos, finals, reset_infos = map(list, zip(*answers, strict=True))
        dones = np.logical_or(terminated, truncated)
        for i in range(self.num_envs):
            infos[i] = {**infos[i], TIME_LIMIT_TRUNCATED: truncated[i] and not terminated[i]}
            if dones[i]:
                infos[i][TERMINAL_OBSERVATION] = finals[i]
                self.reset_infos[i] = reset_infos[i]
        return stacked(self.observation_space, obs), np.array(rewards, np.float32), dones, infos


class VecEnvWrapper(VecEnv):
    """A wrapper of a vector environment. Abstract: subclasses implement :meth:`reset` and :meth:`step_wait`.

    Everything else, including unknown attributes, is forwarded to ``venv``. A subclass that changes observations must
    also change ``infos[i]["terminal_observation"]``, from which agents read the last observation of an episode.

    Args:
        venv: the vector environment.
        observation_space: observation space of one environment; None uses that of ``venv``.
        action_space: action space of one environment; None uses that of ``venv``.
    """

    def __init__(
        self,
        venv: VecEnv,
        observation_space: gym.Space | None = None,
        action_space: gym.Space | None = None,
    ) -> None:
        if not isinstance(venv, VecEnv):
            raise TypeError(
                f"{type(self).__name__} wraps a vector environment, got {type(venv).__name__}; "
                "try DummyVecEnv([lambda: env])"
            )
        self.venv = venv
        super().__init__(
            venv.num_envs,
            venv.observation_space if observation_space is None else observation_space,
            venv.action_space if action_space is None else action_space,
        )
        self.metadata, self.render_mode = venv.metadata, venv.render_mode
        self.reset_infos = getattr(venv, "reset_infos", self.reset_infos)  # its own __init__ may not call VecEnv's

    def step_async(self, actions: Action) -> None:
        self.venv.step_async(actions)

    def close(self) -> None:
        self.venv.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        return self.venv.seed(seed)

    def set_options(self, options: Info | Sequence[Info] | None = None) -> None:
        self.venv.set_options(options)

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.venv.get_images()

    def render(self, mode: str | None = None) -> np.ndarray | None:
        return self.venv.render(mode)

    def has_attr(self, attr_name: str) -> bool:
        return self.venv.has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        return self.venv.get_attr(attr_name, indices)

    def set_attr(self, attr_name: str, value: object, indices: VecEnvIndices = None) -> None:
        self.venv.set_attr(attr_name, value, indices)

    def env_method(
        self, method_name: str, *method_args: object, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        return self.venv.env_is_wrapped(wrapper_class, indices)

    def __getattr__(self, name: str) -> Any:
        if name == "venv":
            raise AttributeError(f"{type(self).__name__}.__init__ must call super().__init__(venv) first")
        inner: Any = self.venv
        owners = []
        while isinstance(inner, VecEnvWrapper):
            owners += [type(inner).__name__] if name in vars(inner) or hasattr(type(inner), name) else []
            inner = inner.venv
        if len(owners) > 1:
            raise AttributeError(f"{name!r} is ambiguous: {' and '.join(owners)} have it; ask one of them through venv")
        return getattr(self.venv, name)


class ObservationWrapper(VecEnvWrapper):
    """A wrapper that maps observations, those of ``terminal_observation`` included. Abstract."""

    @abstractmethod
    def map_observation(self, obs: Observation) -> Observation:
        """Returns the observation of one or of several environments as this wrapper shows it."""

    def reset(self) -> Observation:
        return self.map_observation(self.venv.reset())

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            if TERMINAL_OBSERVATION in info:
                info[TERMINAL_OBSERVATION] = self.map_observation(info[TERMINAL_OBSERVATION])
        return self.map_observation(obs), rewards, dones, infos


W = TypeVar("W", bound=VecEnvWrapper)
G = TypeVar("G", bound=gym.Wrapper)


def unwrap_vec_wrapper(env: VecEnv, vec_wrapper_class: type[W]) -> W | None:
    """Returns the outermost wrapper of that class around a vector environment, or None."""
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, vec_wrapper_class):
            return env
        env = env.venv
    return None


def is_vecenv_wrapped(env: VecEnv, vec_wrapper_class: type[VecEnvWrapper]) -> bool:
    """Returns whether a vector environment is wrapped in that class."""
    return unwrap_vec_wrapper(env, vec_wrapper_class) is not None


def unwrap_wrapper(env: gym.Env, wrapper_class: type[G]) -> G | None:
    """Returns the outermost wrapper of that class around an environment, or None."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, wrapper_class):
            return env
        env = env.env
    return None


def is_wrapped(env: gym.Env, wrapper_class: type[gym.Wrapper]) -> bool:
    """Returns whether an environment is wrapped in that class."""
    return unwrap_wrapper(env, wrapper_class) is not None


def tile_images(images: Sequence[np.ndarray]) -> np.ndarray:
    """Returns images of one shape as one image, in a near-square grid whose unused cells are black."""
    rows = math.ceil(math.sqrt(len(images)))
    columns = math.ceil(len(images) / rows)
    filled = [*images, *[np.zeros_like(images[0])] * (rows * columns - len(images))]
    return np.concatenate([np.concatenate(filled[r * columns : (r + 1) * columns], axis=1) for r in range(rows)])


def stacked(space: gym.Space, parts: list[Any]) -> Observation:
    """Returns the observations of all environments as one, ``(num_envs, ...)``."""
    empty: Any = create_empty_array(space, len(parts))
    return concatenate(space, parts, empty)


def by_key(obs: Observation) -> dict[str, Observation]:
    """Returns Dict observations as they are, others under the key ``""``."""
    return obs if isinstance(obs, dict) else {"": obs}


def is_image(space: gym.Space) -> bool:
    """Returns whether observations are ``uint8`` images with three axes."""
    return isinstance(space, gym.spaces.Box) and space.dtype == np.uint8 and len(space.shape) == 3


def show(image: np.ndarray) -> None:
    """Shows an image, ``uint8 (height, width, 3)``, in a window that the first call opens.

    Raises:
        MissingExtra: if pygame is not installed.
    """
    with requires("render('human')", "pygame-ce", "play"):
        import pygame
    pygame.display.init()
    size = image.shape[1], image.shape[0]
    window = pygame.display.get_surface()
    if window is None or window.get_size() != size:
        window = pygame.display.set_mode(size)
    pygame.event.pump()
    window.blit(pygame.surfarray.make_surface(image.swapaxes(0, 1)), (0, 0))
    pygame.display.flip()
