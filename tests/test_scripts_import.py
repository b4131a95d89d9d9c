"""Scripts outside of the package still import: trials and benchmarks, which the suite does not run."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
NOT_REQUIRED = ("psutil", "sb3_contrib", "sbx", "stable_baselines3", "torch")
"""Packages that some of them need, and the tests do not."""
CODE = f"""
import importlib, pathlib, sys
sys.path.insert(0, "trials")
names = [path.stem for path in sorted(pathlib.Path("trials").glob("*.py"))]
names += [".".join(path.with_suffix("").parts) for path in sorted(pathlib.Path("benchmarks").rglob("*.py"))]
for name in names:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name.split(".")[0] not in {NOT_REQUIRED}:
            print(name, error)
    except Exception as error:
        print(name, repr(error))
print(len(names))
"""


def test_trials_and_benchmarks_import():
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])}
    done = subprocess.run([sys.executable, "-c", CODE], cwd=ROOT, env=environment, capture_output=True, text=True)
    *failed, count = done.stdout.splitlines()
    assert not failed
    assert int(count) > 20, done.stderr
