"""No file is executed: ruff bans what could do so (see pyproject.toml), and a process that loads files is watched."""

import ast
import json
import pickle
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import rejeu
import rejeu.lab.cli
from rejeu.envs.registry import is_plain_id
from rejeu.teaching.courses import leaderboard
from tests import hostile_files
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


TYPED = {"arguments.env", "options.env", "full_name(arguments.env)"}
"""Where a person has typed the id of an environment: the arguments of a command."""


def test_only_what_a_person_has_typed_reaches_the_functions_that_import_an_environment():
    """Ids from elsewhere go through ``from_run``, which asks ``is_plain_id``."""
    calls = [
        (path.name, getattr(scope, "name", ""), ast.unparse(call.args[0]))
        for path in SOURCE.rglob("*.py")
        for scope in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(scope, ast.FunctionDef)
        for call in ast.walk(scope)
        if isinstance(call, ast.Call) and ast.unparse(call.func).endswith(("from_arguments", "find_id"))
    ]
    assert len(calls) > 8
    untyped = {call for call in calls if call[2] not in TYPED}
    assert untyped == {("environment.py", "from_arguments", "env")}  # its own argument, which is one of these


@pytest.mark.parametrize(
    "env_id",
    [
        "evil.py", "models/evil.py", "models/evil.PY", "models/evil.py.", "models/evil.py ", "models\\evil.py", "evil.py\0",
        "evil.py\n", "/evil", "//host/share/evil", "a//b", "../evil", "a/b/c", "C:evil.py", "file:///evil.py", "evil:Walk-v0",
        "evil.py:Walk-v0", "evil.Py", "evil:", ":evil", "", ".", "a" * 201, 3, None, ["evil.py"],
    ],
)  # fmt: skip
def test_a_file_may_not_name_an_environment_that_is_imported(env_id):
    assert not is_plain_id(env_id)


@pytest.mark.parametrize("env_id", ["CartPole-v1", "ALE/Pong-v5", "rejeu/Ball-v0", "Walk.2d-v0", "happy", "Ünï-v0"])
def test_a_file_may_name_an_environment_that_is_looked_up(env_id):
    assert is_plain_id(env_id)


def test_a_leaderboard_imports_no_file_that_a_model_names(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "evil.py").write_text("open('ran', 'w')", encoding="utf-8")
    content = hostile_files.changed(
        (FILES / "sac.safetensors").read_bytes(), lambda h, a: h.update(env_id="models/evil.py")
    )
    (tmp_path / "models" / "student.safetensors").write_bytes(content)
    with pytest.raises(ValueError, match="no model says which environment"):
        leaderboard.usual_env_id(leaderboard.models(tmp_path / "models"))
    assert rejeu.lab.cli.main(["class", "models"]) == 2
    assert not (tmp_path / "ran").exists()
