"""Folders of sweeps, studies and populations that come from somebody else: none has code imported or writes elsewhere.

    python trials/folders.py

The folders of ``tests/data`` are changed in one place at a time, and resumed without and with the environment named on the
command line. A Python file lies next to each. Runs are not trained: what each is handed is kept instead. Exits with 1 if the
file was imported, if a run would import it, or if something was written outside.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
from collections.abc import Callable
from contextlib import chdir, redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any
from unittest import mock

from rejeu import cli
from rejeu.experiments import process

DATA = Path(__file__).resolve().parents[1] / "tests" / "data" / "2026-11"
EVIL = """from pathlib import Path
import gymnasium

Path(__file__).with_name('executed').touch()


class W(gymnasium.Wrapper):
    pass
"""
RUN = "CartPole-v1-PPO-small-seed1"
Change = Callable[[Path], None]


def job(**fields: Any) -> Change:
    """Changes fields of the job that has not begun; ``options`` and ``hyperparameters`` are merged."""

    def change(folder: Path) -> None:
        path = folder / "sweep.json"
        content = json.loads(path.read_text())
        for key, value in fields.items():
            merged = {**content["jobs"][2][key], **value} if isinstance(value, dict) else value
            content["jobs"][2][key] = merged
        path.write_text(json.dumps(content))

    return change


def config(file: str, part: str = "", **fields: Any) -> Change:
    """Changes fields of a JSON file in the folder, or of a part of it."""

    def change(folder: Path) -> None:
        content = json.loads((folder / file).read_text())
        (content[part] if part else content).update(fields)
        (folder / file).write_text(json.dumps(content))

    return change


ARGUMENT = {"--import": "evil.py"}
OF_RUN = f"{RUN}/config.json"
CHANGES: dict[str, list[tuple[str, Change]]] = {
    "sweep": [
        ("job, env_kwargs", job(env_kwargs=ARGUMENT)),
        ("job, option as a value of env_kwargs", job(env_kwargs={"render_mode": "rgb_array --import evil.py"})),
        ("job, wrapper", job(wrappers=["evil:W"])),
        ("job, environment of a module", job(env="evil:CartPole-v1")),
        ("job, environment in a file", job(env="evil.py")),
        ("job, environment as an option", job(env="--import=evil.py")),
        ("job, algorithm of a module", job(algorithm="evil:W")),
        ("job, hyperparameter as an option", job(hyperparameters=ARGUMENT)),
        ("job, module as network", job(hyperparameters={"policy_kwargs.torso": "evil:W"})),
        ("job, another option", job(options={"import": ["evil.py"]})),
        ("job, preset", job(options={"preset": "evil.py"})),
        ("job, log as an option", job(options={"log": ["--import", "evil.py"]})),
        ("job, backend as an option", job(options={"backend": "gymnasium --import evil.py"})),
        ("job, name outside of the folder", job(name="../outside")),
        ("job, absolute name", job(name="/tmp/rejeu-outside")),
        ("job, name as an option", job(name="--import=evil.py")),
        ("config.json of a run, imports", config(OF_RUN, imports=["evil.py"])),
        ("config.json of a run, wrapper", config(OF_RUN, wrappers=["evil:W"])),
        ("config.json of a run, environment", config(OF_RUN, env_argument="evil.py", env="evil:CartPole-v1")),
        ("config.json of a run, env_kwargs", config(OF_RUN, env_kwargs=ARGUMENT)),
    ],
    "study": [
        ("study.json, env_kwargs", config("study.json", env_kwargs=ARGUMENT)),
        ("study.json, environment", config("study.json", env_id="evil:CartPole-v1", env_argument="evil:CartPole-v1")),
        ("study.json, environment in a file", config("study.json", env_argument="evil.py")),
        ("study.json, environment as an option", config("study.json", env_argument="--import=evil.py")),
        ("study.json, wrapper", config("study.json", wrappers=["evil:W"])),
        ("study.json, hyperparameter", config("study.json", fixed=ARGUMENT)),
        ("study.json, backend as an option", config("study.json", backend="gymnasium --import evil.py")),
    ],
    "population": [
        ("population.json, env_kwargs", config("population.json", "plan", env_kwargs=ARGUMENT)),
        ("population.json, environment", config("population.json", "plan", env_argument="evil.py")),
        ("population.json, wrapper", config("population.json", "plan", wrappers=["evil:W"])),
        ("config.json of a member, imports", config("members/00/run/config.json", imports=["evil.py"])),
        ("config.json of a member, wrapper", config("members/00/run/config.json", wrappers=["evil:W"])),
        ("config.json of a member, env_kwargs", config("members/00/run/config.json", env_kwargs=ARGUMENT)),
    ],
}


KEEP = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[1] + '.handed'); sys.exit(2)"


def resume(folder: Path, *more: str) -> str:
    """Resumes the folder, whose runs end at once, and returns the exit status and the last line that was printed."""
    keep = mock.patch.object(process, "program", lambda task: [sys.executable, "-S", "-c", KEEP, str(task)])
    with keep, chdir(folder.parent), redirect_stdout(StringIO()) as out, redirect_stderr(out):
        status = cli.main(["resume", folder.name, "--workers", "1", *more])
    return f"{status}: {(out.getvalue().strip().splitlines() or [''])[-1][:150]}"


def imported(task: Path) -> bool:
    """Returns whether a run would import what the folder named."""
    run = json.loads(task.read_text())["run"]
    return "evil" in json.dumps([run[key] for key in ("imports", "wrappers", "env_argument")])


def main() -> None:
    """Tries every folder and exits with 1 if one did what it may not."""
    wrong = []
    only = sys.argv[1:] or [*CHANGES]
    for kind in only:
        env = "Pendulum-v1" if kind == "population" else "CartPole-v1"
        for name, change in CHANGES[kind]:
            for more in ((), ("--env", env)):
                with tempfile.TemporaryDirectory() as root:
                    inside = Path(root) / "inside"
                    folder = Path(shutil.copytree(DATA / kind, inside / kind))
                    for place in (inside, folder, folder / RUN if kind == "sweep" else folder):
                        (place / "evil.py").write_text(EVIL)
                    before = {path.name for path in (*Path(root).iterdir(), *inside.iterdir())}
                    change(folder)
                    said = resume(folder, *more)
                    executed = [*Path(root).rglob("executed"), *filter(imported, Path(root).rglob("*.handed"))]
                    after = (
                        {path.name for path in (*Path(root).iterdir(), *inside.iterdir())} - before - {"__pycache__"}
                    )
                    bad = bool(executed or after or Path("/tmp/rejeu-outside").exists() or "Traceback" in said)
                    wrong += [name] * bad
                    named = ", environment named" if more else ""
                    print(f"{'WRONG ' if bad else ''}{name}{named}: {said} {sorted(after) or ''}", flush=True)
    print(f"{len(wrong)} did what they may not: {', '.join(wrong) or 'none'}")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
