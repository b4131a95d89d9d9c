"""Sweeps on a Ray cluster: a head and two nodes, which are processes of this machine."""

import contextlib
import os
import signal
import subprocess
import threading
import time

import pytest

import rejeu
from rejeu import cluster
from rejeu.errors import ClusterError
from rejeu.experiments import ray as launcher
from rejeu.experiments.jobs import Resources
from tests import ray_cluster
from tests.cli.test_sweep import assert_equal, models

pytestmark = [
    pytest.mark.exhaustive,  # starts a cluster
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning", "ignore::FutureWarning"),
]
pytest.importorskip("ray")

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


def test_a_killed_run_and_a_killed_worker_change_nothing(nodes, undisturbed, tmp_path):
    running, _ = nodes
    out = tmp_path / "sweep"

    def kill():
        for number, pid in enumerate(trained_processes(out)[:2]):
            parent = int(subprocess.run(["ps", "-o", "ppid=", "-p", str(pid)], capture_output=True, text=True).stdout)
            with contextlib.suppress(ProcessLookupError):
                os.kill(parent if number else pid, signal.SIGKILL)

    thread = when(lambda: len(trained_processes(out)) == 2 and checkpoints(out, "CartPole-v1-DQN-small-seed0"), kill)
    result = rejeu.sweep(PLAN, out, ray=running.address)
    thread.join()
    assert result.is_complete, result.table()
    assert_equal(undisturbed, models(out))


def test_nodes_that_do_not_see_the_folder_copy_the_runs_back(nodes, undisturbed, tmp_path, monkeypatch):
    running, (first, _) = nodes
    out = tmp_path / "sweep"
    real = launcher.write_marker
    monkeypatch.setattr(launcher, "write_marker", lambda folder: (real(folder)[0], "another"))
    thread = when(
        lambda: checkpoints(out, "CartPole-v1-DQN-small-seed0") and checkpoints(out, "CartPole-v1-PPO-small-seed0"),
        lambda: running.remove_node(first, allow_graceful=False),
    )
    result = rejeu.sweep(PLAN, out, ray=running.address)
    thread.join()
    assert result.is_complete, result.table()
    assert_equal(undisturbed, models(out))


def test_mistakes_are_one_line(nodes, tmp_path, monkeypatch):
    running, _ = nodes
    with pytest.raises(ClusterError, match="no node of the Ray cluster has room for a run with CPU=64"):
        rejeu.sweep({**PLAN, "resources": {"cpus": 64}}, tmp_path / "a", ray=running.address)
    versions = cluster.versions
    monkeypatch.setattr(cluster, "versions", lambda more=(): {**versions(more), "jax": "0.0.1"})
    with pytest.raises(ClusterError, match=r"the node .* has jax .* and not 0\.0\.1 as here"):
        rejeu.sweep(PLAN, tmp_path / "b", ray=running.address)


def test_an_unreachable_cluster_is_one_line(tmp_path):
    with pytest.raises(ClusterError, match="cannot be reached"):
        rejeu.sweep(PLAN, tmp_path / "a", ray="127.0.0.1:1")


def test_room():
    assert launcher.places({"CPU": 8.0, "memory": 4e9}, Resources(cpus=0.5, memory="1 GB")) == 4
    assert launcher.requested(Resources(custom={"fast": 1})) == {
        "num_cpus": 1.0,
        "num_gpus": 0.0,
        "resources": {"fast": 1.0},
    }
