"""``rejeu evaluate``: how good a trained agent is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from rejeu.cli import run_folder
from rejeu.cli.environment import RunOptions
from rejeu.cli.run_folder import Which


@dataclass(frozen=True)
class Evaluate(RunOptions):
    """Plays whole episodes with a trained agent's deterministic policy and prints what they came to."""

    run: Annotated[Positional[Path], arg(metavar="RUN")]
    """Folder of a run, or a .safetensors file."""
    episodes: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """How many; 100, or with --minutes as many as there is time for."""
    minutes: Annotated[float | None, arg(metavar="X", help_behavior_hint="")] = None
    """Wall time after which no further episode begins; those under way are played to their end."""
    backend: Annotated[str, arg(metavar="NAME")] = "auto"
    """auto, envpool, gymnasium or gymnasium-async; gymnasium is the environment's own package."""
    seed: Annotated[int | None, arg(metavar="N", help_behavior_hint="")] = None
    """Of the environments; one is drawn if none is given."""
    success_threshold: Annotated[float | None, arg(metavar="RETURN", help_behavior_hint="")] = None
    """Return from which on an episode counts as a success; by default as in training."""
    which: Which = "best"
    """Of a folder: the model that evaluated best in training, or the last."""


def run(arguments: Evaluate) -> int:
    """Evaluates, prints one line, and returns the exit status."""
    from rejeu import load
    from rejeu.validation import number, whole

    episodes, minutes = arguments.episodes, arguments.minutes
    if minutes is not None:
        number("--minutes", minutes, above=0)
    if episodes is not None or minutes is None:
        episodes = whole("--episodes", 100 if episodes is None else episodes, least=1)
    model = run_folder.find_model(arguments.run, arguments.which)
    environment = run_folder.environment_of(model, arguments)
    agent = load(model)
    env = environment.vector(16 if episodes is None else min(episodes, 16), arguments.backend, arguments.seed)
    try:
        print(f"{environment} on {env.backend}, {model}", flush=True)
        threshold = arguments.success_threshold
        print(agent.evaluate(episodes, env=env, success_threshold=threshold, minutes=minutes), flush=True)
    finally:
        env.close()
    return 0
