"""Vector environments that reset themselves, and what wraps them: the bases that scripts for Stable-Baselines3 derive from.

``step`` returns observations, rewards, dones and infos. Where an episode ended, the observation is the next episode's
first, and the ended one's last stands in its info under ``terminal_observation``; ``TimeLimit.truncated`` says there
whether a time limit alone ended it. Agents take such an environment and recover the true successors from the infos.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np

from rejeu.errors import MissingExtra
from rejeu.reporting.text import counted

Indices = int | Iterable[int] | None
"""Which environments: one, several, or None for all."""
StepResult = tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]
"""Observations ``(num_envs, ...)``, rewards ``float32 (num_envs,)``, dones ``bool (num_envs,)`` and infos."""


class VecEnv(ABC):
    """``num_envs`` environments that begin a new episode within the step that ended the old one. Abstract.

    Derive from it to bring a simulator that steps many environments at once; agents take the result as ``env``.

    Args:
        num_envs: how many.
        observation_space: of one environment.
        action_space: of one environment.
    """

    metadata: dict[str, Any]
    """What the environments declare of themselves."""
    render_mode: str | None
    """The mode that the environments were made with."""

    def __init__(self, num_envs: int, observation_space: gym.Space, action_space: gym.Space) -> None:
        self.num_envs = num_envs
        self.observation_space, self.action_space = observation_space, action_space
        self.metadata, self.render_mode = {}, None
        self.reset_infos: list[dict[str, Any]] = [{} for _ in range(num_envs)]
        """What the last ``reset`` of each environment said."""
        self._seeds: list[int | None] = [None] * num_envs
        self._options: list[dict[str, Any] | None] = [None] * num_envs

    @abstractmethod
    def reset(self) -> Any:
        """Starts an episode in every environment and returns the observations ``(num_envs, ...)``."""

    @abstractmethod
    def step_async(self, actions: Any) -> None:
        """Begins a step with one action for each environment."""

    @abstractmethod
    def step_wait(self) -> StepResult:
        """Ends the step that :meth:`step_async` began and returns what :meth:`step` does."""

    @abstractmethod
    def close(self) -> None:
        """Releases the environments."""

    @abstractmethod
    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Returns an attribute of each environment."""

    @abstractmethod
    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute of each environment."""

    @abstractmethod
    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of each environment and returns what each returned."""

    @abstractmethod
    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        """Returns for each environment whether a wrapper of that class is around it."""

    def __repr__(self) -> str:
        spaces = f"observations {self.observation_space}, actions {self.action_space}"
        return f"<{type(self).__name__}: {counted(self.num_envs, 'environment')}, {spaces}>"

    def step(self, actions: Any) -> StepResult:
        """Steps every environment and returns observations, rewards, dones and infos.

        Where an episode ended, the observation is the next episode's first, and the info has the ended one's last under
        ``terminal_observation``. Every info says under ``TimeLimit.truncated`` whether a time limit alone ended it.

        Args:
            actions: one for each environment, in the environment's own range.
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
        """Seeds the next :meth:`reset`, each environment by one more than the one before; returns the seeds."""
        first = int(np.random.SeedSequence().generate_state(1)[0] >> 1) if seed is None else int(seed)
        self._seeds = [first + i for i in range(self.num_envs)]
        return list(self._seeds)

    def set_options(self, options: dict[str, Any] | Sequence[dict[str, Any]] | None = None) -> None:
        """Sets the options of the next :meth:`reset`: one dict for all environments, or one for each."""
        one_for_all = options is None or isinstance(options, dict)
        each: list[Any] = [options] * self.num_envs if one_for_all else list(options or ())
        self._options = copy.deepcopy(each)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns the picture of each environment, ``uint8 (height, width, 3)``.

        Raises:
            NotImplementedError: for a class that does not say how.
        """
        raise NotImplementedError(f"{type(self).__name__} does not define get_images, so it cannot be rendered")

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """Returns all environments' pictures as one, ``uint8 (height, width, 3)``, or shows them and returns None.

        Args:
            mode: ``"rgb_array"`` returns the picture, ``"human"`` shows it in a window; None is the mode that the
                environments were made with.

        Raises:
            ValueError: if the environments were made without a mode that allows it.
        """
        mode = self.render_mode if mode is None else mode
        if mode == "human" and self.render_mode == "human":
            self.env_method("render")
            return None
        if self.render_mode != "rgb_array" or mode not in ("rgb_array", "human"):
            raise ValueError(
                f"render(mode={mode!r}): the environments were made with render_mode={self.render_mode!r}; "
                "make them with render_mode='rgb_array'"
            )
        picture = tile([image for image in self.get_images() if image is not None])
        if mode == "rgb_array":
            return picture
        show(picture)
        return None

    @property
    def unwrapped(self) -> VecEnv:
        """What is left when all wrappers around the vector environment are taken off."""
        return self.venv.unwrapped if isinstance(self, VecEnvWrapper) else self

    def _reset_seeds(self) -> None:
        self._seeds = [None] * self.num_envs

    def _reset_options(self) -> None:
        self._options = [None] * self.num_envs

    def _get_indices(self, indices: Indices) -> list[int]:
        chosen = range(self.num_envs) if indices is None else [indices] if isinstance(indices, int) else indices
        return list(chosen)


class VecEnvWrapper(VecEnv):
    """Changes what a vector environment shows. Abstract: an heir defines :meth:`reset` and :meth:`step_wait`.

    Everything else, attributes it does not have included, is asked of ``venv``. An heir that changes observations must
    change ``infos[i]["terminal_observation"]`` too, where there is one: from it agents learn what an episode ended in.

    Args:
        venv: the vector environment.
        observation_space: of one environment as it is shown; None: that of ``venv``.
        action_space: likewise.
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
        self.reset_infos = venv.reset_infos

    def step_async(self, actions: Any) -> None:
        """Begins a step with one action for each environment."""
        self.venv.step_async(actions)

    def close(self) -> None:
        """Releases the environments."""
        self.venv.close()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seeds the next reset of the environments; returns the seeds."""
        return self.venv.seed(seed)

    def set_options(self, options: dict[str, Any] | Sequence[dict[str, Any]] | None = None) -> None:
        """Sets the options of the next reset of the environments."""
        self.venv.set_options(options)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Returns the picture of each environment."""
        return self.venv.get_images()

    def render(self, mode: str | None = None) -> np.ndarray | None:
        """Renders the environments; see :meth:`VecEnv.render`."""
        return self.venv.render(mode)

    def has_attr(self, attr_name: str) -> bool:
        """Returns whether the environments have the attribute."""
        return self.venv.has_attr(attr_name)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Returns an attribute of each environment."""
        return self.venv.get_attr(attr_name, indices)

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Sets an attribute of each environment."""
        self.venv.set_attr(attr_name, value, indices)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Calls a method of each environment and returns what each returned."""
        return self.venv.env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Indices = None) -> list[bool]:
        """Returns for each environment whether a wrapper of that class is around it."""
        return self.venv.env_is_wrapped(wrapper_class, indices)

    def __getattr__(self, name: str) -> Any:
        if name == "venv":
            raise AttributeError(f"{type(self).__name__}.__init__ must call super().__init__(venv) first")
        return getattr(self.venv, name)


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
    """Returns whether a wrapper of that class is around a vector environment."""
    return unwrap_vec_wrapper(env, vec_wrapper_class) is not None


def unwrap_wrapper(env: gym.Env, wrapper_class: type[G]) -> G | None:
    """Returns the outermost wrapper of that class around an environment, or None."""
    while isinstance(env, gym.Wrapper):
        if isinstance(env, wrapper_class):
            return env
        env = env.env
    return None


def is_wrapped(env: gym.Env, wrapper_class: type[gym.Wrapper]) -> bool:
    """Returns whether a wrapper of that class is around an environment."""
    return unwrap_wrapper(env, wrapper_class) is not None


def tile(images: Sequence[np.ndarray]) -> np.ndarray:
    """Returns pictures of one shape as one picture, in rows of a near-square grid; places left over are black."""
    rows = math.ceil(math.sqrt(len(images)))
    columns = math.ceil(len(images) / rows)
    filled = [*images, *[np.zeros_like(images[0])] * (rows * columns - len(images))]
    return np.concatenate([np.concatenate(filled[r * columns : (r + 1) * columns], axis=1) for r in range(rows)])


def show(picture: np.ndarray) -> None:
    """Shows a picture, ``uint8 (height, width, 3)``, in a window that is opened at the first call.

    Raises:
        MissingExtra: if pygame, which Gymnasium renders most of its environments with, is not installed.
    """
    try:
        import pygame
    except ImportError:
        raise MissingExtra("render('human')", "pygame-ce", "play") from None
    pygame.display.init()
    size = picture.shape[1], picture.shape[0]
    window = pygame.display.get_surface()
    if window is None or window.get_size() != size:
        window = pygame.display.set_mode(size)
    pygame.event.pump()
    window.blit(pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
    pygame.display.flip()
