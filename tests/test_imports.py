"""What importing the package costs and gives."""

import json
import subprocess
import sys

import pytest

import rejeu


def fresh(program: str) -> str:
    """Returns what a program prints in a new interpreter."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    return done.stdout


def test_importing_rejeu_registers_its_environments_and_imports_no_jax_and_its_agents_import_no_algorithm():
    program = """
import json, sys
import rejeu
import gymnasium
print(json.dumps({"loaded": sorted(sys.modules), "ids": [i for i in gymnasium.registry if i.startswith("rejeu/")]}))
print(rejeu.callbacks.Evaluate.__name__)
print(rejeu.AGENTS["DQN"].__name__, "rejeu.algorithms.dqn" in sys.modules, rejeu.DQN.algorithm.__name__)
"""
    text, submodule, algorithm = fresh(program).splitlines()
    found = json.loads(text)
    assert submodule == "Evaluate"  # imported on access
    assert algorithm == "DQN False rejeu.algorithms.dqn"
    assert found["ids"] == ["rejeu/Ball-v0", "rejeu/CartPoleNoVelocity-v0", "rejeu/ParkingHard-v0"]
    loaded = set(found["loaded"])
    assert not loaded & {"jax", "equinox", "optax", "scipy", "rich", "envpool", "rejeu.agents"}


@pytest.mark.exhaustive
def test_training_in_gymnasium_imports_neither_envpool_nor_scipys_statistics(tmp_path):
    arguments = "train CartPole-v1 --steps 16 --backend gymnasium --algo dqn --evaluate-episodes 1"
    program = f"""
import sys
from rejeu.lab.cli import main
main({[*arguments.split(), "--out", str(tmp_path / "run")]!r})
print({{"envpool", "scipy.special", "scipy.stats"}} & {{*sys.modules}} or "none")
"""
    assert fresh(program).splitlines()[-1] == "none"


def test_every_public_name_can_be_imported():
    assert [name for name in [*rejeu.__all__, "SACC"] if not hasattr(rejeu, name)] == ["SACC"]
    assert rejeu.make_vec is rejeu.make_vector
    assert {*rejeu.__all__} <= {*dir(rejeu)}


def test_help_imports_no_jax():
    program = """
import sys
from rejeu.lab.cli import main
for words in (["--help"], ["train", "--help"]):
    try:
        main(words)
    except SystemExit:
        pass
print("loaded", sorted({"jax", "equinox", "rejeu.agents"} & set(sys.modules)))
"""
    assert fresh(program).endswith("loaded []\n")


def test_a_training_prints_its_command_before_jax_is_imported(tmp_path):
    program = f"""
import os, sys
from rejeu.lab.cli import main

class FirstWords:
    def write(self, text):
        loaded = sorted({{"equinox", "jax", "matplotlib", "rejeu.agents"}} & {{*sys.modules}})
        os.write(1, f"{{text}} {{loaded}}".encode())
        os._exit(0)

sys.stdout = FirstWords()
main(["train", "CartPole-v1", "--out", {str(tmp_path / "my run")!r}])
"""
    command, _, folder = fresh(program).partition(" --out ")
    assert command == "command       rejeu train CartPole-v1"
    assert folder.endswith("my run' []") or folder.endswith('my run" []')  # in quotes, by the shell of the system
