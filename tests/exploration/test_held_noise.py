"""Noise that is held: how long, in which actions, and for which algorithms."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms import crossq, flashsac, sac, tqc, xqc
from rejeu.algorithms.sac import continuous
from rejeu.core.algorithm import Clock
from rejeu.exploration.held_noise import spells
from tests.algorithms.batches import BOX, DISCRETE, OBS_DIM, OBS_SPACE
from tests.tiers import only

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.5))


def test_spells_have_probabilities_proportional_to_the_inverse_square():
    found = np.asarray(spells(jax.random.PRNGKey(0), 60_000, 5))
    weights = 1 / np.arange(1, 6) ** 2
    np.testing.assert_allclose(np.bincount(found, minlength=6)[1:] / found.size, weights / weights.sum(), atol=0.01)
    assert (spells(jax.random.PRNGKey(0), 10, 1) == 1).all()


@pytest.mark.parametrize("module", only([sac], [sac, tqc, crossq]))
def test_an_action_is_the_policy_with_noise_that_stays_for_a_spell(module):
    algorithm = module.make(module.Config(noise_repeat=4, policy_kwargs={"net_arch": [5]}), OBS_SPACE, BOX)
    actor = algorithm.actor(algorithm.init(jax.random.PRNGKey(1)))
    carry = algorithm.explorer.init(actor, 2)
    rng, noises, left = np.random.default_rng(0), [], []
    for i in range(60):
        obs = jnp.asarray(rng.normal(size=(2, OBS_DIM)), jnp.float32)
        ended = jnp.array([i == 30, i == 0])
        action, carry = algorithm.explorer.act(carry, actor, obs, ended, jax.random.PRNGKey(i), CLOCK)
        mean, log_std = (np.float64(part) for part in continuous.policy(actor, obs))
        np.testing.assert_allclose(action, np.tanh(mean + np.exp(log_std) * np.float64(carry.noise)), atol=1e-5)
        noises.append(np.asarray(carry.noise))
        left.append(np.asarray(carry.left))
    for env, begins in ((0, 30), (1, 0)):
        changes = [i for i in range(1, 60) if (noises[i][env] != noises[i - 1][env]).any()]
        assert begins in (0, *changes)
        assert (
            1
            <= min(b - a for a, b in itertools.pairwise(changes))
            < max(b - a for a, b in itertools.pairwise(changes))
            <= 4
        )
        for i in changes:
            assert left[i - 1][env] == 0 or i == begins


@pytest.mark.parametrize("module", only([crossq, flashsac], [sac, tqc, crossq, flashsac, xqc]))
def test_noise_is_drawn_anew_where_an_episode_begins_and_else_after_its_spell(module):
    settings = {"noise_repeat": 9, "policy_kwargs": {"net_arch": [4]}}
    algorithm = module.make(module.Config(**settings), OBS_SPACE, BOX)
    shapes = jax.eval_shape(algorithm.actor, jax.eval_shape(algorithm.init, jax.random.PRNGKey(1)))
    carry = algorithm.explorer.init(shapes, 3)._replace(left=jnp.array([5, 5, 0]))
    actor = jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), shapes)
    obs, ended = jnp.zeros((3, OBS_DIM)), jnp.array([True, False, False])
    _, after = algorithm.explorer.act(carry, actor, obs, ended, jax.random.PRNGKey(2), CLOCK)
    assert (np.asarray(after.noise != carry.noise).any(axis=1) == [True, False, True]).all()
    assert int(after.left[1]) == 4


def test_the_entropy_of_a_standard_deviation_is_that_of_a_normal_distribution():
    config = sac.Config(target_entropy="std_0.15")
    draws = np.random.default_rng(0).normal(size=(100_000, 3)) * 0.15
    density = -0.5 * (draws / 0.15) ** 2 - np.log(0.15 * np.sqrt(2 * np.pi))
    assert config.entropy_target(-3.0, 3) == pytest.approx(-density.sum(axis=1).mean(), abs=0.02)


def test_what_goes_without_it_is_refused():
    with pytest.raises(ValueError, match="noise_repeat=4 is not available with action_noise"):
        sac.Config(noise_repeat=4, action_noise=0.1)
    with pytest.raises(ValueError, match="noise_repeat=4 is not available with lstm_hidden_size"):
        sac.Config(noise_repeat=4, policy_kwargs={"lstm_hidden_size": 4})
    with pytest.raises(ValueError, match="use_sde=True explores by itself"):
        sac.Config(noise_repeat=4, use_sde=True)
    for settings in ({"noise_repeat": 4}, {"target_entropy": "std_0.2"}):
        with pytest.raises(ValueError, match="needs Box actions"):
            sac.make(sac.Config(**settings), OBS_SPACE, DISCRETE)
    for value in ("std_0", "std_x", "much"):
        with pytest.raises(ValueError, match=r"must be 'auto', 'std_0\.15' or a number"):
            sac.Config(target_entropy=value)
