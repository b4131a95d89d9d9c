"""A time limit as a terminal state."""

from __future__ import annotations

import numpy as np

import rejeu
from tests.environments import Counter
from tests.helpers import small_sac


def test_with_the_wrapper_nothing_is_bootstrapped_from_the_end_that_a_time_limit_makes():
    """Episodes of 3 steps that are cut off: without the wrapper none terminates, with it every third step does."""
    kinds = []
    for env in (Counter((3,), "truncated"), rejeu.TimeLimitTerminates(Counter((3,), "truncated"))):
        buffer = small_sac(env, learning_starts=100).learn(9).replay_buffer
        batch = buffer.sample(np.random.default_rng(0), (64,))
        kinds.append(sorted({float(discount) for discount in batch.discount}))
    gamma = float(np.float32(0.99))
    assert kinds == [[gamma], [0.0, gamma]]
