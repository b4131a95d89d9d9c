"""Parking in JAX against highway-env's parking-v0."""

from importlib.metadata import version

import jax
import numpy as np
import pytest
from scipy import stats

pytest.importorskip("highway_env")

from rejeu.envs.functional import make
from rejeu.envs.functional.parking import Parking
from rejeu.envs.functional.vector import reset_all
from rejeu.envs.goals import parking_reward
from rejeu.envs.registry import make_env
from tests.envs.functional import parking

ENV = Parking()
equal_to = pytest.mark.skipif(not version("highway-env").startswith("1.12."), reason="written for highway-env 1.12")


def check(n: int, in_single_precision: bool) -> None:
    recorded, success = parking.record(n)
    crashed = recorded.next_state[:, 4].astype(bool)
    assert success.sum() > n / 10
    assert crashed.sum() > n / 10
    assert recorded.state[:, 7].sum() > n / 1000  # collisions in progress
    assert (np.abs(recorded.state[:, 3]) > 39).sum() > n / 20

    exact = parking.compare(recorded, success, x64=True)
    assert not exact.wrong.any()
    far = np.flatnonzero((exact.state > 1e-5) | (exact.obs > 1e-5) | (exact.reward > 1e-5))
    assert len(far) < n / 100
    assert crashed[far].all()
    assert all(parking.is_unstable(recorded, i, exact.after[i]) for i in far)
    rest = np.setdiff1d(np.arange(n), far)
    assert max(exact.state[rest].max(), exact.obs[rest].max(), exact.reward[rest].max()) < 1e-9

    if in_single_precision:
        rounded = parking.compare(recorded, success, x64=False)
        assert rounded.wrong.mean() < 1e-3
        driving = ~crashed
        assert max(rounded.obs[driving].max(), rounded.reward[driving].max()) < 1e-5


@equal_to
def test_steps_equal_highway_envs():
    check(500, in_single_precision=False)


@equal_to
@pytest.mark.exhaustive
def test_twelve_thousand_steps_equal_highway_envs():
    check(12_000, in_single_precision=True)


@equal_to
def test_first_states_have_highway_envs_distribution():
    env = make_env("parking-v0").unwrapped
    env.reset(seed=0)
    theirs = []
    for _ in range(400):
        env._reset()
        theirs.append(parking.get(env))
    theirs = np.array(theirs)
    state = jax.jit(lambda key: reset_all(ENV, key, 4_000).env)(jax.random.key(0))
    ours = parking.numbers(state)
    assert stats.ks_2samp(ours[:, 2], theirs[:, 2]).pvalue > 1e-4
    np.testing.assert_array_equal(ours[:, [0, 1, 3, 4, 5, 6, 7]], 0)
    for found in (ours, theirs):
        up = np.sin(found[:, 2]) > 0
        assert set(found[up, 8]) == set(range(28)) - {6}
        assert set(found[~up, 8]) == set(range(28)) - {20}
    counts = np.array([(ours[:, 8] == goal).sum() for goal in range(28)])
    expected = len(ours) * np.array([0.5 + 0.5 * (goal not in (6, 20)) for goal in range(28)]) / 27
    assert stats.chisquare(counts, expected).pvalue > 1e-4


def test_the_limit_is_500_steps():
    env = make_env("parking-v0").unwrapped
    env.reset(seed=0)
    env.time = 99.4
    assert [env.step(np.zeros(2))[3] for _ in range(3)] == [False, False, True]
    assert make("jax/Parking-v0").max_episode_steps == 500  # at which steps truncate, as they do when compared


def test_rewards_of_goals_are_those_of_hindsight_on_the_host():
    rng = np.random.default_rng(0)
    achieved, desired = rng.normal(size=(2, 5, 3, 6)).astype(np.float32)
    np.testing.assert_allclose(ENV.compute_reward(achieved, desired), parking_reward(achieved, desired), rtol=1e-6)
    near = achieved + 0.01 * desired
    for goal, some in ((desired, False), (near, True)):
        ends = np.asarray(ENV.compute_terminated(achieved, goal))
        np.testing.assert_array_equal(ends, parking_reward(achieved, goal) > -0.12)
        assert ends.any() == some
