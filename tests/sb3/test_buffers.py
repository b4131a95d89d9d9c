"""Every attribute and method of the buffers of agents, on the buffers of agents that have learned."""

import copy

import gymnasium as gym
import numpy as np
import pytest

from rejeu.replay.ring import Ring
from rejeu.sb3 import A2C, DQN, SAC, HerReplayBuffer
from rejeu.sb3.common import buffers
from rejeu.sb3.common.envs import BitFlippingEnv
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from tests.tiers import only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

TINY = {"policy_kwargs": {"net_arch": [4]}, "seed": 0}


def dummy(make, n=1):
    return DummyVecEnv([make] * n)


def made(kind, n_steps=1):
    """Returns an agent that took 20 random steps, with a buffer of a class."""
    settings = {"learning_starts": 100, "buffer_size": 200, **TINY}
    if kind is buffers.HerReplayBuffer:
        env = dummy(lambda: BitFlippingEnv(n_bits=3, max_steps=4), 2)
        return DQN("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, **settings).learn(20)
    if kind is buffers.DictReplayBuffer:
        return DQN("MultiInputPolicy", BitFlippingEnv(n_bits=3), **settings).learn(20)
    make = lambda: gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 5)  # noqa: E731
    return SAC("MlpPolicy", dummy(make, 2), n_steps=n_steps, **settings).learn(20)


KINDS = [buffers.ReplayBuffer, buffers.NStepReplayBuffer, buffers.DictReplayBuffer, buffers.HerReplayBuffer]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("ignore:The last trajectory")
def test_everything_of_a_replay_buffer_works_on_agents(kind):
    model = made(kind, 3 if kind is buffers.NStepReplayBuffer else 1)
    buffer, n_envs = model.replay_buffer, model.n_envs
    assert type(buffer) is kind
    public = {name for name in dir(type(buffer)) if name[0] != "_"} - {"own", "seen", "SHOWN"}
    tried = {name: getattr(buffer, name) for name in [*public, *buffer.SHOWN]}  # no AttributeError
    assert (buffer.size(), buffer.pos, buffer.full, buffer.buffer_size) == (
        20 // n_envs,
        20 // n_envs,
        False,
        200 // n_envs,
    )
    assert tried["actions"].shape[:2] == tried["rewards"].shape == tried["dones"].shape == (20 // n_envs, n_envs)
    with pytest.raises(ValueError, match="read-only"):
        buffer.rewards[0] = 1.0
    batch = buffer.sample(64)
    assert batch.rewards.shape == batch.dones.shape == (64, 1)
    assert batch.actions.shape[0] == 64
    assert {*np.unique(batch.rewards)} <= {*np.unique(buffer.rewards)} or kind in KINDS[1::2]
    assert (batch.discounts is None) == (model.config.n_steps == 1)
    again = copy.deepcopy(buffer)
    if kind is buffers.HerReplayBuffer:
        goals, reached = batch.observations["desired_goal"], batch.next_observations["achieved_goal"]
        np.testing.assert_array_equal(batch.rewards[:, 0], -(goals != reached).any(axis=1).astype(np.float32))
        assert (buffer.n_sampled_goal, buffer.her_ratio, buffer.goal_selection_strategy) == (4, 0.8, "future")
        buffer.set_env(model.get_env())
        buffer.truncate_last_trajectory()
    buffer.reset()
    assert (buffer.size(), again.size(), model.replay_buffer.size()) == (0, 20 // n_envs, 0)
    with pytest.raises(ValueError, match="holds no steps"):
        buffer.sample(1)
    model.replay_buffer = again
    assert model.replay_buffer.size() == 20 // n_envs
    np.testing.assert_array_equal(model.replay_buffer.rewards, again.rewards)
    model.learn(4)
    assert buffer.size() == 24 // n_envs  # a view of the agent's buffer as it is now


def test_a_step_is_added():
    buffer = SAC("MlpPolicy", gym.make("Pendulum-v1"), learning_starts=100, **TINY).learn(10).replay_buffer
    np.testing.assert_array_equal(buffer.next_observations[:-1], buffer.observations[1:])
    buffer.add(np.zeros((1, 3)), np.ones((1, 3)), np.full((1, 1), 0.5), np.array([2.0]), np.array([True]), [{}])
    assert (buffer.size(), buffer.rewards[-1, 0], buffer.dones[-1, 0], buffer.timeouts[-1, 0]) == (11, 2.0, 1.0, 0.0)
    assert (buffer.actions[-1, 0], buffer.next_observations[-1, 0].tolist()) == (0.5, [1.0] * 3)


def test_a_step_without_the_axis_of_environments_is_added():
    buffer = SAC("MlpPolicy", gym.make("Pendulum-v1"), learning_starts=100, **TINY).learn(5).replay_buffer
    buffer.add(np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0]), np.array([0.5]), 2.0, True, [{}])
    assert buffer.observations[-1, 0].tolist() == [1.0, 2.0, 3.0]
    assert buffer.next_observations[-1, 0].tolist() == [4.0, 5.0, 6.0]
    assert (buffer.rewards[-1, 0], buffer.dones[-1, 0]) == (2.0, 1.0)
    model = DQN("MlpPolicy", gym.make("FrozenLake-v1"), learning_starts=100, **TINY).learn(5)
    model.replay_buffer.add(3, np.array([[7]]), 1, 1, False, [{}])
    assert (model.replay_buffer.observations[-1].item(), model.replay_buffer.next_observations[-1].item()) == (3, 7)


def test_a_replay_buffer_draws_what_vec_normalize_scales():
    model = made(buffers.ReplayBuffer)
    env = VecNormalize(dummy(lambda: gym.make("Pendulum-v1")), norm_obs=False)
    env.ret_rms.var = np.array(4.0)
    np.random.seed(0)  # noqa: NPY002
    plain = model.replay_buffer.sample(50).rewards
    np.random.seed(0)  # noqa: NPY002
    np.testing.assert_allclose(model.replay_buffer.sample(50, env).rewards, plain / 2, rtol=1e-5)


def test_ends_by_time_limits_are_no_terminations():
    buffer = made(buffers.ReplayBuffer).replay_buffer
    assert (buffer.dones.sum(), buffer.timeouts.sum(), buffer.sample(100).dones.sum()) == (4, 4, 0)
    zeros = np.zeros((2, 3))
    step = (
        zeros,
        zeros,
        np.zeros((2, 1)),
        np.full(2, 7.0),
        np.array([True, True]),
        [{"TimeLimit.truncated": True}, {}],
    )
    buffer.extend(*(np.repeat(np.asarray(part)[None], 2, 0) for part in step))
    assert buffer.size() == 12
    batch = buffer.sample(400)
    assert 0 < batch.dones.sum() < (batch.rewards == 7).sum()


def test_a_full_replay_buffer_has_its_size():
    model = SAC("MlpPolicy", gym.make("Pendulum-v1"), learning_starts=100, buffer_size=8, **TINY).learn(30)
    assert model.replay_buffer.full
    assert model.replay_buffer.size() == model.replay_buffer.buffer_size
    assert len(model.replay_buffer.rewards) == model.replay_buffer.pos


def test_an_agent_that_was_loaded_alone_shows_an_empty_replay_buffer(tmp_path):
    model = made(buffers.HerReplayBuffer)
    model.save(tmp_path / "m")
    shown = DQN.load(tmp_path / "m").replay_buffer
    assert (type(shown), shown.size(), shown.buffer_size, shown.full) == (buffers.HerReplayBuffer, 0, 200, False)


@pytest.mark.parametrize("nested", only([False], [False, True]))
def test_everything_of_a_rollout_buffer_works_on_agents(nested):
    env, name = (BitFlippingEnv(n_bits=3), "MultiInputPolicy") if nested else (gym.make("CartPole-v1"), "MlpPolicy")
    model = A2C(name, env, n_steps=8, **TINY).learn(8)
    buffer = model.rollout_buffer
    assert type(buffer) is (buffers.DictRolloutBuffer if nested else buffers.RolloutBuffer)
    assert (buffer.size(), buffer.full, buffer.buffer_size, buffer.n_envs, buffer.gae_lambda) == (8, True, 8, 1, 1.0)
    parts = [*buffer.get(5)]
    assert [len(part.actions) for part in parts] == [5, 3]
    assert sorted(float(x) for part in parts for x in part.returns) == sorted(buffer.returns[:, 0].tolist())
    for array in (buffer.rewards, buffer.advantages, buffer.episode_starts):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    buffer.reset()
    model.learn(8)


def test_buffers_cannot_be_made_by_hand_or_set_to_something_else():
    space = gym.spaces.Box(-1, 1, (1,))
    with pytest.raises(TypeError, match=r"rejeu.replay.replay_memory.ReplayMemory"):
        buffers.ReplayBuffer(10, space, space)
    model = made(buffers.ReplayBuffer)
    with pytest.raises(TypeError, match="must be the replay buffer of an agent"):
        model.replay_buffer = Ring
