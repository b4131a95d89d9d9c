"""Pictures of environments: a surface of pygame, or a window, on which the state is drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rejeu.core.errors import requires
from rejeu.core.types import Action, PyTree


class Scene(NamedTuple):
    """The states of an episode to draw."""

    states: list[PyTree]
    """The states of the episode up to now, as NumPy arrays."""
    action: Action
    """The last action; None after a reset."""
    over: bool
    """Whether the episode has ended."""


class Drawing(ABC):
    """A picture, or a window, of an environment."""

    fps: float
    """Frames per second at which an episode is shown."""
    camera: np.ndarray | None = None
    """How goals are projected into the picture, as :func:`rejeu.envs.goal_camera.goal_camera` returns it."""

    @abstractmethod
    def draw(self, scene: Scene) -> np.ndarray | None:
        """Returns ``uint8 (height, width, 3)``, or None if there is a window."""

    @abstractmethod
    def close(self) -> None:
        """Closes the window if there is one."""


class Canvas(Drawing):
    """A surface of pygame on which subclasses draw; a window for the render mode ``human``."""

    def __init__(self, size: tuple[int, int], render_mode: str, title: str, fps: float, fine: int = 1) -> None:
        """Prepares the surface.

        Args:
            size: width and height of the picture in pixels.
            render_mode: ``"rgb_array"`` or ``"human"``.
            title: of the window.
            fps: frames per second.
            fine: the surface is drawn at this multiple of its size and downscaled, for smooth edges.

        Raises:
            MissingExtra: if pygame is not installed.
        """
        with requires(f"drawing {title}", "pygame-ce", "play"):
            import pygame
        self.pygame: ModuleType = pygame
        self.size, self.fps, self.fine = size, fps, fine
        self.surface = pygame.Surface((size[0] * fine, size[1] * fine))
        self.window: Any = None
        self.clock = pygame.time.Clock()
        if render_mode == "human":
            pygame.display.init()
            pygame.display.set_caption(title)
            self.window = pygame.display.set_mode(size)

    @abstractmethod
    def paint(self, scene: Scene) -> None:
        """Draws on the surface."""

    def draw(self, scene: Scene) -> np.ndarray | None:
        self.paint(scene)
        picture = self.surface if self.fine == 1 else self.pygame.transform.smoothscale(self.surface, self.size)
        if self.window is None:
            return np.ascontiguousarray(self.pygame.surfarray.array3d(picture).swapaxes(0, 1))
        self.pygame.event.pump()
        self.window.blit(picture, (0, 0))
        self.pygame.display.flip()
        self.clock.tick(self.fps)
        return None

    def close(self) -> None:
        if self.window is not None:
            self.pygame.display.quit()
            self.window = None
