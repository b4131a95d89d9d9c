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
MARGIN = 2.2
"""Width of the visible area outside the walls, in units of position."""
LINE_SIZE, PLANE_SIZE, STRIPS_WIDTH = (900, 460), (620, 666), 320
"""Width and height in pixels of the image in one dimension and of the plane. They are even, as videos require."""
MOST_STRIPS = 10
"""Maximum number of coordinates that are plotted against time next to the plane."""


class Strip(NamedTuple):
    """Area of the plot of one coordinate against time, in pixels."""

    left: float
    top: float
    right: float
    bottom: float

    def place(self, share: float, height: float) -> Point:
        """Returns the pixel coordinates of a time fraction in [0, 1] and a height from -1 (bottom) to 1 (top)."""
        y = 0.5 * (self.top + self.bottom) - 0.5 * height * (self.bottom - self.top)
        return self.left + share * (self.right - self.left), y


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
        self.dimension, self.n_steps, self.wall = dimension, n_steps, WALL
        width, height = LINE_SIZE if dimension == 1 else PLANE_SIZE
        size = width + STRIPS_WIDTH if dimension > 2 else width, height
        super().__init__(size, render_mode, "rejeu/Ball-v0", 30.0, FINE)
        self.pygame.font.init()
        self.font = self.pygame.font.Font(None, 22 * FINE)
        self.large_font = self.pygame.font.Font(None, 30 * FINE)
        self.left, self.top = (64, 72) if dimension == 1 else (46, 76)
        self.right, self.bottom = width - 26, height - (48 if dimension == 1 else 42)
        self._draw_field()
        self.strips = self._strips() if dimension > 2 else []
        if self.strips:
            self._text("x1", (self.right - 4, self.bottom + 15), FAINT, "right")
            self._text("x2", (self.left - 9, self.top + 8), FAINT, "right")
        for i, strip in enumerate(self.strips):
            self._draw_strip(i, strip)
        self.field = self.surface.copy()

    def paint(self, scene: Scene) -> None:
        trail = [[float(x) for x in state.position] for state in scene.states]
        step = int(scene.states[-1].time) if scene.states else 0
        over = scene.over
        lost = over and bool(trail) and max(map(abs, trail[-1])) > self.wall
        color = BALL if not over else LOST if lost else HELD
        self.surface.blit(self.field, (0, 0))
        points = self._points(trail, step)
        self._draw_trail(points)
        if points:
            if scene.action is not None and len(points) > 1:
                self._draw_push(points[-2], np.clip(scene.action, -MAX_PUSH, MAX_PUSH).tolist())
            self._draw_ball(points[-1], color)
        for i, strip in enumerate(self.strips):
            self._draw_course(strip, [position[i] for position in trail], step, color)
        self._draw_caption(self._caption(trail, step, over, lost), step, color if over else INK, color)

    def _x(self, value: float) -> float:
        low, high = (0.0, float(self.n_steps)) if self.dimension == 1 else (-self.wall - MARGIN, self.wall + MARGIN)
        return self.left + (self.right - self.left) * (value - low) / (high - low)

    def _y(self, value: float) -> float:
        reach = self.wall + MARGIN
        return self.bottom - (self.bottom - self.top) * (value + reach) / (2 * reach)

    def _points(self, trail: Sequence[Sequence[float]], step: int) -> list[Point]:
        """Returns the positions of the trail in the image, clipped to its edges."""
        reach = self.wall + MARGIN
        clipped = [[min(max(x, -reach), reach) for x in position] for position in trail]
        if self.dimension == 1:
            first = step - len(clipped) + 1
            return [(self._x(first + i), self._y(position[0])) for i, position in enumerate(clipped)]
        return [(self._x(position[0]), self._y(position[1])) for position in clipped]

    def _draw_field(self) -> None:
        """Draws the static background: the box, its walls and the axis labels."""
        self.surface.fill(PAPER)
        wall = self.wall
        west, east = (0, self.n_steps) if self.dimension == 1 else (-wall, wall)
        self._rectangle((self.left, self.top), (self.right, self.bottom), OUTSIDE)
        self._rectangle((self._x(west), self._y(wall)), (self._x(east), self._y(-wall)), INSIDE)
        ticks = [-wall, -wall / 2, 0.0, wall / 2, wall]
        for tick in ticks:
            self._line((self._x(west), self._y(tick)), (self._x(east), self._y(tick)), GRID, 1.2)
            self._text(_number(tick), (self.left - 9, self._y(tick)), FAINT, "right")
        for tick in range(0, self.n_steps + 1, self.n_steps // 5) if self.dimension == 1 else ticks:
            if self.dimension > 1 or tick > 0:
                self._line((self._x(tick), self._y(-wall)), (self._x(tick), self._y(wall)), GRID, 1.2)
            self._text(_number(tick), (self._x(tick), self.bottom + 15), FAINT, "center")
        corners = [(self._x(x), self._y(y)) for x, y in ((west, wall), (east, wall), (east, -wall), (west, -wall))]
        sides = ((0, 1), (2, 3)) if self.dimension == 1 else ((0, 1), (1, 2), (2, 3), (3, 0))
        for start, end in sides:
            self._line(corners[start], corners[end], INK, 2.5)

    def _draw_trail(self, points: list[Point]) -> None:
        """Draws the trail. In the plane, the older part has a single faint color and is below the rest."""
        n_old = len(points) if self.dimension == 1 else max(len(points) - FADING, 0)
        if n_old > 1:
            fine = [(x * FINE, y * FINE) for x, y in points[: n_old + 1]]
            color, width = (NEW_TRAIL, 1.6) if self.dimension == 1 else (OLD_TRAIL, 1.0)
            self.pygame.draw.lines(self.surface, color, False, fine, round(width * FINE))
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
        scale = (self.bottom - self.top) / (2 * (self.wall + MARGIN))
        along = np.array([0.0, -push[0]] if self.dimension == 1 else [push[0], -push[1]]) * scale
        length = float(np.hypot(*along))
        if length < 3.0:
            return
        unit, base = along / length, np.array(origin)
        across, head = np.array([-unit[1], unit[0]]), min(9.0, length)
        neck = base + unit * (length - head)
        self._line(tuple(base), tuple(neck), PUSH, 3.0)
        self._polygon([base + along, neck + across * head * 0.5, neck - across * head * 0.5], PUSH)

    def _draw_ball(self, center: Point, color: Color) -> None:
        radius = 9.0
        self._disc((center[0], center[1] + 1.5), radius + 1.5, _mix(INSIDE, INK, 0.25))
        for i in range(8):
            share = i / 7
            shift, tint = 0.33 * radius * share, 0.75 * share**2
            self._disc((center[0] - shift, center[1] - shift), radius * (1 - 0.85 * share), _mix(color, INSIDE, tint))

    def _strips(self) -> list[Strip]:
        """Returns the areas of the plots against time, which share the height of the plane."""
        n = min(self.dimension, MOST_STRIPS)
        left, right, gap = self.right + 74.0, self.size[0] - 26.0, 12.0
        height = (self.bottom - self.top - gap * (n - 1)) / n
        tops = [self.top + i * (height + gap) for i in range(n)]
        return [Strip(left, top, right, top + height) for top in tops]

    def _draw_strip(self, coordinate: int, strip: Strip) -> None:
        """Draws the static background of one plot against time: the box, its walls and the label of the coordinate."""
        wall = self.wall / (self.wall + MARGIN)
        self._rectangle((strip.left, strip.top), (strip.right, strip.bottom), OUTSIDE)
        self._rectangle(strip.place(0, wall), strip.place(1, -wall), INSIDE)
        self._line(strip.place(0, 0), strip.place(1, 0), GRID, 1.2)
        for height in (-wall, wall):
            self._line(strip.place(0, height), strip.place(1, height), INK, 1.6)
        self._text(f"x{coordinate + 1}", (strip.left - 9, strip.place(0, 0)[1]), FAINT, "right")
        if coordinate == len(self.strips) - 1:
            for share in (0.0, 0.5, 1.0):
                place = strip.place(share, 0)[0], self.bottom + 15
                self._text(_number(share * self.n_steps), place, FAINT, "center")
        if coordinate == 0 and self.dimension > len(self.strips):
            self._text(f"{len(self.strips)} of {self.dimension} coordinates", (strip.right, 30), FAINT, "right")

    def _draw_course(self, strip: Strip, values: Sequence[float], step: int, color: Color) -> None:
        """Plots the values of one coordinate up to ``step``."""
        reach, first = self.wall + MARGIN, step - len(values) + 1
        heights = [min(max(value / reach, -1.0), 1.0) for value in values]
        points = [strip.place((first + i) / self.n_steps, height) for i, height in enumerate(heights)]
        if len(points) > 1:
            self.pygame.draw.lines(self.surface, NEW_TRAIL, False, [(x * FINE, y * FINE) for x, y in points], FINE)
        if points:
            self._disc(points[-1], 4.0, color)

    def _caption(self, trail: Sequence[Sequence[float]], step: int, over: bool, lost: bool) -> str:
        """Returns the caption. In more than two dimensions, it names the coordinates in which the ball left the box."""
        if not lost:
            return f"held for {step} steps" if over and step else f"step {step}"
        left = [f"x{i + 1}" for i, x in enumerate(trail[-1]) if abs(x) > self.wall]
        return f"lost in step {step}" + (f" by {', '.join(left)}" if self.dimension > 2 else "")

    def _draw_caption(self, said: str, step: int, ink: Color, color: Color) -> None:
        self._text(said, (self.left, 30), ink, "left", self.large_font)
        self._text(f"of {self.n_steps}", (self.right, 30), FAINT, "right")
        self._rectangle((self.left, 50), (self.right, 55), GRID)
        filled = self.left + (self.right - self.left) * min(step / self.n_steps, 1.0)
        self._rectangle((self.left, 50), (filled, 55), color)

    def _rectangle(self, corner: Point, opposite: Point, color: Color) -> None:
        left, top = round(corner[0] * FINE), round(corner[1] * FINE)
        width, height = round(opposite[0] * FINE) - left, round(opposite[1] * FINE) - top
        self.pygame.draw.rect(self.surface, color, (left, top, width, height))

    def _line(self, start: Sequence[float], end: Sequence[float], color: Color, width: float) -> None:
        """Draws a line as a polygon, because wide lines of pygame have slanted ends. Thin lines have round ends."""
        along = np.subtract(end, start)
        length = float(np.hypot(*along))
        if length > 0.0:
            across = np.array([-along[1], along[0]]) * (0.5 * width / length)
            self._polygon([start + across, end + across, end - across, start - across], color)
        if width < 2.0:
            self._disc(start, 0.5 * width, color)
            self._disc(end, 0.5 * width, color)

    def _polygon(self, points: Sequence[Any], color: Color) -> None:
        self.pygame.draw.polygon(self.surface, color, [(float(x) * FINE, float(y) * FINE) for x, y in points])

    def _disc(self, center: Sequence[float], radius: float, color: Color) -> None:
        self.pygame.draw.circle(
            self.surface, color, (float(center[0]) * FINE, float(center[1]) * FINE), max(radius * FINE, 1.0)
        )

    def _text(self, text: str, place: Point, color: Color, side: str, font: Any = None) -> None:
        """Writes ``text``, vertically centered. ``place`` is its ``side``: ``"left"``, ``"right"`` or ``"center"``."""
        drawn = (font or self.font).render(text, True, color)
        x = place[0] * FINE - {"left": 0.0, "center": 0.5, "right": 1.0}[side] * drawn.get_width()
        self.surface.blit(drawn, (round(x), round(place[1] * FINE - 0.5 * drawn.get_height())))


def _mix(first: Color, second: Color, share: float) -> Color:
    """Interpolates between the colors ``first`` (``share=0``) and ``second`` (``share=1``)."""
    red, green, blue = (round(a + (b - a) * share) for a, b in zip(first, second, strict=True))
    return red, green, blue


def _number(value: float) -> str:
    """Formats a number with a Unicode minus sign."""
    return f"{value:g}".replace("-", "\N{MINUS SIGN}")
