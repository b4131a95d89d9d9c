"""Agents whose actions are limited to a share of their range, and held for several steps, in training and afterwards."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.demonstrations import Demonstrations, clone
from rejeu.envs.make import make_vector
from tests import jax_environments
from tests.environments import Counter, Reach
from tests.helpers import small_sac
from tests.training.compiled.test_off_policy import make

NEVER = 10**6
"""``learning_starts`` of agents that only act at random."""
PPO = {"n_steps": 8, "batch_size": 8, "policy_kwargs": {"net_arch": [8], "log_std_init": 3.0}, "seed": 0}
"""Nearly all of these actions are beyond the bounds."""


def held_sac(env: Any, **settings: Any) -> rejeu.SAC:
    return small_sac(env, **{"action_repeat": 3, "action_share": 0.5, **settings})


def spells(actions: list[np.ndarray]) -> list[int]:
    """Returns how often each action was repeated."""
    changes = [0, *(i for i in range(1, len(actions)) if (actions[i] != actions[i - 1]).any()), len(actions)]
    return np.diff(changes).tolist()


@pytest.mark.parametrize("learning_starts", [NEVER, 8])
def test_training_holds_each_action_until_the_episode_ends_and_adds_up_the_rewards(learning_starts: int) -> None:
    env = Counter((7,), "terminated")
    agent = held_sac(env, learning_starts=learning_starts).learn(12)
    assert spells(env.actions) == [3, 3, 1] * 4
    assert agent.run.replay.arrays()["reward"].ravel()[:3].tolist() == [0 + 1 + 2, 3 + 4 + 5, 6]
    assert agent.history["length"].tolist() == [3] * 4
    assert agent.history["return"][0] == sum(range(7))


def test_in_hindsight_the_reward_of_a_held_action_is_that_of_its_last_step() -> None:
    agent = held_sac(Reach(), replay_buffer_class="HerReplayBuffer", learning_starts=NEVER, action_repeat=5).learn(40)
    ring = agent.run.replay.arrays()
    assert set(ring["reward"].ravel().tolist()) <= {-1.0, 0.0}


def test_on_policy_algorithms_hold_actions_within_the_share_too() -> None:
    env = Counter((7,), low=-2.0, high=4.0)
    rejeu.PPO("MlpPolicy", env, action_repeat=2, action_share=0.5, **PPO).learn(8)
    assert spells(env.actions)[:3] == [2, 2, 2] or len({*np.ravel(env.actions)}) == 2  # most are at a bound
    assert (np.min(env.actions), np.max(env.actions)) == (-0.5, 2.5)


def test_random_actions_and_those_of_the_policy_are_within_the_share() -> None:
    env = Counter((5,), low=[-2.0, 0.0], high=[4.0, 1.0])
    agent = held_sac(env, learning_starts=30, action_repeat=1).learn(60)
    low, high = np.min(env.actions, axis=0), np.max(env.actions, axis=0)
    assert (low >= [-0.5, 0.25]).all()
    assert (high <= [2.5, 0.75]).all()
    assert (high - low > [1.5, 0.25]).all()
    assert agent.action_space == gym.spaces.Box(np.float32([-0.5, 0.25]), np.float32([2.5, 0.75]))


def test_actions_are_within_the_share_on_the_device() -> None:
    """Positions of a point that its actions move."""
    agent = make(rejeu.SAC, jax_environments.Reach(grid=False), action_share=0.125, learning_starts=20).learn(40)
    assert agent.call.stops is not None, "it trained on the host"
    positions = agent.run.replay.arrays()["obs.observation"].reshape(-1)
    moves = np.abs(np.diff(positions[:11]))  # of the first episode
    assert 0.05 < moves.max() <= 0.125 + 1e-6


def test_held_actions_need_the_host() -> None:
    agent = make(rejeu.SAC, jax_environments.Reach(), action_repeat=2)
    agent.on_device = True
    with pytest.raises(
        ValueError, match="on_device=True is not possible: action_repeat=2: actions are held on the host"
    ):
        agent.learn(20)


def test_predict_holds_its_actions_in_its_state() -> None:
    agent = held_sac(Counter())
    observations = np.random.default_rng(0).normal(size=(8, 2, 3)).astype(np.float32)
    starts = np.zeros((8, 2), bool)
    starts[0], starts[4, 1] = True, True
    state, actions = None, []
    for obs, start in zip(observations, starts, strict=True):
        action, state = agent.predict(obs, state, start, deterministic=True)
        actions.append(action)
    anew = [agent.predict(obs, deterministic=True)[0] for obs in observations]
    times = {0: [0, 0, 0, 3, 3, 3, 6, 6], 1: [0, 0, 0, 3, 4, 4, 4, 7]}
    for env, chosen_at in times.items():
        np.testing.assert_array_equal([action[env] for action in actions], [anew[time][env] for time in chosen_at])
    with pytest.raises(ValueError, match="action_repeat=3 was given a state that is not of 1 episodes"):
        agent.predict(observations[0, :1], state)


def test_a_recurrent_policy_remembers_what_it_saw_when_it_chose() -> None:
    settings = {"net_arch": [8], "lstm_hidden_size": 4, "sequence_length": 4}
    agent = held_sac(Counter(), action_share=1.0, policy_kwargs=settings)
    plain = held_sac(Counter(), action_share=1.0, action_repeat=1, policy_kwargs=settings)
    observations = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    state, plain_state, actions, expected = None, None, [], []
    for time, obs in enumerate(observations):
        action, state = agent.predict(obs, state, deterministic=True)
        if time % 3 == 0:
            plain_action, plain_state = plain.predict(obs, plain_state, deterministic=True)
        actions.append(action)
        expected.append(plain_action)
    np.testing.assert_array_equal(actions, expected)


def test_an_evaluation_holds_actions_and_counts_the_steps_of_the_environment() -> None:
    env = Counter((7, 5))
    evaluation = held_sac(Counter()).evaluate(2, env=env)
    assert evaluation.lengths.tolist() == [7, 5]
    assert spells(env.actions) == [3, 3, 1, 3, 2]


def test_a_saved_agent_limits_and_holds_its_actions(tmp_path: Any) -> None:
    agent = held_sac("Pendulum-v1").learn(20)
    loaded = rejeu.load(agent.save(tmp_path / "agent"))
    assert (loaded.action_repeat, loaded.action_share) == (3, 0.5)
    assert loaded.action_space == gym.spaces.Box(-1.0, 1.0, (1,))  # of [-2, 2]
    np.testing.assert_array_equal(loaded.evaluate(2, seed=1).returns, agent.evaluate(2, seed=1).returns)
    vector = make_vector("Pendulum-v1", 2)
    for _ in range(2):
        np.testing.assert_array_equal(
            loaded.evaluate(2, env=vector, seed=1).returns, agent.evaluate(2, env=vector, seed=1).returns
        )
    with pytest.raises(ValueError, match=r"action_share=0\.2 cannot replace 0\.5; train a new agent"):
        rejeu.load(agent.last_saved, action_share=0.2)


def test_a_share_is_exported_and_a_held_action_is_not(tmp_path: Any) -> None:
    limited = small_sac("Pendulum-v1", action_share=0.25)
    exported = limited.export(tmp_path / "policy.npz")
    assert exported.check is not None
    actions = [rejeu.load_policy(exported.path).predict(np.float32([1.0, 0.0, v]))[0] for v in (-8.0, 8.0)]
    assert np.abs(actions).max() <= 0.5
    with pytest.raises(ValueError, match=r"action_repeat=3 cannot be exported: files hold no action; use rejeu\.load"):
        held_sac("Pendulum-v1").export(tmp_path / "held.npz")
    assert not (tmp_path / "held.npz").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"action_share": 0.0}, "action_share=0.0 must be a finite number, above 0 and at most 1"),
        ({"action_share": 1.5}, "action_share=1.5 must be"),
        ({"action_repeat": 0}, "action_repeat=0 must be a whole number of at least 1"),
        ({"action_repeat": 2, "demonstrations": "folder"}, "demonstrations are single steps, not 2"),
    ],
    ids=str,
)
def test_invalid_settings_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        held_sac(Counter(), **settings)


def test_what_does_not_fit_the_actions_is_refused() -> None:
    with pytest.raises(ValueError, match=r"action_share=0.5 needs Box actions with finite bounds, got Discrete\(2\)"):
        rejeu.DQN("MlpPolicy", "CartPole-v1", action_share=0.5)
    with pytest.raises(ValueError, match="action_repeat=2 holds an action that later masks may forbid"):
        rejeu.DQN("MlpPolicy", "CartPole-v1", action_masks=True, action_repeat=2)
    agent = held_sac(Counter())
    whole = held_sac(Counter(), action_share=1.0)
    shown = Demonstrations((), whole.observation_space, whole.action_space)
    with pytest.raises(
        ValueError, match=r"was made for .*, limited by action_share=0\.5; leave it out to use all actions"
    ):
        clone(agent, shown)
    for name in ("action_repeat", "action_share"):
        with pytest.raises(ValueError, match=f"{name} cannot be set on a SAC"):
            setattr(agent, name, 1)
