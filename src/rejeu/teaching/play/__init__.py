"""Play environments by hand, or watch agents, in a window.

``keys.py`` maps keys to actions, ``game.py`` holds the state of a game, ``window.py`` draws it and reads the keyboard. The
studio shows the same games in the web browser.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.agents import Agent
from rejeu.core.interrupt import Interrupt
from rejeu.core.types import Action, Observation
from rejeu.core.validation import number, whole
from rejeu.demonstrations.recording import Recording
from rejeu.envs.masks import for_agent
from rejeu.envs.registry import make_env
from rejeu.envs.rendering import make_rendering_env, natural_fps
from rejeu.envs.validation import id_of
from rejeu.teaching.play.game import Act, Game, Player
from rejeu.teaching.play.keys import KeyMap, full_name, keys_for
from rejeu.teaching.play.window import Window

__all__ = ["Game", "Player", "play", "watch"]

REST_SECONDS = 1.5
"""Seconds for which the end of a round is shown."""


def play(
    env: str | Callable[..., gym.Env],
    *,
    keys: Mapping[str, Action] | None = None,
    seed: int | None = None,
    fps: float | None = None,
    episodes: int | None = None,
    record: str | Path | None = None,
    against: object = None,
) -> Game:
    """Opens a window to play an environment by hand, and returns the game when the window is closed.

    Args:
        env: an id, a short name (Car, Mountain, Lunar), or a function of ``render_mode`` that makes an environment.
        keys: actions by keys, in addition to the environment's defaults. See :mod:`rejeu.teaching.play.keys`.
        seed: seed of the first round; each further round adds one. None draws a seed.
        fps: steps per second; None uses the environment's ``render_fps``, or 30.
        episodes: close after this number of episodes; None never closes.
        record: new or empty folder for a Minari dataset and a video.
        against: an opponent with ``predict(obs, state, deterministic=True)`` that plays with the same seeds.

    Raises:
        MissingExtra: if pygame-ce, or a package for recording, is not installed.
        ValueError: for an unknown environment, one that does not render, or an action space without keys.
        OSError: if there is no display.
    """
    opponents = {} if against is None else {_name(against): against}
    with opened(env, opponents, keys=keys, seed=seed, fps=fps, episodes=episodes, record=record) as opened_game:
        _run(Window(f"rejeu play {opened_game.env_id}"), opened_game)
    return opened_game.game


def watch(
    agent: Any,
    env: str | Callable[..., gym.Env],
    *,
    seed: int | None = None,
    fps: float | None = None,
    episodes: int | None = None,
) -> Game:
    """Opens a window in which an agent plays, and returns the game when the window is closed.

    Args:
        agent: anything with ``predict(obs, state, deterministic=True)``.
        env: an id, a short name (Car, Mountain, Lunar), or a function of ``render_mode`` that makes an environment.
        seed: seed of the first episode; each further episode adds one. None draws a seed.
        fps: steps per second; None uses the environment's ``render_fps``, or 30.
        episodes: close after this number of episodes; None never closes.

    Raises:
        MissingExtra: if pygame-ce is not installed.
        ValueError: for an unknown environment or one that does not render.
        OSError: if there is no display.
    """
    with opened(env, {_name(agent): agent}, by_hand=False, seed=seed, fps=fps, episodes=episodes) as opened_game:
        _run(Window(f"rejeu watch {opened_game.env_id}"), opened_game)
    return opened_game.game


class Opened(NamedTuple):
    """A game, with its environment's id, keys and speed."""

    game: Game
    env_id: str
    keys: KeyMap | None
    """None if nobody plays by hand."""
    fps: float

    def begin(self) -> None:
        """Starts the first round."""
        self.game.begin()
        for player in self.game.players:
            player.act(player.obs, frozenset(), 0)  # an agent compiles at its first action, which would delay the game


@contextmanager
def opened(
    env: str | Callable[..., gym.Env],
    agents: Mapping[str, object],
    by_hand: bool = True,
    *,
    keys: Mapping[str, Action] | None = None,
    seed: int | None = None,
    fps: float | None = None,
    episodes: int | None = None,
    record: str | Path | None = None,
    has_video: bool = True,
) -> Iterator[Opened]:
    """Context of a game that has not begun, whose environments are closed and whose recording is completed at the end.

    ``agents`` play, under these names, and with ``by_hand`` a person too, as the first player. ``has_video`` says whether a
    recording has a video. The other arguments are those of :func:`play`.
    """
    seed, episodes = _check(seed, fps, episodes)
    with ExitStack() as stack:

        def make(agent: Any = None) -> gym.Env:
            player_env = rendering(env) if agent is None else for_agent(agent, rendering(env))
            stack.callback(player_env.close)
            return player_env

        players, bound = [], None
        if by_hand:
            hand_env = make()
            bound = keys_for(id_of(hand_env), hand_env.action_space, keys)
            players.append(Player("you", hand_env, lambda obs, held, step: bound.action(held, step)))
        players += [Player(name, make(agent), _policy(agent)) for name, agent in agents.items()]
        first = players[0]
        fps = natural_fps(first.env) if fps is None else fps
        if record is not None:
            first.recording = Recording(record, first.env, fps if has_video else None)
            stack.callback(first.recording.close)
        names = frozenset() if bound is None else bound.names
        game = Game(players, seed, names, episodes, ticks_over=round(REST_SECONDS * fps))
        yield Opened(game, id_of(first.env), bound, fps)


def turn(window: Window, game: Game) -> None:
    """Processes the events since the last call, advances the game by one step and draws it."""
    for event in window.events():
        game.handle(event)
    game.tick()
    window.draw(game)


def rendering(env: str | Callable[..., gym.Env]) -> gym.Env:
    """Makes an environment that renders to arrays, from an id, a short name or a function.

    Raises:
        ValueError: if the name is unknown, or the environment does not render.
        MissingExtra: if a package of the environment is not installed.
    """
    if not isinstance(env, str):
        return make_rendering_env(env, "the environment")
    env_id = full_name(env)
    return make_rendering_env(partial(make_env, env_id), env_id)


def _run(window: Window, opened_game: Opened) -> None:
    with window, Interrupt() as stop:
        opened_game.begin()
        window.open(opened_game.game, opened_game.keys)
        while not opened_game.game.closed:
            stop.check()
            turn(window, opened_game.game)
            window.wait(opened_game.fps)


def _check(seed: int | None, fps: float | None, episodes: int | None) -> tuple[int, int | None]:
    """Returns the seed, drawn if it is None, and the number of episodes.

    Raises:
        ValueError: for an invalid number.
    """
    if fps is not None:
        number("fps", fps, above=0)
    if episodes is not None:
        whole("episodes", episodes, least=1)
    if seed is None:
        return int(np.random.default_rng().integers(10_000)), episodes
    return whole("seed", seed, least=0), episodes


def _policy(agent: Any) -> Act:
    state: Any = None

    def act(obs: Observation, held: frozenset[str], step: int) -> Action:
        nonlocal state
        action, state = agent.predict(obs, None if step == 0 else state, deterministic=True)
        return action

    return act


def _name(agent: Any) -> str:
    return agent.name if isinstance(agent, Agent) else type(agent).__name__
