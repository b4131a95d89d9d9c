"""Sweeps on a Ray cluster: a head and two nodes, which are processes of this machine."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

import rejeu
from rejeu.core.errors import ClusterError
from rejeu.envs.workers import cluster
from rejeu.lab.experiments import ray as launcher
from rejeu.lab.experiments.folder import Resources
from rejeu.lab.runs import process
from tests.envs import ray_cluster
from tests.lab.cli.test_sweep import assert_equal, models

pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning"
)
starts_a_cluster = pytest.mark.exhaustive

PLAN = {
    "environments": ["CartPole-v1"],
    "algorithms": ["DQN", "PPO"],
    "settings": {"small": {"policy_kwargs": {"net_arch": [8]}, "PPO": {"n_steps": 32}}},
    "steps": 6000,
    "evaluate_every": 100_000,
    "evaluate_episodes": 1,
    "checkpoint_minutes": 0.01,
    "no_report": True,
    "no_video": True,
    "threads": 1,
}


@pytest.fixture
def nodes():
    pytest.importorskip("ray")
    with ray_cluster.running(num_cpus=1) as (running, nodes):
        yield running, nodes


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    result = rejeu.sweep(PLAN, tmp_path_factory.mktemp("local") / "sweep", workers=2)
    assert result.is_complete
    return models(result.path)


def when(condition, action, seconds=120.0):
    """Calls ``action`` in a thread as soon as a condition holds."""

    def wait():
        until = time.monotonic() + seconds
        while not condition() and time.monotonic() < until:
            time.sleep(0.05)
        action()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


def trained_processes(folder):
    """Returns the ids of processes that train in a folder."""
    found = subprocess.run(["ps", "-eo", "pid=,args="], capture_output=True, text=True, check=True).stdout
    lines = [line.split(None, 1) for line in found.splitlines()]
    return [int(pid) for pid, words in lines if "-m rejeu" in words and str(folder) in words]


def checkpoints(folder, job):
    return list((folder / job / "checkpoints").glob("run_*")) if (folder / job).is_dir() else []


@starts_a_cluster
def test_a_lost_node_and_a_killed_run_change_nothing(nodes, undisturbed, tmp_path):
    running, (first, _) = nodes
    out = tmp_path / "sweep"
    thread = when(
        lambda: checkpoints(out, "CartPole-v1-DQN-small-seed0") and checkpoints(out, "CartPole-v1-PPO-small-seed0"),
        lambda: running.remove_node(first, allow_graceful=False),
    )
    result = rejeu.sweep(PLAN, out, ray=running.address)
    thread.join()
    assert result.is_complete, result.table()
    assert_equal(undisturbed, models(out))
    assert trained_processes(out) == []


@starts_a_cluster
def test_mistakes_are_one_line(nodes, tmp_path, monkeypatch):
    running, _ = nodes
    with pytest.raises(ClusterError, match="no node of the Ray cluster has room for a run with CPU=64"):
        rejeu.sweep({**PLAN, "resources": {"cpus": 64}}, tmp_path / "a", ray=running.address)
    versions, marker = cluster.versions, launcher.write_marker
    with monkeypatch.context() as patch:
        patch.setattr(cluster, "versions", lambda more=(): {**versions(more), "jax": "0.0.1"})
        with pytest.raises(ClusterError, match=r"the node .* has jax .* and not 0\.0\.1 as here"):
            rejeu.sweep(PLAN, tmp_path / "b", ray=running.address)
    monkeypatch.setattr(launcher, "write_marker", lambda folder: f"{marker(folder)}-of-another")
    with pytest.raises(ClusterError, match=r"the node .* does not see .*c, the folder of the sweep"):
        rejeu.sweep(PLAN, tmp_path / "c", ray=running.address)


@starts_a_cluster
def test_ctrl_c_stops_the_runs_with_a_checkpoint(nodes, undisturbed, tmp_path):
    running, _ = nodes
    out = tmp_path / "sweep"
    thread = when(
        lambda: len(checkpoints(out, "CartPole-v1-DQN-small-seed0")) > 1, lambda: os.kill(os.getpid(), signal.SIGINT)
    )
    with pytest.raises(KeyboardInterrupt):
        rejeu.sweep(PLAN, out, ray=running.address)
    thread.join()
    assert trained_processes(out) == []
    result = rejeu.sweep(PLAN, out, ray=running.address)
    assert result.is_complete, result.table()
    assert_equal(undisturbed, models(out))


def train(tmp_path, code, **changes):
    (tmp_path / "task").write_text(code, encoding="utf-8")
    settings = {name: tmp_path / name for name in ("task", "log", "stop")} | {"folder": tmp_path, "environ": {}}
    settings |= {"marker": launcher.write_marker(tmp_path), "versions": cluster.versions(launcher.PACKAGES)}
    return launcher.train(**{**settings, **changes})


def test_a_node_trains_in_the_folder_until_it_is_asked_to_stop(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "program", lambda task: [sys.executable, str(task)])
    monkeypatch.setattr(launcher, "POLL", 0.01)
    assert train(tmp_path, "print('trained')") == 0
    assert (tmp_path / "log").read_text(encoding="utf-8") == "trained\n"
    waits = "import sys; sys.stdin.read(); sys.exit(143)"
    (tmp_path / "stop").touch()
    assert train(tmp_path, waits) == 143


def test_a_node_that_has_other_versions_or_another_folder_is_refused(tmp_path):
    with pytest.raises(ClusterError, match=r"the node .* has jax .* and not 0\.0\.1"):
        train(tmp_path, "", versions={**cluster.versions(launcher.PACKAGES), "jax": "0.0.1"})
    with pytest.raises(ClusterError, match="does not see"):
        train(tmp_path, "", marker=str(tmp_path / "a" / "none"))


def test_a_node_does_not_import_jax():
    code = "import sys, rejeu.lab.experiments.ray; print('jax' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


def test_room():
    assert launcher.places({"CPU": 8.0, "memory": 4e9}, Resources(cpus=0.5, memory="1 GB")) == 4
    assert launcher.requested(Resources(custom={"fast": 1})) == {
        "num_cpus": 1.0,
        "num_gpus": 0.0,
        "resources": {"fast": 1.0},
    }
