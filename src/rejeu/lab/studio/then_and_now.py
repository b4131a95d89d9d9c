"""Then and now: policies from the course of training act from the same start, side by side, on a page and in one clip."""

from __future__ import annotations

import asyncio
import math
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path

import numpy as np
from nicegui import ui
from PIL import Image, ImageDraw, ImageFont

from rejeu.agents import load
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core.errors import one_line
from rejeu.core.language import said
from rejeu.core.types import JsonObject
from rejeu.lab.runs import requests
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.runs.config import read_folder
from rejeu.lab.runs.environment import from_run
from rejeu.lab.studio.games import HostedGame, caption
from rejeu.lab.studio.layout import EVERY, action
from rejeu.lab.studio.player import step_of
from rejeu.lab.studio.screen import Screen
from rejeu.lab.studio.speech import say
from rejeu.logs.video import VideoFile, playback_fps
from rejeu.teaching.play import Opened, opened
from rejeu.teaching.play.game import Event, Game

WIDTH, MARGIN, HEADER, FOOTER = 320, 8, 24, 24
"""Pixels of a clip: width of each picture, margin, and the lines of text above and below."""
SIZE = 15
"""Of the letters."""
PAPER, INK, FAINT, GOOD = (246, 246, 243), (28, 39, 51), (100, 112, 125), (30, 138, 95)
MOST_FPS, MOST_SECONDS, HOLD_SECONDS = 20.0, 20.0, 1.5
"""Of a clip: frames a second, length, and how long the end is shown."""
FORMATS = {"GIF": ".gif", "WebM": ".webm"}


def policies(folder: RunFolder) -> dict[str, Path]:
    """Returns an early policy, one of the middle, the best and the current one, as far as they were kept, oldest first.

    They are model files by what they are called.
    """
    course = requests.models(folder.models)
    models = [("", path) for path in (*course[:1], *course[len(course) // 2 :][:1])]
    models += [("best", path) for path in [folder.best] if path.is_file()]
    models += [("current", path) for path in (folder.live, folder.agent) if path.is_file()][:1]
    by_step: dict[int, list[tuple[str, Path]]] = {}
    for word, path in models:
        by_step.setdefault(step_of(path), []).append((word, path))
    return {
        ", ".join([*(said(word) for word, _ in same if word), said("after {} steps", f"{step:,}")]): same[0][1]
        for step, same in sorted(by_step.items())
    }


def open_game(folder: RunFolder, options: RunOptions, seed: int) -> AbstractContextManager[Opened]:
    """Returns the context of a game of one round, in which these policies act from the same start.

    Raises:
        FileNotFoundError: if the run has no model yet.
        ValueError: if the environment must be named, or cannot be rendered.
    """
    environment = from_run(read_folder(folder), folder.path, options)
    agents = {name: load(model, device="cpu") for name, model in policies(folder).items()}
    if not agents:
        raise FileNotFoundError(said("there is no policy yet; the first is kept at the first evaluation"))
    return opened(environment.make, agents, by_hand=False, seed=seed, episodes=1)


def save_clip(path: Path, folder: RunFolder, options: RunOptions, *seeds: int) -> Path:
    """Writes the rounds of these seeds as one clip: a gif, webm or mp4 file. Returns its path.

    Raises:
        MissingExtra: if imageio-ffmpeg is not installed.
        FileNotFoundError: as :func:`open_game`, and its ValueError.
    """
    with open_game(folder, options, seeds[0]) as playing:
        fps = playback_fps(playing.game.players[0].env)
        stride = math.ceil(fps / MOST_FPS)
        with VideoFile(path, fps / stride) as video:
            for playing.game.seed in seeds:
                for frame in frames(playing.game, stride, round(MOST_SECONDS * fps)):
                    video.write(frame)
                for _ in range(round(HOLD_SECONDS * video.fps)):
                    video.write(frame)
    return path


def frames(game: Game, stride: int = 1, most_steps: int = 1000) -> Iterator[np.ndarray]:
    """Yields the pictures of a round, ``uint8 (height, width, 3)``: the start, each ``stride``-th step, and the end."""
    game.begin()
    for step in range(most_steps + 1):
        is_last = game.phase == "over" or step == most_steps
        if step % stride == 0 or is_last:
            yield in_row([player.frame for player in game.players], [caption(game, player) for player in game.players])
        if is_last:
            return
        game.tick()


def in_row(pictures: Sequence[np.ndarray], captions: Sequence[JsonObject]) -> np.ndarray:
    """Returns pictures of the same width in one row, with names above, and scores and messages below."""
    scaled = [Image.fromarray(picture) for picture in pictures]
    scaled = [picture.resize((WIDTH, round(picture.height * WIDTH / picture.width))) for picture in scaled]
    height = max(picture.height for picture in scaled)
    whole = Image.new("RGB", (len(scaled) * (WIDTH + MARGIN) + MARGIN, HEADER + height + FOOTER), PAPER)
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(SIZE)
    for i, (picture, texts) in enumerate(zip(scaled, captions, strict=True)):
        edge, below = MARGIN + i * (WIDTH + MARGIN), HEADER + height + FOOTER / 2
        whole.paste(picture, (edge, HEADER))
        pen.text((edge, HEADER / 2), texts["name"], INK, font, "lm")
        pen.text((edge, below), texts["score"], FAINT, font, "lm")
        pen.text((edge + WIDTH, below), texts["message"], GOOD if texts["won"] else INK, font, "rm")
    return np.asarray(whole)


class ThenAndNow:
    """The row on the page of a run, and buttons to save it. Mutable."""

    def __init__(self, folder: RunFolder, options: RunOptions) -> None:
        self.folder, self.options, self.seed = folder, options, 0
        self.playing: HostedGame | None = None
        with ui.expansion(say("Then and now")).classes("w-full"):
            policies = say("An early, a middle, the best and the current policy, from the same start")
            ui.label(policies).classes("text quiet")
            with ui.row().classes("gap-2"):
                action(say("Play"), "play_arrow", self.play)
                action(say("another start"), "casino", lambda: self.play(self.seed + 1))
                for name, suffix in FORMATS.items():
                    save = partial(self.save, suffix=suffix)
                    action(say("save as {}", name), "download", lambda event, save=save: save(event.sender))
            self.stage = ui.element("div").classes("w-full one-row")
            self.status = ui.label().classes("text quiet")
        ui.timer(EVERY, self.look)

    def play(self, seed: int | None = None) -> None:
        """Lets the policies act from a start, by default the one before."""
        self.seed = seed if isinstance(seed, int) else self.seed
        self.stage.clear()  # the screen of an earlier round ends it
        with self.stage:
            screen = Screen()
        playing = self.playing = HostedGame(lambda: open_game(self.folder, self.options, self.seed), screen.show)
        screen.on_leave = lambda: playing.handle(Event("close"))

    def look(self) -> None:
        """Says that the round has not begun yet, or why it cannot."""
        playing = self.playing
        if playing is not None:
            is_loading = playing.opened is None and not playing.ended
            loading = say("agents are loaded and compiled ...")
            now = playing.said or say("start {}", self.seed)
            self.status.text = loading if is_loading else now

    async def save(self, button: ui.button, suffix: str) -> None:
        """Writes the clip, and lets the browser save it."""
        button.props["loading"] = True
        try:
            with tempfile.TemporaryDirectory() as temporary:
                path = Path(temporary) / f"then-and-now-{self.seed}{suffix}"
                await asyncio.to_thread(save_clip, path, self.folder, self.options, self.seed)
                ui.download.content(path.read_bytes(), path.name)
        except Exception as error:  # the environment can raise anything
            ui.notify(one_line(error), type="negative")
        finally:
            button.props["loading"] = False
