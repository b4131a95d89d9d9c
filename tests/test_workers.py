"""Worker processes: started safely, and what goes wrong in one is said here."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import sys
import textwrap
import threading

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from rejeu.envs import workers
from rejeu.envs.vector import GymnasiumVector, make_vector
from rejeu.errors import WorkerError
from tests.environments import Counter


class UnsendableError(Exception):
    """An exception that pickle can neither write nor read again."""

    def __init__(self, code, text):
        super().__init__(text)
        self.lock = threading.Lock()


class Faulty(Counter):
    """Fails in worker processes, in the way that ``fault`` says."""

    def __init__(self, fault):
        super().__init__((3,))
        self.fault = fault
        if fault == "make" and multiprocessing.parent_process() is not None:
            raise UnsendableError(1, "no such device")

    def reset(self, **kwargs):
        if self.fault == "reset":
            raise UnsendableError(1, "cannot begin")
        return super().reset(**kwargs)

    def step(self, action):
        if action[0] > 0.5:
            if self.fault == "exit":
                os._exit(3)
            raise UnsendableError(1, "the wheel came off")
        return super().step(action)


def make(fault, n_envs=2):
    return make_vector(lambda: Faulty(fault), n_envs, "gymnasium-async", seed=0)


def test_workers_walk_as_the_environments_in_this_process_do():
    walks = []
    for backend in ("gymnasium", "gymnasium-async"):
        vector = make_vector("Pendulum-v1", 2, backend, seed=3)
        assert vector.backend == backend
        obs, rows = vector.reset(), []
        rng = np.random.default_rng(0)
        for _ in range(210):
            obs = np.array(obs)
            step = vector.step(rng.uniform(-2, 2, (2, 1)).astype(np.float32))
            done = step.terminated | step.truncated
            rows.append((obs, np.array(step.obs), step.reward, done))
            obs = vector.reset_done(done) if done.any() else step.obs
        walks.append(rows)
        vector.close()
    for one, two in zip(*walks, strict=True):
        for left, right in zip(one, two, strict=True):
            np.testing.assert_array_equal(left, right)


def test_workers_are_never_forked_from_this_process():
    vector = make("nothing")
    env = vector.env
    assert (env.context, env.shared_memory, env.autoreset_mode) == (workers.START_METHOD, True, AutoresetMode.DISABLED)
    assert workers.START_METHOD in ("forkserver", "spawn")
    vector.close()


def test_a_vector_of_workers_knows_what_it_was_made_of():
    vector = make_vector("MountainCar-v0", 2, "gymnasium-async")
    assert (vector.env_id, vector.max_episode_steps, vector.reward_threshold) == ("MountainCar-v0", 200, -110.0)
    vector.close()
    given = make_vector(SyncVectorEnv([lambda: gym.make("MountainCar-v0")] * 2))
    assert (given.env_id, given.max_episode_steps, given.reward_threshold) == ("MountainCar-v0", 200, -110.0)


def test_environments_registered_in_this_process_reach_the_workers(monkeypatch):
    monkeypatch.setitem(gym.registry, "OnlyHere-v0", EnvSpec("OnlyHere-v0", Counter, max_episode_steps=2))
    vector = make_vector("OnlyHere-v0", 2, "gymnasium-async")
    vector.reset()
    vector.step(np.zeros((2, 1), np.float32))
    assert vector.step(np.zeros((2, 1), np.float32)).truncated.all()
    vector.close()


@pytest.mark.parametrize(
    ("fault", "words"), [("make", "no such device"), ("reset", "cannot begin"), ("step", "the wheel came off")]
)
def test_the_traceback_of_a_worker_reaches_the_user(fault, words):
    with pytest.raises(WorkerError, match=rf"(?s)Traceback .*test_workers.py.*UnsendableError: {words}"):
        make_and_step(fault)


def make_and_step(fault):
    with contextlib.closing(make(fault)) as vector:
        vector.reset()
        vector.step(np.array([[0.0], [1.0]], np.float32))


def test_the_environments_that_failed_are_named():
    vector = make("step", 3)
    vector.reset()
    with pytest.raises(WorkerError, match="environments 0, 2 failed in a worker process"):
        vector.step(np.array([[1.0], [0.0], [1.0]], np.float32))
    vector.close()


def test_a_worker_that_is_gone_is_reported():
    vector = make("exit")
    vector.reset()
    with pytest.raises(WorkerError, match="ended by itself: that of environment 1 with exit code 3"):
        vector.step(np.array([[0.0], [1.0]], np.float32))
    assert not any(process.is_alive() for process in vector.env.processes)
    vector.close()


def test_ctrl_c_leaves_the_workers_at_work():
    """A terminal sends it to every process; the main one may want to finish the step that it is in."""
    vector = make("nothing")
    vector.reset()
    for process in vector.env.processes:
        os.kill(process.pid, signal.SIGINT)
    np.testing.assert_array_equal(vector.step(np.zeros((2, 1), np.float32)).obs[:, 1], 1)
    vector.close()


def test_a_function_that_cannot_be_sent_is_refused():
    lock = threading.Lock()

    class Locked(Counter):
        held = lock

    with pytest.raises(
        TypeError, match=r"sent to worker processes, and cannot be pickled: .*lock.*backend='gymnasium'"
    ):
        make_vector(lambda: Locked((3,)), 2, "gymnasium-async")


def test_a_self_resetting_vector_without_shared_memory_is_refused():
    """Its workers forget a masked reset, and would reset once more instead of taking the next step."""
    env = AsyncVectorEnv([Counter] * 2, shared_memory=False, context=workers.START_METHOD)
    with pytest.raises(
        ValueError, match=r"AsyncVectorEnv without shared memory .*autoreset_mode=AutoresetMode.DISABLED"
    ):
        GymnasiumVector(env)
    env.close()


# The main script, which every worker imports.


def run_script(tmp_path, text):
    script = tmp_path / "script.py"
    script.write_text(textwrap.dedent(text))
    return subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)


def test_a_script_without_a_guard_is_told_so(tmp_path):
    ran = run_script(
        tmp_path,
        """
        import rejeu
        print("began")
        rejeu.make_vector("Pendulum-v1", 2, "gymnasium-async")
        """,
    )
    assert ran.stdout == "began\n"
    assert "must stand under `if __name__ == '__main__':`" in ran.stderr.splitlines()[-1]


def test_a_script_with_a_guard_makes_workers(tmp_path):
    ran = run_script(
        tmp_path,
        """
        import gymnasium
        import rejeu
        from gymnasium.envs.classic_control import PendulumEnv

        class Mine(PendulumEnv):
            pass

        if __name__ == "__main__":
            gymnasium.register("Mine-v0", Mine)
            env = rejeu.make_vector("Mine-v0", 2, "gymnasium-async")
            print(env.reset().shape, env.step(env.env.action_space.sample()).reward.shape)
            env.close()
        """,
    )
    assert (ran.stdout, ran.stderr) == ("(2, 3) (2,)\n", "")


def test_where_a_script_stands_is_told_from_its_text(tmp_path):
    ran = run_script(
        tmp_path,
        """
        import threading
        from rejeu.envs.workers import main_runs_again

        def ask():
            print(main_runs_again())

        ask()
        if __name__ == "__main__":
            ask()
            thread = threading.Thread(target=ask)
            thread.start()
            thread.join()
        """,
    )
    assert ran.stdout.split() == ["True", "False", "None"]
    asked = "from rejeu.envs.workers import main_runs_again as ask; print(ask())"
    assert subprocess.run([sys.executable, "-c", asked], capture_output=True, text=True, check=True).stdout == "False\n"
