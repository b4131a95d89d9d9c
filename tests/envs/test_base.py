"""Seeds, steps, infos and descriptions that all vectors share, and the wrappers for old environments."""

import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.envs import base
from rejeu.envs.wrappers import to_space
from tests.environments import Counter


def test_seeds_are_checked_up_to_their_bounds():
    assert base.checked_seed(None, 2) is None
    assert base.checked_seed(np.int64(2**40), 2) == 2**40  # one number is of the vector
    assert base.checked_seed(np.array([0, 2**31 - 2]), 2) == (0, 2**31 - 2)
    for wrong in ([0, 2**31 - 1], [0, -1], [0], [0.0, 1.0]):
        with pytest.raises(ValueError, match="seed"):
            base.checked_seed(wrong, 2)


@pytest.mark.parametrize(("env_id", "backend"), [("CartPole-v1", "gymnasium"), ("jax/CartPole-v1", "jax")])
def test_a_reset_takes_seeds_of_numpy_and_names_one_that_is_none(env_id, backend):
    vector = rejeu.make_vector(env_id, 2, backend)
    expected = vector.reset(3).copy()
    np.testing.assert_array_equal(vector.reset(np.int64(3)), expected)
    expected = vector.reset([5, 1]).copy()
    np.testing.assert_array_equal(vector.reset(np.array([5, 1])), expected)
    for seed in (-1, 1.0, "3", [1, 2, 3]):
        with pytest.raises(
            ValueError, match=r"seed=.* must be a whole number from 0, or a sequence of 2, one for each"
        ):
            vector.reset(seed)


def test_runs_have_seeds_of_their_own():
    seeds = [base.seed_of_run(seed) for seed in range(50)]
    assert len({*seeds}) == 50
    assert seeds[7] == np.random.SeedSequence([7, base.OF_ENVIRONMENTS]).generate_state(1)[0] // 2
    assert max(seeds) < 2**31


def test_the_return_of_an_episode_is_that_of_its_monitor_if_there_is_one():
    step = base.Step(None, np.zeros(3), *[np.zeros(3, bool)] * 2, [{}] * 3, np.array([5.0, math.nan, 0.0]))
    assert [step.return_of(i, 9.0) for i in range(3)] == [5.0, 9.0, 0.0]
    assert step._replace(returns=None).return_of(0, 9.0) == 9.0


def test_infos_of_a_vector_are_those_of_its_environments():
    final = {"x": np.array([7, 0]), "_x": np.array([True, False])}
    info = {"x": np.array([1, 2]), "y": np.array([3, 4]), "_y": np.array([False, True]), "size": 5}
    assert base.each_info(info, 2) == [{"x": 1}, {"x": 2, "y": 4}]
    info |= {"final_info": final, "_final_info": np.array([True, False])}
    assert base.each_info(info, 2) == [{"x": 7}, {"x": 2, "y": 4}]
    assert base.each_info(info, 2, begun=True) == [{"x": 1, "final_info": {"x": 7}}, {"x": 2, "y": 4}]
    assert (base.each_info([{"a": 1}], 1), base.each_info(None, 2)) == ([{"a": 1}], [{}, {}])


def test_environments_that_only_step_together_show_the_active_ones():
    seen = []

    def step_all(action):
        seen.append(action.tolist())
        flags = np.array([True, True, False])
        return base.Step(np.arange(3.0)[:, None], np.ones(3), flags, ~flags, [{}] * 3)

    before, active = np.full((3, 1), -1.0), np.array([False, True, True])
    step = base.step_whole(step_all, before, np.array([[5.0], [6.0], [7.0]]), active)
    assert seen == [[[6.0], [6.0], [7.0]]]  # what the first is given is allowed for another
    assert step.obs.tolist() == [[-1.0], [1.0], [2.0]]
    assert (step.reward.tolist(), step.terminated.tolist(), step.truncated.tolist()) == (
        [0.0, 1.0, 1.0],
        [False, True, False],
        [False, False, True],
    )


def test_what_is_known_of_a_registration():
    assert base.describe_spec(gym.make("MountainCar-v0")) == ("MountainCar-v0", 200, -110.0)
    assert base.describe_spec(Counter()) == ("Counter", None, None)
    assert base.describe_spec(gym.make("rejeu/Ball-v0"))[1] == 500


def test_time_limits_terminate_and_ends_stay_ends():
    for ends in ("truncated", "terminated"):
        env = rejeu.TimeLimitTerminates(Counter((2,), ends))
        env.reset()
        assert [env.step(np.zeros(1))[2:4] for _ in range(2)] == [(False, False), (True, False)]


def test_an_old_environment_is_seeded_drawn_and_closed():
    calls = []
    old = SimpleNamespace(
        observation_space=SimpleNamespace(low=np.zeros(2), high=1.0, shape=(2,)),
        action_space=gym.spaces.Discrete(2),
        seed=lambda seed: calls.append(("seed", seed)),
        reset=lambda: [0, 1],
        render=lambda: "picture",
        close=lambda: calls.append("close"),
    )
    env = rejeu.OldEnvironment(old)
    env.reset(seed=3)
    obs, info = env.reset()
    assert (obs.dtype, obs.tolist(), info, env.render()) == (np.float32, [0, 1], {}, "picture")
    env.close()
    assert calls == [("seed", 3), "close"]
    del old.close
    env.close()
    assert env.observation_space == gym.spaces.Box(0, 1, (2,), np.float32)
    bytes_ = SimpleNamespace(low=np.zeros(3, np.uint8), high=np.full(3, 9, np.uint8), dtype=np.uint8)
    assert to_space(bytes_) == gym.spaces.Box(0, 9, (3,), np.uint8)


def test_the_cart_pole_without_velocities_shows_place_and_angle():
    whole, part = gym.make("CartPole-v1"), gym.make("rejeu/CartPoleNoVelocity-v0")
    obs, shown = whole.reset(seed=4)[0], part.reset(seed=4)[0]
    for _ in range(5):
        np.testing.assert_array_equal(shown, obs[[0, 2]])
        obs, shown = whole.step(1)[0], part.step(1)[0]
    np.testing.assert_array_equal(part.observation_space.high, whole.observation_space.high[[0, 2]])
