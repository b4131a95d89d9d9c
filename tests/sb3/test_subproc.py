"""Vector environments with one process for each environment."""

import os
import signal

import numpy as np
import pytest

from rejeu.core.errors import WorkerError
from rejeu.sb3.common.monitor import Monitor
from rejeu.sb3.common.vec_env import SubprocVecEnv, VecMonitor
from tests.golden.vec_env_script import Walk
from tests.sb3.test_vec_env import replayed, walks


def test_environments_in_processes_show_what_those_in_this_process_show():
    """Lambdas, attributes, pictures, learning and errors, all with the same processes: they take seconds to begin."""
    env = SubprocVecEnv([lambda i=i: Monitor(Walk(i)) for i in range(2)])
    here = walks()
    try:
        for one in (env, here):
            one.seed(3)
        np.testing.assert_array_equal(env.reset(), here.reset())
        for _ in range(9):
            for there, expected in zip(env.step([0, 1]), here.step([0, 1]), strict=True):
                if isinstance(expected, list):
                    for info, other in zip(there, expected, strict=True):
                        assert set(info) == set(other)
                        assert info["TimeLimit.truncated"] == other["TimeLimit.truncated"]
                        if "terminal_observation" in info:
                            np.testing.assert_array_equal(info["terminal_observation"], other["terminal_observation"])
                else:
                    np.testing.assert_array_equal(there, expected)
                    assert there.dtype == expected.dtype
        assert env.get_attr("rank") == [0, 1]
        env.set_attr("scale", 2.0, indices=-1)  # counted from the end
        assert env.get_attr("scale", [1, 0]) == [2.0, 1.0]
        assert env.env_method("has_wrapper_attr", "rang") == [False, False]
        assert env.env_is_wrapped(Monitor) == [True, True]
        assert not env.has_attr("rang")
        batch = replayed(VecMonitor(env))
        np.testing.assert_array_equal(batch.next_obs[:, 0], batch.obs[:, 0] + 1)
        os.kill(env.processes[0].pid, signal.SIGINT)  # as Ctrl-C does
        assert len(env.reset()) == 2
        with pytest.raises(ValueError, match="1 actions for 2 environments"):
            env.step([0])
        env.set_attr("rank", "nonsense", indices=0)
        with pytest.raises(WorkerError, match=r"environment 0 raised an error:(.|\n)*unsupported operand"):
            env.step([0, 0])
        assert env.closed
        assert not any(worker.alive for worker in env.workers.workers)
    finally:
        env.close()


def test_an_environment_that_cannot_be_made_is_reported():
    def fail():
        raise RuntimeError("no licence")

    with pytest.raises(WorkerError, match="no licence"):
        SubprocVecEnv([fail])
    with pytest.raises(ValueError, match="empty"):
        SubprocVecEnv([])
