"""No file is executed: ruff bans what could do so (see pyproject.toml), and a process that loads files is watched."""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rejeu
from tests.core.test_schemas import FILES

ROOT = Path(__file__).parents[2]
SOURCE = Path(rejeu.__file__).parent


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import os, torch.serialization",
        "from joblib import load",
        "def f():\n    import dill as d",
        "from builtins import eval as e",
        "eval(header['code'])",
        "exec(text)",
        "import importlib\nimportlib.import_module(header['module'])",
        "from gymnasium.vector.utils import CloudpickleWrapper",
    ],
)
def test_ruff_reports_what_could_run_a_file(source):
    command = [sys.executable, "-m", "ruff", "check", "--select", "TID251,S102,S307", "--stdin-filename"]
    result = subprocess.run(
        [*command, "src/rejeu/checkpoints/model_files.py", "-"], input=source, capture_output=True, text=True, cwd=ROOT
    )
    assert result.returncode == 1, result.stdout + result.stderr


def test_every_loader_compares_arrays_before_it_reads_them():
    """``checkpoint.read`` reads all arrays, and is for files that are known to be good."""
    assert not [path for path in SOURCE.rglob("*.py") if "checkpoint.read(" in path.read_text(encoding="utf-8")]


LOAD = """
import json, sys, tempfile
import rejeu, rejeu.sb3, jax
from pathlib import Path
from rejeu import agents
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from tests.environments import Counter
from tests.golden import record_files

folder = Path(sys.argv[1])
warm = rejeu.load(folder / "sac.safetensors")  # imports what building and compiling networks needs
agent = record_files.replay_agent()
env = DummyVecEnv([lambda: Counter((5,))])
VecNormalize.load(folder / "vec_normalize.safetensors", env)
events, watching = [], False
WATCHED = {"pickle.find_class", "marshal.loads", "exec", "compile", "import", "os.system", "subprocess.Popen", "os.exec"}
WATCHED |= {"os.posix_spawn", "os.fork", "ctypes.dlopen", "socket.connect", "code.__new__", "function.__new__"}


def hook(event, arguments):
    if watching and event in WATCHED:
        what = arguments[0] if arguments else ""
        events.append([event, getattr(what, "co_filename", None) or str(what)])


def watched(name, read):
    global events, watching
    events, before = [], set(sys.modules)
    watching, outcome = True, "read"
    try:
        read(folder / name)
    except rejeu.CheckpointError:
        outcome = "refused"
    watching = False
    return {"outcome": outcome, "events": events, "modules": sorted(set(sys.modules) - before)}


def unpickled(path):
    import pickle

    pickle.loads(path.read_bytes())


sys.addaudithook(hook)
seen = {
    "agent": watched("sac.safetensors", rejeu.load),
    "replay": watched("replay.safetensors", agent.load_replay_buffer),
    "vec_normalize": watched("vec_normalize.safetensors", lambda path: VecNormalize.load(path, env)),
    "pickle": watched("evil.pkl", unpickled),
}
print(json.dumps(seen))
"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory) -> dict:
    """What was run, compiled, imported or started while a process read each kind of file, and a pickle at last."""
    folder = tmp_path_factory.mktemp("files")
    for path in FILES.glob("*.safetensors"):
        shutil.copy(path, folder)
    (folder / "evil.pkl").write_bytes(pickle.dumps(print))
    result = subprocess.run(
        [sys.executable, "-c", LOAD, str(folder)], capture_output=True, text=True, check=True, cwd=ROOT
    )
    return json.loads(result.stdout.splitlines()[-1])


@pytest.mark.parametrize("kind", ["agent", "replay", "vec_normalize"])
def test_reading_a_file_runs_and_imports_nothing(seen, kind):
    assert seen[kind] == {"outcome": "read", "events": ours(seen[kind]["events"]), "modules": []}


def ours(events: list) -> list:
    """What the standard library makes of our own classes: dataclasses write their methods as text of their own."""
    return [event for event in events if event[0] in ("exec", "compile", "function.__new__") and is_generated(event[1])]


def is_generated(name: str) -> bool:
    return name.startswith("<string>") or name in ("<stdin>",)


def test_the_watch_sees_a_pickle_that_runs_code(seen):
    """Else the test above could not fail."""
    assert ["pickle.find_class", "builtins"] in seen["pickle"]["events"]
