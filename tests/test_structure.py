"""``scripts/structure.py`` finds names of algorithms that are written where the catalog should be read."""

import ast
import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[1]


def structure():
    """Returns the script as a module."""
    spec = importlib.util.spec_from_file_location("structure", ROOT / "scripts" / "structure.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_name_of_an_algorithm_stands_in_its_room_alone():
    tree = ast.parse('"""SAC and TD3."""\nname = "SAC"\nother = f"{name} SAC", "sac"\nnames = ("TQC", "HER")\n')
    rooms = ("algorithms.sac", "agents.zip_files", "sb3.algorithms", "agents.agent", "lab.cli", "algorithms_too")
    found = structure().algorithm_names(ROOT / "src", {f"rejeu.{room}": (ROOT, tree) for room in rooms})
    assert found == [
        f"rejeu.{room}:{place}"
        for room in ("agents.agent", "lab.cli", "algorithms_too")
        for place in ("2 SAC", "4 TQC")
    ]


def test_two_folders_that_import_each_other_are_named_once():
    arrows = [("checkpoints.resume", "agents.policy"), ("agents.agent", "checkpoints.resume"), ("agents.agent", "core")]
    imports = [(f"rejeu.{importer}", f"rejeu.{imported}", 1) for importer, imported in arrows]
    assert structure().both_ways([*imports, ("rejeu.agents.agent", "rejeu", 1)]) == ["agents and checkpoints"]
