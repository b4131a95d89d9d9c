"""``rejeu sweep`` and ``rejeu resume SWEEP`` with real processes."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import load_file

import rejeu
from rejeu.core import interrupt
from rejeu.lab import cli

PLAN = """\
environments = ["CartPole-v1"]
algorithms = ["DQN", "PPO"]
seeds = 2
steps = {steps}
no_report = true
no_video = true
evaluate_every = 100000
evaluate_episodes = 1
checkpoint_minutes = 0.01

[settings.small]
policy_kwargs.net_arch = [8]
PPO.n_steps = 32
"""
CHILD = """
import signal, sys, time
from rejeu.core import interrupt
signal.signal(signal.SIGTERM, lambda *_: (print("stopping", flush=True), sys.exit(143)))
interrupt.by_parent()
print(repr(sys.stdin.read()), flush=True)
for _ in range(600):  # Python handles a signal of another thread between two calls
    time.sleep(0.1)
"""


def write_plan(tmp_path, steps):
    path = tmp_path / "plan.toml"
    path.write_text(PLAN.format(steps=steps), encoding="utf-8")
    return path


def models(folder):
    return {path.parent.name: load_file(path) for path in folder.glob("*/agent.safetensors")}


def assert_equal(one, other):
    assert one.keys() == other.keys()
    for name, arrays in one.items():
        for key, array in arrays.items():
            np.testing.assert_array_equal(array, other[name][key], err_msg=f"{name} {key}")


@pytest.fixture
def child():
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, interrupt.SUPERVISED: "1"},
        text=True,
    )
    yield process
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()


def test_a_supervised_process_stops_when_its_input_ends(child):
    assert child.stdout.readline() == "''\n"  # what it starts does not read from the pipe
    child.stdin.close()
    assert child.stdout.readline() == "stopping\n"
    assert child.wait(10) == 143


def test_a_mistake_in_the_plan(tmp_path, capsys):
    path = write_plan(tmp_path, 0)
    assert cli.main(["sweep", str(path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == f"rejeu: error: {path}: steps=0: expected `int` >= 1\n"
    assert not (tmp_path / "out").exists()


@pytest.mark.exhaustive  # trains in four processes
def test_a_sweep_is_trained_compared_and_not_repeated(tmp_path, capsys):
    path, out = write_plan(tmp_path, 300), tmp_path / "out"
    assert cli.main(["sweep", str(path), "--out", str(out), "--workers", "2", "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    assert (content["done"], content["failed"], len(content["runs"])) == (4, 0, 4)
    assert (out / "plan.toml").read_text(encoding="utf-8") == path.read_text(encoding="utf-8")
    assert (out / "compare.html").is_file()
    assert len(rejeu.compare(out).groups) == 2
    times = {one: one.stat().st_mtime_ns for one in out.glob("*/agent.safetensors")}
    result = rejeu.sweep(path, out, workers=2)
    assert result.is_complete
    assert times == {one: one.stat().st_mtime_ns for one in out.glob("*/agent.safetensors")}
