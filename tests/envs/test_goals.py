"""The goal functions that hindsight replay calls."""

import abc
import contextlib

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.core.errors import BadEnvironmentError
from rejeu.envs import checker
from rejeu.envs.goals import goal_functions, over_batches, parking_reward
from rejeu.envs.make import GymnasiumVector, InProcess, make_vector
from rejeu.envs.registry import make_env
from tests.environments import Counter, Reach
from tests.helpers import small_sac
from tests.tiers import only


def goals(n, dim=2, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, dim)).astype(np.float32), rng.normal(size=(n, dim)).astype(np.float32)


def distance(achieved, desired, info):
    return -np.linalg.norm(achieved - desired, axis=-1)


def one_distance(achieved, desired, info):
    assert achieved.ndim == 1, "one row at a time"
    return -float(np.linalg.norm(achieved - desired))


def counted(function):
    def call(achieved, desired, info):
        call.shapes.append(np.shape(achieved))
        return function(achieved, desired, info)

    call.shapes = []
    return call


def test_parking_reward_equals_that_of_highway_env():
    env = make_vector("parking-v0", backend="gymnasium").envs[0].unwrapped
    achieved, desired = goals(200, 6)
    expected = [env.compute_reward(a, d, {}) for a, d in zip(achieved, desired, strict=True)]
    np.testing.assert_allclose(parking_reward(achieved, desired), expected, rtol=1e-5)


@pytest.mark.parametrize("function", [distance, one_distance])
def test_rewards_of_a_batch_are_those_of_its_rows(function):
    achieved, desired = goals(20)
    expected = [distance(a, d, {}) for a, d in zip(achieved, desired, strict=True)]
    batched = over_batches(function, np.float32)
    for _ in range(2):
        given = batched(achieved, desired)
        assert given.dtype == np.float32
        np.testing.assert_allclose(given, expected, rtol=1e-6)


def test_a_vectorized_function_is_called_once_a_batch_after_it_was_found_out():
    function = counted(distance)
    batched = over_batches(function, np.float32)
    batched(*goals(20))
    function.shapes.clear()
    for n in (20, 7, 1):
        batched(*goals(n))
    assert function.shapes == [(20, 2), (7, 2), (1, 2)]


def test_whether_a_function_is_vectorized_is_found_out_once():
    function = counted(one_distance)
    batched = over_batches(function, np.float32)
    batched(*goals(20))
    function.shapes.clear()
    batched(*goals(5))
    assert function.shapes == [(2,)] * 5


def test_a_function_that_answers_batches_with_one_number_is_called_by_row():
    """A norm over all axes, and a comparison of whole arrays: both forget the batch."""
    achieved, desired = goals(6)
    batched = over_batches(lambda a, d, info: -np.linalg.norm(a - d), np.float32)
    np.testing.assert_allclose(batched(achieved, desired), distance(achieved, desired, {}), rtol=1e-6)


def test_a_function_that_mixes_rows_is_called_by_row():
    """Of a batch it says something of the right shape with the wrong values: the sum over all rows in each."""

    def mixing(achieved, desired, info):
        total = np.sum(achieved - desired)
        return np.full(len(achieved), total) if achieved.ndim == 2 else total

    achieved, desired = goals(6)
    given = over_batches(mixing, np.float32)(achieved, desired)
    np.testing.assert_allclose(given, (achieved - desired).sum(axis=1), rtol=1e-5)


def test_an_exception_of_a_function_of_goals_says_which_goals_it_was_given():
    batched = over_batches(lambda achieved, desired, info: -abs(achieved[:, 0] - desired[:, 0]), np.float32)
    with pytest.raises(
        BadEnvironmentError, match=r"raised IndexError of goals of the shape \(2,\): too many"
    ) as caught:
        batched(*goals(20))
    assert isinstance(caught.value.__cause__, IndexError)


def test_a_single_row_does_not_decide():
    """One row of one number could be either; the decision waits for two."""
    function = counted(distance)
    batched = over_batches(function, np.float32)
    batched(*goals(1))
    batched(*goals(9))
    function.shapes.clear()
    batched(*goals(9))
    assert function.shapes == [(9, 2)]


def test_the_reward_receives_achieved_before_desired():
    functions = goal_functions(Asymmetric())
    achieved, desired = np.array([[1.0], [2.0]]), np.array([[10.0], [20.0]])
    np.testing.assert_array_equal(functions.reward(achieved, desired), [1.0 - 20.0, 2.0 - 40.0])
    assert functions.terminated(achieved, desired).tolist() == [True, True]
    assert functions.terminated(desired, achieved).tolist() == [False, False]
    assert functions.terminated(achieved, desired).dtype == bool


class Asymmetric(Reach):
    def compute_reward(self, achieved, desired, info):
        return achieved[..., 0] - 2 * desired[..., 0]

    def compute_terminated(self, achieved, desired, info):
        return achieved[..., 0] < desired[..., 0]


def test_goal_functions_are_found_beneath_wrappers():
    assert goal_functions(gym.wrappers.TimeLimit(Reach(), 5)).reward is not None
    assert goal_functions(Reach()).terminated is None


class Unfinished(Reach):
    @abc.abstractmethod
    def compute_terminated(self, achieved, desired, info):
        raise NotImplementedError


def test_an_abstract_method_is_none():
    """As FrankaKitchen of Gymnasium-Robotics has one."""
    assert goal_functions(Unfinished()).terminated is None
    checker.check_env(Unfinished(), warn=False)


def test_an_environment_without_compute_reward_has_no_goal_functions():
    assert goal_functions(Counter()) is None
    assert InProcess([Counter()]).goals() is None
    assert make_vector("Pendulum-v1", backend="envpool").goals() is None


def test_vectors_of_goal_environments_offer_their_functions():
    achieved, desired = np.zeros((3, 1)), np.array([[0.0], [0.4], [0.6]])
    synchronous = GymnasiumVector(gym.vector.SyncVectorEnv([Reach]))
    for vector in (InProcess([Reach()]), synchronous):
        np.testing.assert_array_equal(vector.goals().reward(achieved, desired), [0.0, 0.0, -1.0])


def test_envpool_and_highway_env_reward_parking_and_end_alike():
    """highway-env has no ``compute_terminated``; its episodes end where ``_is_success`` says."""
    achieved, desired = goals(50, 6)
    near = achieved + 0.01 * desired
    own = make_env("parking-v0").unwrapped
    envpool, gymnasium, hard = (
        make_vector(name, backend=b).goals()
        for name, b in (("parking-v0", "envpool"), ("parking-v0", "gymnasium"), ("rejeu/ParkingHard-v0", "gymnasium"))
    )
    for goal in (desired, near):
        np.testing.assert_allclose(envpool.reward(achieved, goal), gymnasium.reward(achieved, goal), rtol=1e-5)
        ends = [bool(own._is_success(*pair)) for pair in zip(achieved, goal, strict=True)]
        assert any(ends) == (goal is near)
        for functions in (envpool, gymnasium, hard):
            np.testing.assert_array_equal(functions.terminated(achieved, goal), ends)


class ReachNested(Reach):
    """Goals are a position and whether a gripper is open."""

    goal_space = gym.spaces.Dict(
        {"at": gym.spaces.Box(-20.0, 20.0, (1,)), "open": gym.spaces.Tuple([gym.spaces.Discrete(2)])}
    )
    observation_space = gym.spaces.Dict(
        {"observation": gym.spaces.Box(-20.0, 20.0, (1,)), "achieved_goal": goal_space, "desired_goal": goal_space}
    )

    def compute_reward(self, achieved, desired, info):
        if isinstance(achieved, np.ndarray):  # in this class's own step
            return super().compute_reward(achieved, desired, info)
        assert achieved.keys() == desired.keys() == {"at", "open"}
        is_reached = (np.abs(achieved["at"] - desired["at"])[..., 0] < 0.5) & (
            achieved["open"][0] == desired["open"][0]
        )
        return is_reached.astype(np.float32) - 1.0

    def _observe(self):
        goals = {
            key: {"at": at, "open": (1,)} for key, at in (("achieved_goal", self.position), ("desired_goal", self.goal))
        }
        return {"observation": self.position, **goals}


def flat_reach():
    return rejeu.FlatGoals(ReachNested())


def test_flat_goals_give_compute_reward_the_goals_of_the_environment():
    env = flat_reach()
    assert [*env.observation_space.spaces] == [*ReachNested.observation_space.spaces]
    obs, _ = env.reset(seed=0)
    assert obs in env.observation_space
    np.testing.assert_array_equal(obs["achieved_goal"], [obs["observation"][0], 0.0, 1.0])
    assert not [finding for finding in checker.findings(env) if "goal" in finding.text]
    goals = goal_functions(env)
    assert goals.terminated is None
    achieved, desired = np.float32([[0, 1, 0], [0, 1, 0], [0, 1, 0]]), np.float32([[0.4, 1, 0], [0.4, 0, 1], [9, 1, 0]])
    np.testing.assert_array_equal(goals.reward(achieved, desired), [0.0, -1.0, -1.0])
    with pytest.raises(ValueError, match="achieved_goal, desired_goal is missing"):
        rejeu.FlatGoals(Counter())


@pytest.mark.parametrize("backend", only((), ["gymnasium", "gymnasium-async"]))
def test_flat_goals_are_relabeled_in_this_process_and_in_workers(backend):
    with contextlib.closing(make_vector(flat_reach, 2, backend, seed=0)) as vector:
        agent = small_sac(vector, replay_buffer_class="HerReplayBuffer", learning_starts=100)
        buffer = agent.learn(60).replay_buffer
    batch = buffer.sample(np.random.default_rng(0), (256,))
    own = np.abs(batch.next_obs["achieved_goal"] - batch.obs["desired_goal"])[:, 0] < 0.5
    np.testing.assert_array_equal(batch.reward, own - 1.0)
    assert own.mean() > 0.2
