"""``rejeu list``: the algorithms and presets."""

from __future__ import annotations

from collections.abc import Mapping

from rejeu.agents import presets
from rejeu.agents.presets import Preset
from rejeu.algorithms.catalog import CATALOG
from rejeu.core.types import JsonObject
from rejeu.lab.cli.commands import List
from rejeu.logs.formatting import aligned


def run_list(arguments: List) -> tuple[int, JsonObject]:
    """Prints the lists."""
    algorithms = described(is_extended=bool(arguments.imports))
    if not arguments.json:
        show(algorithms)
    return 0, {"algorithms": algorithms, "presets": [as_dict(preset) for preset in presets.every()]}


def show(algorithms: Mapping[str, str]) -> None:
    """Prints the algorithms, and the presets by environment."""
    print("algorithms")
    print(aligned(("", *entry) for entry in algorithms.items()))
    print("\nenvironments with tuned hyperparameters, the preset of rejeu train first; in brackets, names for --preset")
    rows: dict[str, list[tuple[str, ...]]] = {}
    for preset in presets.every():
        steps = f"{preset.total_steps:,} steps"
        result = presets.find_result(preset.env_id, preset.algorithm, preset.name)
        shown = preset.source if result is None else str(result)
        if result is not None and result.budget.endswith(" steps") and result.budget != steps:
            shown += f", after {result.budget}"
        of_env = rows.setdefault(preset.env_id, [])
        algorithm = f"{preset.algorithm} ({preset.name})" if preset.name else preset.algorithm
        of_env.append(("", "" if of_env else preset.env_id, algorithm, steps, shown))
    print(aligned(row for of_env in rows.values() for row in of_env))
    print("\nIn brackets: 95 % confidence interval of a mean return, lowest and highest success rate of a seed.")
    print("Any other Gymnasium or EnvPool id is trained without a preset.")


def described(is_extended: bool) -> dict[str, str]:
    """Returns the first lines of the docstrings of all agents by name.

    Args:
        is_extended: whether imported modules may have registered others; else nothing is imported, which would take seconds.
    """
    if is_extended:
        from rejeu.agents import AGENTS

        return {name: (agent.__doc__ or "").partition("\n")[0] for name, agent in AGENTS.items()}
    return {name: entry.summary for name, entry in CATALOG.items()}


def as_dict(preset: Preset) -> JsonObject:
    """Returns a preset with its measured result, which is None if there is none."""
    fields = {name: value for name, value in vars(preset).items() if name not in ("backend", "success_threshold")}
    return {**fields, "result": presets.find_result(preset.env_id, preset.algorithm, preset.name)}
