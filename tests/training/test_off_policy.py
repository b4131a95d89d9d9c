"""When off-policy learning takes gradient steps, on the host and on the device, against counting step by step."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from rejeu.algorithms.config import OffPolicyConfig
from rejeu.training import off_policy
from rejeu.training.compiled import off_policy as on_device


def host_turns(config, learn_from):
    """A function of the steps and the ended episodes of a turn that returns the gradient steps which are due."""
    run = SimpleNamespace(step=0, learn_from=learn_from, owed=0, steps_since_update=0, env=SimpleNamespace())
    run.replay = SimpleNamespace(size=lambda: run.step)

    def turn(taken, ended):
        run.step, run.env.n_envs = run.step + taken, taken
        return off_policy.due(run, config, ended)

    return turn


due_on_device = jax.jit(on_device.due, static_argnums=0)


def device_turns(config, learn_from):
    counts = on_device.Counts(np.uint32(0), *np.zeros(3, np.int32))

    def turn(taken, ended):
        nonlocal counts
        n, counts = due_on_device(config, counts, np.int32(taken), np.int32(ended), np.uint32(learn_from))
        return int(n)

    return turn


@pytest.mark.parametrize("turns", [host_turns, device_turns])
@pytest.mark.parametrize("gradient_steps", [3, -1])
def test_steps_up_to_learning_starts_bring_no_gradient_steps_and_later_ones_one_period_after_the_other(
    turns, gradient_steps
):
    for train_freq in (1, 4):
        config = OffPolicyConfig(train_freq=train_freq, gradient_steps=gradient_steps)
        for n_envs, learn_from in product((1, 3, 8), (0, 5, 16)):
            turn, taken, since = turns(config, learn_from), 0, 0
            for _ in range(12):
                periods = 0
                for _ in range(n_envs):
                    taken += 1
                    since += taken > learn_from
                    periods += taken > learn_from and (taken - learn_from) % train_freq == 0
                expected = periods * gradient_steps if gradient_steps > 0 else since if periods else 0
                since = 0 if periods else since
                assert turn(n_envs, 0) == expected, (train_freq, n_envs, learn_from, taken)


@pytest.mark.parametrize("turns", [host_turns, device_turns])
def test_episodes_count_from_the_first_turn_beyond_learning_starts(turns):
    turn = turns(OffPolicyConfig(train_freq=(2, "episode"), gradient_steps=3), 16)
    ended = [(8, 1), (8, 1), (8, 1), (8, 0), (8, 1), (8, 4), (8, 1), (8, 1)]
    assert [turn(*one) for one in ended] == [0, 0, 0, 0, 3, 6, 0, 3]


def test_periods_end_where_a_multiple_of_their_length_is_crossed():
    for every, n_envs in product((1, 3, 8), (1, 2, 5)):
        config = OffPolicyConfig(train_freq=every)
        for step in range(n_envs, 40, n_envs):
            crossed = any(one % every == 0 for one in range(step - n_envs + 1, step + 1))
            run = SimpleNamespace(step=step, env=SimpleNamespace(n_envs=n_envs))
            assert off_policy.reaches(run, config, 0) == crossed
