"""What people have typed about the environments of runs, and what of it threads and processes get. No browser."""

import ast
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="needs nicegui, which is in the extra studio")

from rejeu.lab import studio as package
from rejeu.lab.reporting.rows import RowReader
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.studio.state import Studio
from tests.lab.reporting.report.folders import CONFIG, write

WALK = {"env": "Walk-v0", "env_argument": "walk.py"}
WORLD = {"env": "Walk-v0", "env_kwargs": {"world": "/a/b.xml", "g": 2.5}, "wrappers": ["a:Wrap"]}


def read(folder, typed=None, **runs):
    """Returns a studio that has read runs with these changes of their configuration."""
    for name, changes in runs.items():
        write(folder / name, {**CONFIG, **changes}, videos=False)
    studio = Studio(folder) if typed is None else Studio(folder, typed=typed)
    reader = RowReader(folder)
    studio.rows, studio.summaries = reader.read(), reader.summaries()
    return studio


def test_an_environment_that_was_typed_may_be_imported_with_the_numbers_of_the_run(tmp_path):
    studio = read(tmp_path, run={**WALK, "env_kwargs": {"g": 3}})
    assert (studio.given("run"), studio.words("run")) == (RunOptions(), [])
    studio.trust(RunConfig(env="walk.py", env_kwargs={"g": 2}, imports=("a.py",)))
    assert studio.given("run") == RunOptions(env="walk.py", env_kwargs={"g": 3}, imports=("a.py",))
    assert studio.words("run") == ["--env", "walk.py", "--env-kwargs", "g=3", "--import", "a.py"]


@pytest.mark.parametrize(
    "typed",
    [
        {"env": "Walk-v0", "env_argument": "other.py"},  # registers it too
        {"env": "walk.py"},
    ],
)
def test_a_run_is_made_as_a_person_has_named_its_environment_and_not_as_its_folder_does(tmp_path, typed):
    studio = read(
        tmp_path, RunConfig(**typed), run={"env": "Walk-v0", "env_argument": typed.get("env_argument", "walk.py")}
    )
    assert studio.given("run").env == (typed.get("env_argument") or typed["env"])
    evil = read(
        tmp_path, RunConfig(env="Walk-v0", env_argument="walk.py"), evil={"env": "Walk-v0", "env_argument": "evil.py"}
    )
    assert evil.given("evil").env == "walk.py"


@pytest.mark.parametrize(
    "run",
    [
        {"env": "Evil-v0", "env_argument": "evil.py"},
        {"env": "Evil-v0", "imports": ["evil"]},
        {**WALK, "wrappers": ["evil:Wrap"]},
        {**WALK, "env_kwargs": {"world": "/etc/evil.xml"}},
        {**WALK, "env_kwargs": {f"n{i}": i for i in range(1000)}},
        {**WALK, "imports": ["evil.py"]},
    ],
)
def test_nothing_but_what_a_person_has_typed_comes_from_a_folder(tmp_path, run):
    studio = read(tmp_path, RunConfig(env="Walk-v0", env_argument="walk.py", imports=("a",)), run=run)
    studio.trust(RunConfig(env="Other-v0", wrappers=("evil:Wrap",), env_kwargs={"world": "/etc/evil.xml"}))
    words = studio.words("run")
    assert not [word for word in words if "evil" in word]
    assert words[-2:] == ["--import", "a"]
    assert len(words) < 10


def test_paths_and_wrappers_are_those_that_were_typed_for_that_very_run(tmp_path):
    studio = read(tmp_path, a=WORLD, b={**WORLD, "env_kwargs": {"world": "/c.xml", "g": 1.0}})
    for world, g in (("/a/b.xml", 2.5), ("/c.xml", 1.0)):
        studio.trust(RunConfig(env="Walk-v0", env_kwargs={"world": world, "g": g}, wrappers=("a:Wrap",)))
    assert studio.given("a").env_kwargs == WORLD["env_kwargs"]
    assert studio.given("b").env_kwargs == {"world": "/c.xml", "g": 1.0}
    assert studio.given("b").wrappers == ("a:Wrap",)


def test_modules_of_the_command_line_are_imported_for_every_run_and_page(tmp_path):
    studio = read(tmp_path, RunConfig(env="", imports=("a.py",)), run={"env": "Walk-v0"})
    assert studio.words("run") == ["--env", "Walk-v0", "--import", "a.py"]
    assert studio.words("no run") == ["--import", "a.py"]
    assert studio.typed("Walk-v0").env is None  # looked up
    assert studio.typed("Walk-v0").imports == ("a.py",)


def test_pages_find_the_environment_of_the_command_line_by_its_id_and_no_settings_of_a_run(tmp_path):
    studio = read(tmp_path, RunConfig(env="Walk-v0", env_argument="walk.py", env_kwargs={"g": 1}))
    studio.trust(RunConfig(env="CartPole-v1", env_kwargs={"sutton_barto_reward": True}))
    for name in ("Walk-v0", "walk.py"):
        assert studio.typed(name) == RunOptions(env="walk.py", env_kwargs={"g": 1})
    assert [studio.typed(name).env for name in ("CartPole-v1", "evil.py", "")] == [None] * 3


OPTIONS = dict.fromkeys(("environment_of", "LivePlayer", "ThenAndNow"), "given(")
MADE = {"from_run": "typed(", **OPTIONS, "start": "words"}
"""What makes an environment or starts a process for a run, and where its last argument but the path comes from."""

HANDED = ("player.py", "then_and_now.py")
"""Files whose classes are handed the options, by the calls that are checked."""


def test_all_that_makes_an_environment_or_starts_a_process_asks_what_was_typed():
    calls = [
        (path.name, ast.unparse(call.func).rpartition(".")[2], ast.unparse(call))
        for path in Path(package.__file__).parent.glob("*.py")
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(call, ast.Call)
    ]
    asked = [
        (file, name, text) for file, name, text in calls if name in MADE and ("processes." in text or name != "start")
    ]
    assert len(asked) >= 5
    assert [call for call in asked if MADE[call[1]] not in call[2] and call[0] not in HANDED] == []
    makers = {
        "from_arguments",
        "make",
        "make_vector",
        "make_env",
        "find_id",
        "import_source",
        "Popen",
        "start_apart",
        "run",
    }
    assert {(file, name) for file, name, _ in calls if name in makers} == {
        ("processes.py", "start_apart"),  # start
        ("new.py", "Popen"),  # rejeu check of what is in the form
        ("server.py", "run"),  # the server itself
    }
