"""``rejeu play``: an environment played by hand, alone or next to a trained agent."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Any

from rejeu.agents import load
from rejeu.cli import environment, jsonout
from rejeu.cli.commands import Play
from rejeu.play import Game, play
from rejeu.play.known import full_name
from rejeu.reporting.formatting import counted
from rejeu.runs.folder import find_model
from rejeu.runs.values import value


def run(arguments: Play) -> int:
    """Plays, prints the scores, and returns the exit status."""
    made = environment.from_arguments(full_name(arguments.env), arguments)
    agent = None
    if arguments.against is not None:
        model = find_model(arguments.against, arguments.which)
        trained_on = environment.recorded_id(model)
        if trained_on != made.env_id:
            raise ValueError(f"--against {arguments.against}: that agent plays {trained_on}, not {made.env_id}")
        agent = load(model)
    with jsonout.messages(arguments.json) as output:
        game = play(
            made.make,
            keys=parse_keys(chain.from_iterable(arguments.keys)),
            seed=arguments.seed,
            fps=arguments.fps,
            episodes=arguments.episodes,
            record=arguments.record,
            against=agent,
        )
        print(scores(game), flush=True)
        recording = game.players[0].recording
        if recording is not None:
            print(recording, flush=True)
        if arguments.json:
            jsonout.emit(as_dict(game), output)
    return 0


def parse_keys(assignments: Iterable[str]) -> dict[str, Any]:
    """Returns the action of each combination of keys.

    Raises:
        ValueError: for an assignment without ``=``.

    >>> parse_keys(["a=0", "a+w=[1,-0.5]", "none=wait"])
    {'a': 0, 'a+w': [1, -0.5], 'none': 'wait'}
    """
    result = {}
    for assignment in assignments:
        keys, equals, text = assignment.rpartition("=")
        if not equals or not keys:
            raise ValueError(f"--keys {assignment!r} must be keys=action, such as a=0 or a+w=[1,-1]")
        result[keys.strip()] = value(text)
    return result


def as_dict(game: Game) -> dict[str, Any]:
    """Returns the players with their scores."""
    return {
        "players": [
            {"name": one.name, "episodes": len(one.scores), "mean": one.mean, "best": one.best, "scores": one.scores}
            for one in game.players
        ]
    }


def scores(game: Game) -> str:
    """Returns a line for each player: number of complete episodes, mean and best score."""
    lines = []
    for player in game.players:
        n = len(player.scores)
        episodes = counted(n, "episode")
        lines.append(f"{player.name}: {episodes}" + (f", mean {player.mean:.2f}, best {player.best:.2f}" if n else ""))
    return "\n".join(lines)
