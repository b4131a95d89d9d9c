"""Advantages against plain float64 sums and closed forms."""

import jax
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from rejeu.algorithms.actor_critic.gae import advantages

GAMMA = 0.9
estimate = jax.jit(advantages)


def by_definition(reward, value, next_value, discount, ended, gae_lambda):
    """A_t = sum over k >= t of (prod of lambda discount from t to k - 1) delta_k, up to the end of the episode or rollout.

    Equation 16 of arXiv 1506.02438 as the sum that it is, not as a recursion; one environment after the other.
    """
    reward, value, next_value, discount = np.float64([reward, value, next_value, discount])
    result = np.zeros_like(reward)
    for t, env in np.ndindex(result.shape):
        weight = 1.0
        for k in range(t, len(reward)):
            result[t, env] += weight * (reward[k, env] + discount[k, env] * next_value[k, env] - value[k, env])
            if ended[k, env]:
                break
            weight *= gae_lambda * discount[k, env]
    return result


def random_steps(shape, seed, gamma=GAMMA):
    """Rewards, values and ends of which a third each are terminal states, time limits and none."""
    rng = np.random.default_rng(seed)
    reward, value, next_value = rng.normal(size=(3, *shape)).astype(np.float32)
    how = rng.integers(3, size=shape)
    discount = np.where(how == 1, 0.0, gamma).astype(np.float32)
    return reward, value, next_value, discount, how > 0


@settings(max_examples=60)
@given(
    shape=st.sampled_from([(1, 1), (7, 2), (20, 3)]),
    seed=st.integers(0, 2**32 - 1),
    gamma=st.floats(0.0, 1.0),
    gae_lambda=st.floats(0.0, 1.0),
)
def test_advantages_equal_the_sum_that_defines_them(shape, seed, gamma, gae_lambda):
    steps = random_steps(shape, seed, gamma)
    np.testing.assert_allclose(
        estimate(*steps, np.float32(gae_lambda)), by_definition(*steps, gae_lambda), rtol=1e-5, atol=1e-5
    )


def test_lambda_1_gives_the_return_to_go_minus_the_value():
    """Four steps: a terminal state after the second, a time limit after the fourth, where the value 7 is left over."""
    reward, value = np.float32([[1.0], [2.0], [3.0], [4.0]]), np.float32([[0.5], [0.25], [-1.0], [2.0]])
    next_value = np.float32([[0.25], [100.0], [2.0], [7.0]])
    discount = np.float32([[GAMMA], [0.0], [GAMMA], [GAMMA]])
    ended = np.array([[False], [True], [False], [True]])
    to_go = [1.0 + GAMMA * 2.0, 2.0, 3.0 + GAMMA * 4.0 + GAMMA**2 * 7.0, 4.0 + GAMMA * 7.0]
    given = estimate(reward, value, next_value, discount, ended, np.float32(1.0))
    np.testing.assert_allclose(given[:, 0], np.array(to_go) - value[:, 0], rtol=1e-6)


@pytest.mark.parametrize("gae_lambda", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("limit", [1, 3, 100])
def test_the_right_values_of_an_endless_reward_leave_no_advantage(limit, gae_lambda):
    """Always 1 is worth 1 / (1 - gamma), however often a time limit or the rollout's end cuts it."""
    shape = (12, 2)
    value = np.full(shape, 1.0 / (1.0 - GAMMA), np.float32)
    ended = np.repeat((np.arange(12) % limit == limit - 1)[:, None], 2, axis=1)
    given = estimate(
        np.ones(shape, np.float32), value, value, np.full(shape, GAMMA, np.float32), ended, np.float32(gae_lambda)
    )
    np.testing.assert_allclose(given, np.zeros(shape), atol=1e-5)


def test_the_rollouts_end_bootstraps_from_the_value_of_the_state_reached():
    """Nothing ended; with lambda 1 three rewards are summed and the value 10 of the last state is added."""
    reward, value = np.float32([[1.0], [2.0], [4.0]]), np.float32([[0.0], [0.0], [0.0]])
    given = estimate(
        reward,
        value,
        np.float32([[0.0], [0.0], [10.0]]),
        np.full((3, 1), 0.5, np.float32),
        np.zeros((3, 1), bool),
        np.float32(1.0),
    )
    np.testing.assert_allclose(
        given[:, 0], [1 + 0.5 * 2 + 0.25 * 4 + 0.125 * 10, 2 + 0.5 * 4 + 0.25 * 10, 4 + 0.5 * 10]
    )
