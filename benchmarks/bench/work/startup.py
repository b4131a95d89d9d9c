"""Measures complete processes: an import, training until the first update, and the help of the command line."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.bench.work import common

MODULES = {"rejeu": "rejeu", "sb3": "stable_baselines3", "sbx": "sbx"}
FIRST_UPDATE = """
import {module} as library
agent = library.SAC("MlpPolicy", "Pendulum-v1", learning_starts=100, batch_size=64, seed=0{device})
agent.learn(102)
assert agent.{count}
agent.predict(agent.{space}.sample())
"""


def measure(library: str) -> dict[str, Any]:
    """Times each process. Those that compile run twice: with an empty compilation cache, and with the filled one."""
    module = MODULES[library]
    first_update = FIRST_UPDATE.format(
        module=module,
        device=', device="cpu"' if library == "sb3" else "",
        count="n_updates" if library == "rejeu" else "_n_updates",
        space="observation_space",
    )
    result = {"python": run("pass"), "import": run(f"import {module}")}
    with tempfile.TemporaryDirectory() as folder:
        cache_settings = {
            "JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "jax"),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        result["first update, cold"] = run(first_update, **cache_settings)
        result["first update, warm"] = run(first_update, **cache_settings)
    if library == "rejeu":
        result["command line, --help"] = run(
            "import sys; sys.argv = ['rejeu', '--help']; from rejeu.lab.cli import main; main"
        )
    return {"seconds": result}


def run(code: str, **environment: str) -> float:
    """Returns the duration of ``python -c code`` in seconds.

    Raises:
        RuntimeError: if the process fails; the message contains its output.
    """
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ, **environment}, check=False
    )
    seconds = time.perf_counter() - began
    if done.returncode:
        raise RuntimeError(f"python -c {code!r} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    return seconds


if __name__ == "__main__":
    common.main(measure)
