"""``rejeu record``: a video of a trained agent."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rejeu.cli import run_folder
from rejeu.cli.environment import RunOptions
from rejeu.cli.run_folder import RunFolder, Which


@dataclass(frozen=True)
class Record(RunOptions):
    """Films a few episodes of a trained agent in the environment's own package."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a run, or a .safetensors file."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Where to write; by default video.mp4 in the folder, or beside the file under its name."""
    episodes: Annotated[int, arg(metavar="N")] = 3
    """How many."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Of the environment; one is drawn if none is given."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""


def run(arguments: Record) -> int:
    """Films, prints where, and returns the exit status."""
    from rejeu import load
    from rejeu.reporting.text import counted
    from rejeu.reporting.video import record_video
    from rejeu.validation import whole

    episodes = whole("--episodes", arguments.episodes, least=1)
    model = run_folder.find_model(arguments.run, arguments.which)
    beside = RunFolder(arguments.run).video if arguments.run.is_dir() else model.with_suffix(".mp4")
    out = beside if arguments.out is None else arguments.out
    environment = run_folder.environment_of(model, arguments)
    path = record_video(load(model), out, env=environment.drawing, episodes=episodes, seed=arguments.seed)
    print(f"{path}: {counted(episodes, 'episode')} of {model} in {environment}", flush=True)
    return 0
