"""Advantages against plain float64 sums and closed forms."""

from __future__ import annotations

import jax
import numpy as np
from hypothesis import given, settings, strategies as st

from rejeu.algorithms.actor_critic.gae import advantages

GAMMA = 0.9
estimate = jax.jit(advantages)


def by_definition(reward, value, next_value, discount, ended, gae_lambda):
    """A_t = sum over k >= t of (prod of lambda discount from t to k - 1) delta_k, up to the end of the episode or rollout.

    Equation 16 of arXiv 1506.02438 as the sum that it is, not as a recursion; one environment after the other.
    """
    reward, value, next_value, discount = map(np.float64, (reward, value, next_value, discount))
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
