"""Attributes of agents: hyperparameters that are set count, and what has no effect raises."""

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.core import validation

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [4]}, "seed": 0}


@pytest.fixture(scope="module")
def agent():
    return rejeu.DQN("MlpPolicy", "CartPole-v1", learning_starts=8, buffer_size=100, batch_size=4, **SMALL)


def test_a_learning_rate_that_is_set_counts_from_the_next_update_on(agent):
    agent.learning_rate = 0.0
    assert agent.learning_rate == agent.config.learning_rate == 0.0
    before = agent.get_parameters()
    agent.learn(20)
    assert agent.run.n_updates > 0
    weights = [key for key in before if key.startswith("network")] or [key for key in before if "weight" in key]
    for key in weights:
        np.testing.assert_array_equal(before[key], agent.get_parameters()[key])


def test_no_attribute_of_an_agent_hides_a_hyperparameter():
    kinds = rejeu.agents.AGENTS.values()
    assert not [key for kind in kinds for key in validation.field_names(kind.algorithm.Config) if hasattr(kind, key)]


def test_unknown_attributes_raise_with_the_nearest_name(agent):
    with pytest.raises(AttributeError, match=r"'learning_rat'; did you mean learning_rate"):
        agent.learning_rat = 0.1
    with pytest.raises(AttributeError, match="'replay_bufer'"):
        agent.replay_bufer = None
    with pytest.raises(AttributeError, match="did you mean evaluate"):
        agent.evalute  # noqa: B018
    with pytest.raises(AttributeError, match=r"DQN has no attribute 'xyzzy'$"):
        agent.xyzzy  # noqa: B018


@pytest.mark.parametrize(("name", "value"), [("seed", 3), ("device", "cpu"), ("stats_window_size", 2), ("env", None)])
def test_what_is_read_when_an_agent_is_made_cannot_be_set_later(agent, name, value):
    with pytest.raises(AttributeError, match=name):
        setattr(agent, name, value)


def test_what_does_not_fit_changes_nothing(agent):
    config, shapes = agent.config, jax.tree.leaves(agent.learner.shapes)
    with pytest.raises(ValueError, match="dueling cannot be set"):
        agent.dueling = True
    with pytest.raises(ValueError, match="gamma"):
        agent.gamma = 2.0
    assert agent.config == config
    assert jax.tree.leaves(agent.learner.shapes) == shapes


def test_a_class_of_ones_own_may_have_further_attributes():
    class Mine(rejeu.A2C):
        pass

    agent = Mine("MlpPolicy", "CartPole-v1", **SMALL)
    agent.calls = 1
    agent.gamma = 0.5
    assert (agent.calls, agent.config.gamma) == (1, 0.5)


def test_the_name_of_a_method_of_masks_takes_the_environment_or_nothing():
    """sb3-contrib calls the method with the environment."""
    from rejeu.sb3_contrib.common.wrappers import ActionMasker

    class Choice(gym.Env):
        observation_space, action_space = gym.spaces.Discrete(2), gym.spaces.Discrete(2)

        def given(self, env):
            return [env is self, False]

        def own(self):
            return [True, False]

    for name in ("given", "own"):
        assert ActionMasker(Choice(), name).action_masks().tolist() == [True, False]
