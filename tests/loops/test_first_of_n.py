"""Off-policy learning where environments do not wait for each other."""

from __future__ import annotations

import contextlib
import functools

import numpy as np
import pytest

from rejeu.envs.make import make_vector
from tests.helpers import assert_same_parameters, small_sac
from tests.tiers import only
from tests.worker_environments import Paced

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


def trained(wait_for, total=70, n_envs=3, arrivals=None, **settings):
    make = functools.partial(Paced, seconds=0.002)
    with contextlib.closing(
        make_vector(make, n_envs, "gymnasium-async", seed=0, wait_for=wait_for, arrivals=arrivals)
    ) as env:
        agent = small_sac(env, **settings)
        agent.learn(total)
        return agent, None if wait_for is None else env.arrivals


@pytest.mark.parametrize("settings", only(["plain"], SETTINGS))
def test_waiting_for_all_is_lockstep(settings):
    lockstep, _ = trained(None, **SETTINGS[settings])
    agent, arrivals = trained(3, **SETTINGS[settings])
    assert_same_parameters(lockstep, agent)
    np.testing.assert_array_equal(arrivals, np.tile(np.arange(3), (24, 1)))
    for name, array in lockstep.replay_buffer.arrays().items():
        np.testing.assert_array_equal(array, agent.replay_buffer.arrays()[name])
    np.testing.assert_array_equal(lockstep.history.table()[:, :5], agent.history.table()[:, :5])


@pytest.mark.parametrize("settings", only(["noise"], SETTINGS))
def test_a_run_repeats_from_the_record_of_arrivals(settings):
    live, arrivals = trained(2, **SETTINGS[settings])
    again, repeated = trained(2, arrivals=arrivals, **SETTINGS[settings])
    np.testing.assert_array_equal(arrivals, repeated)
    assert live.num_timesteps == again.num_timesteps == 70
    assert_same_parameters(live, again)
