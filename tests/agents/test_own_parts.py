"""A subclass replaces the replay buffer, the noise or the loop of an agent by overriding one method."""

import numpy as np
import pytest

import rejeu
from rejeu.agents import OffPolicyAgent
from rejeu.algorithms import sac
from rejeu.callbacks import Checkpoint
from rejeu.core.errors import CheckpointError
from rejeu.exploration.noise import NormalActionNoise
from rejeu.replay.hindsight import HerReplayBuffer
from rejeu.replay.uniform import ReplayBuffer
from tests.environments import Reach
from tests.helpers import small_sac

SMALL = {"learning_starts": 8, "batch_size": 4, "buffer_size": 300, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
BALL = "rejeu/Ball-v0"


class Counted(ReplayBuffer):
    """Counts its draws."""

    def draw(self, rng, shape, progress=1.0):
        batch, drawn = super().draw(rng, shape, progress)
        self.n_draws = getattr(self, "n_draws", 0) + 1
        return batch, drawn


class OwnSAC(OffPolicyAgent):
    """SAC with a buffer, a loop and noise of its own."""

    algorithm = sac

    def make_buffer(self, env):
        usual = super().make_buffer(env)
        return Counted(usual.ring, usual.gamma, usual.n_steps, usual.priorities, usual.each_reward)

    def make_noise(self):
        return NormalActionNoise(np.zeros(self.action_space.shape), np.full(self.action_space.shape, 0.1))

    def loop(self, n_steps, progress):
        self.turns = 0
        for turn in super().loop(n_steps, progress):
            self.turns += 1
            yield turn


def test_a_subclass_replaces_buffer_loop_and_noise():
    agent = OwnSAC("MlpPolicy", BALL, **SMALL).learn(20)
    assert isinstance(agent.replay_buffer, Counted)
    assert agent.replay_buffer.n_draws == agent.n_updates == 12
    assert agent.turns == 20
    plain = small_sac(BALL).learn(20)
    assert any((plain.get_parameters()[name] != array).any() for name, array in agent.get_parameters().items())


def test_an_agent_with_own_parts_is_loaded_and_resumed(tmp_path):
    whole = OwnSAC("MlpPolicy", BALL, **SMALL).learn(40)
    stop = lambda agent, progress: progress.step < 20  # noqa: E731
    OwnSAC("MlpPolicy", BALL, **SMALL).learn(40, [Checkpoint(tmp_path / "run", every=100), stop])
    again = OwnSAC.resume(tmp_path / "run").learn()
    assert again.resumed.exact
    assert isinstance(again.replay_buffer, Counted)
    for name, array in whole.get_parameters().items():
        np.testing.assert_array_equal(again.get_parameters()[name], array)
    loaded = OwnSAC.load(again.save(tmp_path / "model"), BALL)
    assert isinstance(loaded.replay_buffer, Counted)
    assert rejeu.SAC.load(tmp_path / "model").num_timesteps == 40


class Scaled(ReplayBuffer):
    """Multiplies rewards by a factor."""

    def __init__(self, ring, gamma, n_steps=1, priorities=None, each_reward=False, factor=1.0, notes=()):
        super().__init__(ring, gamma, n_steps, priorities, each_reward)
        self.factor, self.notes = factor, notes

    def draw(self, rng, shape, progress=1.0):
        batch, drawn = super().draw(rng, shape, progress)
        return batch._replace(reward=np.float32(self.factor) * batch.reward), drawn


class OwnHer(HerReplayBuffer):
    pass


def test_a_class_of_ones_own_is_a_replay_buffer_class(tmp_path):
    settings = {"replay_buffer_class": Scaled, "replay_buffer_kwargs": {"factor": 3.0, "notes": ["a", "b"]}}
    agent = rejeu.SAC("MlpPolicy", BALL, **SMALL, **settings).learn(20)
    assert isinstance(agent.replay_buffer, Scaled)
    assert agent.replay_buffer.factor == 3.0
    assert any((small_sac(BALL).learn(20).get_parameters()[k] != v).any() for k, v in agent.get_parameters().items())
    path = agent.save(tmp_path / "model")
    with pytest.raises(CheckpointError, match=r"replay_buffer_class.*give it again"):
        rejeu.SAC.load(path)
    loaded = rejeu.SAC.load(path, BALL, replay_buffer_class=Scaled)
    assert (loaded.replay_buffer.factor, loaded.replay_buffer.notes) == (3.0, ("a", "b"))


def test_a_subclass_of_the_hindsight_buffer_gets_goals_and_settings():
    kwargs = {"n_sampled_goal": 2}
    settings = SMALL | {"replay_buffer_class": OwnHer, "replay_buffer_kwargs": kwargs}
    agent = rejeu.SAC("MultiInputPolicy", Reach(), **settings)
    assert isinstance(agent.replay_buffer, OwnHer)
    assert agent.config.hindsight.n_sampled_goal == 2
