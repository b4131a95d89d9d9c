"""``rejeu record``: a video of a trained agent."""

from __future__ import annotations

from rejeu.agents import load
from rejeu.cli import jsonout
from rejeu.cli.commands import Record
from rejeu.cli.environment import environment_of
from rejeu.reporting.formatting import counted
from rejeu.reporting.video import record_video
from rejeu.runs.folder import RunFolder, find_model


def run(arguments: Record) -> int:
    """Records a video, prints its path, and returns the exit status."""
    model = find_model(arguments.run, arguments.which)
    default = RunFolder(arguments.run).video if arguments.run.is_dir() else model.with_suffix(".mp4")
    out = default if arguments.out is None else arguments.out
    environment = environment_of(model, arguments)
    with jsonout.messages(arguments.json) as output:
        path = record_video(
            load(model), out, env=environment.rendering, episodes=arguments.episodes, seed=arguments.seed
        )
        print(f"{path}: {counted(arguments.episodes, 'episode')} of {model} in {environment}", flush=True)
        if arguments.json:
            about = {"model": model, "env_id": environment.env_id}
            jsonout.emit({"video": path, "episodes": arguments.episodes, **about}, output)
    return 0
