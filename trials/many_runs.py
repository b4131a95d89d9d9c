"""Two defects of commands with many runs, which anyone can try; exits with 1 if one of them is back.

    python trials/many_runs.py

1. The folder of a sweep comes from somebody else: its ``sweep.json`` names a keyword argument ``--import``, or a
   module. Neither ``rejeu resume FOLDER`` nor ``rejeu resume FOLDER --env ENV`` may import the file that lies next to
   it.
2. ``rejeu pbt --measure success`` in an environment that reports no successes ends with an error, and trains no member
   twice.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

EVIL = "from pathlib import Path\nPath('executed').touch()\n"
PBT = ["pbt", "Pendulum-v1", "--algo", "SAC", "--members", "2", "--rounds", "2", "--round-steps", "200"]
PBT += [
    "--measure",
    "success",
    "--evaluate-episodes",
    "2",
    "--set",
    "policy_kwargs.net_arch=[8]",
    "--out",
    "population",
]


def rejeu(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-m", "rejeu", *words]
    return subprocess.run(command, cwd=folder, env=environ, capture_output=True, text=True, timeout=600)


def imports_nothing(folder: Path) -> bool:
    """Returns whether no folder of a sweep has its file imported."""
    (folder / "evil.py").write_text(EVIL, encoding="utf-8")
    kwargs: list[dict[str, object]] = [
        {"render_mode": "rgb_array", "--import": "evil.py"},
        {"render_mode": "evil.py --import evil.py"},
        {"--import": "evil"},
    ]
    for number, one in enumerate(kwargs):
        sweep = folder / f"sweep-{number}"
        sweep.mkdir()
        job = {"name": "a", "env": "CartPole-v1", "seed": 0, "env_kwargs": one, "options": {"steps": 10}}
        content = {"jobs": [job], "threads": 1, "schema": 1}
        (sweep / "sweep.json").write_text(json.dumps(content), encoding="utf-8")
        for more in ([], ["--env", "CartPole-v1"]):
            done = rejeu(["resume", sweep.name, *more], folder)
            is_refused = done.returncode == 2 and done.stderr.count("\n") == 1
            print(f"sweep.json with {one}, {' '.join(more) or 'nothing typed'}: {done.stderr.strip()}")
            if not is_refused or (folder / "executed").exists():
                return False
    return True


def ends_without_success(folder: Path) -> bool:
    """Returns whether a population without successes ends with one line, and starts each member once."""
    done = rejeu(PBT, folder)
    print(f"pbt without successes: exit status {done.returncode}: {done.stderr.strip()}")
    starts = [
        path.read_text(encoding="utf-8").count("run folder") for path in folder.glob("population/members/*/run.log")
    ]
    return done.returncode == 2 and "all members failed" in done.stderr and max(starts) <= 1


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        good = [imports_nothing(Path(name)), ends_without_success(Path(name))]
    print("all as it should be" if all(good) else "a defect is back")
    sys.exit(not all(good))


if __name__ == "__main__":
    main()
