"""Builds the source distribution and the wheel, and tests the wheel in a new virtual environment, without extras.

    python scripts/wheel.py [FOLDER]

Both are saved in ``FOLDER``, or deleted if none is given. The wheel is built from the source distribution. The exit
status is 0 if it contains only the package, installs, imports, runs its commands, and trains, also in the notebooks of
``examples``. Needs the package ``build``.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCRIPT = """
import rejeu
agent = rejeu.PPO("MlpPolicy", "CartPole-v1", n_steps=128, seed=0).learn(512)
print(agent.evaluate(episodes=2))
agent.save("cartpole")
agent.export("cartpole.npz")
assert rejeu.load("cartpole").num_timesteps == 512
"""


def run(*command: str | Path, cwd: Path = ROOT) -> str:
    """Runs a command without environment variables that point Python to the sources; returns its output."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    done = subprocess.run(
        command, cwd=cwd, env=environment, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, check=True
    )
    return done.stdout.strip()


def build(folder: Path) -> Path:
    """Builds the source distribution, and from it the wheel, in ``folder``; returns the path of the wheel."""
    run(sys.executable, "-m", "build", "-o", folder, ROOT)
    (wheel,) = folder.glob("rejeu-*.whl")
    return wheel


def check_contents(wheel: Path) -> None:
    """Exits unless the wheel contains the package with its type marker, and nothing else."""
    names = zipfile.ZipFile(wheel).namelist()
    strangers = [name for name in names if not name.startswith(("rejeu/", "rejeu-"))]
    if strangers or "rejeu/py.typed" not in names:
        sys.exit(f"{wheel.name} holds {strangers[:5]}" if strangers else f"{wheel.name} has no rejeu/py.typed")


def try_out(wheel: Path, folder: Path) -> None:
    """Installs the wheel in a virtual environment under ``folder`` and uses it there."""
    venv.create(folder / "venv", with_pip=True)
    programs = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
    python = programs / "python"
    run(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel)
    version = run(python, "-c", "import rejeu; print(rejeu.__version__)", cwd=folder)
    if f"rejeu-{version}-" not in wheel.name:
        sys.exit(f"{wheel.name} says that its version is {version}")
    run(programs / "rejeu", "--help", cwd=folder)
    print(run(python, "-c", SCRIPT, cwd=folder))


NOTEBOOKS = """
import pathlib, re, sys
import nbclient, nbformat
for path in sorted(pathlib.Path(sys.argv[1]).glob("*.ipynb")):
    notebook = nbformat.read(path, 4)
    for cell in notebook.cells:  # the first one installs rejeu
        cell.source = re.sub(r"^%pip .*", "", re.sub(r"\\b(\\d+)_000\\b", "1_024", cell.source))
    nbclient.NotebookClient(notebook, timeout=600).execute()
    print(path.name)
"""


def try_notebooks(wheel: Path, folder: Path) -> None:
    """Executes the notebooks of ``examples`` with the wheel and the extra that their first cell names, in fewer steps."""
    python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    extra = "rejeu[plot] @ " + wheel.as_uri()
    run(python, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", extra, "ipykernel", "nbclient")
    print(run(python, "-c", NOTEBOOKS, ROOT / "examples" / "notebooks", cwd=folder))


def try_without_jax(wheel: Path, folder: Path) -> None:
    """Does what docs/deployment.md says under "Python without JAX", with a policy that the full installation exported."""
    venv.create(folder / "light", with_pip=True)
    python = folder / "light" / ("Scripts" if os.name == "nt" else "bin") / "python"
    run(python, "-m", "pip", "install", "-q", "--no-deps", wheel)
    run(
        python,
        "-m",
        "pip",
        "install",
        "-q",
        "-c",
        ROOT / "constraints.txt",
        "gymnasium",
        "msgspec",
        "numpy",
        "safetensors",
    )
    use = "import rejeu; policy = rejeu.load_policy('cartpole.npz'); print(policy.predict(policy.observation_space.sample()))"
    print(run(python, "-c", use, cwd=folder))


def main() -> None:
    """Builds, checks and tests the wheel."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        wheels = Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else folder / "dist"
        wheel = build(wheels)
        check_contents(wheel)
        try_out(wheel, folder)
        try_notebooks(wheel, folder)
        try_without_jax(wheel, folder)
    print(f"{wheel.name} installs and runs")


if __name__ == "__main__":
    main()
