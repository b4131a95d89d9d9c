"""``rejeu watch``: a trained agent at play, in a window."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rejeu.cli import run_folder
from rejeu.cli.environment import RunOptions
from rejeu.cli.run_folder import Which


@dataclass(frozen=True)
class Watch(RunOptions):
    """Opens a window in which a trained agent plays, in the environment's own package.

    r begins the episode anew, p pauses, q quits.
    """

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a run, or a .safetensors file."""
    episodes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Close after so many; by default when you do."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Of the first episode; each further one has the next seed. One is drawn if none is given."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""
    fps: Annotated[float | None, arg(metavar="N", help_behavior_hint="")] = None
    """Steps a second; by default the environment's own."""


def run(arguments: Watch) -> int:
    """Shows the agent, prints its scores, and returns the exit status."""
    from rejeu import load
    from rejeu.cli.play import scores
    from rejeu.play import watch

    model = run_folder.find_model(arguments.run, arguments.which)
    environment = run_folder.environment_of(model, arguments)
    game = watch(load(model), environment.make, seed=arguments.seed, fps=arguments.fps, episodes=arguments.episodes)
    print(scores(game), flush=True)
    return 0
