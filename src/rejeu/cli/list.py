"""``rejeu list``: what there is to train."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class List:
    """Lists the algorithms and the environments with tuned hyper-parameters."""


def run(arguments: List) -> int:
    """Prints the lists and returns the exit status."""
    from rejeu import AGENTS, presets

    print("algorithms")
    for name, agent in AGENTS.items():
        print(f"  {name:<22}{(agent.__doc__ or '').partition(chr(10))[0]}")
    print("\npresets (any other Gymnasium or EnvPool id is trained with the algorithm's defaults)")
    for preset in presets.ALL:
        steps = f"{preset.total_steps:>10,} steps"
        print(f"  {preset.env_id:<22}{preset.algorithm:<6}{steps}  {preset.result or preset.source}")
    return 0
