"""What a sweep returns, by the states of its jobs. With real processes: ``tests/lab/cli/test_sweep.py``."""

from itertools import product
from pathlib import Path
from types import SimpleNamespace

from rejeu.lab.experiments.sweep import STATES, SweepResult


def test_a_sweep_is_complete_when_every_job_is_done():
    for states in product(STATES, repeat=3):
        jobs = tuple(SimpleNamespace(state=state, path=Path(str(i))) for i, state in enumerate(states))
        result = SweepResult(Path(), jobs)
        assert result.is_complete == (states == ("done",) * 3)
        assert result.runs == [Path(str(i)) for i in range(3) if states[i] == "done"]
        assert result.failed == [job for job in jobs if job.state == "failed"]
        assert result.counts() == {state: states.count(state) for state in STATES}
