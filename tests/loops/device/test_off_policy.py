"""Off-policy learning on the device: the same as on the host, step by step, and wherever the chunks end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint, Evaluate
from tests.jax_environments import Breaks, Reach
from tests.loops.device.same_draws import use_same_draws
from tests.sharing import shared_learners

SMALL = {"buffer_size": 200, "learning_starts": 20, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 3}


def make(kind: Any, env: Any, n_envs: int = 1, **settings: Any) -> Any:
    """Returns a small agent in environments in JAX."""
    vector = rejeu.make_vector(env, n_envs)
    policy = "MultiInputPolicy" if isinstance(vector.observation_space, gym.spaces.Dict) else "MlpPolicy"
    with shared_learners():
        return kind(policy, vector, **{**SMALL, **settings})


def learn_on_host(agent: Any, n_steps: int) -> None:
    """Trains with the loop of the host, and with the random numbers of the device."""
    use_same_draws(agent.run)
    agent.on_device = False
    agent.learn(n_steps)


def assert_same_runs(one: Any, two: Any, tolerance: float) -> None:
    """Asserts that two agents have the same parameters, replay buffers, episodes and counters."""
    for name, value in one.get_parameters().items():
        np.testing.assert_allclose(value, two.get_parameters()[name], rtol=tolerance, atol=tolerance, err_msg=name)
    for name, rows in one.replay_buffer.arrays().items():
        np.testing.assert_allclose(rows, two.replay_buffer.arrays()[name], rtol=tolerance, atol=tolerance, err_msg=name)
    assert len(one.history) == len(two.history)
    np.testing.assert_allclose(one.history.table()[:, :4], two.history.table()[:, :4], rtol=tolerance)
    for name in ("step", "episode", "n_updates", "owed", "steps_since_update"):
        assert getattr(one.run, name) == getattr(two.run, name), name
    np.testing.assert_allclose(one.run.action, two.run.action, atol=tolerance)


@pytest.mark.parametrize(
    ("n_envs", "settings"),
    [
        (1, {}),
        pytest.param(3, {"train_freq": 4, "gradient_steps": 2, "n_steps": 2}, marks=pytest.mark.exhaustive),
        pytest.param(2, {"train_freq": (2, "episode"), "gradient_steps": 3}, marks=pytest.mark.exhaustive),
        pytest.param(2, {"overlap": False, "gradient_steps": -1}, marks=pytest.mark.exhaustive),
    ],
)
def test_dqn_equals_the_loop_of_the_host(n_envs: int, settings: dict[str, Any]) -> None:
    """Every action and episode is equal. XLA rounds the arithmetic of a larger program otherwise in the last bits."""
    device, host = (make(rejeu.DQN, "jax/CartPole-v1", n_envs, **settings) for _ in range(2))
    device.learn(301)
    assert device.stops is not None
    learn_on_host(host, 301)
    assert device.n_updates > 10 or "episode" in str(settings)
    assert_same_runs(device, host, 1e-4)
    for name in ("action", "reward", "kind", "head", "n_steps"):
        one, two = device.replay_buffer.arrays()[name], host.replay_buffer.arrays()[name]
        np.testing.assert_array_equal(one, two, err_msg=name)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        pytest.param(rejeu.SAC, {"normalize": True, "action_noise": 0.1}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.TD3, {"action_noise": "ou(0.2)"}, marks=pytest.mark.exhaustive),
        pytest.param(rejeu.CrossQ, {}, marks=pytest.mark.exhaustive),
    ],
)
def test_continuous_actions_equal_the_loop_of_the_host(kind: Any, settings: dict[str, Any]) -> None:
    device, host = (make(kind, "jax/Pendulum-v1", 2, **settings) for _ in range(2))
    device.learn(101)
    learn_on_host(host, 101)
    assert_same_runs(device, host, 1e-4)


@pytest.mark.parametrize(
    ("strategy", "stops", "n_steps"),
    [
        ("future", True, 1),
        pytest.param("final", False, 3, marks=pytest.mark.exhaustive),
        pytest.param("episode", False, 1, marks=pytest.mark.exhaustive),
        pytest.param("random", True, 2, marks=pytest.mark.exhaustive),
    ],
)
def test_hindsight_equals_the_loop_of_the_host(strategy: str, stops: bool, n_steps: int) -> None:
    settings = {"replay_buffer_class": "HerReplayBuffer", "n_steps": n_steps, "buffer_size": 60}
    settings["replay_buffer_kwargs"] = {"goal_selection_strategy": strategy}
    device, host = (make(rejeu.DDPG, Reach(stops=stops), 2, action_noise=0.3, **settings) for _ in range(2))
    device.learn(160)
    assert device.stops is not None
    learn_on_host(host, 160)
    assert_same_runs(device, host, 1e-4)
    assert {episode.success for episode in device.history.episodes} == ({0.0, 1.0} if stops else {0.0})


@pytest.mark.parametrize("what", ["reward", pytest.param("observation", marks=pytest.mark.exhaustive)])
def test_an_environment_that_returns_nan_is_reported_as_on_the_host(what: str) -> None:
    device, host = (make(rejeu.DQN, Breaks(what=what)) for _ in range(2))
    with pytest.raises(rejeu.BadEnvironmentError) as raised:
        device.learn(40)
    with pytest.raises(rejeu.BadEnvironmentError) as expected:
        learn_on_host(host, 40)
    assert str(raised.value) == str(expected.value)
    assert device.run.step == 24


def test_results_do_not_depend_on_where_chunks_end() -> None:
    one, two = (make(rejeu.DQN, "jax/CartPole-v1", 3) for _ in range(2))
    one.learn(200)
    two.learn(200, lambda agent, progress: None if progress.step % 7 else True)
    three = make(rejeu.DQN, "jax/CartPole-v1", 3)

    class Often:
        every = 10

        def __call__(self, agent: Any, progress: Any) -> None:
            steps.append(progress.step)

    steps: list[int] = []
    three.learn(200, Often())
    assert [step for step in steps if step in (12, 21, 30, 42)] == [
        12,
        21,
        30,
        42,
    ]  # as soon as 10, 20, ... are crossed
    assert_same_runs(one, two, 0.0)
    assert_same_runs(one, three, 0.0)


def test_a_resumed_run_continues_bit_for_bit(tmp_path: Path) -> None:
    whole, parts = (make(rejeu.DQN, "jax/CartPole-v1", 2) for _ in range(2))
    whole.learn(240)
    parts.learn(240, [Checkpoint(tmp_path, every=50), lambda agent, progress: progress.step < 100])
    assert parts.num_timesteps < 240
    with shared_learners():
        resumed = rejeu.DQN.resume(tmp_path, env=rejeu.make_vector("jax/CartPole-v1", 2))
    assert resumed.resumed.exact
    resumed.learn()
    assert_same_runs(whole, resumed, 0.0)


def test_evaluations_take_place_at_multiples_of_their_interval() -> None:
    evaluate = Evaluate("jax/CartPole-v1", every=60, episodes=2, seed=0)
    agent = make(rejeu.DQN, "jax/CartPole-v1").learn(130, evaluate)
    assert [result.step for result in evaluate.results] == [60, 120]
    assert agent.num_timesteps == 130


def test_learning_ends_with_the_last_of_the_episodes_asked_for() -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1", learning_starts=10_000).learn(episodes=3)
    assert len(agent.history) == 3
    assert agent.num_timesteps == agent.history["step"][-1]


def test_an_evaluation_in_the_training_environments_starts_new_episodes() -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1")
    agent.learn(60)
    agent.evaluate(1, env=agent.env)
    agent.learn(40, reset_num_timesteps=False)
    assert agent.num_timesteps == 100


def test_nan_is_reported_as_on_the_host(tmp_path: Path) -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1", learning_rate=1e30)
    agent.report_folder = tmp_path
    with pytest.raises(rejeu.NonFiniteError, match="lower learning_rate") as raised:
        agent.learn(200)
    assert raised.value.batch is not None
    assert all(np.isfinite(value).all() for value in agent.get_parameters().values())
    host = make(rejeu.DQN, "jax/CartPole-v1", learning_rate=1e30)
    host.report_folder = tmp_path
    with pytest.raises(rejeu.NonFiniteError) as expected:
        learn_on_host(host, 200)
    assert raised.value.step == expected.value.step
    assert raised.value.names == expected.value.names


def test_unsupported_settings_train_on_the_host_with_a_warning() -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1", priorities={})
    with pytest.warns(UserWarning, match="prioritized replay"):
        agent.learn(30)
    assert agent.num_timesteps == 30
    agent.on_device = True
    with pytest.raises(ValueError, match="prioritized replay"):
        agent.learn(30)
