"""The course of a game: players who begin at the same start, the keys they hold, pauses, scores. No window, no clock."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from rejeu.envs.base import success_of
from rejeu.play.keys import CONTROLS
from rejeu.play.recording import Recording
from rejeu.reporting.video import rgb_frame

Act = Callable[[Any, frozenset[str], int], Any]
"""Takes the observation, the keys held and the step of the episode, from 0; returns the action, or None to wait."""

PATIENCE = 0.25
"""Seconds of delay after which lost time is given up rather than made up for."""


@dataclass
class Player:
    """Who plays, and how it went so far. Mutable."""

    name: str
    env: gym.Env
    """Made with ``render_mode="rgb_array"``."""
    act: Act
    recording: Recording | None = None
    """What keeps a copy of everything played."""
    obs: Any = None
    frame: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3), np.uint8))
    """What the environment looks like, ``uint8 (height, width, 3)``."""
    score: float = 0.0
    """Sum of the rewards of this episode."""
    steps: int = 0
    """Steps of this episode."""
    over: bool = True
    success: float = math.nan
    """1 or 0 once the episode is over, NaN where the environment does not say."""
    scores: list[float] = field(default_factory=list)
    """Of the episodes that were played to their end."""

    @property
    def best(self) -> float:
        """Best score of an episode played to its end, NaN before there is one."""
        return max(self.scores, default=math.nan)

    @property
    def mean(self) -> float:
        """Mean score of the episodes played to their end, NaN before there is one."""
        return float(np.mean(self.scores)) if self.scores else math.nan

    def begin(self, seed: int) -> None:
        """Begins an episode; one that is under way is given up."""
        self.obs, _ = self.env.reset(seed=seed)
        self.frame = rgb_frame(self.env)
        self.score, self.steps, self.over, self.success = 0.0, 0, False, math.nan
        if self.recording is not None:
            self.recording.begin(self.obs, seed, self.frame)

    def step(self, action: Any) -> None:
        """Takes a step."""
        self.obs, reward, terminated, truncated, info = self.env.step(action)
        self.frame = rgb_frame(self.env)
        self.score += float(reward)
        self.steps += 1
        self.over = bool(terminated or truncated)
        if self.recording is not None:
            self.recording.step(self.obs, action, float(reward), bool(terminated), bool(truncated), self.frame)
        if self.over:
            self.success = success_of(info)
            self.scores.append(self.score)


@dataclass
class Game:
    """One or several players of the same starts. Mutable; every method returns at once.

    A round begins with the same seed for all; the next one has the next seed. It waits for a bound key, unless
    ``bound`` is empty, and is over when everybody's episode is.
    """

    players: list[Player]
    seed: int
    """Of the present round."""
    bound: frozenset[str] = frozenset()
    """Keys that mean actions; empty where nobody plays by hand."""
    episodes: int | None = None
    """Rounds after which the game closes, None for no end."""
    rest: int = 45
    """Ticks for which the end of a round stays to be seen."""
    phase: Literal["ready", "running", "over"] = "ready"
    paused: bool = False
    closed: bool = False
    held: set[str] = field(default_factory=set)
    """Keys held down."""
    rounds: int = 0
    """Rounds played to their end."""
    tapped: set[str] = field(default_factory=set)
    """Keys pressed since the last tick: one that was let go again already counts for one step."""
    resting: int = 0
    """Ticks until the next round, while one is over."""

    def begin(self) -> None:
        """Begins the present round, anew if it is under way."""
        for player in self.players:
            player.begin(self.seed)
        self.phase = "ready" if self.bound else "running"
        self.paused = False

    def press(self, key: str) -> None:
        """Takes note of a key that went down."""
        command = None if key in self.bound else CONTROLS.get(key)
        if command == "close":
            self.closed = True
        elif command == "restart":
            self.begin()
        elif command == "pause" and self.phase == "ready":
            self.phase = "running"
        elif command == "pause":
            self.paused = not self.paused
        else:
            self.held.add(key)
            self.tapped.add(key)

    def release(self, key: str) -> None:
        """Takes note of a key that went up."""
        self.held.discard(key)

    def release_all(self) -> None:
        """Takes note that keys are no longer heard of: another window has the keyboard."""
        self.held.clear()

    def tick(self) -> None:
        """Lets the time of one step go by."""
        keys = frozenset(self.held | self.tapped)
        self.tapped.clear()
        if self.closed or self.paused:
            return
        if self.phase == "over":
            self.resting -= 1
            if self.resting <= 0:
                self._next()
            return
        if self.phase == "ready":
            if not keys & self.bound:
                return
            self.phase = "running"
        self._step(keys)

    def _step(self, keys: frozenset[str]) -> None:
        playing = [player for player in self.players if not player.over]
        actions = [player.act(player.obs, keys, player.steps) for player in playing]
        if any(action is None for action in actions):
            return
        for player, action in zip(playing, actions, strict=True):
            player.step(action)
        if all(player.over for player in self.players):
            self.phase, self.resting = "over", self.rest
            self.rounds += 1

    def _next(self) -> None:
        if self.episodes is not None and self.rounds >= self.episodes:
            self.closed = True
            return
        self.seed += 1
        self.begin()


class Pace:
    """Keeps a rate: waits until the next multiple of a period, whatever was done in between.

    Args:
        rate: per second.
        clock: the seconds gone by since some moment.
        sleep: waits for so many seconds.
    """

    def __init__(
        self,
        rate: float,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.period = 1.0 / rate
        self._clock, self._sleep = clock, sleep
        self._due = clock()

    def wait(self) -> None:
        """Waits for the next moment; one that has passed is not waited for, and of long delays nothing is made up."""
        self._due += self.period
        left = self._due - self._clock()
        if left > 0:
            self._sleep(left)
        elif left < -PATIENCE:
            self._due -= left
