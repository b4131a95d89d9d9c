"""QR-DQN's loss against loops in float64, its target, its update, and the distributions that it learns."""

import functools

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import rejeu
from rejeu.algorithms import dqn, qrdqn
from rejeu.core.algorithm import TD_ERROR, Clock, Transition
from tests.algorithms.test_dqn import (
    BATCH,
    CLOCK,
    N_ACTIONS,
    OBS_SPACE,
    forward,
    random_batch,
)

ACTION_SPACE = gym.spaces.Discrete(N_ACTIONS)
N_QUANTILES = 3
RETURNS = qrdqn.quantile_returns(N_QUANTILES)


@functools.cache
def make(**settings):
    settings = {"n_quantiles": N_QUANTILES, "policy_kwargs": {"net_arch": [5, 4]}, **settings}
    algorithm = qrdqn.make(qrdqn.Config(**settings), OBS_SPACE, ACTION_SPACE)
    return algorithm, algorithm.init(jax.random.PRNGKey(1))


def numpy_quantiles(network, obs):
    return forward(network.outputs, obs).reshape(len(obs), N_ACTIONS, N_QUANTILES)


def numpy_quantile_huber(current, target):
    """Sum over quantiles i of the mean over samples j of |tau_i - 1{u < 0}| h(u), u = y_j - theta_i: plain loops."""
    n, total = len(current), 0.0
    for i, theta in enumerate(current):
        tau = (2 * i + 1) / (2 * n)
        for y in target:
            u = float(y) - float(theta)
            h = u * u / 2 if abs(u) <= 1 else abs(u) - 0.5
            total += abs(tau - (1 if u < 0 else 0)) * h / len(target)
    return total


def test_network_gives_the_means_of_its_quantiles():
    _, state = make()
    obs = random_batch().obs
    expected = numpy_quantiles(state.network, obs)
    np.testing.assert_allclose(state.network(obs), expected, atol=1e-5)
    np.testing.assert_allclose(RETURNS.values(state.network, obs, None), expected.mean(axis=2), atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_td_target_moves_the_quantiles_of_the_action_with_the_highest_mean():
    _, state = make()
    batch = random_batch()
    given = dqn.td_target(state.network, state.network, batch, False, RETURNS)
    following = numpy_quantiles(state.network, batch.next_obs)
    expected = [
        batch.reward[i] + batch.discount[i] * following[i, following[i].mean(axis=1).argmax()] for i in range(BATCH)
    ]
    np.testing.assert_allclose(given, expected, atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
@pytest.mark.parametrize("weighted", [False, True])
def test_quantile_loss_equals_loops(weighted):
    _, state = make()
    batch = random_batch(weighted=weighted)
    target = np.linspace(-3.0, 3.0, BATCH * N_QUANTILES, dtype=np.float32).reshape(BATCH, N_QUANTILES)
    loss, (error, value) = dqn.td_loss(state.network, batch, jnp.array(target), RETURNS)
    expected = numpy_quantiles(state.network, batch.obs)[np.arange(BATCH), batch.action]
    np.testing.assert_allclose(value, expected.mean(axis=1), atol=1e-5)
    np.testing.assert_allclose(error, expected.mean(axis=1) - target.mean(axis=1), atol=1e-5)
    weights = batch.weight if weighted else np.ones(BATCH)
    losses = [w * numpy_quantile_huber(c, t) for w, c, t in zip(weights, expected, target, strict=True)]
    assert float(loss) == pytest.approx(np.mean(losses), abs=1e-5)


def test_update_reports_the_difference_of_means_as_td_error():
    algorithm, state = make()
    batch = random_batch()
    _, metrics = jax.jit(algorithm.update)(state, batch, CLOCK)
    current = numpy_quantiles(state.network, batch.obs)[np.arange(BATCH), batch.action].mean(axis=1)
    following = numpy_quantiles(state.network, batch.next_obs).mean(axis=2).max(axis=1)
    np.testing.assert_allclose(
        metrics[TD_ERROR], np.abs(current - batch.reward - batch.discount * following), atol=1e-5
    )
    assert float(metrics["q_value"]) == pytest.approx(current.mean(), abs=1e-5)


def test_update_descends_by_adam_with_the_papers_epsilon():
    """One step of optax's own Adam with epsilon 0.01 / batch_size, 0.01 / 4 here, is what the update takes."""
    algorithm, state = make(learning_rate=0.1, batch_size=4)
    batch = random_batch()
    after, _ = jax.jit(algorithm.update)(state, batch, CLOCK)
    target = dqn.td_target(state.network, state.target_network, batch, False, RETURNS)
    gradient, _ = jax.grad(dqn.td_loss, has_aux=True)(state.network, batch, target, RETURNS)
    optimizer = optax.adam(0.1, eps=0.01 / 4)
    step, _ = optimizer.update(gradient, optimizer.init(state.network))
    expected = optax.apply_updates(state.network, step)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), after.network, expected)
    assert np.abs(after.network.outputs.head.bias - state.network.outputs.head.bias).max() > 1e-2


def test_quantiles_of_a_coin_are_learnt():
    """A reward of -10 or 10, then the end; two quantiles, of levels 1/4 and 3/4.

    Near -10 the gradient vanishes where the pull of the +10, tau / 2, equals the push of the -10, (1 - tau) (theta + 10)
    / 2: for tau = 1/4, theta = -10 + 1/3. By symmetry the other is 10 - 1/3. (Quantiles proper are -10 and 10; the
    thirds are what Huber's rounding costs.)
    """
    obs, action = np.zeros((2, 3), np.float32), np.zeros(2, np.int32)
    batch = Transition(obs, action, np.float32([-10.0, 10.0]), obs, np.zeros(2, np.float32))
    algorithm, state = make(n_quantiles=2, learning_rate=rejeu.Linear(0.1, 0.0))

    def update(state, progress):
        return algorithm.update(state, batch, Clock(jnp.uint32(1), jnp.uint32(0), progress))[0], None

    state, _ = jax.jit(lambda s: jax.lax.scan(update, s, jnp.linspace(0.0, 1.0, 2_000)))(state)
    quantiles = state.network(obs[:1])[0, 0]
    np.testing.assert_allclose(quantiles, [-10 + 1 / 3, 10 - 1 / 3], atol=0.02)
