"""Virtual environments of the libraries that rejeu is compared with."""

from __future__ import annotations

import json
import subprocess
import sys
import venv
from pathlib import Path

TORCH = "torch==2.13.0"
"""Package that is installed first, from the index that pip is configured to use. Only its CPU build is needed."""
PEERS = {
    "sb3": [
        "stable-baselines3==2.9.2",
        "sb3-contrib==2.9.0",
        "highway-env==1.12.1",
        "envpool==1.2.5",
        "gymnasium[box2d]",
    ],
    "sbx": ["sbx-rl==0.28.0", "jax==0.10.2", "stable-baselines3==2.9.2", "gymnasium[box2d]"],
}
NEEDED = {
    "rejeu": ("rejeu", "highway_env", "envpool", "Box2D"),
    "sb3": ("stable_baselines3", "sb3_contrib", "highway_env", "Box2D"),
    "sbx": ("sbx", "stable_baselines3", "Box2D"),
}
"""Modules that the measurements of a library require."""
FIND = "import importlib.util, sys; print(*[n for n in sys.argv[1:] if importlib.util.find_spec(n) is None])"


def python_of(folder: Path) -> Path:
    """Returns the path of the Python interpreter of a virtual environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def make(peer: str, root: Path) -> str:
    """Returns the interpreter of a library's virtual environment in ``root``, which is created if missing.

    Raises:
        SystemExit: if a package cannot be installed. The next call then creates the environment again.
    """
    folder, wanted = root / peer, [TORCH, *PEERS[peer]]
    python, mark = python_of(folder), folder / "installed.json"
    if mark.exists() and json.loads(mark.read_text(encoding="utf-8")) == wanted:
        return str(python)
    print(f"making an environment for {peer} in {folder}: {', '.join(wanted)}", flush=True)
    mark.unlink(missing_ok=True)
    venv.create(folder, with_pip=True, clear=True)
    for packages in ([TORCH], PEERS[peer]):
        done = subprocess.run([str(python), "-m", "pip", "install", "--quiet", *packages], check=False)
        if done.returncode:
            raise SystemExit(f"pip could not install {', '.join(packages)} into {folder}")
    mark.write_text(json.dumps(wanted), encoding="utf-8")
    return str(python)


def missing(python: str, library: str) -> list[str]:
    """Returns the modules required by a library's measurements that an interpreter lacks.

    Raises:
        SystemExit: if the interpreter cannot be run.
    """
    try:
        done = subprocess.run([python, "-c", FIND, *NEEDED[library]], capture_output=True, text=True, check=False)
    except OSError as error:
        raise SystemExit(f"the interpreter for {library} cannot be run: {error}") from None
    if done.returncode:
        raise SystemExit(f"the interpreter for {library} cannot be run: {done.stderr.strip()[-500:]}")
    return done.stdout.split()
