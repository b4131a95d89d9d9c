"""``rejeu evaluate``: how good a trained agent is."""

from __future__ import annotations

from contextlib import closing

from rejeu import devices
from rejeu.agents import load
from rejeu.cli import jsonout
from rejeu.cli.commands import Evaluate
from rejeu.cli.environment import environment_of
from rejeu.runs.folder import find_model


def run(arguments: Evaluate) -> int:
    """Evaluates, prints the result, and returns the exit status."""
    devices.start_with("--device", arguments.device)
    episodes, minutes = arguments.episodes, arguments.minutes
    if minutes is None and episodes is None:
        episodes = 100
    model = find_model(arguments.run, arguments.which)
    environment = environment_of(model, arguments)
    agent = load(model, device=arguments.device)
    n_envs = 16 if episodes is None else min(episodes, 16)
    with (
        jsonout.messages(arguments.json) as output,
        closing(environment.vector(n_envs, arguments.backend, arguments.seed)) as env,
    ):
        print(f"{environment} on {env.backend}, {model}", flush=True)
        threshold = arguments.success_threshold
        result = agent.evaluate(episodes, env=env, success_threshold=threshold, minutes=minutes)
        print(result, flush=True)
        if arguments.json:
            about = {"model": model, "env_id": environment.env_id, "backend": env.backend}
            episodes_of = {"returns": result.returns, "lengths": result.lengths, "successes": result.successes}
            jsonout.emit({**about, **result.to_dict(), **episodes_of}, output)
    return 0
