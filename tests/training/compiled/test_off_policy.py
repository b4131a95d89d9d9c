"""Off-policy learning on the device: the same as on the host, step by step, and wherever the chunks end."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint, Evaluate
from rejeu.training.compiled.trainer import DeviceTrainer
from tests.jax_environments import Reach
from tests.sharing import shared_learners
from tests.tiers import only
from tests.training.compiled.same_draws import assert_same_learning, use_same_draws

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
    assert_same_learning(one, two, tolerance, ("owed", "steps_since_update"))
    np.testing.assert_allclose(one.run.action, two.run.action, atol=tolerance)
    if one.replay_buffer.priorities is not None:
        assert_same_priorities(one, two, tolerance)


def assert_same_priorities(one: Any, two: Any, tolerance: float) -> None:
    """Asserts that two agents have the same priorities, and the same TD errors that are to change them."""
    ours, theirs = (agent.replay_buffer.priorities.state() for agent in (one, two))
    for name, value in ours.items():
        np.testing.assert_allclose(value, theirs[name], rtol=10 * tolerance, atol=tolerance, err_msg=name)
    parts = []
    for agent in (one, two):
        pairs = [(draw.position, draw.time, np.ravel(td_error)) for draw, td_error in agent.run.td_errors]
        parts.append([np.concatenate(column) for column in zip(*pairs, strict=True)])
    assert len(parts[0]) == len(parts[1])
    for ours, theirs in zip(*parts, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=10 * tolerance, atol=tolerance)


@pytest.mark.parametrize(
    ("n_envs", "settings"),
    [
        pytest.param(1, {}, marks=pytest.mark.exhaustive),
        pytest.param(3, {"train_freq": 4, "gradient_steps": 2, "n_steps": 2}, marks=pytest.mark.exhaustive),
        pytest.param(2, {"train_freq": (2, "episode"), "gradient_steps": 3}, marks=pytest.mark.exhaustive),
        pytest.param(2, {"overlap": False, "gradient_steps": -1}, marks=pytest.mark.exhaustive),
        (
            2,
            {
                "priorities": {},
                "train_freq": 4,
                "gradient_steps": 2,
                "n_steps": 2,
                "target_update_interval": 1,
                "tau": 0.3,
            },
        ),
        pytest.param(3, {"priorities": {"alpha": 1.0}, "gradient_steps": -1}, marks=pytest.mark.exhaustive),
    ],
)
def test_dqn_equals_the_loop_of_the_host(n_envs: int, settings: dict[str, Any]) -> None:
    """Every action and episode is equal. XLA rounds the arithmetic of a larger program otherwise in the last bits."""
    device, host = (make(rejeu.DQN, "jax/CartPole-v1", n_envs, **settings) for _ in range(2))
    device.learn(301)
    assert device.call.stops is not None
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
    ("strategy", "stops", "n_steps", "priorities"),
    [
        ("future", True, 1, None),
        pytest.param("final", False, 3, None, marks=pytest.mark.exhaustive),
        pytest.param("episode", False, 1, None, marks=pytest.mark.exhaustive),
        pytest.param("random", True, 2, None, marks=pytest.mark.exhaustive),
        pytest.param({"future": 2, "desired": 2}, True, 1, None, marks=pytest.mark.exhaustive),
        pytest.param("future", True, 2, {}, marks=pytest.mark.exhaustive),
    ],
)
def test_hindsight_equals_the_loop_of_the_host(
    strategy: str | dict[str, int], stops: bool, n_steps: int, priorities: dict[str, Any] | None
) -> None:
    settings = {"replay_buffer_class": "HerReplayBuffer", "n_steps": n_steps, "buffer_size": 60}
    settings["priorities"] = priorities
    settings["replay_buffer_kwargs"] = {"goal_selection_strategy": strategy}
    device, host = (make(rejeu.DDPG, Reach(stops=stops), 2, action_noise=0.3, **settings) for _ in range(2))
    device.learn(160)
    assert device.call.stops is not None
    learn_on_host(host, 160)
    assert_same_runs(device, host, 1e-4)
    assert {episode.success for episode in device.history.episodes} == ({0.0, 1.0} if stops else {0.0})


def test_results_do_not_depend_on_where_chunks_end() -> None:
    class Often:
        every = 10

        def __call__(self, agent: Any, progress: Any) -> None:
            steps.append(progress.step)

    steps: list[int] = []
    one, two = (make(rejeu.DQN, "jax/CartPole-v1", 3) for _ in range(2))
    one.learn(120)
    two.learn(120, [Often(), lambda agent, progress: None if progress.step % 7 else True])
    assert {12, 21, 30, 42} <= {*steps}  # as soon as 10, 20, ... are crossed
    assert_same_runs(one, two, 0.0)


@pytest.mark.parametrize("priorities", only([{}], [None, {}]))
def test_a_resumed_run_continues_bit_for_bit(tmp_path: Path, priorities: dict[str, Any] | None) -> None:
    whole, parts = (make(rejeu.DQN, "jax/CartPole-v1", 2, priorities=priorities) for _ in range(2))
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


def test_unsupported_settings_train_on_the_host_with_a_warning() -> None:
    agent = make(rejeu.DQN, "jax/CartPole-v1", priorities={}, gradient_steps=-1, train_freq=(1, "episode"))
    with pytest.warns(UserWarning, match="priorities with gradient_steps=-1"):
        agent.learn(30)
    assert agent.num_timesteps == 30
    agent.on_device = True
    with pytest.raises(ValueError, match="priorities with gradient_steps=-1"):
        agent.learn(30)


@pytest.mark.exhaustive
def test_priorities_continue_from_the_loop_of_the_host_and_back() -> None:
    """Also with the TD errors of several gradient steps that are still to set priorities."""
    agent = make(rejeu.DQN, "jax/CartPole-v1", priorities={}, gradient_steps=4)
    for n_steps, on_device in ((40, False), (40, True), (40, False)):
        agent.on_device = on_device
        agent.learn(n_steps, reset_num_timesteps=False)
        priorities = agent.replay_buffer.priorities
        assert np.count_nonzero(priorities.state()["values"]) == agent.replay_buffer.size()
        assert sum(len(draw.position) for draw, _ in agent.run.td_errors) == 4 * 8
    assert len({*priorities.state()["values"]}) > 60


def test_a_chunk_that_is_interrupted_is_completed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The replay buffer, which is full, is as the chunk leaves it, and training continues from there.

    Only the history lacks the episodes of the chunk.
    """
    interrupted, other = (make(rejeu.SAC, "jax/Pendulum-v1", 2) for _ in range(2))
    finish = DeviceTrainer.finish

    def fails_once(trainer: DeviceTrainer) -> None:
        if trainer.runs[0].step >= 300:
            monkeypatch.undo()
            raise KeyboardInterrupt
        finish(trainer)

    monkeypatch.setattr(DeviceTrainer, "finish", fails_once)
    with pytest.raises(KeyboardInterrupt):
        interrupted.learn(600)
    taken = interrupted.num_timesteps
    assert 300 <= taken < 600
    interrupted.learn(600 - taken, reset_num_timesteps=False)
    other.learn(600)
    assert len(interrupted.history) < len(other.history)
    interrupted.history = other.history
    assert_same_runs(interrupted, other, 0)


@pytest.mark.exhaustive
def test_steps_are_copied_to_the_host_when_they_are_read() -> None:
    sizes: list[int] = []

    def look(agent: Any, progress: Any) -> None:
        copied = agent.run.fetch is None
        if progress.step >= 100:
            sizes.append(agent.replay_buffer.size())
            assert sizes[-1] == progress.step
            assert agent.run.fetch is None
        assert not copied

    agent = make(rejeu.SAC, "jax/Pendulum-v1").learn(150, look)
    assert agent.call.stops is not None
    assert sizes
    assert sizes[-1] == 150
