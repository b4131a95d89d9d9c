"""Worker processes: started safely, and what goes wrong in one is said here."""

import contextlib
import gc
import multiprocessing
import os
import pathlib
import signal
import subprocess
import sys
import textwrap
import threading
import time
from multiprocessing import forkserver

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from rejeu.core import interrupt
from rejeu.core.errors import BadEnvironmentError, WorkerError
from rejeu.envs.make import GymnasiumVector, make_vector
from rejeu.envs.workers import pool
from rejeu.sb3.common.vec_env import SubprocVecEnv
from tests.environments import Counter
from tests.helpers import small_sac
from tests.tiers import exhaustive, only
from tests.worker_environments import DrawsGlobally, Faulty, Losable, Rare


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


def drawn_globally(vector, seed):
    """What two environments draw at a reset and at a step, ``(draws, n_envs)``; what they draw when made must differ too."""
    if isinstance(vector, SubprocVecEnv):
        vector.seed(seed)
        seen = vector.reset(), vector.step(np.zeros((2, 1)))[0]
    else:
        seen = np.array(vector.reset(seed)), np.array(vector.step(np.zeros((2, 1))).obs)
    made, *rest = np.concatenate([one.T for one in seen])
    assert made[0] != made[1]
    return np.delete(rest, 2, axis=0)


@pytest.mark.parametrize("make_two", [SubprocVecEnv, lambda fns: make_vector(fns[0], 2, "gymnasium-async", seed=0)])
def test_global_generators_of_workers_differ_and_repeat_with_the_seed(make_two):
    vector = make_two([DrawsGlobally] * 2)
    try:
        first, other, again = (drawn_globally(vector, seed) for seed in (3, 50, 3))
    finally:
        vector.close()
    assert len({*first.ravel()} | {*other.ravel()}) == first.size + other.size == 16
    np.testing.assert_array_equal(first, again)


def test_workers_are_never_forked_from_this_process():
    vector = make("nothing")
    kinds = {type(worker.process).__name__ for worker in vector.workers.workers}
    assert kinds == {"ForkServerProcess" if sys.platform == "linux" else "SpawnProcess"}
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
    with pytest.raises(WorkerError, match=rf"(?s)Traceback .*worker_environments.py.*UnsendableError: {words}"):
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
    with pytest.raises(
        WorkerError, match=r"environment 1 ended by itself at 'step' \(exit code 3\); what it printed .* res"
    ):
        vector.step(np.array([[0.0], [1.0]], np.float32))
    assert not any(worker.alive for worker in vector.workers.workers)
    vector.close()


def children():
    return multiprocessing.active_children()


def actions(*given):
    return np.array(given, np.float32)[:, None]


@pytest.mark.parametrize("act", [1, 2])
def test_a_worker_that_crashes_or_hangs_is_named_and_all_are_ended(act):
    began = time.monotonic()
    vector = make_vector(Losable, 3, "gymnasium-async", seed=0, worker_timeout=1.0)
    vector.reset()
    words = (
        r"environment 1 ended by itself at 'step' \(exit code (-9, SIGKILL|9)\)"
        if act == 1
        else r"environment 1 gave no answer to 'step' for 1 seconds; a longer worker_timeout"
    )
    with pytest.raises(WorkerError, match=words):
        vector.step(actions(0, act, 0))
    assert time.monotonic() - began < 60
    assert not children()
    with pytest.raises(WorkerError, match="create the environments again"):
        vector.reset()
    vector.close()


@pytest.mark.parametrize("act", only([1], [1, 2]))
def test_a_lost_worker_is_started_anew_and_its_episode_truncated(act):
    vector = make_vector(Losable, 2, "gymnasium-async", seed=0, worker_timeout=1.0, restart_workers=1)
    vector.reset()
    before = np.array(vector.step(actions(0, 0)).obs)
    with pytest.warns(RuntimeWarning, match=r"environment 1 .*'step'.*restarted \(1 of at most 1 times\).*truncated"):
        step = vector.step(actions(0, act))
    assert step.truncated.tolist() == [False, True]
    assert not step.terminated.any()
    assert step.reward[1] == 0.0
    assert "environment 1" in step.info[1]["worker_restarted"]
    np.testing.assert_array_equal(step.obs[1], before[1])
    np.testing.assert_array_equal(step.obs[0, :2], [0, 2])
    obs = vector.reset_done(step.truncated)
    np.testing.assert_array_equal(obs[:, :2], [[0, 2], [0, 0]])
    assert obs[1, 2] not in before[:, 2]  # drawn from another seed
    np.testing.assert_array_equal(vector.step(actions(0, 0)).obs[:, 1], [3, 1])
    with pytest.raises(WorkerError, match="and 1 restarts are spent"):
        vector.step(actions(0, act))
    assert not children()


def test_a_worker_lost_at_a_reset_is_started_anew(tmp_path):
    crash = tmp_path / "crash"
    vector = make_vector(lambda: Losable(crash), 1, "gymnasium-async", seed=0, restart_workers=2)
    vector.reset()
    crash.touch()
    with pytest.warns(RuntimeWarning, match=r"ended by itself at 'reset' \(exit code 5\); it is restarted"):
        np.testing.assert_array_equal(vector.reset()[0, :2], [0, 0])
    vector.close()


def test_training_goes_on_where_workers_are_started_anew():
    vector = make_vector(Rare, 2, "gymnasium-async", seed=0, restart_workers=99)
    agent = small_sac(vector, learning_starts=99)
    with pytest.warns(RuntimeWarning, match="restarted"):
        agent.learn(60)
    assert agent.num_timesteps == 60
    assert 0 < vector.workers.restarts_left < 99
    buffer = agent.replay_buffer.arrays()
    assert np.isfinite(buffer["reward"]).all()
    vector.close()


def test_a_subproc_vector_replaces_lost_processes_too():
    env = SubprocVecEnv([Losable] * 2, restart_workers=1)
    try:
        env.reset()
        before = env.step(actions(0, 0))[0]
        with pytest.warns(RuntimeWarning, match="environment 0 ended by itself"):
            obs, rewards, dones, infos = env.step(actions(1, 0))
        assert (dones.tolist(), rewards[0], infos[0]["TimeLimit.truncated"]) == ([True, False], 0.0, True)
        np.testing.assert_array_equal(infos[0]["terminal_observation"], before[0])
        np.testing.assert_array_equal(obs[:, 1], [0, 2])
        with pytest.raises(WorkerError, match=r"environment 1 ended by itself .*restarts are spent"):
            env.step(actions(0, 1))
        assert env.closed
    finally:
        env.close()
    assert not children()


def test_answers_that_nobody_fetched_are_dropped():
    """As after a Ctrl-C that came between question and answer."""
    vector = make("nothing")
    vector.reset()
    vector.workers.send({i: ("step", np.zeros(1, np.float32)) for i in range(2)})
    np.testing.assert_array_equal(vector.step(actions(0, 0)).obs[:, 1], 2)
    vector.workers.send({0: ("step", np.zeros(1, np.float32))})
    np.testing.assert_array_equal(vector.reset_done(np.array([True, False]))[:, 1], [0, 2])
    vector.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"worker_timeout": 0}, "worker_timeout=0 must be a number of seconds above 0, or None"),
        ({"restart_workers": -1}, "restart_workers=-1 must be a whole number"),
        ({"restart_workers": 1, "backend": "gymnasium"}, "got backend='gymnasium'.*use backend='gymnasium-async'"),
        ({"ray": {"num_cpus": 1}}, "is for backend='ray', got backend='gymnasium-async'"),
    ],
)
def test_options_of_workers_are_checked(options, words):
    with pytest.raises(ValueError, match=words):
        make_vector(Losable, 2, **{"backend": "gymnasium-async", **options})


def test_nothing_is_left_after_an_exception_or_a_vector_let_go():
    before = open_files()
    vector = make("step")
    vector.reset()
    with pytest.raises(WorkerError, match="wheel"):
        vector.step(np.ones((2, 1), np.float32))
    np.testing.assert_array_equal(vector.reset()[:, 1], 0)  # the processes are still there
    vector.close()
    vector.close()
    assert not children()
    assert open_files() <= before
    vector = make("nothing")
    del vector
    gc.collect()
    assert not children()


def open_files():
    """How many handles this process has, where that can be seen; the server of workers has one for good."""
    make_vector(Counter, 1, "gymnasium-async").close()
    gc.collect()
    folder = pathlib.Path("/proc/self/fd")
    return len(list(folder.iterdir())) if folder.exists() else 0


def test_spaces_that_differ_are_noticed(tmp_path):
    class Other(Counter):
        def __init__(self):
            super().__init__()
            if multiprocessing.parent_process() is not None:
                self.observation_space = gym.spaces.Box(-1.0, 1.0, (2,))

    with pytest.raises(BadEnvironmentError, match=r"environment 0: its spaces are Box.* all must be the same"):
        make_vector(Other, 2, "gymnasium-async")
    assert not children()


@pytest.mark.skipif(os.name == "nt", reason="os.kill ends a process on Windows, whatever the signal")
@pytest.mark.parametrize("number", [*interrupt.NAMES], ids=[*interrupt.NAMES.values()])
def test_a_request_to_stop_leaves_the_workers_at_work(number):
    """Terminals, timeout and SLURM send it to every process; the main one may want to finish the step that it is in."""
    vector = make("nothing")
    vector.reset()
    servers = [forkserver._forkserver._forkserver_pid] if pool.START_METHOD == "forkserver" else []
    for pid in (*servers, *(worker.process.pid for worker in vector.workers.workers)):
        os.kill(pid, number)
    np.testing.assert_array_equal(vector.step(np.zeros((2, 1), np.float32)).obs[:, 1], 1)
    assert all(worker.alive for worker in vector.workers.workers)  # which only a fork server that lives can say
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
    env = AsyncVectorEnv([Counter] * 2, shared_memory=False, context=pool.START_METHOD)
    with pytest.raises(
        ValueError,
        match=r"AsyncVectorEnv without shared memory .*autoreset_mode=gymnasium.vector.AutoresetMode.DISABLED",
    ):
        GymnasiumVector(env)
    env.close()


# The main script, which every worker imports.


@exhaustive
@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C reaches a process by another way")
def test_nothing_is_left_after_ctrl_c(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        textwrap.dedent(
            """
            import time
            import numpy as np
            import rejeu
            from gymnasium.envs.classic_control import PendulumEnv

            class Slow(PendulumEnv):
                def step(self, action):
                    time.sleep(100)

            if __name__ == "__main__":
                env = rejeu.make_vector(Slow, 2, "gymnasium-async")
                env.reset()
                print(*(worker.process.pid for worker in env.workers.workers), flush=True)
                env.step(np.zeros((2, 1)))
            """
        )
    )
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as ran:
        pids = [int(pid) for pid in ran.stdout.readline().split()]
        assert len(pids) == 2
        ran.send_signal(signal.SIGINT)
        assert "KeyboardInterrupt" in ran.communicate(timeout=60)[1]
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def run_script(tmp_path, text):
    script = tmp_path / "script.py"
    script.write_text(textwrap.dedent(text))
    return subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120, check=False)


def test_a_script_without_a_guard_is_told_so(tmp_path):
    ran = run_script(
        tmp_path,
        """
        import rejeu
        rejeu.make_vector("Pendulum-v1", 2, "gymnasium-async")
        """,
    )
    assert ran.returncode == 1
    assert "must stand under `if __name__ == '__main__':`" in ran.stderr.splitlines()[-1]


@exhaustive
def test_a_script_with_a_guard_makes_workers(tmp_path):
    ran = run_script(
        tmp_path,
        """
        import gymnasium
        import numpy
        import rejeu
        from gymnasium.envs.classic_control import PendulumEnv

        class Mine(PendulumEnv):
            pass

        if __name__ == "__main__":
            gymnasium.register("Mine-v0", Mine)
            env = rejeu.make_vector("Mine-v0", 2, "gymnasium-async")
            print(env.reset().shape, env.step(numpy.zeros((2, 1))).reward.shape)
            env.close()
        """,
    )
    assert (ran.stdout, ran.stderr) == ("(2, 3) (2,)\n", "")


def test_worker_processes_do_not_import_jax():
    """It would take a second and 100 MB in each of them."""
    code = "import sys, rejeu.envs.workers.process, tests.worker_environments; print('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


@exhaustive
def test_files_of_the_current_folder_take_no_place_of_modules_in_a_worker(tmp_path):
    """As where the command rejeu runs, whose path begins with the folder of its script."""
    (tmp_path / "here").mkdir()
    for name in ("random", "socket", "tempfile"):
        (tmp_path / "here" / f"{name}.py").write_text("open('ran', 'w')", encoding="utf-8")
    script = tmp_path / "script.py"
    script.write_text(
        "import os, rejeu\n"
        "if __name__ == '__main__':\n"
        "    env = rejeu.make_vector('CartPole-v1', 2, 'gymnasium-async')\n"
        "    env.reset(); env.close()\n"
        "    print('PYTHONSAFEPATH' in os.environ)\n",
        encoding="utf-8",
    )
    ended = subprocess.run([sys.executable, str(script)], cwd=tmp_path / "here", capture_output=True, text=True)
    assert (ended.returncode, ended.stdout.strip()) == (0, "False"), ended.stderr
    assert not (tmp_path / "here" / "ran").exists()


def test_an_environment_of_a_worker_starts_processes_as_in_this_process():
    class Asked(Counter):
        def variable(self):
            return os.environ.get("PYTHONSAFEPATH")

    with contextlib.closing(make_vector(lambda: Asked((3,)), 1, "gymnasium-async")) as vector:
        assert vector.call("variable") == [os.environ.get("PYTHONSAFEPATH")]
