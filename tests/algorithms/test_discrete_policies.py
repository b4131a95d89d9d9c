"""The policies of SAC and DDPG over Discrete actions: what is drawn, and how actions are numbered."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy import stats

import rejeu
from tests.algorithms.batches import CLOCK, DISCRETE, N_ACTIONS, OBS_DIM, OBS_SPACE
from tests.environments import Sampled
from tests.numpy_networks import forward, layers, softmax

pytestmark = pytest.mark.usefixtures("learners_are_shared")

every_agent = pytest.mark.parametrize("kind", [rejeu.SAC, rejeu.DDPG])
SMALL = {"policy_kwargs": {"net_arch": [5, 4]}}


def algorithm_and_actor(kind):
    """The actor has its last layer eight times as large, so that its probabilities are far from equal."""
    algorithm = kind.algorithm.make(kind.algorithm.Config(**SMALL), OBS_SPACE, DISCRETE)
    actor = jax.jit(algorithm.init)(jax.random.PRNGKey(1)).actor
    bold = eqx.tree_at(lambda a: (a.head.weight, a.head.bias), actor, (8 * actor.head.weight, 8 * actor.head.bias))
    return algorithm, bold


@every_agent
def test_training_actions_are_drawn_from_the_policys_probabilities_row_by_row(kind):
    """20,000 draws at each of two observations, by Pearson's chi-square."""
    (algorithm, actor), n = algorithm_and_actor(kind), 20_000
    obs = np.float32([[2.0, -1.0, 0.5], [0.0, 0.0, 5.0]])
    probabilities = softmax(forward(layers(actor), obs))
    assert probabilities.max() > 0.5 > 0.05 > probabilities.min()
    assert np.abs(probabilities[0] - probabilities[1]).max() > 0.2
    draw = jax.jit(lambda actor, obs, key: algorithm.explore(actor, obs, key, CLOCK))
    action = np.asarray(draw(actor, np.repeat(obs, n, axis=0), jax.random.PRNGKey(0)))
    assert action.dtype == np.int32
    for drawn, expected in zip(action.reshape(2, n), probabilities, strict=True):
        counts = np.bincount(drawn, minlength=N_ACTIONS)
        assert stats.chisquare(counts, n * expected).pvalue > 1e-3


@every_agent
def test_the_deterministic_action_is_the_most_probable(kind):
    algorithm, actor = algorithm_and_actor(kind)
    obs = 3.0 * np.random.default_rng(0).normal(size=(50, OBS_DIM)).astype(np.float32)
    probabilities = softmax(forward(layers(actor), obs))
    given = np.asarray(algorithm.exploit(actor, obs))
    assert given.dtype == np.int32
    assert len(set(given.tolist())) > 1
    np.testing.assert_array_equal(given, probabilities.argmax(axis=1))


class Echo(Sampled):
    """Rewards every action by its own number, and refuses those that are not in its space."""

    def __init__(self):
        super().__init__(OBS_SPACE, DISCRETE)

    def reward(self, action):
        assert self.action_space.contains(action), action
        return float(action)


@every_agent
@pytest.mark.parametrize("learning_starts", [0, 40])
def test_actions_are_counted_from_the_start_of_the_space_outside_and_from_0_inside(learning_starts, kind):
    """Those that the policy draws as well as the random ones before learning starts."""
    agent = kind("MlpPolicy", Echo(), seed=0, learning_starts=learning_starts, train_freq=1000, **SMALL).learn(40)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (500,))
    assert set(batch.action.tolist()) == {0, 1, 2, 3}
    np.testing.assert_array_equal(batch.reward, batch.action + 5)


@every_agent
def test_predictions_are_the_spaces_own_numbers(kind):
    agent = kind("MlpPolicy", Echo(), seed=0, **SMALL)
    parameters = agent.get_parameters()
    parameters["actor.head.weight"][:] = 0.0
    for best in range(N_ACTIONS):
        parameters["actor.head.bias"][:] = np.eye(N_ACTIONS)[best]
        agent.set_parameters(parameters)
        assert agent.predict(np.zeros(OBS_DIM), deterministic=True)[0] == 5 + best
    drawn, _ = agent.predict(np.zeros((200, OBS_DIM)))
    assert set(drawn.tolist()) == {5, 6, 7, 8}
