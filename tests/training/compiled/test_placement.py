"""Several devices that share the runs of one program, in processes with two CPU devices."""

from __future__ import annotations

import os
import subprocess
import sys

import jax
import pytest

from rejeu.training.compiled.trainer import filled, group_size, mesh_of
from tests.training.compiled.two_devices import CASES

TWO = "--xla_force_host_platform_device_count=2"


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", [*CASES, "placement"])
def test_runs_on_two_devices_equal_single_ones(name: str) -> None:
    environ = {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {TWO}"}
    words = [sys.executable, "-m", "tests.training.compiled.two_devices", name]
    done = subprocess.run(words, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_device_has_the_same_number_of_runs() -> None:
    cpus = [jax.devices("cpu")[0]] * 2
    assert [group_size(n, cpus) for n in (1, 2, 3, 5, 16, 17, 64)] == [1, 2, 4, 6, 16, 10, 16]
    assert [group_size(n, cpus[:1]) for n in (1, 8, 9, 64)] == [1, 8, 5, 8]
    assert filled([1, 2, 3, 4, 5], 6) == [1, 2, 3, 4, 5, 1]
    assert mesh_of(1, cpus) is None
