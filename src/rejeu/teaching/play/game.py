"""The state of a game: players with the same seeds, held keys, pauses, scores. It has no window and no clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.core.types import Action, Observation
from rejeu.demonstrations.recording import Recording
from rejeu.envs.base import success_of
from rejeu.envs.rendering import rgb_frame
from rejeu.teaching.play.keys import CONTROLS

Act = Callable[[Observation, frozenset[str], int], Action]
"""Maps the observation, the held keys and the step of the episode (from 0) to an action, or None to wait."""


class Event(NamedTuple):
    """An event of the keyboard or the window."""

    type: str
    """``press``, ``release``, ``leave`` (the window lost the keyboard focus) or ``close``."""
    key: str = ""
    """SDL's name of the key in lower case."""


@dataclass
class Player:
    """A player with its environment and scores. Mutable."""

    name: str
    env: gym.Env
    """Made with ``render_mode="rgb_array"``."""
    act: Act
    recording: Recording | None = None
    """Recording of the episodes, None if they are not recorded."""
    obs: Observation = None
    frame: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 3), np.uint8))
    """The latest frame, ``uint8 (height, width, 3)``."""
    score: float = 0.0
    """Sum of the rewards of this episode."""
    steps: int = 0
    """Steps of this episode."""
    over: bool = True
    success: float = math.nan
    """1 or 0 at the end of the episode, NaN if the environment does not report it."""
    scores: list[float] = field(default_factory=list)
    """Scores of the completed episodes."""

    @property
    def best(self) -> float:
        """Best score of a completed episode, NaN before the first."""
        return max(self.scores, default=math.nan)

    @property
    def mean(self) -> float:
        """Mean score of the completed episodes, NaN before the first."""
        return float(np.mean(self.scores)) if self.scores else math.nan

    def begin(self, seed: int) -> None:
        """Starts an episode, and aborts a running one."""
        self.obs, _ = self.env.reset(seed=seed)
        self.frame = rgb_frame(self.env)
        self.score, self.steps, self.over, self.success = 0.0, 0, False, math.nan
        if self.recording is not None:
            self.recording.begin(self.obs, seed, self.frame)

    def step(self, action: Action) -> None:
        """Steps the environment."""
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
    """One or several players whose rounds have the same seeds. Mutable; no method waits.

    Each round uses the next seed, the same for all players. It waits for the first bound key, unless ``bound`` is
    empty. It is over when the episodes of all players are over.
    """

    players: list[Player]
    seed: int
    """Seed of the current round."""
    bound: frozenset[str] = frozenset()
    """Keys with actions; empty if nobody plays by hand."""
    episodes: int | None = None
    """Rounds after which the game closes, None for no limit."""
    ticks_over: int = 45
    """Ticks for which the end of a round is shown."""
    phase: Literal["ready", "running", "over"] = "ready"
    paused: bool = False
    closed: bool = False
    held: set[str] = field(default_factory=set)
    """Keys that are currently held."""
    rounds: int = 0
    """Number of completed rounds."""
    tapped: set[str] = field(default_factory=set)
    """Keys pressed since the last tick. A key that was released since then still counts for one step."""
    resting: int = 0
    """Ticks until the next round."""

    def begin(self) -> None:
        """Starts the current round, or restarts it."""
        for player in self.players:
            player.begin(self.seed)
        self.phase = "ready" if self.bound else "running"
        self.paused = False

    def handle(self, event: Event) -> None:
        """Handles an event."""
        if event.type == "press":
            self.press(event.key)
        elif event.type == "release":
            self.held.discard(event.key)
        elif event.type == "leave":
            self.held.clear()
        else:
            self.closed = True

    def press(self, key: str) -> None:
        """Handles a key press."""
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

    def tick(self) -> None:
        """Advances the game by one step."""
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
            self.phase, self.resting = "over", self.ticks_over
            self.rounds += 1

    def _next(self) -> None:
        if self.episodes is not None and self.rounds >= self.episodes:
            self.closed = True
            return
        self.seed += 1
        self.begin()
