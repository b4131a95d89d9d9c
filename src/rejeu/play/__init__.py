"""Environments played by hand, and agents watched at play, in a window.

``keys.py`` says which action the keys held stand for, ``game.py`` what happens step by step, ``window.py`` shows it and
listens, ``recording.py`` keeps it.
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
from rejeu.envs.faults import id_of
from rejeu.envs.masks import shown_to
from rejeu.envs.registry import make_env
from rejeu.interrupt import Interrupt
from rejeu.play.game import Act, Game, Pace, Player
from rejeu.play.keys import KeyMap
from rejeu.play.known import full_name, keys_for
from rejeu.play.recording import Recording
from rejeu.play.window import Window
from rejeu.reporting.video import DEFAULT_FPS, make_drawing
from rejeu.validation import number, whole

__all__ = ["Game", "Player", "play", "watch"]

REST_SECONDS = 1.5
"""How long the end of a round stays to be seen."""


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
    """Opens a window in which a person plays, and returns the game as it stood when the window was closed.

    Args:
        env: an id, or Car, Mountain or Lunar; or a function that takes ``render_mode`` and makes an environment.
        keys: actions by keys, on top of those known for the environment; see :mod:`rejeu.play.keys`.
        seed: of the first start; each further one has the next seed. None draws one.
        fps: steps a second; None: the environment's own, 30 if it declares none.
        episodes: close after so many; None leaves that to the player.
        record: folder, new or empty, for a Minari dataset and a video of what is played.
        against: an agent, anything with ``predict(obs, state, deterministic=True)``, that plays the same starts beside.

    Raises:
        MissingExtra: if pygame-ce, or what a recording needs, is not installed.
        ValueError: for an unknown environment, one without pictures, or actions that cannot be played by hand.
        OSError: if there is no screen.
    """
    seed, episodes = _check(seed, fps, episodes)
    with ExitStack() as stack:
        playing = drawing(env)
        stack.callback(playing.close)
        env_id = id_of(playing)
        keys_of_env = keys_for(env_id, playing.action_space, keys)
        fps = natural_fps(playing) if fps is None else fps
        by_hand = Player("you", playing, lambda obs, held, step: keys_of_env.action(held, step))
        players = [by_hand]
        if against is not None:
            rival = shown_to(against, drawing(env))
            stack.callback(rival.close)
            players.append(Player(_name(against), rival, _policy(against)))
        if record is not None:
            by_hand.recording = Recording(record, env_id, fps)
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
    """Opens a window in which an agent plays, and returns the game as it stood when the window was closed.

    Args:
        agent: anything with ``predict(obs, state, deterministic=True)``.
        env: an id, or Car, Mountain or Lunar; or a function that takes ``render_mode`` and makes an environment.
        seed: of the first episode; each further one has the next seed. None draws one.
        fps: steps a second; None: the environment's own, 30 if it declares none.
        episodes: close after so many; None leaves that to who watches.

    Raises:
        MissingExtra: if pygame-ce is not installed.
        ValueError: for an unknown environment or one without pictures.
        OSError: if there is no screen.
    """
    seed, episodes = _check(seed, fps, episodes)
    with ExitStack() as stack:
        playing = shown_to(agent, drawing(env))
        stack.callback(playing.close)
        fps = natural_fps(playing) if fps is None else fps
        player = Player(_name(agent), playing, _policy(agent))
        game = Game([player], seed, episodes=episodes, rest=round(REST_SECONDS * fps))
        _run(Window(f"rejeu watch {id_of(playing)}"), game, None, fps)
    return game


def turn(window: Window, game: Game) -> None:
    """Does what the events since the last call ask for, lets one step's time go by, and shows the game."""
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


def drawing(env: str | Callable[..., gym.Env]) -> gym.Env:
    """Returns an environment that draws to arrays, of an id or a short name, or made by a function.

    Raises:
        ValueError: if none is called so, or it cannot draw.
        MissingExtra: if a package that it needs is not installed.
    """
    if not isinstance(env, str):
        return make_drawing(env, "the environment")
    env_id = full_name(env)
    return make_drawing(partial(make_env, env_id), env_id)


def natural_fps(env: gym.Env) -> float:
    """Returns the steps a second that an environment declares, or 30."""
    return float(env.metadata.get("render_fps") or DEFAULT_FPS)


def _run(window: Window, game: Game, keys: KeyMap | None, fps: float) -> None:
    with window, Interrupt() as stop:
        game.begin()
        for player in game.players:
            player.act(player.obs, frozenset(), 0)  # an agent compiles at its first action; not while somebody plays
        window.open(game, keys)
        pace = Pace(fps)
        while not game.closed:
            stop.check()
            turn(window, game)
            pace.wait()


def _check(seed: int | None, fps: float | None, episodes: int | None) -> tuple[int, int | None]:
    """Returns the seed, drawn if there is none, and the number of episodes.

    Raises:
        ValueError: for a bad number.
    """
    if fps is not None:
        number("fps", fps, above=0)
    if episodes is not None:
        whole("episodes", episodes, least=1)
    if seed is None:
        return int(np.random.default_rng().integers(10_000)), episodes
    return whole("seed", seed, least=0), episodes


def _policy(agent: Any) -> Act:
    memory: Any = None

    def act(obs: Any, held: Any, step: int) -> Any:
        nonlocal memory
        action, memory = agent.predict(obs, None if step == 0 else memory, deterministic=True)
        return action

    return act


def _name(agent: Any) -> str:
    return agent.name if isinstance(agent, Agent) else type(agent).__name__
