"""A window on an environment in which an agent acts, and a person takes over by holding keys."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import jax
import numpy as np

from rejeu.agents import Agent, OffPolicyAgent
from rejeu.callbacks.base import TrainingCallback
from rejeu.core import interrupt, spaces
from rejeu.core.language import said
from rejeu.core.types import Action, Observation, PyTree
from rejeu.core.validation import number
from rejeu.demonstrations.recording import Recording
from rejeu.envs.in_process import InProcess
from rejeu.envs.rendering import natural_fps, rgb_frame
from rejeu.envs.validation import id_of
from rejeu.teaching.play.game import Game, Player
from rejeu.teaching.play.keys import CONTROLS, keys_for
from rejeu.teaching.play.window import Window
from rejeu.training.run import Progress


class Expert:
    """Where a person takes over by holding keys: a window on an environment that somebody else steps. Mutable.

    Called, it returns the action of the person, whatever the observation. The first call opens the window. ``p`` pauses, ``q``
    closes the window; nobody takes over any more then.

    Args:
        env: made with ``render_mode="rgb_array"``.
        keys: actions by keys, in addition to the environment's defaults.
        fps: steps a second; None uses the environment's own.

    Raises:
        MissingExtra: if pygame-ce is not installed.
        ValueError: if the action space has no keys.
        OSError: if there is no display.
    """

    def __init__(self, env: gym.Env, keys: Mapping[str, Action] | None = None, fps: float | None = None) -> None:
        self.env, self.keys = env, keys_for(id_of(env), env.action_space, keys)
        self.fps = natural_fps(env) if fps is None else number("fps", fps, above=0)
        self.player = Player("agent", env, lambda obs, held, step: None, over=False)
        self.game = Game([self.player], 0, self.keys.names, phase="running")
        self.window = Window(said("{}: hold a key to take over", f"rejeu {id_of(env)}"))

    def __call__(self, obs: Observation = None) -> Action:
        """Draws the environment, waits for its next step, and returns the action of the person; None where no key is held.

        After Ctrl-C, which ends the training or the clone, nobody is waited for.
        """
        if self.window.canvas is None:
            self.player.frame = rgb_frame(self.env)
            self.window.open(self.game, self.keys)
        while not self.game.closed and interrupt.requested() is None:
            for event in self.window.events():
                if event.type != "press" or event.key in self.keys.names or CONTROLS.get(event.key) != "restart":
                    self.game.handle(event)
            if self.game.closed:
                self.close()
                break
            held = frozenset(self.game.held | self.game.tapped) & self.keys.names
            self.player.name = "you" if held else "agent"
            self.player.frame = rgb_frame(self.env)
            self.window.draw(self.game)
            self.window.wait(self.fps)
            if not self.game.paused:
                self.game.tapped.clear()
                return self.keys.action(held, self.player.steps) if held else None
        return None

    def stepped(self, reward: float, done: bool) -> None:
        """Updates the score that the window shows."""
        self.player.score, self.player.steps = self.player.score + reward, self.player.steps + 1
        if done:
            self.player.scores.append(self.player.score)
            self.player.score, self.player.steps = 0.0, 0

    def close(self) -> None:
        """Closes the window."""
        self.game.closed = True
        self.window.close()


class Assist(TrainingCallback):
    """Lets a person act in place of an agent while it trains: who holds a key acts, and who releases it gives the agent back.

    The replay buffer holds what was done, so the agent learns from the person's actions as from its own. The person's steps
    are also written to a Minari dataset, each stretch without a release as an episode.

    Args:
        folder: new or empty, of the dataset; None writes none.
        keys: as for :func:`rejeu.teaching.play.play`.
        fps: steps a second; None uses the environment's own.

    Raises:
        ValueError: when training starts, if the algorithm has no replay buffer, or the environment is not a single one of
            Gymnasium that renders to arrays.
    """

    every_step: ClassVar[bool] = True

    def __init__(
        self, folder: str | Path | None = None, keys: Mapping[str, Action] | None = None, fps: float | None = None
    ) -> None:
        self.folder, self.keys, self.fps = folder, keys, fps
        self.seat: Expert
        self.recording: Recording | None = None
        self.steps = 0
        """Number of steps in which the person acted."""
        self._by_hand = False

    def before_training(self, agent: Agent) -> None:
        """Checks the agent; the window opens after the first step, when there is something to show."""
        check(agent)
        self.seat = Expert(agent.run.env.envs[0], self.keys, self.fps)
        if self.folder is not None:
            self.recording = Recording(self.folder, agent.run.env.envs[0], None)

    def __call__(self, agent: Agent, progress: Progress) -> None:
        """Records the step that was taken, and replaces the action of the next one if a key is held."""
        run = agent.run
        if self.seat.game.closed and not self._by_hand:
            return
        assert progress.result is not None
        terminated, truncated = bool(progress.result.terminated[0]), bool(progress.result.truncated[0])
        if self._by_hand:
            self.steps += 1
            if self.recording is not None:
                obs = progress.result.obs if progress.last_obs is None else progress.last_obs
                action, reward = progress.action, float(progress.result.reward[0])
                self.recording.step(single(obs), single(action), reward, terminated, truncated)
        self.seat.stepped(float(progress.result.reward[0]), terminated or truncated)
        action = self.seat()
        if action is not None:
            run.action = spaces.unscale_action(agent.action_space, np.asarray(action)[None])
            if self.recording is not None and not (self._by_hand and not (terminated or truncated)):
                self.recording.begin(single(run.obs), None)
        self._by_hand = action is not None

    def after_training(self, agent: Agent, error: BaseException | None) -> None:
        """Closes the window and completes the dataset."""
        self.seat.close()
        if self.recording is not None:
            self.recording.close()


def check(agent: Agent) -> None:
    """Raises ``ValueError`` if a person cannot act in place of an agent, ``OSError`` if there is no display."""
    if not isinstance(agent, OffPolicyAgent) or agent.config.offline:
        why = "it steps no environment" if isinstance(agent, OffPolicyAgent) else "it learns from its own actions alone"
        raise ValueError(
            f"nobody can take over from {agent.name}, because {why}; use an algorithm with a replay buffer, as SAC"
        )
    if not isinstance(agent.run.env, InProcess) or agent.n_envs != 1:
        raise ValueError(
            f"taking over needs one environment of the backend gymnasium, got {agent.n_envs} of {agent.run.env.backend}"
        )
    keys_for(agent.run.env.env_id, agent.action_space)
    Window("").close()


def single(batch: PyTree) -> PyTree:
    """Returns a copy of the only row of a batch of observations or actions."""
    return jax.tree.map(lambda leaf: np.array(leaf[0]), batch)
