"""Games that threads play for pages: who plays what, from where on."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from rejeu.agents import load
from rejeu.checkpoints.run_folder import dated, find_model
from rejeu.core.errors import one_line
from rejeu.core.language import said
from rejeu.core.types import JsonObject
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.environment import Environment, environment_of, from_run
from rejeu.lab.studio.speech import speaking
from rejeu.lab.studio.state import Studio
from rejeu.teaching.play import Opened, opened
from rejeu.teaching.play.game import Event, Game, Player
from rejeu.teaching.play.keys import full_name
from rejeu.teaching.play.window import message, number, score_summary

SLOW = 20.0
"""Steps a second below which a key that is pressed acts at once, rather than at the next step."""


def asked_game(
    studio: Studio, env: str, names: Sequence[str], by_hand: bool, seed: int | None, is_recorded: bool
) -> AbstractContextManager[Opened]:
    """Returns the context of a game that somebody asks for.

    Args:
        studio: that has the agents.
        env: id of the environment; empty for that of the first agent.
        names: of models: paths below the folder of the studio, or those that the command line named.
        by_hand: whether a person plays.
        seed: of the first round; None draws one.
        is_recorded: whether the episodes of the person are written below the folder of the studio.

    Raises:
        ValueError: if the environment or an agent cannot be used, or nobody plays.
        OSError: if there is no such model.
    """
    if not env and not names:
        raise ValueError(said("choose an environment"))
    if not names and not by_hand:
        raise ValueError("nobody plays; choose an agent, or play yourself")
    players = {name: find_agent(studio, name) for name in names}
    environment = next((played for _, played in players.values()), None)
    if environment is None:
        environment = from_run(RunConfig(env=full_name(env)), "the address", studio.typed(env))
    env_id = env or environment.env_id
    for name, (_, played) in players.items():
        if played.env_id != env_id:
            raise ValueError(f"{name} plays {played.env_id}, not {env_id}")
    agents = {name: load(model, device="cpu") for name, (model, _) in players.items()}
    folder = studio.below(f"played/{dated(environment.env_id).name}") if is_recorded and by_hand else None
    return opened(environment.make, agents, by_hand, seed=seed, record=folder, has_video=False)


def find_agent(studio: Studio, name: str) -> tuple[Path, Environment]:
    """Returns the model of a name, and its environment.

    Raises:
        ValueError: if the name leads out of the folder, or the environment must be named on the command line.
        FileNotFoundError: if there is no such model.
    """
    if name in studio.guests:
        return studio.guests[name]
    model = find_model(studio.below(name))
    return model, environment_of(model, studio.given(name))


class HostedGame:
    """A game that a thread plays until it is closed. Mutable.

    Args:
        start: returns the context of the game; it is entered in the thread, to which drivers that render may be bound.
        show: called with the pictures, the captions, and how many keys had been pressed before.
    """

    def __init__(self, start: Callable[[], AbstractContextManager[Opened]], show: Callable[..., object]) -> None:
        self.opened: Opened | None = None
        """None until it has begun."""
        self.said = ""
        """Message at the end: an error, or the recording."""
        self.ended = False
        self._start, self._show = start, show
        self._events: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._presses = 0
        threading.Thread(target=speaking(self._run), daemon=True).start()

    def handle(self, event: Event) -> None:
        """Passes an event to the game."""
        self._events.put(event)

    def handle_all(self, event_type: str, keys: Sequence[str]) -> None:
        """Passes events of the same kind of several keys."""
        for key in keys:
            self.handle(Event(event_type, key))

    def _run(self) -> None:
        try:
            with self._start() as opened:
                opened.begin()
                self.opened = opened
                self._play(opened)
                recording = opened.game.players[0].recording
            self.said = "" if recording is None else str(recording)
        except Exception as error:  # the environment can raise anything
            self.said = one_line(error)
        finally:
            self.ended = True

    def _play(self, opened: Opened) -> None:
        game, drawn, due = opened.game, None, time.perf_counter()
        while not game.closed:
            self._take_events(game, due, at_once=opened.fps < SLOW)
            game.tick()
            progress = [(player.steps, len(player.scores)) for player in game.players]
            now = self._presses, game.seed, game.phase, game.paused, progress
            if now != drawn:
                drawn = now
                pictures = [player.frame for player in game.players]
                self._show(pictures, [caption(game, player) for player in game.players], self._presses)
            at = time.perf_counter()
            due = max(min(due, at) + 1 / opened.fps, at)  # a step that took too long is not caught up

    def _take_events(self, game: Game, due: float, at_once: bool) -> None:
        """Handles events until the next step is due, or until a key is pressed that acts at once."""
        is_due = False
        while not is_due:
            try:
                timeout = due - time.perf_counter()
                event = self._events.get(timeout=timeout) if timeout > 0 else self._events.get_nowait()
            except queue.Empty:
                return
            game.handle(event)
            self._presses += event.type == "press"
            is_due = game.closed or (at_once and event.type == "press")


def caption(game: Game, player: Player) -> JsonObject:
    """Returns the texts of a player's picture."""
    return {
        "name": said(player.name),
        "score": said("score {}", number(player.score)) + " · " + said("step {}", player.steps),
        "about": score_summary(player, by_hand=bool(game.bound)),
        "message": message(game, player),
        "won": player.success == 1.0,
    }
