"""The classic control tasks in JAX against Gymnasium's."""

import gymnasium as gym
import jax
import numpy as np
import pytest
from scipy import stats

from rejeu.envs.functional import make
from rejeu.envs.functional.vector import reset_all
from tests.envs.functional.classic_control import CASES, Case, difference
from tests.tiers import only

each_case = pytest.mark.parametrize("case", CASES, ids=[case.env_id for case in CASES])


@each_case
def test_steps_equal_gymnasiums_in_double_precision(case: Case):
    found = difference(case, 4_000, x64=True)
    assert found.n_terminated == 0
    assert found.state < case.rounding
    assert found.reward < 1e-12
    assert found.obs < 1e-6  # Gymnasium rounds observations to float32


@pytest.mark.parametrize("case", only(CASES[1:2], CASES), ids=[case.env_id for case in CASES])
def test_steps_are_gymnasiums_rounded_to_single_precision(case: Case):
    found = difference(case, 4_000, x64=False)
    assert found.n_terminated == 0
    assert max(found.state, found.obs) < 1e-5
    assert found.reward < 2e-5  # of at most 17


@each_case
def test_first_states_have_gymnasiums_distribution(case: Case):
    theirs = gym.make(case.env_id)
    expected = np.array([theirs.reset(seed=i)[0] for i in range(500)])
    drawn = np.asarray(jax.jit(lambda key: reset_all(case.env, key, 2_000).obs)(jax.random.key(0)))
    for ours, reference in zip(drawn.T, expected.T, strict=True):
        if np.ptp(reference) == 0:
            np.testing.assert_array_equal(ours, reference[0])
        else:
            assert stats.ks_2samp(ours, reference).pvalue > 1e-4


@each_case
def test_spaces_limits_and_thresholds_are_gymnasiums(case: Case):
    theirs = gym.make(case.env_id)
    ours = make(f"jax/{case.env_id}")
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.max_episode_steps == theirs.spec.max_episode_steps
