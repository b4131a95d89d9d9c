"""``rejeu import``: models of Stable-Baselines3."""

from __future__ import annotations

from contextlib import closing, nullcontext
from typing import Any

from rejeu.cli import environment
from rejeu.cli.commands import Import
from rejeu.cli.output import echo
from rejeu.reporting.formatting import counted


def run_import(arguments: Import) -> tuple[int, dict[str, Any]]:
    """Converts a model of Stable-Baselines3 and prints what was taken over."""
    from rejeu.sb3.zip_files import load_zip

    out = arguments.model.with_suffix(".safetensors") if arguments.out is None else arguments.out
    if out.exists():
        raise FileExistsError(f"{out} exists; name another file with --out")
    made = (
        None if arguments.env is None else environment.from_arguments(arguments.env, arguments).vector(1, "auto", None)
    )
    with nullcontext() if made is None else closing(made):
        agent = load_zip(arguments.model, made, arguments.vecnormalize, **arguments.hyperparameters)
        path = agent.save(out)
    echo(f"{path}: {agent.name}, {counted(agent.num_timesteps, 'step')}, {counted(agent.n_updates, 'update')}")
    for note in agent.notes:  # type: ignore[attr-defined]
        echo(f"note: {note}")
    return 0, {"model": path, "algorithm": agent.name, "notes": agent.notes}  # type: ignore[attr-defined]
