"""Hyperparameters that are set on an agent count from the next update on, or raise."""

import gymnasium as gym
import numpy as np
import pytest

from rejeu.sb3 import A2C, DQN, PPO
from rejeu.sb3.common.callbacks import BaseCallback
from rejeu.sb3_contrib import ARS

TINY = {"policy_kwargs": {"net_arch": [4]}, "seed": 0}
FAST = {"train_freq": 8, "learning_starts": 8, "batch_size": 8, "target_update_interval": 10_000}


class At(BaseCallback):
    """Calls a function at one step, and keeps the parameters of the policy one step later."""

    def __init__(self, step, function):
        super().__init__()
        self.step, self.function = step, function

    def _on_step(self):
        if self.n_calls == self.step:
            self.function(self.model)
        if self.n_calls == self.step + 1:
            self.kept = policy_of(self.model)
        return True


def policy_of(model):
    return {name: np.array(array) for name, array in model.get_parameters()["policy"].items()}


@pytest.mark.parametrize(
    ("kind", "settings"), [(A2C, {"n_steps": 8}), pytest.param(DQN, FAST, marks=pytest.mark.exhaustive)]
)
def test_a_learning_rate_set_in_a_callback_counts_from_the_next_update(kind, settings):
    def stop_learning(model):
        model.learning_rate = 0.0
        model._setup_lr_schedule()

    model = kind("MlpPolicy", gym.make("CartPole-v1"), **TINY, **settings)
    before, callback = policy_of(model), At(20, stop_learning)
    model.learn(48, callback=callback)
    after = policy_of(model)
    assert any(not np.array_equal(before[name], after[name]) for name in after)
    assert all(np.array_equal(callback.kept[name], after[name]) for name in after)
    assert (model.num_timesteps, model.lr_schedule(1.0)) == (48, 0.0)


def test_a_number_that_a_callback_sets_at_every_step_is_compiled_once(tmp_path):
    learners, seen = [], []

    class Decays(BaseCallback):
        def _on_step(self):
            self.model.ent_coef = 0.1 / self.n_calls
            self.model.clip_range = 0.2
            learners.append(self.model.learner)
            seen.append(self.model.ent_coef)
            return True

    model = PPO("MlpPolicy", gym.make("CartPole-v1"), **TINY, n_steps=4, batch_size=4, n_epochs=1)
    with pytest.raises(ValueError, match="must not fall below 0"):
        model.ent_coef = -1
    model.learn(12, Decays())
    assert len({id(one) for one in learners}) == 1
    assert seen == [0.1 / n for n in range(1, 13)]
    model.save(tmp_path / "m")
    assert PPO.load(tmp_path / "m").ent_coef == model.ent_coef == 0.1 / 12


@pytest.fixture(scope="module")
def dqn():
    return DQN("MlpPolicy", gym.make("CartPole-v1"), **TINY, **FAST, buffer_size=100)


def test_settings_of_the_loop_and_of_the_buffer_can_be_set(dqn):
    dqn.gamma, dqn.train_freq, dqn.learning_starts, dqn.buffer_size = 0.5, (2, "step"), 20, 50
    assert dqn.run.replay.discounts.tolist() == [1.0, 0.0, 0.5, 0.0]
    assert (dqn.run.learn_from, dqn.config.train_freq, dqn.run.replay.ring.rows) == (20, 2, 50)
    dqn.lr_schedule = lambda remaining: remaining / 10
    assert dqn.learning_rate(0.5) == dqn.lr_schedule(0.5) == 0.05


@pytest.mark.parametrize(
    ("name", "value", "error", "message"),
    [
        ("gamma", 2, ValueError, "gamma=2 must be"),
        ("policy_kwargs", {"net_arch": [5]}, ValueError, "policy_kwargs cannot be set on a DQN whose networks"),
        ("action_masks", True, ValueError, "constructor or load"),
        ("exploration_schedule", lambda _: 0.1, ValueError, "must be one of linear"),
        ("q_net", None, AttributeError, "use set_parameters"),
        ("_n_updates", 3, AttributeError, "cannot be set"),
        ("_logger", 3, AttributeError, r"use set_logger\(...\)"),
    ],
)
def test_what_cannot_be_set_raises_and_changes_nothing(dqn, name, value, error, message):
    config, learner = dqn.config, dqn.learner
    with pytest.raises(error, match=message):
        setattr(dqn, name, value)
    assert dqn.config is config
    assert dqn.learner is learner


def test_the_size_of_a_buffer_that_holds_steps_cannot_be_set():
    stop = lambda local_variables, global_variables: local_variables["self"].num_timesteps < 4  # noqa: E731
    model = PPO("MlpPolicy", gym.make("CartPole-v1"), **TINY, n_steps=16, batch_size=16).learn(16, stop)
    with pytest.raises(ValueError, match="n_steps cannot be set on a PPO whose buffer holds steps"):
        model.n_steps = 8
    model.n_steps = 16
    assert model.run.replay.length == 4


def test_attributes_of_ones_own_can_be_set_and_nearly_right_names_warn(dqn):
    dqn.best_so_far = 3
    assert dqn.best_so_far == 3
    with pytest.warns(UserWarning, match="is the hyperparameter batch_size meant"):
        dqn.batchsize = 3


def test_a_function_for_the_noise_of_ars_takes_the_remaining_progress():
    model = ARS("LinearPolicy", "Pendulum-v1", delta_std=lambda remaining: 0.1 * remaining)
    assert (model.config.delta_std(1.0), model.delta_std(1.0)) == (0.0, 0.1)
