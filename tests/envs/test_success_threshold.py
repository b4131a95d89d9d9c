"""Which episodes count as successes where the environment does not say so itself."""

import json
import math
import re

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs.base import success_of
from rejeu.envs.make import InProcess, make_vector
from rejeu.lab.cli import main
from tests.environments import Counter, Reach
from tests.tiers import exhaustive

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [4]}, "n_steps": 6, "seed": 0}


def counter(**spec):
    """Episodes of 3 steps whose returns are 3, 303, 603 and so on."""
    env = Counter((3,))
    if spec:
        env.spec = gym.envs.registration.EnvSpec("Counter-v0", **spec)
    return env


def last_step(vector):
    vector.reset(seed=0)
    return vector.step(np.zeros((vector.n_envs, 1), np.float32))


@pytest.mark.parametrize(
    ("declared", "threshold", "episode_return", "expected"),
    [
        (None, 5.0, 5.0, 1.0),
        (None, 5.0, 4.999, 0.0),
        (None, -100.0, -99.0, 1.0),
        (7.0, None, 7.0, 1.0),
        (7.0, None, 6.0, 0.0),
        (7.0, 5.0, 6.0, 1.0),
        (7.0, 0.0, -1.0, 0.0),
        (None, None, 1e9, math.nan),
    ],
)
def test_a_return_is_judged_by_what_is_asked_else_by_what_is_declared(declared, threshold, episode_return, expected):
    vector = InProcess([counter() if declared is None else counter(reward_threshold=declared)])
    judged = vector.judge(last_step(vector), 0, episode_return, threshold)
    assert judged == expected or (math.isnan(judged) and math.isnan(expected))


@pytest.mark.parametrize(
    ("info", "expected"),
    [
        ({}, math.nan),
        ({"is_success": True}, 1.0),
        ({"success": True}, 1.0),
        ({"success": 0.0}, 0.0),
        ({"is_success": False, "success": True}, 0.0),
        ({"is_success": np.array([True, False])}, 0.0),
        ({"success": None}, math.nan),
        ({"is_success": math.nan}, math.nan),
        ({"is_success": np.array([1.0, math.nan])}, math.nan),
        ({"is_success": "no"}, math.nan),
        ({"success": {"door": True}}, math.nan),
        ({"success": 0.3}, 0.0),
        ({"success": -1}, 0.0),
        ({"success": 2}, 1.0),
    ],
)
def test_an_info_says_success_by_one_of_two_keys(info, expected):
    np.testing.assert_equal(success_of(info), expected)
    shown = Reach()
    shown.step = lambda action: (*Reach.step(shown, action)[:4], info)
    vector = InProcess([shown], seed=0)
    np.testing.assert_equal(vector.success(last_step(vector), 0), expected)


def test_what_the_environment_says_goes_first():
    vector = InProcess([Reach(), Reach()], seed=0)
    vector.reset()
    step = vector.step(np.zeros((2, 1), np.float32))
    for i in range(2):
        own = vector.success(step, i)
        assert vector.judge(step, i, 1e9, 0.0) == vector.judge(step, i, -1e9, 0.0) == own


@pytest.mark.parametrize("backend", ["envpool", "gymnasium"])
def test_the_environments_own_threshold_is_known_on_every_backend(backend):
    assert make_vector("CartPole-v1", 2, backend).reward_threshold == 475.0
    assert make_vector("Pendulum-v1", 2, backend).reward_threshold is None


def test_history_says_which_training_episodes_succeeded():
    agent = rejeu.A2C("MlpPolicy", counter(), success_threshold=303.0, **SMALL).learn(12)
    assert [(e.episode_return, e.success) for e in agent.history.episodes] == [
        (3.0, 0.0),
        (303.0, 1.0),
        (603.0, 1.0),
        (903.0, 1.0),
    ]
    assert agent.statistics()["rollout/success_rate"] == 0.75
    silent = rejeu.A2C("MlpPolicy", counter(), **SMALL).learn(6)
    assert all(math.isnan(e.success) for e in silent.history.episodes)


def test_evaluation_takes_a_threshold_of_its_own_else_the_agents(tmp_path):
    agent = rejeu.A2C("MlpPolicy", counter(), success_threshold=303.0, **SMALL)
    assert agent.evaluate(4, env=counter()).successes.tolist() == [0.0, 1.0, 1.0, 1.0]
    assert agent.evaluate(4, env=counter(), success_threshold=600.0).success_rate == 0.5
    loaded = rejeu.load(agent.save(tmp_path / "model"))
    assert loaded.success_threshold == 303.0
    assert loaded.evaluate(4, env=counter()).success_rate == 0.75
    assert (
        rejeu.load(tmp_path / "model.safetensors", success_threshold=600.0).evaluate(4, env=counter()).success_rate
        == 0.5
    )
    assert math.isnan(rejeu.A2C("MlpPolicy", counter(), **SMALL).evaluate(2, env=counter()).success_rate)


@exhaustive
def test_masks_and_memory_leave_the_judgement_alone():
    env = counter()
    env.action_space, env.action_masks = gym.spaces.Discrete(2), lambda: [1, 0]
    agent = rejeu.MaskablePPO("MlpPolicy", env, success_threshold=303.0, **SMALL).learn(6)
    assert [e.success for e in agent.history.episodes] == [0.0, 1.0]


@pytest.mark.parametrize("value", ["high", True, math.nan])
def test_a_bad_threshold_is_refused(value):
    with pytest.raises((TypeError, ValueError), match="success_threshold"):
        rejeu.A2C("MlpPolicy", counter(), success_threshold=value, **SMALL)


@exhaustive
def test_the_command_line_takes_thresholds(tmp_path, capsys):
    out = tmp_path / "run"
    argv = ["train", "Pendulum-v1", "--algo", "A2C", "--steps", "400", "--evaluate-every", "400"]
    argv += ["--evaluate-episodes", "2", "--seed", "0", "--out", str(out), "--success-threshold", "-1e6"]
    assert main([*argv, "--set", "policy_kwargs.net_arch=[4]"]) == 0
    assert json.loads((out / "config.json").read_text())["success_threshold"] == -1e6
    assert rejeu.load(out / "best.safetensors").success_threshold == -1e6
    assert "success 100.0%" in capsys.readouterr().out
    for more, rate in (([], "100.0%"), (["--success-threshold", "0"], "0.0%")):
        assert main(["evaluate", str(out), "--episodes", "2", "--seed", "0", *more]) == 0
        assert re.search(rf"^success {re.escape(rate)} ", capsys.readouterr().out, re.MULTILINE)
    assert (
        main(["train", "Pendulum-v1", "--steps", "5", "--success-threshold", "nan", "--out", str(tmp_path / "b")]) == 2
    )
    assert "--success-threshold" in capsys.readouterr().err
