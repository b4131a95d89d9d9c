"""``rejeu evaluate``: how good a trained agent is."""

from __future__ import annotations

from contextlib import closing

from rejeu.agents import load
from rejeu.cli import run_folder
from rejeu.cli.commands import Evaluate


def run(arguments: Evaluate) -> int:
    """Evaluates, prints one line, and returns the exit status."""
    episodes, minutes = arguments.episodes, arguments.minutes
    if minutes is None and episodes is None:
        episodes = 100
    model = run_folder.find_model(arguments.run, arguments.which)
    environment = run_folder.environment_of(model, arguments)
    agent = load(model)
    n_envs = 16 if episodes is None else min(episodes, 16)
    with closing(environment.vector(n_envs, arguments.backend, arguments.seed)) as env:
        print(f"{environment} on {env.backend}, {model}", flush=True)
        threshold = arguments.success_threshold
        print(agent.evaluate(episodes, env=env, success_threshold=threshold, minutes=minutes), flush=True)
    return 0
