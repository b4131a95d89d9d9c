"""Workers that connect from elsewhere, with a stand-in for Ray whose actors are threads; test_ray.py has the real one."""

import contextlib
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from rejeu.core.errors import ClusterError, WorkerError
from rejeu.envs.make import make_vector
from rejeu.envs.workers import cluster, process, remote
from tests.worker_environments import Paced


class GetTimeoutError(Exception):
    pass


class RayError(Exception):
    pass


class RayTaskError(RayError):
    cause = ModuleNotFoundError("No module named 'my_env'")


class Task:
    """Runs a function in a thread; the first ``n_failures`` tasks end with ``error`` before they begin."""

    n_failures, error = 0, RayError("The actor never ran")

    def __init__(self, function, *arguments):
        self.failed = Task.n_failures > 0
        Task.n_failures -= self.failed
        self.thread = threading.Thread(target=lambda: None if self.failed else function(*arguments), daemon=True)
        self.thread.start()


class Ray(SimpleNamespace):
    """The part of Ray that is used."""

    util = SimpleNamespace(get_node_ip_address=lambda: "127.0.0.1")
    exceptions = SimpleNamespace(GetTimeoutError=GetTimeoutError, RayError=RayError, RayTaskError=RayTaskError)

    def remote(self, kind):
        def made():
            actor = kind()
            return SimpleNamespace(serve=SimpleNamespace(remote=lambda *arguments: Task(actor.serve, *arguments)))

        return SimpleNamespace(options=lambda **options: SimpleNamespace(remote=made))

    def wait(self, tasks, timeout):
        tasks[0].thread.join(timeout)
        return ([], tasks) if tasks[0].thread.is_alive() else (tasks, [])

    def get(self, task, timeout):
        if task.failed:
            raise Task.error
        task.thread.join(timeout)
        if task.thread.is_alive():
            raise GetTimeoutError

    def kill(self, actor, no_restart):
        pass

    def is_initialized(self):
        return True

    def cluster_resources(self):
        return {"CPU": 2.0}


@pytest.fixture(autouse=True)
def ray(monkeypatch):
    ray = Ray(closed=[])
    monkeypatch.setattr(process, "node_address", lambda: "10.0.0.7")
    monkeypatch.setattr(remote, "LOOK_SECONDS", 0.05)
    monkeypatch.setattr(
        cluster,
        "connect",
        lambda address: SimpleNamespace(ray=ray, is_local=False, close=lambda: ray.closed.append(address)),
    )
    return ray


def opened(n_envs=2, **options):
    return contextlib.closing(make_vector(Paced, n_envs, "ray", seed=0, **options))


def test_environments_elsewhere_walk_as_those_here_do(ray):
    with opened(ray={"address": "auto"}) as ours, contextlib.closing(make_vector(Paced, 2, "gymnasium", seed=0)) as own:
        np.testing.assert_array_equal(ours.reset(), own.reset())
        for _ in range(12):
            action = np.full((2, 1), 0.3, np.float32)
            step, other = ours.step(action), own.step(action)
            np.testing.assert_array_equal(step.obs, other.obs)
            np.testing.assert_array_equal(step.reward, other.reward)
            done = step.terminated | step.truncated
            np.testing.assert_array_equal(done, other.terminated | other.truncated)
            if done.any():
                np.testing.assert_array_equal(ours.reset_done(done), own.reset_done(done))
    assert ray.closed == ["auto"]


def test_an_actor_that_never_ran_is_started_again(monkeypatch):
    monkeypatch.setattr(Task, "n_failures", 3)
    with opened() as vector:
        assert vector.reset().shape == (2, 3)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RayTaskError(), r"environment 0 could not be started: ModuleNotFoundError: No module named 'my_env'$"),
        (RayError("The actor died.\nOut of memory Some common causes are: many"), "started: Out of memory$"),
    ],
)
def test_an_actor_that_cannot_be_started_is_named(ray, monkeypatch, error, words):
    monkeypatch.setattr(Task, "n_failures", 99)
    monkeypatch.setattr(Task, "error", error)
    with pytest.raises(WorkerError, match=words):
        make_vector(Paced, 2, "ray")
    assert ray.closed == [None]


def test_another_version_is_refused(ray, monkeypatch):
    monkeypatch.setattr(process.cluster, "versions", iter([{"rejeu": "1"}, {"rejeu": "2"}]).__next__)
    with pytest.raises(
        ClusterError, match=r"^node 10\.0\.0\.7 has rejeu 1 and not 2 as here; install the same versions"
    ):
        make_vector(Paced, 1, "ray")
    assert ray.closed == [None]


def test_connections_without_a_token_are_closed(monkeypatch):
    monkeypatch.setattr(remote, "TOKEN_SECONDS", 0.2)
    actors = remote.Actors({})
    address = actors._server.getsockname()
    for sent in (b"", b"short", bytes(process.TOKEN_BYTES)):
        with socket.create_connection(address) as stranger:
            stranger.sendall(sent)
            began = time.monotonic()
            actors.accept(1.0)
            assert time.monotonic() - began < 5
            assert stranger.recv(1) == b""
    actors.accept(0.01)  # nobody
    actors.close()


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"num_cpu": 1}, TypeError, "did you mean num_cpus"),
        ({"num_cpus": -1}, ValueError, "num_cpus=-1 must be"),
        ({"resources": {"fast": "two"}}, ValueError, "fast"),
        ({"resources": 1}, TypeError, "dict of numbers by name"),
        ({"address": 6379}, TypeError, "'HOST:PORT' or 'auto'"),
    ],
)
def test_options_are_checked(options, error, words):
    with pytest.raises(error, match=words):
        make_vector(Paced, 1, "ray", ray=options)
