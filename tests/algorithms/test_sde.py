"""State-dependent exploration (gSDE): when the matrix of its noise is sampled."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms.actor_critic.network import sde_explorer

ACTOR = SimpleNamespace(
    log_std=jnp.zeros((3, 1)),
    use_expln=False,
    hidden=lambda obs: obs,
    distribution=lambda hidden, mask: SimpleNamespace(mean=jnp.zeros((2, 1))),
)
ENDS = {0: [0, 1], 4: [0], 8: [1]}
"""Environments that begin an episode with a step."""


@pytest.mark.parametrize(
    ("n_steps", "restarts", "expected"),
    [
        (3, True, [[0, 3, 4, 7, 10], [0, 3, 6, 8, 11]]),  # counted from the beginning of each episode
        (3, False, [[0, 3, 4, 6, 9], [0, 3, 6, 8, 9]]),  # of the run
        (-1, True, [[0, 4], [0, 8]]),
    ],
)
def test_noise_is_sampled_every_n_steps_and_where_an_episode_begins(n_steps, restarts, expected):
    explorer = sde_explorer(n_steps, restarts)
    carry, sampled = explorer.init(ACTOR, 2), [[], []]
    for step in range(12):
        before = np.array(carry[0])
        ended = np.isin(np.arange(2), ENDS.get(step, []))
        action, carry = explorer.act(carry, ACTOR, jnp.ones((2, 3)), ended, jax.random.key(step), None)
        np.testing.assert_allclose(action, np.sum(carry[0], axis=1), rtol=1e-5)
        for env in range(2):
            sampled[env] += [step] * (not np.array_equal(before[env], carry[0][env]))
    assert sampled == expected
