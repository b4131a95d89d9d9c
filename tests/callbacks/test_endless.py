"""Environments whose episodes do not end: found before training, and evaluated for a limited time that Ctrl-C ends."""

import os
import re
import signal
import sys

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint, Evaluate
from rejeu.envs import checker
from rejeu.lab.cli import main
from rejeu.lab.runs.read import read_run
from rejeu.logs import evaluation
from tests.helpers import assert_same_parameters, small_sac
from tests.lab.cli.test_cli import FEWER_FILES, TINY

SOURCE = """
import gymnasium as gym, numpy as np

class Endless(gym.Env):
    observation_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.full(2, 0.5, np.float32), 1.0, False, False, {}

gym.register("Endless-v0", "endless_env:Endless")
"""

pytestmark = pytest.mark.usefixtures("learners_are_shared")


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(evaluation, "MOST_STEPS", 40)
    (tmp_path / "endless_env.py").write_text(SOURCE)
    yield tmp_path
    gym.registry.pop("Endless-v0", None)
    sys.modules.pop("endless_env", None)


@pytest.mark.filterwarnings("always::UserWarning")
def test_training_ends_although_no_episode_does(here, capsys, monkeypatch):
    monkeypatch.setattr(checker, "QUICK", checker.QUICK._replace(seconds=60.0))  # not fewer steps on a slow machine
    words = ["train", "endless_env.py", "--steps", "60", "--out", "run", "--evaluate-episodes", "3", "--log", "json"]
    assert main([*words, *FEWER_FILES, "--set", *TINY]) == 0
    text = capsys.readouterr()
    assert "no episode ended in 500 steps" in text.err
    assert "3 episodes of an evaluation did not end in 40 steps and were cut off" in text.err
    assert re.search(r"evaluating the final policy on 3 episodes.*\n(.*\n)*step +60 +return 40\.00", text.out)
    assert read_run("run").state == "finished"


class Interrupting(gym.Wrapper):
    """Asks the process to stop at its n-th step, once."""

    left = -1

    def step(self, action):
        Interrupting.left -= 1
        if Interrupting.left == 0:
            os.kill(os.getpid(), signal.SIGINT)
        return self.env.step(action)


@pytest.mark.parametrize("at", [100, 300], ids=["between", "at the end"])
def test_a_signal_ends_an_evaluation_and_the_resumed_run_repeats_it(tmp_path, at):
    def train(folder, agent, steps=None):
        evaluate = Evaluate(lambda: Interrupting(gym.make("Pendulum-v1")), every=40, episodes=1, seed=1)
        agent.learn(steps, [evaluate, Checkpoint(tmp_path / folder, minutes=60)])
        return agent, evaluate

    agent, whole = train("whole", small_sac("Pendulum-v1"), 80)
    Interrupting.left = at
    stopped, cut = train("cut", small_sac("Pendulum-v1"), 80)
    assert stopped.interrupted
    assert len(cut.results) < len(whole.results)
    again = rejeu.SAC.resume(tmp_path / "cut")
    if at == 100:
        again, resumed = train("cut", again)
        np.testing.assert_array_equal(
            [one.evaluation.returns for one in whole.results], [one.evaluation.returns for one in resumed.results]
        )
    assert_same_parameters(agent, again)


def test_the_check_finds_it_however_slow_the_machine_is(here, capsys, monkeypatch):
    monkeypatch.setattr(checker, "MOST_SECONDS", 0.0)
    assert main(["check", "endless_env.py"]) == 0
    assert "no episode ended in 2,000 steps; it declares no time limit" in capsys.readouterr().out
