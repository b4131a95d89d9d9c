"""NaN on the device: the error says in which steps, and the agent has the state before them."""

import re
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import rejeu
from tests.jax_environments import Breaks, Undefined
from tests.training.compiled import test_on_policy as on_policy
from tests.training.compiled.test_off_policy import learn_on_host, make

HINDSIGHT = {"replay_buffer_class": "HerReplayBuffer", "action_noise": 0.3}
HUGE = {"learning_rate": 1e30}


@pytest.mark.parametrize(
    "what",
    ["reset", *(pytest.param(what, marks=pytest.mark.exhaustive) for what in ("reward", "observation"))],
)
def test_an_environment_that_returns_nan_is_reported_with_its_steps(what: str) -> None:
    agent = make(rejeu.DQN, Breaks(what=what), 2)
    said = r"not finite in one of the steps \d+ to \d+; agent.on_device = False .* says which"
    with pytest.raises(rejeu.BadEnvironmentError, match=said) as raised:
        agent.learn(100)
    assert agent.call.stops is not None
    assert "\n" not in str(raised.value)
    assert_finite_experience(agent)
    if what == "reward":
        with pytest.raises(rejeu.BadEnvironmentError, match="reward nan in environment 0 after 48 steps"):
            learn_on_host(make(rejeu.DQN, Breaks(what=what), 2), 100)
        first, last = (int(number) for number in re.findall(r"\d+", str(raised.value))[-2:])
        assert first <= 48 <= last


def assert_finite_experience(agent: Any) -> None:
    """Asserts that what is learned from next is finite."""
    batch, _ = agent.run.replay.draw(np.random.default_rng(0), (200,), 0.0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(batch))


def assert_reported(agent: Any, said: str) -> rejeu.NonFiniteError:
    """Asserts that training fails, that the error says so, and that the agent has the state before the steps that it names."""
    states = {0: agent.get_parameters()}

    def remember(agent: Any, progress: Any) -> None:
        states[progress.step] = agent.get_parameters()

    with pytest.raises(rejeu.NonFiniteError, match=said) as raised:
        agent.learn(300, remember)
    assert agent.call.stops is not None
    error = raised.value
    assert "\n" not in str(error)
    begin = max(states)
    assert f"in the environment steps {begin + 1:,} to {error.step:,}." in str(error)
    assert error.batch is None
    for name, value in agent.get_parameters().items():
        np.testing.assert_array_equal(value, states[begin][name], err_msg=name)
        assert np.isfinite(value).all()
    assert agent.num_timesteps == error.step
    return error


@pytest.mark.parametrize(
    ("kind", "env", "settings", "said"),
    [
        (rejeu.DQN, "jax/CartPole-v1", HUGE, "loss .inf.* lower learning_rate"),
        pytest.param(rejeu.DDPG, Undefined(), HINDSIGHT, "critic_loss .nan", marks=pytest.mark.exhaustive),
        pytest.param(rejeu.DQN, "jax/CartPole-v1", {**HUGE, "nonfinite": "skip", "train_freq": 1},
                     "100 updates in a row were skipped", marks=pytest.mark.exhaustive),
    ],
)  # fmt: skip
def test_nan_of_an_update_is_reported_with_its_steps(kind: Any, env: Any, settings: dict[str, Any], said: str) -> None:
    agent = make(kind, env, **settings)
    assert_reported(agent, said)
    if kind is not rejeu.DDPG:  # whose goals are judged when they are drawn
        assert_finite_experience(agent)


def test_an_agent_trains_on_after_a_nan_and_the_host_saves_its_batches(tmp_path: Path) -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1", **HUGE)
    step = assert_reported(agent, "names the turn and saves its batches").step
    agent.learning_rate = 1e-3
    agent.learn(40, reset_num_timesteps=False)
    assert agent.num_timesteps == step + 40
    agent.learning_rate = 1e30
    agent.on_device, agent.report_folder = False, tmp_path
    with pytest.raises(rejeu.NonFiniteError, match="in the update after environment step ") as raised:
        agent.learn(40, reset_num_timesteps=False)
    assert raised.value.batch is not None


@pytest.mark.exhaustive
def test_nan_of_an_on_policy_update_is_reported_with_its_steps() -> None:
    agent = on_policy.make(rejeu.PPO, "jax/CartPole-v1", **on_policy.PPO, learning_rate=1e38)
    assert "policy_gradient_loss" in str(assert_reported(agent, "lower learning_rate").names)
    assert agent.run.replay.size() == 0
