"""``rejeu watch``: a window in which a trained agent plays."""

from __future__ import annotations

from rejeu.agents import load
from rejeu.cli import jsonout
from rejeu.cli.commands import Watch
from rejeu.cli.environment import environment_of
from rejeu.cli.play import as_dict, scores
from rejeu.play import watch
from rejeu.runs.folder import find_model


def run(arguments: Watch) -> int:
    """Shows the agent, prints its scores, and returns the exit status."""
    model = find_model(arguments.run, arguments.which)
    environment = environment_of(model, arguments)
    with jsonout.messages(arguments.json) as output:
        game = watch(load(model), environment.make, seed=arguments.seed, fps=arguments.fps, episodes=arguments.episodes)
        print(scores(game), flush=True)
        if arguments.json:
            jsonout.emit(as_dict(game), output)
    return 0
