"""What a notebook shows: IPython's own formatters and display messages, without a kernel."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
from IPython.core.interactiveshell import InteractiveShell

import rejeu
from rejeu.evaluation import Evaluation
from rejeu.history import History
from rejeu.loops.host import Episode
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize

NAN = math.nan


def formatted(thing):
    return InteractiveShell().display_formatter.format(thing)[0]


def test_an_evaluation_shows_its_numbers():
    evaluation = Evaluation(np.array([1.0, 3.0]), np.array([10, 20]), np.array([1.0, 0.0]))
    shown = formatted(evaluation)
    assert shown["text/plain"] == f"<Evaluation: {evaluation}>"
    assert "success 50.0%" in shown["text/plain"]
    assert "return 2.00 ± 1.00" in shown["text/plain"]
    assert (
        "<tr><th>return</th><td>2.00</td><td>-10.71 to 14.71</td><td>1.00</td></tr>" in shown["text/html"]
    )  # t = 12.706
    assert "<tr><th>success</th><td>50.0%</td>" in shown["text/html"]


def test_an_evaluation_without_successes_has_no_row_for_them():
    shown = formatted(Evaluation(np.ones(3), np.ones(3), np.full(3, NAN)))
    assert "success" not in shown["text/html"] + shown["text/plain"]


def test_a_history_shows_a_summary():
    rows = [(100 * (i + 1), 0, float(i), 50 + i % 2, float(i % 2), 0.5) for i in range(1_000)]
    assert formatted(History(Episode(*row) for row in rows))["text/plain"] == (
        "<History: 1,000 episodes in 100,000 steps; mean of the last 20: return 989.50, length 50.5, success 50%>"
    )
    assert repr(History([Episode(9, 0, -1.0, 9, NAN, 0.5)])) == (
        "<History: 1 episode in 9 steps; mean of the last 1: return -1.00, length 9.0>"
    )
    assert repr(History()) == "<History: no episodes>"


def test_vector_environments_show_what_they_step():
    assert repr(rejeu.make_vector("Pendulum-v1", 2, "gymnasium")) == "<InProcess: 2 x Pendulum-v1, backend 'gymnasium'>"
    inside = DummyVecEnv([lambda: gym.make("CartPole-v1")] * 2)
    assert repr(inside).startswith("<DummyVecEnv: 2 environments, observations Box(")
    assert repr(VecNormalize(inside)).endswith("actions Discrete(2)>")
