"""Nothing that a file holds is run: no source that reads files can, and while one is read nothing does."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

import rejeu
from tests.io.test_schemas import FOLDERS

SOURCE = Path(rejeu.__file__).parent
MODULES = {"pickle", "_pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "torch", "yaml", "code", "runpy"}
"""Modules that run what they read, or keep what does."""
CALLS = {"eval", "exec", "compile", "__import__", "globals"}
LOOKUPS = {
    "getattr": 1,
    "import_module": 0,
    "find_spec": 0,
    "load_module": 0,
    "spec_from_file_location": 0,
    "run_path": 0,
}
"""Functions that find code by a name, and at which place that is given; it must stand in the source."""
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)


class Find(NamedTuple):
    """Something in a source that could run, or find, what a file names."""

    what: str
    line: int


ALLOWED = {
    # Functions go to worker processes as this program made them; nothing is read from a file.
    "envs/workers/process.py": {"CloudpickleWrapper"},
    "envs/workers/pool.py": {"CloudpickleWrapper"},
    # The modules are those of our own table of environments' packages.
    "envs/registry.py": {"import_module", "find_spec"},
    # What the user typed on the command line; tests/cli/test_environments.py sees that nothing from a file gets there.
    "cli/importing.py": {"import_module", "getattr"},
    # Callbacks of Stable-Baselines3's kind are handed globals; nothing is taken from them.
    "reporting/evaluation.py": {"globals()"},
    # The names of the fields of our own dataclasses, and settings that a class lists in its own source.
    "agents/base.py": {"getattr"},
    "agents/description.py": {"getattr"},
    "agents/resume.py": {"getattr"},
    "callbacks/evaluate.py": {"getattr"},
    "cli/run_folder.py": {"getattr"},
    "envs/snapshot.py": {"getattr"},
    "hooks/base.py": {"getattr"},
    "hooks/calling.py": {"globals()"},
    "algorithms/config.py": {"getattr"},
    "exploration/noise.py": {"getattr"},
    "networks/shape.py": {"getattr"},
    "reporting/summary.py": {"getattr"},
    # The attribute that the program asks a wrapper for, passed on to the wrapped environments.
    "sb3/common/vec_env/base_vec_env.py": {"getattr"},
    # The names of the agents, listed in the source.
    "sb3/__init__.py": {"getattr", "import_module"},
}


def finds(text: str) -> Iterator[Find]:
    """Yields what in a source could run, or find, what a file names."""
    tree = ast.parse(text)
    yield from within(tree, tree)


def within(node: ast.AST, scope: ast.AST) -> Iterator[Find]:
    """Yields what in a node could, of which ``scope`` is the function around it."""
    line = getattr(node, "lineno", 0)
    if isinstance(node, ast.Import):
        yield from (Find(name, line) for alias in node.names if (name := alias.name.split(".")[0]) in MODULES)
    elif isinstance(node, ast.ImportFrom):
        if (node.module or "").split(".")[0] in MODULES:
            yield Find(str(node.module), line)
        suspicious = {"CloudpickleWrapper", *CALLS, *MODULES}
        yield from (Find(alias.name, line) for alias in node.names if alias.name in suspicious)
    elif isinstance(node, ast.Call):
        yield from in_call(node, scope)
    elif isinstance(node, ast.Attribute) and node.attr in {"__subclasses__", "__globals__", "__builtins__"}:
        yield Find(node.attr, line)
    elif (
        isinstance(node, ast.Subscript)
        and ast.unparse(node.value) == "sys.modules"
        and not spelt_out(node.slice, scope)
    ):
        yield Find("sys.modules", line)
    for child in ast.iter_child_nodes(node):
        yield from within(child, child if isinstance(child, FUNCTIONS) else scope)


def in_call(node: ast.Call, scope: ast.AST) -> Iterator[Find]:
    """Yields what in one call could."""
    name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
    if isinstance(node.func, ast.Name) and name in CALLS:
        yield Find(f"{name}()", node.lineno)
    if name in LOOKUPS and (len(node.args) <= LOOKUPS[name] or not spelt_out(node.args[LOOKUPS[name]], scope)):
        yield Find(name, node.lineno)
    for keyword in node.keywords:
        if keyword.arg == "allow_pickle" and not (isinstance(keyword.value, ast.Constant) and not keyword.value.value):
            yield Find("allow_pickle", node.lineno)


def spelt_out(name: ast.expr, scope: ast.AST) -> bool:
    """Whether a name stands in the source: as a text, or as what a loop in the same function takes from a list of texts."""
    if isinstance(name, ast.IfExp):
        return spelt_out(name.body, scope) and spelt_out(name.orelse, scope)
    if not isinstance(name, ast.Name):
        return isinstance(name, ast.Constant)
    lists = []
    for node in here(scope):
        if isinstance(node, ast.For | ast.comprehension) and name.id in names_in(node.target):
            lists.append(node.iter)
        elif (isinstance(node, ast.arg) and node.arg == name.id) or (
            isinstance(node, ast.Assign) and any(name.id in names_in(target) for target in node.targets)
        ):
            return False
    return bool(lists) and all(is_list_of_texts(one) for one in lists)


def here(scope: ast.AST) -> Iterator[ast.AST]:
    """Yields the nodes of a function, but not those of functions within it."""
    for node in ast.iter_child_nodes(scope):
        yield node
        if not isinstance(node, FUNCTIONS):
            yield from here(node)


def names_in(target: ast.expr) -> set[str]:
    return {node.id for node in ast.walk(target) if isinstance(node, ast.Name)}


def is_list_of_texts(value: ast.expr) -> bool:
    """Whether an expression is a tuple of constants, or of tuples of them, or a constant of the module."""
    if isinstance(value, ast.Name):
        return value.id.isupper()
    if isinstance(value, ast.Tuple | ast.List):
        return all(isinstance(part, ast.UnaryOp | ast.Constant) or is_list_of_texts(part) for part in value.elts)
    return False


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda p: p.relative_to(SOURCE).as_posix())
def test_no_source_runs_or_looks_up_what_a_file_names(path):
    allowed = ALLOWED.get(path.relative_to(SOURCE).as_posix(), set())
    assert not [find for find in finds(path.read_text(encoding="utf-8")) if find.what not in allowed]


def test_every_loader_compares_arrays_before_it_reads_them():
    """``checkpoint.read`` reads whatever there is, and is for files that are known to be good."""
    assert not [path for path in SOURCE.rglob("*.py") if "checkpoint.read(" in path.read_text(encoding="utf-8")]


def test_nothing_is_allowed_that_is_not_there():
    for name, allowed in ALLOWED.items():
        assert allowed == allowed & {find.what for find in finds((SOURCE / name).read_text(encoding="utf-8"))}, name


@pytest.mark.parametrize(
    ("source", "what"),
    [
        ("import pickle", "pickle"),
        ("import os, torch.serialization", "torch"),
        ("from joblib import load", "joblib"),
        ("def f():\n    import dill as d", "dill"),
        ("from builtins import eval as e", "eval"),
        ("eval(header['code'])", "eval()"),
        ("exec(text)", "exec()"),
        ("np.load(path, allow_pickle=True)", "allow_pickle"),
        ("np.load(path, allow_pickle=flag)", "allow_pickle"),
        ("getattr(optax, header['optimizer'])", "getattr"),
        ("getattr(optax, name)", "getattr"),
        ("for name in header:\n    getattr(optax, name)", "getattr"),
        ("def f(name):\n    for name in ('a', 'b'):\n        getattr(optax, name)", "getattr"),
        ("name = header['x']\nfor name in ('a', 'b'):\n    getattr(optax, name)", "getattr"),
        ("importlib.import_module(header['module'])", "import_module"),
        ("import_module(name)", "import_module"),
        ("globals()[name]()", "globals()"),
        ("sys.modules[name]", "sys.modules"),
        ("object.__subclasses__()", "__subclasses__"),
        ("from gymnasium.vector.utils import CloudpickleWrapper", "CloudpickleWrapper"),
        ("yaml = __import__('yaml')", "__import__()"),
    ],
)
def test_the_search_finds_what_it_is_for(source, what):
    assert what in {find.what for find in finds(source)}


def test_the_search_passes_what_is_harmless():
    harmless = "import json\ngetattr(x, 'name', None)\nnp.load(p, allow_pickle=False)\nre.compile('a')\n"
    assert not list(finds(harmless + "for key in ('a', 'b'):\n    getattr(self, key)\nsys.modules['__main__']\n"))


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
target = folder / sys.argv[2]
events, watching = [], False
WATCHED = {"pickle.find_class", "marshal.loads", "exec", "compile", "import", "os.system", "subprocess.Popen", "os.exec"}
WATCHED |= {"os.posix_spawn", "os.fork", "ctypes.dlopen", "socket.connect", "code.__new__", "function.__new__"}


def hook(event, arguments):
    if watching and event in WATCHED:
        what = arguments[0] if arguments else ""
        events.append([event, getattr(what, "co_filename", None) or str(what)])


sys.addaudithook(hook)
before = set(sys.modules)
watching = True
outcome = "read"
try:
    if sys.argv[3] == "agent":
        loaded = rejeu.load(target)
    elif sys.argv[3] == "replay":
        agent.load_replay_buffer(target)
    elif sys.argv[3] == "vec_normalize":
        VecNormalize.load(target, env)
    else:
        import pickle

        pickle.loads(target.read_bytes())
except rejeu.CheckpointError:
    outcome = "refused"
watching = False
print(json.dumps({"outcome": outcome, "events": events, "modules": sorted(set(sys.modules) - before)}))
"""


def watched(folder: Path, name: str, kind: str) -> dict:
    """Reads a file in a process that notes what is run, compiled, imported or started meanwhile."""
    environment_is_ours = [sys.executable, "-c", LOAD, str(folder), name, kind]
    result = subprocess.run(
        environment_is_ours, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
    )
    return json.loads(result.stdout.splitlines()[-1])


@pytest.mark.parametrize(("name", "kind"), [("sac", "agent"), ("replay", "replay"), ("vec_normalize", "vec_normalize")])
def test_reading_a_file_runs_and_imports_nothing(name, kind):
    seen = watched(FOLDERS[-1], f"{name}.safetensors", kind)
    assert seen == {"outcome": "read", "events": ours(seen["events"]), "modules": []}


def ours(events: list) -> list:
    """What the standard library makes of our own classes: dataclasses write their methods as text of their own."""
    return [event for event in events if event[0] in ("exec", "compile", "function.__new__") and is_generated(event[1])]


def is_generated(name: str) -> bool:
    return name.startswith("<string>") or name in ("<stdin>",)


def test_the_watch_sees_a_pickle_that_runs_code(tmp_path):
    """Else the test above could not fail."""
    import pickle
    import shutil

    for path in FOLDERS[-1].glob("*.safetensors"):
        shutil.copy(path, tmp_path)
    (tmp_path / "evil.pkl").write_bytes(pickle.dumps(print))
    seen = watched(tmp_path, "evil.pkl", "pickle")
    assert ["pickle.find_class", "builtins"] in seen["events"]
