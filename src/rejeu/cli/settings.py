"""Options that exclude each other, in all commands."""

from __future__ import annotations

from typing import Any


def check_values(arguments: Any) -> None:
    """Raises ``ValueError`` if options exclude each other."""
    given = {key: value for key, value in vars(arguments).items() if value is not None}
    if {"steps", "minutes"} <= given.keys():
        raise ValueError("--steps and --minutes exclude each other; give one of them")
    if {"pause", "seeds"} <= given.keys():
        raise ValueError("--pause is for a single run; leave it out, or --seeds")
    if "jobs" in given and "seeds" not in given:
        raise ValueError("--jobs is for several seeds; give --seeds N too")
    if "backend" in vars(arguments) and given.get("backend") != "ray" and {"ray", "env_cpus"} & given.keys():
        raise ValueError("--ray and --env-cpus are for --backend ray; give it too, or leave them out")
