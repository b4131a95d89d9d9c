"""The window of a game: the environments side by side, with scores above and keys below."""

from __future__ import annotations

import math
import os
from types import ModuleType
from typing import Any, NamedTuple, Self

import numpy as np

from rejeu.core import hardware
from rejeu.core.errors import requires
from rejeu.core.language import said
from rejeu.core.types import Action
from rejeu.logs.formatting import counted
from rejeu.teaching.play.game import Event, Game, Player
from rejeu.teaching.play.keys import KeyMap, equivalent_keys

Color = tuple[int, int, int]
Keycap = tuple[str, frozenset[str]]
"""Text of a key in the legend, and the names of the equivalent keys."""

PAPER, INK, FAINT, LINE = (246, 246, 243), (52, 58, 70), (128, 134, 145), (214, 217, 222)
BLUE, GREEN, WHITE = (40, 104, 190), (38, 150, 96), (255, 255, 255)
MARGIN, HEADER, MESSAGE_ROW, LEGEND_ROW = 14, 62, 38, 26
"""Pixels: margin, header and message row of each picture, and row of the legend."""
MIN_HEIGHT, MAX_WIDTH = 360, 720
"""Smaller pictures are enlarged by an integer factor up to this height, unless they would exceed this width."""
SHARE_OF_SCREEN = 0.9
"""Maximum share of the screen that the window uses."""
OFFSCREEN_DRIVERS = ("dummy", "offscreen")
"""SDL's drivers without a screen. They are used only if SDL_VIDEODRIVER selects them, as in the tests."""
HELP = (("r", "restart"), ("p", "pause"), ("q", "quit"))


class LegendEntry(NamedTuple):
    """An action in the legend."""

    keys: list[Keycap]
    """Alternative keys of the action."""
    label: str
    """Description of the action in English."""


class Window:
    """A window on the screen. Mutable; as a context manager it is closed at the end.

    It opens in two steps, because environments render with the same library. Whether there is a screen is checked before an
    environment renders, and the size of the window depends on the rendered frames.

    Raises:
        MissingExtra: if pygame-ce is not installed.
        OSError: if there is no display.
    """

    def __init__(self, title: str) -> None:
        with requires("playing", "pygame-ce", "play"):
            import pygame
        self.pygame: ModuleType = pygame
        self.title = title
        hardware.quiet_sdl()
        try:
            pygame.display.init()
            driver = pygame.display.get_driver()
        except pygame.error as error:
            driver = str(error)
        # SDL falls back to offscreen drivers, where nobody could close the window.
        if not pygame.display.get_init() or (
            driver in OFFSCREEN_DRIVERS and os.environ.get("SDL_VIDEODRIVER") != driver
        ):
            pygame.display.quit()
            raise OSError(
                f"cannot open a window: SDL finds no display ({driver}); play in a browser with "
                "rejeu studio, or film a trained agent with rejeu record RUN"
            )
        pygame.font.init()
        self.clock = pygame.time.Clock()
        self.canvas: Any = None
        """The surface at its natural size."""
        self._screen: Any = None
        self._legend: list[LegendEntry] = []
        self._sizes: list[tuple[int, int]] = []

    def open(self, game: Game, keys: KeyMap | None) -> None:
        """Opens the window at the size of the game's frames, with a legend if there are keys."""
        pygame = self.pygame
        self._fonts = {size: pygame.font.Font(None, size) for size in (20, 22, 24)}
        self._legend = [] if keys is None else legend(keys)
        self._sizes = [picture_size(player.frame) for player in game.players]
        width = sum(size[0] for size in self._sizes) + MARGIN * (len(self._sizes) + 1)
        self._rows = self._arrange(width)
        height = HEADER + max(size[1] for size in self._sizes) + MESSAGE_ROW + LEGEND_ROW * len(self._rows)
        self.canvas = pygame.Surface((width, height))
        screen_width, screen_height = pygame.display.get_desktop_sizes()[0]
        fit = min(1.0, SHARE_OF_SCREEN * screen_width / width, SHARE_OF_SCREEN * screen_height / height)
        self._screen = pygame.display.set_mode((round(width * fit), round(height * fit)), pygame.RESIZABLE)
        pygame.display.set_caption(self.title)
        pygame.key.stop_text_input()  # otherwise an input method may swallow letters

    def events(self) -> list[Event]:
        """Returns the events since the last call, oldest first."""
        pygame = self.pygame
        new_events = []
        for event in pygame.event.get():
            if event.type in (pygame.KEYDOWN, pygame.KEYUP):
                event_type = "press" if event.type == pygame.KEYDOWN else "release"
                new_events.append(Event(event_type, pygame.key.name(event.key).lower()))
            elif event.type == pygame.WINDOWFOCUSLOST:
                new_events.append(Event("leave"))
            elif event.type == pygame.QUIT:
                new_events.append(Event("close"))
        return new_events

    def draw(self, game: Game) -> None:
        """Draws the game."""
        self.canvas.fill(PAPER)
        x = MARGIN
        for player, size in zip(game.players, self._sizes, strict=True):
            self._draw_header(player, x, size[0], by_hand=bool(game.bound))
            self._draw_picture(player.frame, (x, HEADER), size)
            text = message(game, player)
            if text:
                middle = x + size[0] / 2, HEADER + size[1] + MESSAGE_ROW / 2
                self._draw_message(text, middle, GREEN if player.success == 1.0 else INK)
            x += size[0] + MARGIN
        self._draw_legend(game)
        self._present()

    def wait(self, fps: float) -> None:
        """Waits until the next of ``fps`` steps per second is due; delays are not caught up."""
        self.clock.tick(fps)

    def close(self) -> None:
        """Closes the window."""
        self._screen = None
        self.pygame.display.quit()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _present(self) -> None:
        if self._screen.get_size() == self.canvas.get_size():
            self._screen.blit(self.canvas, (0, 0))
        else:
            width, height = self.canvas.get_size()
            fit = min(self._screen.get_width() / width, self._screen.get_height() / height)
            size = max(round(width * fit), 1), max(round(height * fit), 1)
            corner = (self._screen.get_width() - size[0]) // 2, (self._screen.get_height() - size[1]) // 2
            self._screen.fill(PAPER)
            self._screen.blit(self.pygame.transform.smoothscale(self.canvas, size), corner)
        self.pygame.display.flip()

    def _draw_header(self, player: Player, x: int, width: int, by_hand: bool) -> None:
        self._write(said(player.name), (x, 12), 24, INK)
        self._write(score_summary(player, by_hand), (x + width, 14), 22, FAINT, right=True)
        self._write(said("score {}", number(player.score)), (x, 37), 24, BLUE)
        self._write(said("step {}", player.steps), (x + width, 38), 22, FAINT, right=True)

    def _draw_picture(self, frame: np.ndarray, corner: tuple[int, int], size: tuple[int, int]) -> None:
        height, width = frame.shape[:2]
        picture = self.pygame.image.frombuffer(np.ascontiguousarray(frame).tobytes(), (width, height), "RGB")
        if (width, height) != size:
            picture = self.pygame.transform.scale(picture, size)
        self.canvas.blit(picture, corner)
        self.pygame.draw.rect(self.canvas, LINE, (corner[0] - 1, corner[1] - 1, size[0] + 2, size[1] + 2), 1)

    def _draw_message(self, text: str, middle: tuple[float, float], color: Color) -> None:
        """Writes a message below the picture, where it covers nothing."""
        drawn = self._fonts[24].render(text, True, WHITE)
        plate = drawn.get_rect().inflate(28, 10)
        plate.center = round(middle[0]), round(middle[1])
        self.pygame.draw.rect(self.canvas, color, plate, border_radius=8)
        self.canvas.blit(drawn, (plate.x + 14, plate.y + 6))

    def _arrange(self, width: int) -> list[list[tuple[LegendEntry, int]]]:
        """Returns the rows of the legend, each entry with its left edge; the window's keys come last."""
        entries = [*self._legend, *(LegendEntry([(key, frozenset())], said(label)) for key, label in HELP)]
        rows: list[list[tuple[LegendEntry, int]]] = [[]]
        x = MARGIN
        for entry in entries:
            keys = sum(self._key_width(text) + 4 for text, _ in entry.keys)
            wide = keys + self._fonts[20].size(said(entry.label))[0] + 16
            if x + wide > width and rows[-1]:
                rows.append([])
                x = MARGIN
            rows[-1].append((entry, x))
            x += wide
        return rows

    def _key_width(self, text: str) -> int:
        return int(self._fonts[22].size(text)[0]) + 12

    def _draw_legend(self, game: Game) -> None:
        top = self.canvas.get_height() - LEGEND_ROW * len(self._rows) - 2
        for row, entries in enumerate(self._rows):
            y = top + LEGEND_ROW * row
            for entry, x in entries:
                for text, names in entry.keys:
                    plate = (x, y, self._key_width(text), LEGEND_ROW - 6)
                    down = bool(names & game.held)
                    self.pygame.draw.rect(self.canvas, BLUE if down else WHITE, plate, border_radius=4)
                    self.pygame.draw.rect(self.canvas, BLUE if down else LINE, plate, 1, border_radius=4)
                    self._write(text, (x + 6, y + 3), 22, WHITE if down else INK)
                    x += self._key_width(text) + 4
                self._write(said(entry.label), (x + 2, y + 4), 20, FAINT)

    def _write(self, text: str, corner: tuple[int, int], size: int, color: Color, right: bool = False) -> None:
        drawn = self._fonts[size].render(text, True, color)
        self.canvas.blit(drawn, (corner[0] - drawn.get_width() if right else corner[0], corner[1]))


def legend(keys: KeyMap) -> list[LegendEntry]:
    """Returns the entries of the legend in the order of the bindings: all keys of each action, and its description."""
    entries: dict[Action, LegendEntry] = {}
    for binding in keys.bindings:
        entry = entries.setdefault(binding.action, LegendEntry([], binding.label))
        entry.keys.append(("+".join(sorted(binding.keys)), equivalent_keys(binding, keys.bindings)))
    return list(entries.values())


def message(game: Game, player: Player) -> str:
    """Returns the message below a player's picture, empty for none."""
    if player.over and player.steps:
        outcome = {1.0: "success", 0.0: "failed"}.get(player.success, "over")
        return said("{}: {}", said(outcome), number(player.score))
    if game.paused:
        return said("paused")
    return said("press a key to begin") if game.phase == "ready" else ""


def score_summary(player: Player, by_hand: bool) -> str:
    """Returns a summary of the completed episodes, empty before the first; without the mean if played by hand."""
    if not player.scores:
        return ""
    best = said("best {}", number(player.best))
    mean = said("mean {} of {}", number(player.mean), counted(len(player.scores), said("episode")))
    return best if by_hand else f"{mean}   {best}"


def picture_size(frame: np.ndarray) -> tuple[int, int]:
    """Returns the width and height at which a picture is shown: its own, or an integer multiple if it is small.

    >>> [picture_size(np.zeros((*size, 3), np.uint8)) for size in ((400, 600), (100, 80), (150, 600))]
    [(600, 400), (320, 400), (600, 150)]
    """
    height, width = frame.shape[:2]
    times = max(min(math.ceil(MIN_HEIGHT / height), MAX_WIDTH // width), 1) if height < 0.75 * MIN_HEIGHT else 1
    return width * times, height * times


def number(value: float) -> str:
    """Returns a score as text: an integer, or with one decimal; a dash for NaN.

    >>> number(200.0), number(-13.27), number(float("nan"))
    ('200', '-13.3', '-')
    """
    if math.isnan(value):
        return "-"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.1f}"
