"""Courses as notebooks: exercises and solutions, in English and French, from one source each.

:mod:`rejeu.teaching.courses.notebooks` describes how to write one, :mod:`rejeu.teaching.courses.checks` how answers are
checked.
"""

from pathlib import Path

from rejeu.core.errors import MissingExtra
from rejeu.teaching.courses.checks import SESSION
from rejeu.teaching.courses.notebooks import (
    LANGUAGES,
    Language,
    Version,
    minutes,
    notebook,
    sources,
    steps,
    write,
)

__all__ = ["LANGUAGES", "Language", "Version", "by_hand", "minutes", "notebook", "sources", "steps", "write"]


def by_hand(
    env: str, episodes: int, seed: int | None = None, against: object = None, record: str | Path | None = None
) -> list[float]:
    """Opens a window to play an environment by hand, and returns your scores; without a display it prints that and returns.

    Args:
        env: an id, or Car, Mountain or Lunar.
        episodes: the window closes after this number of episodes.
        seed: seed of the first episode; each further one adds one.
        against: an agent that plays the same episodes next to you. Its scores are printed.
        record: new or empty folder for a Minari dataset and a video of what you play.
    """
    from rejeu.teaching.play import play

    try:
        game = play(env, episodes=episodes, seed=seed, against=against, record=record)
    except (MissingExtra, OSError) as error:
        print(SESSION.say("no_game" if isinstance(error, MissingExtra) else "no_window", what=error))
        return []
    for opponent in game.players[1:]:
        print(opponent.name, opponent.scores)
    return game.players[0].scores
