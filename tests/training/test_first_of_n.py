"""Off-policy learning where environments do not wait for each other."""

from __future__ import annotations

import contextlib
import functools

import numpy as np
import pytest

from rejeu.envs.make import make_vector
from tests.helpers import assert_same_parameters, small_sac
from tests.tiers import only
from tests.worker_environments import Paced, in_order

SETTINGS = {
    "plain": {},
    "noise": {"action_noise": "ou(0.2)"},
    "parameter noise": {"action_noise": "parameter(0.1)"},
    "normalize": {"normalize": True},
    "n-step": {"n_steps": 3},
    "prioritized": {"priorities": {}},
    "whole episodes": {"train_freq": (1, "episode")},
    "no overlap": {"overlap": False},
}


def trained(wait_for, total=70, n_envs=3, **settings):
    make = functools.partial(Paced, seconds=0.002)
    with contextlib.closing(make_vector(make, n_envs, "gymnasium-async", seed=0, wait_for=wait_for)) as env:
        return small_sac(env if wait_for is None else in_order(env), **settings).learn(total)


@pytest.mark.parametrize("settings", only(["plain"], SETTINGS))
def test_waiting_for_all_is_lockstep(settings):
    lockstep, agent = trained(None, **SETTINGS[settings]), trained(3, **SETTINGS[settings])
    assert_same_parameters(lockstep, agent)
    for name, array in lockstep.replay_buffer.arrays().items():
        np.testing.assert_array_equal(array, agent.replay_buffer.arrays()[name])
    np.testing.assert_array_equal(lockstep.history.table()[:, :5], agent.history.table()[:, :5])


@pytest.mark.parametrize("settings", only(["noise"], SETTINGS))
def test_a_run_depends_on_the_order_of_arrival_and_on_nothing_else(settings):
    live, again = trained(2, **SETTINGS[settings]), trained(2, **SETTINGS[settings])
    assert live.num_timesteps == again.num_timesteps == 70
    assert_same_parameters(live, again)
