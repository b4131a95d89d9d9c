"""PQN's targets, losses and whole updates against float64 NumPy, its exploration, its network and what it refuses."""

import functools

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings as hypothesis_settings, strategies as st

import rejeu
from rejeu.algorithms import config as configs, pqn
from rejeu.core.algorithm import Clock
from rejeu.core.prng import nth
from rejeu.core.spaces import leaves
from rejeu.networks import LayerNorm
from tests.algorithms.test_gae import random_steps
from tests.algorithms.test_ppo import LAST_STEP_MISSING, OBS_SPACE, random_rollout
from tests.numpy_networks import gradient
from tests.tiers import only_tuples

pytestmark = pytest.mark.usefixtures("learners_are_shared")

ACTIONS = gym.spaces.Discrete(3)
CLOCK = Clock(np.uint32(1), np.uint32(0), np.float32(0.25))
IMAGE = gym.spaces.Box(0, 255, (8, 8, 1), np.uint8)
RATE = 3e-2


@functools.cache
def make(**settings):
    config = pqn.Config(**{"policy_kwargs": {"net_arch": [5, 4]}, "learning_rate": RATE, **settings})
    algorithm = pqn.make(config, OBS_SPACE, ACTIONS)
    return config, algorithm, algorithm.init(jax.random.PRNGKey(1))


# An independent network in float64: its parameters by name, and how they are applied.


def parameters(network):
    """Returns copies of weight, bias, scale and offset of each layer in the order of use; the head has the first two."""
    hidden = zip(network.torso.layers, network.torso.norms, strict=True)
    parts = [[layer.weight, layer.bias, norm.scale, norm.offset] for layer, norm in hidden]
    return [[np.array(x, np.float64) for x in part] for part in [*parts, [network.head.weight, network.head.bias]]]


def forward(layers, x):
    x = np.float64(x)
    for weight, bias, scale, offset in layers[:-1]:
        x = x @ weight + bias
        x = (x - x.mean(axis=1, keepdims=True)) / np.sqrt(x.var(axis=1, keepdims=True) + 1e-5) * scale + offset
        x = np.maximum(x, 0.0)
    return x @ layers[-1][0] + layers[-1][1]


def assert_equal(one, two, atol, rtol=0.0):
    for a, b in zip(one, two, strict=True):
        for x, y in zip(a, b, strict=True):
            np.testing.assert_allclose(x, y, atol=atol, rtol=rtol)


class Descent:
    """Plain gradient descent."""

    def __init__(self, layers):
        self.layers = layers

    def step(self, slopes, rate):
        for layer, slope in zip(self.layers, slopes, strict=True):
            for i, g in enumerate(slope):
                layer[i][...] = layer[i] - rate * g


# Targets.


def by_definition(reward, next_value, discount, ended, q_lambda):
    """The sum over n of (1 - lambda) lambda^(n-1) times the n-step return, the last of which has the remaining weight.

    The n-step return sums n rewards and bootstraps from the highest value in the state that follows them. The last one ends
    with the episode or the rollout.
    """
    reward, next_value, discount = np.float64([reward, next_value, discount])
    result = np.zeros_like(reward)
    for t, env in np.ndindex(result.shape):
        rewards, weight = 0.0, 1.0
        for n, k in enumerate(range(t, len(reward)), start=1):
            rewards += weight * reward[k, env]
            weight *= discount[k, env]
            is_last = ended[k, env] or k == len(reward) - 1
            share = q_lambda ** (n - 1) * (1.0 if is_last else 1.0 - q_lambda)
            result[t, env] += share * (rewards + weight * next_value[k, env])
            if is_last:
                break
    return result


returns = jax.jit(pqn.lambda_returns)


@hypothesis_settings(max_examples=60)
@given(
    shape=st.sampled_from([(1, 1), (7, 2), (20, 3)]),
    seed=st.integers(0, 2**32 - 1),
    gamma=st.floats(0.0, 1.0),
    q_lambda=st.floats(0.0, 1.0),
)
def test_targets_equal_the_average_of_n_step_returns_that_defines_them(shape, seed, gamma, q_lambda):
    """A third of the steps each are terminal states, time limits and neither."""
    reward, _, next_value, discount, ended = random_steps(shape, seed, gamma)
    given = returns(reward, next_value, discount, with_last(ended), np.float32(q_lambda))
    expected = by_definition(reward, next_value, discount, ended, np.float32(q_lambda))
    np.testing.assert_allclose(given, expected, rtol=1e-4, atol=1e-5)


def with_last(ended):
    """The last step of a rollout ends it."""
    return np.concatenate([ended[:-1], np.ones_like(ended[:1])])


def test_a_terminal_state_is_worth_nothing_and_a_time_limit_what_it_was_reached_in():
    """Four steps with lambda 1 and gamma 1/2: a terminal state after the second, a time limit after the fourth."""
    reward, next_value = np.float32([[1], [2], [3], [4]]), np.float32([[100], [100], [100], [8]])
    discount, ended = np.float32([[0.5], [0], [0.5], [0.5]]), np.array([[False], [True], [False], [True]])
    given = returns(reward, next_value, discount, ended, np.float32(1.0))
    np.testing.assert_allclose(given[:, 0], [1 + 0.5 * 2, 2, 3 + 0.5 * (4 + 0.5 * 8), 4 + 0.5 * 8])


@pytest.mark.usefixtures("strict_dtypes")
def test_targets_bootstrap_from_the_highest_value_in_the_true_successor():
    """Also where the rollout ends and where padding follows: there the step is the last that counts."""
    _, _, state = make()
    rollout = random_rollout(ACTIONS, valid=LAST_STEP_MISSING)
    data = pqn.samples(state.network, jax.tree.map(jnp.array, rollout), 0.7)
    next_value = forward(parameters(state.network), rollout.next_obs.reshape(-1, 3)).max(axis=1)
    next_value = next_value.reshape(rollout.reward.shape)
    follows_padding = np.concatenate([~rollout.valid[1:], np.ones_like(rollout.valid[:1])])
    ended = rollout.ended | follows_padding
    expected = by_definition(rollout.reward, next_value, rollout.discount, ended, 0.7).reshape(-1)
    valid = rollout.valid.reshape(-1)
    np.testing.assert_allclose(np.asarray(data.target)[valid], expected[valid], atol=1e-5)
    np.testing.assert_array_equal(data.valid, valid)
    np.testing.assert_array_equal(data.action, rollout.action.reshape(-1))


# Losses and updates.


@pytest.mark.parametrize(
    "settings",
    [
        {"max_grad_norm": None},
        {"max_grad_norm": 0.05, "q_lambda": 0.9, "learning_rate": rejeu.Linear(0.04, 0.0)},
    ],
)
def test_three_updates_equal_numpy(settings):
    """14 of 15 steps exist: the last of four minibatches has two. A quarter of the way from 0.04 to 0 the rate is 0.03."""
    config, algorithm, state = make(batch_size=4, n_epochs=2, optimizer="sgd", **settings)
    layers = parameters(state.network)
    optimizer = Descent(layers)
    update = jax.jit(algorithm.update)
    for k in range(3):
        rollout = random_rollout(ACTIONS, seed=k, valid=LAST_STEP_MISSING)
        orders = orders_of(state, rollout.valid, config)
        next_value = forward(layers, rollout.next_obs.reshape(-1, 3)).max(axis=1).reshape(rollout.reward.shape)
        ended = rollout.ended | np.concatenate([~rollout.valid[1:], np.ones_like(rollout.valid[:1])])
        target = by_definition(rollout.reward, next_value, rollout.discount, ended, config.q_lambda).reshape(-1)
        data = rollout.obs.reshape(-1, 3), rollout.action.reshape(-1), target
        found = []
        for order in orders:
            for first in range(0, 14, 4):
                index = order[first : min(first + 4, 14)]
                batch = [part[index] for part in data]
                slopes = gradient(layers, lambda batch=batch: loss_of(layers, *batch)[0])
                norm = np.sqrt(sum(np.sum(x**2) for layer in slopes for x in layer))
                scale = min(1.0, (config.max_grad_norm or np.inf) / norm)
                found.append(loss_of(layers, *batch))
                optimizer.step([[scale * x for x in layer] for layer in slopes], RATE)
        state, metrics = update(state, rollout, CLOCK)
        assert_equal(parameters(state.network), layers, atol=2e-5)
        for field, expected in zip(("loss", "q_value"), np.mean(found, axis=0), strict=True):
            assert float(metrics[field]) == pytest.approx(expected, rel=2e-5, abs=2e-5), field
        assert float(metrics["gradient_steps"]) == len(found) == 8
        assert float(metrics["learning_rate"]) == pytest.approx(RATE)
    assert (int(state.n_updates), int(state.n_rollouts)) == (24, 3)


def loss_of(layers, obs, action, target):
    """Returns the loss of a minibatch and the mean value of its actions."""
    value = forward(layers, obs)[np.arange(len(action)), action]
    return 0.5 * np.mean((value - target) ** 2), value.mean()


def orders_of(state, valid, config):
    """The random order of the valid steps in each epoch: that of uniform numbers, as documented."""
    drawn = jax.random.uniform(nth(state.key, state.n_rollouts), (config.n_epochs, valid.size))
    index = np.flatnonzero(valid.reshape(-1))
    return [index[np.argsort(np.asarray(row)[index], kind="stable")] for row in drawn]


# Exploration.


@pytest.mark.parametrize(
    ("settings", "progress", "expected"),
    [
        (pqn.FOR_MANY, 0.05, 0.5 * (1.0 + 0.001)),
        ({"exploration_initial_eps": 0.8, "exploration_final_eps": 0.2, "exploration_fraction": 0.5}, 0.125, 0.65),
    ],
)
def test_epsilon_follows_the_progress_of_the_run(settings, progress, expected):
    """Of the share epsilon of actions, two thirds are not the best of three."""
    _, algorithm, state = make(**settings)
    clock = CLOCK._replace(progress=np.float32(progress))
    obs = np.random.default_rng(0).normal(size=(1, 3)).astype(np.float32).repeat(20_000, axis=0)
    action = algorithm.explore(state.network, obs, jax.random.PRNGKey(3), clock)
    best = forward(parameters(state.network), obs[:1]).argmax()
    np.testing.assert_array_equal(algorithm.exploit(state.network, obs[:1]), [best])
    assert np.mean(np.asarray(action) != best) == pytest.approx(expected * 2 / 3, abs=0.012)
    _, metrics = jax.jit(algorithm.update)(state, random_rollout(ACTIONS), clock)
    assert float(metrics["exploration_rate"]) == pytest.approx(expected, rel=1e-4)


# The network.


def norms(network):
    parts = jax.tree.leaves(network, is_leaf=lambda node: isinstance(node, LayerNorm))
    return sum(isinstance(part, LayerNorm) for part in parts)


def network_of(space, **shape):
    config = configs.with_widths(pqn.Config(policy_kwargs=shape), leaves(space))
    return jax.eval_shape(pqn.make(config, space, ACTIONS).init, jax.random.PRNGKey(0)).network


def test_every_layer_but_the_last_is_normalized_by_default():
    assert norms(network_of(OBS_SPACE)) == 2
    assert norms(network_of(IMAGE)) == 3  # two convolutions and a linear layer
    assert norms(network_of(gym.spaces.Dict(a=IMAGE, b=OBS_SPACE))) == 5
    assert norms(network_of(IMAGE, cnn_layer_norm=False)) == 0
    assert norms(network_of(OBS_SPACE, layer_norm=False)) == 0
    assert norms(network_of(OBS_SPACE, architecture="simba", n_blocks=1)) == 2  # SimBa's own
    assert [layer.bias.shape for layer in network_of(OBS_SPACE).torso.layers] == [(128,), (128,)]


# Settings.


def test_the_values_for_many_environments_are_those_of_the_authors():
    """Config ``pqn_atari.yaml`` of the authors' code: 32 minibatches of 128 environments times 32 steps have 128 steps."""
    theirs = {
        "learning_rate": 2.5e-4,
        "n_steps": 32,
        "batch_size": 128 * 32 // 32,
        "n_epochs": 2,
        "gamma": 0.99,
        "q_lambda": 0.65,
        "exploration_fraction": 0.1,
        "exploration_initial_eps": 1.0,
        "exploration_final_eps": 0.001,
        "max_grad_norm": 10.0,
        "optimizer": "radam",
    }
    config = pqn.Config(**pqn.FOR_MANY)
    assert {key: getattr(config, key) for key in theirs} == theirs


@pytest.mark.parametrize(("n_envs", "settings"), only_tuples([(9, {})], [(9, {}), (8, pqn.FOR_MANY)]))
def test_values_for_another_number_of_environments_are_warned_of(n_envs, settings):
    agent = rejeu.PQN("MlpPolicy", rejeu.make_vector("jax/CartPole-v1", n_envs), seed=0, **settings)
    with pytest.warns(UserWarning, match=f"environments, and there are {n_envs}"):
        agent.learn(n_envs, lambda agent, turn: False)


# With a constant learning rate of 5e-4, one of these seeds ended at 103 with one environment and two with four.
@pytest.mark.slow
@pytest.mark.parametrize("n_envs", [1, 4, 8])
def test_the_defaults_learn_with_few_environments_on_every_seed(n_envs):
    agents = rejeu.train_seeds(rejeu.PQN, "MlpPolicy", "jax/CartPole-v1", 100_000, seeds=range(100, 106), n_envs=n_envs)
    assert min(agent.evaluate(20, seed=1).mean_return for agent in agents) > 475
