"""``rejeu play``: an environment played by hand, alone or beside a trained agent."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from rejeu.cli import run_folder, settings
from rejeu.cli.environment import EnvironmentOptions, named
from rejeu.cli.run_folder import Which
from rejeu.reporting.text import counted

if TYPE_CHECKING:
    from rejeu.play import Game


@dataclass(frozen=True)
class Play(EnvironmentOptions):
    """Opens a window in which you play an environment with a, s, d, w or the arrows.

    Any keys may be held together. The window says what each does; r begins anew, p pauses, q quits.
    """

    env: Annotated[Positional[str], arg(metavar="ENV")]
    """Id of an environment with Discrete or Box actions, as for rejeu train; or Car, Mountain or Lunar."""
    keys: Annotated[tuple[tuple[str, ...], ...], UseAppendAction, arg(metavar="KEYS=ACTION ...")] = ()
    """Other keys: a=0 d=2 none=1 for Discrete actions, w=[1,0] a+w=[1,-1] for Box actions; none is nothing held."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Of the first start; each further one has the next seed. One is drawn if none is given."""
    fps: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """Steps a second; by default the environment's own."""
    episodes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Close after so many; by default when you do."""
    record: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")] = None
    """New or empty folder for a Minari dataset and a video of what you play."""
    against: Annotated[Path | None, arg(metavar="RUN", help_behavior_hint="")] = None
    """Folder of a run, or a .safetensors file, whose agent plays the same starts beside you."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""


def run(arguments: Play) -> int:
    """Plays, prints the scores, and returns the exit status."""
    from rejeu import load
    from rejeu.play import play
    from rejeu.play.known import full_name

    environment = named(full_name(arguments.env), arguments)
    env_id, agent = environment.env_id, None
    if arguments.against is not None:
        model = run_folder.find_model(arguments.against, arguments.which)
        trained_on = run_folder.recorded_id(model)
        if trained_on != env_id:
            raise ValueError(f"--against {arguments.against}: that agent plays {trained_on}, not {env_id}")
        agent = load(model)
    game = play(
        environment.make,
        keys=assigned(chain.from_iterable(arguments.keys)),
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
    return 0


def assigned(assignments: Iterable[str]) -> dict[str, Any]:
    """Returns actions by keys.

    Raises:
        ValueError: for an assignment without ``=``.

    >>> assigned(["a=0", "a+w=[1,-0.5]", "none=wait"])
    {'a': 0, 'a+w': [1, -0.5], 'none': 'wait'}
    """
    result = {}
    for assignment in assignments:
        keys, equals, text = assignment.rpartition("=")
        if not equals or not keys:
            raise ValueError(f"--keys {assignment!r} must be keys=action, such as a=0 or a+w=[1,-1]")
        result[keys.strip()] = settings.value(text)
    return result


def scores(game: Game) -> str:
    """Returns a line for each player: episodes played to their end, their mean score and the best."""
    lines = []
    for player in game.players:
        n = len(player.scores)
        told = counted(n, "episode")
        lines.append(f"{player.name}: {told}" + (f", mean {player.mean:.2f}, best {player.best:.2f}" if n else ""))
    return "\n".join(lines)
