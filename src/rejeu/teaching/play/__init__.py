"""Play environments by hand, or watch agents, in a window.

``keys.py`` maps keys to actions, ``game.py`` holds the state of a game, ``window.py`` draws it and reads the keyboard,
``recording.py`` writes a dataset and a video.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from rejeu.agents import Agent
from rejeu.core.interrupt import Interrupt
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
    keys: Mapping[str, Any] | None = None,
    seed: int | None = None,
    fps: float | None = None,
    episodes: int | None = None,
    record: str | Path | None = None,
    against: Any = None,
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
    seed, episodes = _check(seed, fps, episodes)
    with ExitStack() as stack:
        playing_env = rendering(env)
        stack.callback(playing_env.close)
        env_id = id_of(playing_env)
        keys_of_env = keys_for(env_id, playing_env.action_space, keys)
        fps = natural_fps(playing_env) if fps is None else fps
        by_hand = Player("you", playing_env, lambda obs, held, step: keys_of_env.action(held, step))
        players = [by_hand]
        if against is not None:
            opponent_env = for_agent(against, rendering(env))
            stack.callback(opponent_env.close)
            players.append(Player(_name(against), opponent_env, _policy(against)))
        if record is not None:
            by_hand.recording = Recording(record, playing_env, fps)
            stack.callback(by_hand.recording.close)
        game = Game(players, seed, keys_of_env.names, episodes, rest=round(REST_SECONDS * fps))
        _run(Window(f"rejeu play {env_id}"), game, keys_of_env, fps)
    return game


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
    seed, episodes = _check(seed, fps, episodes)
    with ExitStack() as stack:
        playing_env = for_agent(agent, rendering(env))
        stack.callback(playing_env.close)
        fps = natural_fps(playing_env) if fps is None else fps
        player = Player(_name(agent), playing_env, _policy(agent))
        game = Game([player], seed, episodes=episodes, rest=round(REST_SECONDS * fps))
        _run(Window(f"rejeu watch {id_of(playing_env)}"), game, None, fps)
    return game


def turn(window: Window, game: Game) -> None:
    """Processes the events since the last call, advances the game by one step and draws it."""
    for event in window.events():
        if event.kind == "press":
            game.press(event.key)
        elif event.kind == "release":
            game.release(event.key)
        elif event.kind == "leave":
            game.release_all()
        else:
            game.closed = True
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


def _run(window: Window, game: Game, keys: KeyMap | None, fps: float) -> None:
    with window, Interrupt() as stop:
        game.begin()
        for player in game.players:
            player.act(player.obs, frozenset(), 0)  # an agent compiles at its first action, which would delay the game
        window.open(game, keys)
        while not game.closed:
            stop.check()
            turn(window, game)
            window.wait(fps)


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

    def act(obs: Any, held: Any, step: int) -> Any:
        nonlocal state
        action, state = agent.predict(obs, None if step == 0 else state, deterministic=True)
        return action

    return act


def _name(agent: Any) -> str:
    return agent.name if isinstance(agent, Agent) else type(agent).__name__
