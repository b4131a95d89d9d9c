"""``rejeu import``, ``push`` and ``pull``: models from and for others."""

from __future__ import annotations

from contextlib import closing, nullcontext
from typing import Any

from rejeu.cli import environment
from rejeu.cli.commands import Import, Pull, Push
from rejeu.cli.output import echo
from rejeu.reporting.formatting import counted
from rejeu.runs.config import quoted


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


def run_push(arguments: Push) -> tuple[int, dict[str, Any]]:
    """Uploads a model and prints its address."""
    from rejeu import hub

    address = hub.push(arguments.run, arguments.repo, arguments.private, echo)
    echo(address)
    return 0, {"address": address}


def run_pull(arguments: Pull) -> tuple[int, dict[str, Any]]:
    """Downloads a model and prints what to do with it."""
    from rejeu import hub

    folder = hub.pull(arguments.repo, arguments.out)
    models = sorted([*folder.glob("*.safetensors"), *folder.glob("*.zip")])
    scaler = "".join(f" --vecnormalize {quoted(path)}" for path in sorted(folder.glob("*.pkl"))[:1])
    for model in models:
        is_zip = model.suffix == ".zip"
        echo(f"rejeu import {quoted(model)}{scaler}" if is_zip else f"rejeu evaluate {quoted(model)}")
    return 0, {"folder": folder, "models": models}
