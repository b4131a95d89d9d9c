"""Reads 1,000 damaged and hostile models of Stable-Baselines3 and records the outcomes.

This is the larger version of a test in ``tests/sb3/test_zip_files.py``, with the files of ``tests/hostile_zips.py``: pickles
that would create a folder, shapes and sizes beyond those of the file, zip bombs, and random damage of every part::

    python trials/sb3_hostile.py [N]

Results are written to ``trials/results/sb3_hostile.json``.
"""

from __future__ import annotations

import sys
import tempfile
import time
import tracemalloc
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from provenance import provenance, write

from rejeu.errors import CheckpointError
from rejeu.sb3 import load_zip
from tests.hostile_zips import hostile_zips

VALID = Path(__file__).parents[1] / "tests" / "data" / "sb3" / "ppo-normalized.zip"
RESULTS = Path(__file__).parent / "results" / "sb3_hostile.json"


def main(n: int) -> None:
    """Reads the files and writes the results."""
    outcomes: Counter[str] = Counter()
    longest, largest = (0.0, ""), (0, "")
    with tempfile.TemporaryDirectory() as folder:
        ran, path = Path(folder) / "ran", Path(folder) / "model.zip"
        for name, content in hostile_zips(VALID.read_bytes(), n, seed=1, ran=ran):
            path.write_bytes(content)
            tracemalloc.start()
            began = time.process_time()
            try:
                load_zip(path)
                outcome = "read"
            except CheckpointError as error:
                outcome = "refused" if "\n" not in str(error) else "refused in more than one line"
            except Exception as error:  # of other kinds is a fault, and counted
                outcome = f"{type(error).__name__} in {name}"
            seconds, peak = time.process_time() - began, tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            outcomes[outcome] += 1
            longest, largest = max(longest, (seconds, name)), max(largest, (peak, name))
            if ran.exists():
                outcomes[f"code of {name} was executed"] += 1
                ran.rmdir()
    result = {
        "files": sum(outcomes.values()),
        "outcomes": dict(outcomes),
        "longest processor seconds": [round(longest[0], 1), longest[1]],
        "most memory in MiB": [round(largest[0] / 2**20, 1), largest[1]],
    }
    print(result)
    write(RESULTS, {**provenance(), **result})


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
