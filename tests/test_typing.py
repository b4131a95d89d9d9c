"""A script that uses the package type-checks: the package has ``py.typed``, and its lazy names are visible."""

import ast
import subprocess
import sys
import tempfile
from importlib import resources
from pathlib import Path

from rejeu.agents import named
from rejeu.algorithms.catalog import CATALOG
from tests.tiers import exhaustive

STUB = Path(named.__file__).with_suffix(".pyi")

SCRIPT = """
import gymnasium as gym
import numpy as np

import rejeu
from rejeu.callbacks import Checkpoint, Evaluate
from rejeu.algorithms.search import LogUniform

env: gym.Env = gym.make("Pendulum-v1")
agent = rejeu.SAC("MlpPolicy", env, learning_rate=1e-3, seed=0)
agent = agent.learn(1_000, [Checkpoint("checkpoints", minutes=5)])
reveal_type(agent)
action, state = agent.predict(np.zeros(3, np.float32))
reveal_type(action)
loaded: rejeu.SAC = rejeu.SAC.load("model")
rejeu.register(rejeu.SAC)
vector = rejeu.make_vec("Pendulum-v1", 2)
batch = rejeu.Transition(0, 0, 0.0, 0, 1.0)
print(batch.reward, vector.n_envs)
agents = rejeu.train_seeds(rejeu.PQN, "MlpPolicy", "jax/CartPole-v1", 1_000, seeds=2, device="cpu")
print(agents[0].q_values(np.zeros(4)).shape)
sweep = rejeu.sweep({"environments": ["CartPole-v1"], "seeds": 2}, "runs/sweep", workers=2)
print(sweep.counts(), rejeu.compare(sweep.path).table(), rejeu.write_report(sweep.runs).name)
study = rejeu.tune("Pendulum-v1", "SAC", trials=2, search={"learning_rate": LogUniform(1e-4, 1e-2)})
noise = rejeu.OrnsteinUhlenbeckActionNoise([0.0], 0.2, repulsive=1e-4), rejeu.NormalActionNoise(mean=[0.0], sigma=0.1)
print(noise, study.best, None if study.preset is None else study.preset.hyperparameters)
rejeu.SACC
agent.lern(3)
"""


SETTINGS = """
[mypy]
strict = True
follow_imports = silent

[mypy-jax.*,equinox.*,optax.*,scipy.*,matplotlib.*,rich.*,envpool.*,msgspec.*,IPython.*]
follow_imports = skip
"""
"""The last two lines save most of the time: nothing in the script is of their types."""
CACHE = Path(tempfile.gettempdir()) / "rejeu-test-mypy"
"""What is known of the packages from earlier runs."""


@exhaustive  # mypy takes seconds, and half a minute at first
def test_a_script_type_checks_and_its_mistakes_are_found(tmp_path):
    assert resources.files("rejeu").joinpath("py.typed").is_file()
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    (tmp_path / "mypy.ini").write_text(SETTINGS)
    done = subprocess.run(
        [sys.executable, "-m", "mypy", "--cache-dir", str(CACHE), str(script)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    errors = [line for line in done.stdout.splitlines() if ": error:" in line]
    assert len(errors) == 2, done.stdout
    assert 'Module has no attribute "SACC"' in errors[0]
    assert '"SAC" has no attribute "lern"' in errors[1]
    assert 'Revealed type is "rejeu.agents.named.SAC"' in done.stdout


def test_the_stub_of_the_named_agents_is_the_catalog():
    classes = [one for one in ast.parse(STUB.read_text(encoding="utf-8")).body if isinstance(one, ast.ClassDef)]
    stated = {one.name: (one.bases[0].id, ast.get_docstring(one)) for one in classes}
    bases = {"replay": "OffPolicyAgent", "offline": "OffPolicyAgent", "rollout": "OnPolicyAgent"}
    assert stated == {name: (bases[entry.kind], entry.summary) for name, entry in CATALOG.items()}
