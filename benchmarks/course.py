"""Trains the car and the lander of course 1 on several seeds, with the cells of its solution, and records the tables.

    python benchmarks/course.py --seeds 0 1 2 3 4

The result is what the cells "Counting successes" and "Statistics" of the notebook print. Only the seeds are replaced.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from rejeu.teaching import courses
from trials.provenance import provenance, write

RESULT = Path(__file__).parent / "results" / "course.json"
LEFT_OUT = ("by_hand(", "draw_training(", "plt.show(", "show_videos(", ".save(")
"""Cells with these words play, draw or save, and train nothing that is measured."""
ROW = re.compile(r"(.{24}) +(\d+) +(-?[\d.]+) ± +([\d.]+) +(\S+) +(\d+)%")


def cells(seed: int) -> list[str]:
    """Returns the code of the solution, with other seeds of the agents and their environments."""
    source = courses.sources()[0].read_text(encoding="utf-8")
    code = [cell.source for cell in courses.notebook(source, "en", "solution").cells if cell.cell_type == "code"]
    wanted = [cell for cell in code if not any(word in cell for word in LEFT_OUT)]
    seeded = [cell.replace("    seed=0,\n)", f"    seed={seed},\n)") for cell in wanted]
    return [cell.replace("n_envs=n_envs, seed=0", f"n_envs=n_envs, seed={seed}") for cell in seeded]


def train(seed: int) -> dict[str, dict[str, dict[str, float]]]:
    """Returns the mean return and the share of successes of each row, for the car and the lander."""
    names: dict[str, Any] = {"my_scores": {"Mountain": [], "Lunar": []}, "DQN_PARTS": ()}  # of cells that are left out
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()) as printed:
        os.chdir(folder)  # for the videos
        try:
            for cell in cells(seed):
                exec(compile(cell, "course 1", "exec"), names)
        finally:
            os.chdir(before)
    tables = printed.getvalue().split("LunarLander  ")
    rows = [
        {row[1].strip(): {"return": float(row[3]), "success": int(row[6]) / 100} for row in ROW.finditer(table)}
        for table in tables
    ]
    return dict(zip(("car", "lander"), rows, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--out", type=Path, default=RESULT)
    arguments = parser.parse_args()
    runs = []
    for seed in arguments.seeds:
        runs.append({"seed": seed, **train(seed)})
        print(json.dumps(runs[-1]), flush=True)
    write(arguments.out, {**provenance(), "runs": runs}, rows="runs")


if __name__ == "__main__":
    main()
