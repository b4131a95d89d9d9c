"""The examples of README and docs run as they are written, page by page, each page's blocks in one namespace.

Only their length is cut (the fixture ``short``), and a window is closed after a few turns. What a page takes from the
reader, it gets from ``PREPARATIONS``.
"""

import importlib
import importlib.util
import os
import re
import shlex
import shutil
import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import gymnasium
import pytest

import rejeu
from rejeu.algorithms import ppo, sac
from rejeu.core import validation
from rejeu.lab import cli
from rejeu.lab.experiments.plan import read_plan
from rejeu.lab.runs import process
from rejeu.lab.runs.config import assigned, merged
from rejeu.sb3 import load_zip
from tests.sb3_models import MadeUp
from tests.tiers import only

ROOT = Path(__file__).parents[1]
WRITTEN = Path(os.environ.get("REJEU_PAGES", ROOT))
"""The checkout whose pages are read; ``scripts/surface.py`` runs the examples of another one."""
PAGES = [WRITTEN / "README.md", *sorted((WRITTEN / "docs").rglob("*.md"))]
TURNS = 5
"""After which a window is closed."""


class Block(NamedTuple):
    """A fenced block of a page."""

    language: str
    line: int
    """Where its text begins."""
    text: str


def blocks(page):
    """Returns a page's fenced blocks, in order."""
    found, opened = [], None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        fence = re.fullmatch(r"\s*```(\w*)", line)
        if fence and opened is None:
            opened = Block(fence[1], number + 1, "")
        elif fence:
            found.append(opened)
            opened = None
        elif opened is not None:
            opened = opened._replace(text=f"{opened.text}{line}\n")
    assert opened is None, f"{page}: a block of line {opened.line} has no end"
    return found


def commands(page):
    """Returns the arguments of each ``rejeu`` command in a page's blocks."""
    texts = [block.text for block in blocks(page) if block.language in ("", "bash", "console")]
    lines = [line.removeprefix("$ ") for text in texts for line in text.replace("\\\n", " ").splitlines()]
    parts = [part.strip() for line in lines for part in line.split("&&")]
    return [shlex.split(part, comments=True)[1:] for part in parts if part.startswith("rejeu ")]


def table_commands(page):
    """Returns the arguments of each ``rejeu`` command in the tables of a page."""
    rows = [line for line in page.read_text(encoding="utf-8").splitlines() if line.startswith("|")]
    spans = [span for row in rows for span in re.findall(r"`(rejeu [^`]+)`", row)]
    return [shlex.split(span)[1:] for span in spans]


PAGES_WITH_COMMANDS_IN_TABLES = [
    WRITTEN / "docs" / name for name in ("coming-from-rl-zoo.md", "coming-from-cleanrl.md")
]
PYTHON_PAGES = [page for page in PAGES if any(block.language == "python" for block in blocks(page))]
BY_DEFAULT = [
    WRITTEN / f"{name}.md"
    for name in (
        "README",
        *(f"docs/{name}" for name in ("quickstart", "own-environment", "own-loop", "logging", "comparing")),
        *(f"docs/{name}" for name in ("environments", "troubleshooting", "coming-from-sb3", "coming-from-cleanrl")),
        *(f"docs/algorithms/{name}" for name in ("dqn", "iqn", "td3", "trpo")),
    )
]
"""What everybody reads first, and pages that take little time. The exhaustive tier has the others."""
COMMANDS = [(page, arguments) for page in PAGES for arguments in commands(page)]
COMMANDS += [(page, arguments) for page in PAGES_WITH_COMMANDS_IN_TABLES for arguments in table_commands(page)]


def name(value):
    return str(value.relative_to(WRITTEN)) if isinstance(value, Path) else " ".join(value)


def play_a_recording():
    """Does what the page on playing says before it opens a recording, and trains the agent that it shows."""
    from tests.playing import down, perform

    def script(window, game):
        down("d")
        yield from range(400)

    assert (
        perform(script, cli.main, ["play", "CartPole-v1", "--record", "played", "--episodes", "1", "--seed", "0"]) == 0
    )
    kwargs = {"replay_buffer_class": rejeu.HerReplayBuffer, "policy_kwargs": {"net_arch": [8]}}
    rejeu.SAC("MultiInputPolicy", "parking-v0", seed=0, **kwargs).save("parking")


def import_box2d():
    """Imports Box2D without warnings as errors, which crash it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        pytest.importorskip("Box2D")


def give_a_model_of_stable_baselines3():
    """Copies a model, and registers an environment of its spaces."""
    for end, name in (("zip", "model.zip"), ("pkl", "vecnormalize.pkl")):
        shutil.copy(ROOT / "tests" / "data" / "sb3" / f"ppo-normalized.{end}", name)
    agent = load_zip("model.zip")
    gymnasium.register("MyEnv-v0", lambda: MadeUp(agent.observation_space, agent.action_space))


PREPARATIONS = {
    "docs/play.md": play_a_recording,
    "docs/networks.md": import_box2d,
    "docs/sb3-models.md": give_a_model_of_stable_baselines3,
}


@pytest.fixture
def trainings_pretend(monkeypatch):
    """Lets the trainings of a study run a program that pretends."""
    pytest.importorskip("optuna")
    fake = Path(__file__).parent / "lab" / "experiments" / "fake_training.py"
    monkeypatch.setattr(process, "program", lambda task: [sys.executable, "-S", str(fake), str(task)])


@pytest.fixture
def windows_close(monkeypatch):
    """Closes each window after some turns."""
    pygame = pytest.importorskip("pygame")
    from rejeu.teaching import play as package
    from rejeu.teaching.play.window import Window

    real, count = package.turn, [0]

    def turn(window, game):
        count[0] += 1
        if count[0] % TURNS == 0:
            pygame.event.post(pygame.event.Event(pygame.QUIT))
        real(window, game)

    monkeypatch.setattr(package, "turn", turn)
    monkeypatch.setattr(Window, "wait", lambda self, fps: None)


@pytest.mark.parametrize("page", only(BY_DEFAULT, PYTHON_PAGES), ids=name)
def test_the_examples_of_a_page_run(page, short, request, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    if prepare := PREPARATIONS.get(page.relative_to(WRITTEN).as_posix()):
        prepare()
    if page.name in ("play.md", "networks.md"):
        request.getfixturevalue("windows_close")
    if page.name == "tuning.md":
        request.getfixturevalue("trainings_pretend")
    module = ModuleType("example")  # where classes and functions of the page are found again
    monkeypatch.setitem(sys.modules, "example", module)
    for block in blocks(page):
        if block.language == "python":
            lines = "\n" * (block.line - 1)
            exec(compile(lines + block.text, str(page), "exec"), module.__dict__)


@pytest.mark.parametrize(("page", "arguments"), COMMANDS, ids=name)
def test_the_commands_of_a_page_are_understood(page, arguments, monkeypatch, capsys):
    given = []
    command = ModuleType("command")
    run = lambda known: (given.append(known) or 0, None)  # noqa: E731
    command.__getattr__ = lambda name: run if name.startswith("run_") else None
    monkeypatch.setattr(cli.importlib, "import_module", lambda name: command)
    command.import_source = lambda name: None
    assert cli.main(arguments) == 0, capsys.readouterr().err
    assert len(given) == 1


def test_the_plan_of_the_page_on_scaling_is_read(tmp_path):
    page = ROOT / "docs" / "scaling.md"
    (tmp_path / "plan.toml").write_text("".join(block.text for block in blocks(page) if block.language == "toml"))
    plan, _ = read_plan(tmp_path / "plan.toml")
    assert (len(plan.jobs), plan.resources.cpus) == (40, 2)


def script(name):
    """Returns a module of the folder ``scripts``."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_figures_in_pages_are_those_of_the_data():
    figures = script("figures")
    outdated = [path for path, text in figures.rendered() if path.read_text(encoding="utf-8") != text]
    assert not outdated, "run: python scripts/figures.py"


def test_links_between_pages_lead_somewhere():
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        for target in re.findall(r"\]\((?!https?:)([^)#\s]+)", page.read_text(encoding="utf-8")):
            assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_links_to_the_source_name_definitions():
    source_links, errors = script("source_links"), []
    for page in [*PAGES, ROOT / "CHANGELOG.md"]:
        source_links.resolved(page.read_text(encoding="utf-8"), page.parent, page.parent, errors.append)
    assert not errors


def test_overviews_link_to_every_page():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    algorithms = sorted(path.name for path in (ROOT / "docs" / "algorithms").glob("*.md"))
    assert len(algorithms) == len(rejeu.agents.BUILT_IN)
    assert [page for page in algorithms if f"(algorithms/{page})" not in index] == []
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} - {"index.md", "changelog.md"}
    assert len(pages) > 20
    for overview in (index, (ROOT / "llms.txt").read_text(encoding="utf-8")):
        assert [page for page in sorted(pages) if not re.search(rf"\((docs/)?{page}\)", overview)] == []


def test_the_settings_of_the_page_on_rl_zoo_exist():
    page = (ROOT / "docs" / "coming-from-rl-zoo.md").read_text(encoding="utf-8")
    spans = re.findall(r"`((?:rejeu train [^`]*)?--set [^`]+)`", page)
    assert len(spans) > 8
    for span in spans:
        words = shlex.split(span)
        given = merged(assigned(words[words.index("--set") + 1 :]), {})
        config = ppo.Config if "clip_range" in given or "vf" in span else sac.Config
        hindsight = {"replay_buffer_class": "HerReplayBuffer"} if "replay_buffer_kwargs" in given else {}
        validation.build(config, given | hindsight)
