"""Environments in Ray actors: the same as in local workers, and what becomes of lost machines."""

import contextlib
import functools
import os
import subprocess
import sys
import textwrap
import time
import warnings

import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core.errors import WorkerError
from rejeu.envs.make import make_vector
from rejeu.envs.workers import pool, remote
from tests.envs import ray_cluster
from tests.helpers import assert_same_parameters, small_sac
from tests.worker_environments import Losable, Paced, imports_jax, process_id

pytestmark = [
    pytest.mark.exhaustive,
    pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning"),  # Ray starts nodes so; each is another program at once
]
pytest.importorskip("ray")


@pytest.fixture(scope="module", autouse=True)
def nodes():
    with ray_cluster.running() as (running, nodes):
        os.environ["RAY_ADDRESS"] = running.address
        try:
            yield running, nodes
        finally:
            del os.environ["RAY_ADDRESS"]


@pytest.fixture(autouse=True)
def disconnected():
    yield
    import ray

    assert not ray.is_initialized()


def opened(make, n_envs=2, **options):
    return contextlib.closing(make_vector(make, n_envs, "ray", seed=0, **options))


def actions(*given):
    return np.array(given, np.float32)[:, None]


def test_actors_walk_as_the_environments_in_this_process_do():
    with opened("Pendulum-v1") as ours, contextlib.closing(make_vector("Pendulum-v1", 2, "gymnasium", seed=0)) as own:
        assert (ours.backend, ours.env_id, ours.max_episode_steps) == ("ray", "Pendulum-v1", 200)
        np.testing.assert_array_equal(ours.reset(), own.reset())
        rng = np.random.default_rng(0)
        for _ in range(210):
            action = rng.uniform(-2, 2, (2, 1)).astype(np.float32)
            step, other = ours.step(action), own.step(action)
            np.testing.assert_array_equal(step.obs, other.obs)
            np.testing.assert_array_equal(step.reward, other.reward)
            np.testing.assert_array_equal(step.truncated, other.truncated)
            if step.truncated.any():
                np.testing.assert_array_equal(ours.reset_done(step.truncated), own.reset_done(step.truncated))
        active = np.array([True, False])
        np.testing.assert_array_equal(ours.step(action, active).obs, own.step(action, active).obs)
        np.testing.assert_array_equal(ours.reset([5, 9]), own.reset([5, 9]))


def test_actors_do_not_import_jax_and_end_with_the_vector():
    with opened(Paced, 3) as vector:
        assert vector.workers.ask(dict.fromkeys(range(3), ("call", imports_jax))) == dict.fromkeys(range(3), False)
        pids = [*vector.workers.ask(dict.fromkeys(range(3), ("call", process_id))).values()]
        assert len({*pids, os.getpid()}) == 4
    assert_gone(pids)


def assert_gone(pids, seconds=20):
    """Asserts that processes have ended, or do so soon."""
    deadline = time.monotonic() + seconds
    while any(is_running(pid) for pid in pids):
        assert time.monotonic() < deadline, "actors are still running"
        time.sleep(0.1)


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("ends", ["return", "raise SystemExit(3)", "1 / 0", "os.kill(os.getpid(), signal.SIGKILL)"])
def test_nothing_is_left_when_a_program_ends(tmp_path, ends):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import os, signal
            import rejeu
            from tests.worker_environments import Paced, process_id

            def main():
                env = rejeu.make_vector(Paced, 2, "ray")
                env.reset()
                print(*env.workers.ask(dict.fromkeys(range(2), ("call", process_id))).values(), flush=True)
                {ends}

            if __name__ == "__main__":
                main()
            """
        )
    )
    ran = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)
    pids = [int(word) for word in ran.stdout.splitlines()[0].split()]
    assert len(pids) == 2
    assert_gone(pids)


@pytest.mark.parametrize("act", [1, 2])
def test_an_actor_that_crashes_or_hangs_is_named_and_all_are_ended(act):
    with opened(Losable, 3, worker_timeout=2.0) as vector:
        pids = [*vector.workers.ask(dict.fromkeys(range(3), ("call", process_id))).values()]
        vector.reset()
        words = (
            "ended by itself at 'step'"
            if act == 1
            else "gave no answer to 'step' for 2 seconds; a longer worker_timeout"
        )
        with pytest.raises(WorkerError, match=f"the Ray actor of environment 1 on node 127.0.0.1 {words}"):
            vector.step(actions(0, act, 0))
        with pytest.raises(WorkerError, match="create the environments again"):
            vector.reset()
    assert_gone(pids)


@pytest.mark.parametrize("act", [1, 2])
def test_a_lost_actor_is_replaced_and_its_episode_truncated(act):
    with opened(Losable, 2, worker_timeout=3.0, restart_workers=1) as vector:
        before = vector.reset().copy()
        with pytest.warns(
            RuntimeWarning, match=r"environment 1 .*'step'.*restarted \(1 of at most 1 times\).*truncated"
        ):
            step = vector.step(actions(0, act))
        assert step.truncated.tolist() == [False, True]
        assert step.reward[1] == 0.0
        assert "environment 1" in step.info[1]["worker_restarted"]
        np.testing.assert_array_equal(step.obs[1], before[1])
        assert vector.reset_done(step.truncated)[1, 2] != before[1, 2]  # drawn from another seed
        assert vector.step(actions(0, 0)).obs[1, 1] == 1


def test_a_run_resumes_exactly(tmp_path):
    def train(n, env, callback=None):
        return small_sac(env).learn(n, callback)

    with opened("Pendulum-v1") as env:
        whole = train(60, env)
    with opened("Pendulum-v1") as env:
        small_sac(env).learn(60, [lambda agent, turn: turn.step < 30, Checkpoint(tmp_path, every=10)])
    with opened("Pendulum-v1") as env:
        again = rejeu.SAC.resume(tmp_path, env)
        assert again.resumed.exact
        again.learn()
    assert_same_parameters(whole, again)


def test_environments_without_a_place_are_named(monkeypatch):
    monkeypatch.setattr(pool, "START_SECONDS", 3.0)
    monkeypatch.setattr(remote, "SLOW_START_SECONDS", 1.0)
    with (
        pytest.warns(RuntimeWarning, match="environment 0 waits for a place on the cluster, of which each"),
        pytest.raises(
            WorkerError, match=r"environment 0 found no place .*'num_cpus': 99.*, and which has 16 CPUs in all"
        ),
    ):
        make_vector(Paced, 1, "ray", ray={"num_cpus": 99}, worker_timeout=2.0)


def test_a_cluster_that_the_program_is_connected_to_stays_connected(nodes):
    import ray

    ray.init(address=nodes[0].address)
    try:
        with opened(Paced) as one, opened(Paced) as two:
            one.reset()
            two.reset()
        assert ray.is_initialized()
    finally:
        ray.shutdown()


def test_a_node_is_lost_in_the_middle_of_training(nodes):
    running, (first, *_) = nodes
    extra = running.add_node(**ray_cluster.LOOPBACK, num_cpus=8, resources={"extra": 8})
    running.remove_node(first, allow_graceful=False)
    with opened(functools.partial(Paced, 0.01), 4, restart_workers=8, ray={"num_cpus": 2}) as env:
        agent, lost = small_sac(env), []

        def kill(agent, turn):
            if turn.step >= 60 and not lost:
                lost.append(extra)
                running.remove_node(extra, allow_graceful=False)
            time.sleep(0.05 if lost and not caught else 0)  # until Ray's worker processes notice

        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            agent.learn(400, kill)
        assert agent.num_timesteps == 400
        restarted = [str(one.message) for one in caught if "it is restarted" in str(one.message)]
        assert restarted
        assert all("the Ray actor of environment" in text for text in restarted)
        assert 8 - env.workers.restarts_left == len(restarted)
        assert np.isfinite(agent.replay_buffer.arrays()["reward"]).all()
