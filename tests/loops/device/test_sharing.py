"""Several devices that share the runs of one program, in processes with two CPU devices."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from rejeu.loops.device.sharing import filled, mesh_of
from tests.loops.device.two_devices import CASES

TWO = "--xla_force_host_platform_device_count=2"


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "rollouts on the device" else pytest.mark.exhaustive)
        for name in (*CASES, "placement")
    ],
)
def test_runs_on_two_devices_equal_single_ones(name: str) -> None:
    environ = {**os.environ, "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {TWO}"}
    words = [sys.executable, "-m", "tests.loops.device.two_devices", name]
    done = subprocess.run(words, env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_every_device_has_the_same_number_of_runs() -> None:
    mesh = mesh_of(5, np.array([f"device {i}" for i in range(2)]).tolist())
    assert mesh is not None
    assert filled([1, 2, 3, 4, 5], mesh) == [1, 2, 3, 4, 5, 1]
    assert mesh_of(1, ["one", "two"]) is None  # type: ignore[list-item]
