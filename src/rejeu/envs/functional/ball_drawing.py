"""The ball of the host and of JAX: its box, its rewards, and its picture.

One dimension is drawn as position against time, two as a plane. More dimensions are drawn as the plane of the first two
coordinates, next to plots of coordinates against time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rejeu.envs.canvas import Canvas, Scene

Color = tuple[int, int, int]
Point = tuple[float, float]

WALL, MAX_PUSH = 10.0, 2.0
"""The box is [-WALL, WALL] in every dimension; pushes and initial positions are in [-MAX_PUSH, MAX_PUSH]."""
HELD_REWARD, LOST_REWARD = 50.0, -10.0
"""Rewards of the last step of an episode. The reward of every other step is 1."""
PAPER, INSIDE, OUTSIDE = (246, 246, 243), (255, 255, 255), (244, 235, 232)
INK, FAINT, GRID = (52, 58, 70), (140, 146, 156), (232, 234, 238)
OLD_TRAIL, NEW_TRAIL = (214, 225, 240), (40, 104, 190)
BALL, HELD, LOST, PUSH = (40, 104, 190), (38, 150, 96), (205, 62, 52), (236, 140, 38)
FINE = 2
"""Supersampling factor: the image is drawn at this multiple of its size and downscaled, for smooth edges."""
FADING = 80
"""Number of steps over which the trail fades."""
REACH = WALL + 2.2
"""Largest visible distance from the middle, in units of position; positions beyond are drawn at the edge."""
LINE_SIZE, PLANE_SIZE, STRIPS_WIDTH = (900, 460), (620, 666), 320
"""Width and height in pixels of the image in one dimension and of the plane. They are even, as videos require."""
MOST_STRIPS = 10
"""Maximum number of coordinates that are plotted against time next to the plane."""


class Panel(NamedTuple):
    """An area of the picture, in pixels: the plane of the first two coordinates, or one coordinate against time."""

    left: float
    top: float
    right: float
    bottom: float
    low: float
    high: float
    """The values at the left and the right edge."""
    coordinate: int | None = None
    """The coordinate that is plotted against time, None for the plane."""

    def place(self, x: float, y: float) -> Point:
        """Returns the pixel of ``x`` on the horizontal axis and the position ``y`` on the vertical one."""
        share = (x - self.low) / (self.high - self.low)
        height = (y + REACH) / (2 * REACH)
        return self.left + share * (self.right - self.left), self.bottom - height * (self.bottom - self.top)

    def points(self, trail: np.ndarray, step: int) -> list[Point]:
        """Returns the pixels of positions ``(n, dimension)``, the last of which is that of ``step``."""
        visible = trail.clip(-REACH, REACH)
        if self.coordinate is None:
            return [self.place(x, y) for x, y in visible[:, :2].tolist()]
        return [self.place(step - len(trail) + 1 + i, y) for i, y in enumerate(visible[:, self.coordinate].tolist())]


class BallDrawing(Canvas):
    """Draws states that have a ``position``, of the host's ball and of that in JAX, and the last push."""

    def __init__(self, dimension: int, n_steps: int, render_mode: str) -> None:
        """Prepares the drawing, and opens a window for the render mode ``human``.

        Args:
            dimension: number of dimensions of the box.
            n_steps: time limit of an episode.
            render_mode: ``"rgb_array"`` or ``"human"``.

        Raises:
            MissingExtra: if pygame is not installed.
        """
        self.dimension, self.n_steps = dimension, n_steps
        width, height = LINE_SIZE if dimension == 1 else PLANE_SIZE
        size = width + STRIPS_WIDTH if dimension > 2 else width, height
        super().__init__(size, render_mode, "rejeu/Ball-v0", 30.0, FINE)
        self.pygame.font.init()
        self.font = self.pygame.font.Font(None, 22 * FINE)
        self.large_font = self.pygame.font.Font(None, 30 * FINE)
        if dimension == 1:
            self.main = Panel(64, 72, width - 26, height - 48, 0, n_steps, 0)
        else:
            self.main = Panel(46, 76, width - 26, height - 42, -REACH, REACH)
        self.strips = self._strips() if dimension > 2 else []
        self.surface.fill(PAPER)
        for panel in (self.main, *self.strips):
            self._draw_box(panel)
        self._draw_labels()
        self.field = self.surface.copy()

    def paint(self, scene: Scene) -> None:
        trail = np.array([state.position for state in scene.states], np.float64).reshape(-1, self.dimension)
        step = int(scene.states[-1].time) if scene.states else 0
        lost = scene.over and len(trail) > 0 and bool(np.abs(trail[-1]).max() > WALL)
        color = BALL if not scene.over else LOST if lost else HELD
        self.surface.blit(self.field, (0, 0))
        points = self.main.points(trail, step)
        self._draw_trail(points)
        if scene.action is not None and len(points) > 1:
            self._draw_push(points[-2], np.clip(scene.action, -MAX_PUSH, MAX_PUSH).tolist())
        if points:
            self._draw_ball(points[-1], color)
        for strip in self.strips:
            self._draw_course(strip.points(trail, step), color)
        self._draw_caption(self._caption(trail, step, scene.over, lost), step, color if scene.over else INK, color)

    def _strips(self) -> list[Panel]:
        """Returns the plots of coordinates against time, which share the height of the plane."""
        n, gap = min(self.dimension, MOST_STRIPS), 12.0
        left, right, top, bottom = self.main.right + 74.0, self.size[0] - 26.0, self.main.top, self.main.bottom
        height = (bottom - top - gap * (n - 1)) / n
        tops = [top + i * (height + gap) for i in range(n)]
        return [Panel(left, top, right, top + height, 0, self.n_steps, i) for i, top in enumerate(tops)]

    def _draw_box(self, panel: Panel) -> None:
        """Draws the static background of a panel: the box, its walls, and a grid unless it is a strip."""
        west, east = (-WALL, WALL) if panel.coordinate is None else (panel.low, panel.high)
        self._rectangle((panel.left, panel.top), (panel.right, panel.bottom), OUTSIDE)
        self._rectangle(panel.place(west, WALL), panel.place(east, -WALL), INSIDE)
        levels = (0.0,) if panel in self.strips else (-WALL, -WALL / 2, 0.0, WALL / 2, WALL)
        times = range(self.n_steps // 5, self.n_steps + 1, self.n_steps // 5)
        upright = levels if panel.coordinate is None else () if panel in self.strips else times
        for y in levels:
            self._line(panel.place(west, y), panel.place(east, y), GRID, 1.2)
        for x in upright:
            self._line(panel.place(x, -WALL), panel.place(x, WALL), GRID, 1.2)
        width = 1.6 if panel in self.strips else 2.5
        for y in (-WALL, WALL):
            self._line(panel.place(west, y), panel.place(east, y), INK, width)
        for x in (west, east) if panel.coordinate is None else ():
            self._line(panel.place(x, -WALL), panel.place(x, WALL), INK, width)

    def _draw_labels(self) -> None:
        """Writes the numbers at the axes, and the names of the coordinates where there are several plots."""
        main, below = self.main, self.main.bottom + 15
        ticks = (-WALL, -WALL / 2, 0.0, WALL / 2, WALL)
        for tick in ticks:
            self._text(_number(tick), (main.left - 9, main.place(0, tick)[1]), FAINT, "right")
        for tick in range(0, self.n_steps + 1, self.n_steps // 5) if self.dimension == 1 else ticks:
            self._text(_number(tick), (main.place(tick, 0)[0], below), FAINT, "center")
        if not self.strips:
            return
        self._text("x1", (main.right - 4, below), FAINT, "right")
        self._text("x2", (main.left - 9, main.top + 8), FAINT, "right")
        for i, strip in enumerate(self.strips):
            self._text(f"x{i + 1}", (strip.left - 9, strip.place(0, 0)[1]), FAINT, "right")
        for share in (0.0, 0.5, 1.0):
            position = self.strips[-1].place(share * self.n_steps, 0)[0], below
            self._text(_number(share * self.n_steps), position, FAINT, "center")
        if self.dimension > len(self.strips):
            label = f"{len(self.strips)} of {self.dimension} coordinates"
            self._text(label, (self.strips[0].right, 30), FAINT, "right")

    def _draw_trail(self, points: list[Point]) -> None:
        """Draws the trail. In the plane, the older part has a single faint color and is below the rest."""
        n_old = len(points) if self.dimension == 1 else max(len(points) - FADING, 0)
        if n_old > 1:
            self._lines(points[: n_old + 1], *((NEW_TRAIL, 1.6) if self.dimension == 1 else (OLD_TRAIL, 1.0)))
        for i in range(max(n_old, 1), len(points)):
            freshness = 1.0 - (len(points) - 1 - i) / FADING
            color = _mix(OLD_TRAIL, NEW_TRAIL, freshness**2)
            self._line(points[i - 1], points[i], color, 1.6)
            self._disc(points[i], 1.2 + 1.2 * freshness, color)
        if points:
            self._disc(points[0], 4.5, FAINT)
            self._disc(points[0], 2.8, INSIDE)

    def _draw_push(self, origin: Point, push: Sequence[float]) -> None:
        """Draws the push as an arrow from the previous position of the ball."""
        scale = (self.main.bottom - self.main.top) / (2 * REACH)
        along = np.array([0.0, -push[0]] if self.dimension == 1 else [push[0], -push[1]]) * scale
        length = float(np.hypot(*along))
        if length < 3.0:
            return
        unit, base = along / length, np.array(origin)
        across, head = np.array([-unit[1], unit[0]]), min(9.0, length)
        neck = base + unit * (length - head)
        self._line(tuple(base), tuple(neck), PUSH, 3.0)
        tip = [base + along, neck + across * head * 0.5, neck - across * head * 0.5]
        self.pygame.draw.polygon(self.surface, PUSH, [(float(x) * FINE, float(y) * FINE) for x, y in tip])

    def _draw_ball(self, center: Point, color: Color) -> None:
        radius = 9.0
        self._disc((center[0], center[1] + 1.5), radius + 1.5, _mix(INSIDE, INK, 0.25))
        for i in range(8):
            share = i / 7
            shift, tint = 0.33 * radius * share, 0.75 * share**2
            self._disc((center[0] - shift, center[1] - shift), radius * (1 - 0.85 * share), _mix(color, INSIDE, tint))

    def _draw_course(self, points: list[Point], color: Color) -> None:
        """Draws one coordinate up to the present."""
        if len(points) > 1:
            self._lines(points, NEW_TRAIL, 1.0)
        if points:
            self._disc(points[-1], 4.0, color)

    def _caption(self, trail: np.ndarray, step: int, over: bool, lost: bool) -> str:
        """Returns the caption. In more than two dimensions, it names the coordinates in which the ball left the box."""
        if not lost:
            return f"held for {step} steps" if over and step else f"step {step}"
        beyond = [f"x{i + 1}" for i in np.flatnonzero(np.abs(trail[-1]) > WALL)]
        return f"lost in step {step}" + (f" by {', '.join(beyond)}" if self.dimension > 2 else "")

    def _draw_caption(self, caption: str, step: int, ink: Color, color: Color) -> None:
        left, right = self.main.left, self.main.right
        self._text(caption, (left, 30), ink, "left", self.large_font)
        self._text(f"of {self.n_steps}", (right, 30), FAINT, "right")
        self._rectangle((left, 50), (right, 55), GRID)
        self._rectangle((left, 50), (left + (right - left) * min(step / self.n_steps, 1.0), 55), color)

    def _rectangle(self, corner: Point, opposite: Point, color: Color) -> None:
        left, top = round(corner[0] * FINE), round(corner[1] * FINE)
        width, height = round(opposite[0] * FINE) - left, round(opposite[1] * FINE) - top
        self.pygame.draw.rect(self.surface, color, (left, top, width, height))

    def _line(self, start: Point, end: Point, color: Color, width: float) -> None:
        self._lines([start, end], color, width)

    def _lines(self, points: Sequence[Point], color: Color, width: float) -> None:
        fine = [(x * FINE, y * FINE) for x, y in points]
        self.pygame.draw.lines(self.surface, color, False, fine, max(round(width * FINE), 1))

    def _disc(self, center: Point, radius: float, color: Color) -> None:
        self.pygame.draw.circle(self.surface, color, (center[0] * FINE, center[1] * FINE), max(radius * FINE, 1.0))

    def _text(self, text: str, position: Point, color: Color, side: str, font: Any = None) -> None:
        """Writes ``text``, vertically centered. ``position`` is its ``side``: ``"left"``, ``"right"`` or ``"center"``."""
        drawn = (font or self.font).render(text, True, color)
        x = position[0] * FINE - {"left": 0.0, "center": 0.5, "right": 1.0}[side] * drawn.get_width()
        self.surface.blit(drawn, (round(x), round(position[1] * FINE - 0.5 * drawn.get_height())))


def _mix(first: Color, second: Color, share: float) -> Color:
    """Interpolates between the colors ``first`` (``share=0``) and ``second`` (``share=1``)."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(first, second, strict=True))
    return red, green, blue


def _number(value: float) -> str:
    """Formats a number with a Unicode minus sign."""
    return f"{value:g}".replace("-", "\N{MINUS SIGN}")
