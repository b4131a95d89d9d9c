"""EnvPool's environments are Gymnasium's: the same spaces, limits, rewards and ends, for all whose presets
may train in EnvPool.

Where the dynamics are deterministic, EnvPool's episodes are replayed in Gymnasium: put where EnvPool's began, and given the
same actions, it must go the same way. Where an episode began at random is then compared as a distribution. LunarLander has
random ground and engines whose thrust scatters, so there rewards are computed from what is seen and free fall is compared by
step.
"""

import math
import warnings
from importlib.metadata import PackageNotFoundError, version
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
from scipy import stats

from rejeu.agents import presets
from rejeu.core import spaces
from rejeu.envs.envpool import DIFFERENT
from rejeu.envs.make import make_vector
from tests.tiers import only

envpool = pytest.importorskip("envpool", exc_type=ImportError)

LANDERS = "LunarLander-v3", "LunarLanderContinuous-v3"


class Episode(NamedTuple):
    start: Any
    steps: list[tuple]
    """Of each step: the observation before, the action, and what came of it (see ``outcome``)."""


class Replayed(NamedTuple):
    """How to replay an environment's episodes."""

    put: Any
    """Puts a Gymnasium environment where an observation says."""
    act: Any
    """Actions that bring about every kind of end."""
    ends: set
    """The kinds of end to replay: (terminated, truncated, success)."""
    n_envs: int = 16
    every_step: bool = False
    """Whether to put it there at every step: where rounding grows with time."""
    apart: Any = None
    """Of an observation, whether the two are known to differ there."""
    apart_by: float = 2e-5
    """Largest difference of an element of an observation."""


def put_cart_pole(env, obs):
    env.state = obs.astype(np.float64)


def put_pendulum(env, obs):
    env.state = np.array([math.atan2(obs[1], obs[0]), obs[2]], np.float64)


def put_mountain_car(env, obs):
    env.state = obs.astype(np.float64)


def put_acrobot(env, obs):
    angles = [math.atan2(obs[1], obs[0]), math.atan2(obs[3], obs[2])]
    env.state = np.array([*angles, *obs[4:]], np.float64)


def put_parking(env, obs):
    """Features are x, y, vx, vy, cos h and sin h, in units of 100, 100, 5, 5, 1 and 1; a car starts at rest."""
    x, y, _, _, cos, sin = obs["observation"].astype(np.float64)
    (vehicle,) = env.controlled_vehicles
    vehicle.position, vehicle.heading, vehicle.speed = np.array([100 * x, 100 * y]), math.atan2(sin, cos), 0.0
    x, y, _, _, cos, sin = obs["desired_goal"].astype(np.float64)
    vehicle.goal.position, vehicle.goal.heading = np.array([100 * x, 100 * y]), math.atan2(sin, cos)


def put_fetch(env, obs):
    """The arm always starts alike."""
    env.goal = obs["desired_goal"].astype(np.float64)


def mujoco_version():
    try:
        return tuple(map(int, version("mujoco").split(".")[:2]))
    except PackageNotFoundError:
        return 0, 0


def balance(obs, t, rng):
    """Half of them balance the pole, the others do anything."""
    action = rng.integers(2, size=len(obs))
    action[::2] = (obs[::2] @ [0.0, 0.1, 1.0, 0.5] > 0).astype(int)
    return action


def swing(obs, t, rng):
    """Half of them push the way that the car goes, the others anyhow."""
    action = rng.integers(3, size=len(obs))
    action[::2] = np.where(obs[::2, 1] >= 0, 2, 0)
    return action


def pump(obs, t, rng):
    """Half of them push the way that the second link turns, the others anyhow."""
    action = rng.integers(3, size=len(obs))
    action[::2] = np.where(obs[::2, 5] >= 0, 2, 0)
    return action


def push(obs, t, rng):
    """Half of the cars push along and reach the goal, the others do not."""
    action = rng.uniform(-0.1, 0.1, (len(obs), 1)).astype(np.float32)
    action[::2, 0] = np.where(obs[::2, 1] >= 0, 1.0, -1.0)
    return action


def torque(obs, t, rng):
    return rng.uniform(-2, 2, (len(obs), 1)).astype(np.float32)


def at_top_speed(obs):
    return abs(obs[2]) == 8.0


def drive(obs, t, rng):
    """The first car stands still; the others hold random pedals and wheels for two seconds."""
    if t % 10 == 0:
        drive.held = rng.uniform(-1, 1, (len(obs["observation"]), 2)).astype(np.float32)
        drive.held[0] = 0.0
    return drive.held


def reach(obs, t, rng):
    """Half of the arms go to the goal, the others anywhere."""
    action = rng.uniform(-1, 1, (len(obs["observation"]), 4)).astype(np.float32)
    action[::2, :3] = np.clip(10 * (obs["desired_goal"] - obs["achieved_goal"]), -1, 1)[::2]
    return action


FALLS, LIMIT = (True, False, None), (False, True, None)
FETCH = 2e-5 if mujoco_version() < (3, 7) else 2e-2
"""EnvPool holds an older MuJoCo. Since 3.7 the arm is pulled a little differently, by up to 15 mm."""
REPLAYED = {
    "CartPole-v1": Replayed(put_cart_pole, balance, {FALLS, LIMIT}, every_step=True),
    "Pendulum-v1": Replayed(put_pendulum, torque, {LIMIT}, every_step=True, apart=at_top_speed),
    "MountainCar-v0": Replayed(put_mountain_car, swing, {FALLS, LIMIT}, every_step=True),
    "MountainCarContinuous-v0": Replayed(put_mountain_car, push, {FALLS, LIMIT}, every_step=True),
    "Acrobot-v1": Replayed(put_acrobot, pump, {FALLS, LIMIT}, every_step=True),
    "parking-v0": Replayed(put_parking, drive, {(True, False, 0.0), (True, False, 1.0), (False, True, 0.0)}, n_envs=64),
    "FetchReach-v4": Replayed(put_fetch, reach, {(False, True, 0.0), (False, True, 1.0)}, n_envs=8, apart_by=FETCH),
}
COMPARED = *REPLAYED, *LANDERS
BEGIN_ALIKE = "FetchPush-v4", "FetchPickAndPlace-v4", "PointMaze_UMaze-v3", "PointMaze_Medium-v3", "PointMaze_Large-v3"
"""Whose first observations alone are compared. The arm of FetchPush waits 17 mm nearer in EnvPool."""


def skip_without_robotics(env_id):
    if env_id.startswith(("Fetch", "PointMaze")):
        pytest.importorskip("gymnasium_robotics", exc_type=ImportError)


def both(env_id, n_envs=2, seed=0):
    """The environments on either side."""
    if env_id in LANDERS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of what SWIG generates
            pytest.importorskip("Box2D")
    skip_without_robotics(env_id)
    return make_vector(env_id, n_envs, "gymnasium", seed), make_vector(env_id, n_envs, "envpool", seed)


def test_every_environment_is_compared_whose_tuned_preset_may_train_in_envpool():
    known = set(envpool.list_all_envs())
    may = {preset.env_id for preset in presets.ALL if preset.backend != "gymnasium" and not preset.name}
    assert may & known <= {*COMPARED, *BEGIN_ALIKE}


# What they are.


@pytest.mark.parametrize("env_id", COMPARED)
def test_spaces_limits_and_thresholds_are_the_same(env_id):
    gymnasium, pool = both(env_id)
    assert spaces.leaves(pool.observation_space) == spaces.leaves(gymnasium.observation_space)
    assert spaces.describe(pool.action_space) == spaces.describe(gymnasium.action_space)
    assert pool.max_episode_steps == gymnasium.max_episode_steps is not None
    assert pool.reward_threshold == gymnasium.reward_threshold
    for space in (pool.observation_space, gymnasium.observation_space):
        for obs in (pool.reset(), gymnasium.reset()):
            assert space.contains(jax.tree.map(lambda leaf: np.array(leaf[0]), obs))


# Replayed.


def row(tree, i):
    return jax.tree.map(lambda leaf: np.array(leaf[i]), tree)


def outcome(vector, step, i):
    success = vector.success(step, i)
    return row(step.obs, i), step.reward[i], bool(step.terminated[i]), bool(step.truncated[i]), success


def end_of(episode):
    *_, terminated, truncated, success = episode.steps[-1][2]
    return terminated, truncated, None if math.isnan(success) else success


def episodes_of_each_kind(vector, replayed):
    """The first episode of every kind of end."""
    rng, found = np.random.default_rng(0), {}
    obs = vector.reset()
    running = [Episode(row(obs, i), []) for i in range(vector.n_envs)]
    for t in range(2_000):
        before, action = jax.tree.map(np.array, obs), replayed.act(obs, t, rng)
        step = vector.step(action)
        for i, episode in enumerate(running):
            episode.steps.append((row(before, i), action[i], outcome(vector, step, i)))
        done = step.terminated | step.truncated
        obs = vector.reset_done(done) if done.any() else step.obs
        for i in np.flatnonzero(done):
            found.setdefault(end_of(running[i]), running[i])
            running[i] = Episode(row(obs, i), [])
        if set(found) >= replayed.ends:
            return found
    raise AssertionError(f"of {replayed.ends} only {set(found)} came about")


@pytest.mark.parametrize("env_id", only(REPLAYED.keys() - {"parking-v0"}, REPLAYED))
def test_episodes_of_envpool_replayed_in_gymnasium_go_the_same_way(env_id):
    skip_without_robotics(env_id)
    replayed = REPLAYED[env_id]
    pool = make_vector(env_id, replayed.n_envs, "envpool", seed=0)
    gymnasium = make_vector(env_id, 1, "gymnasium", seed=0)
    env = gymnasium.envs[0].unwrapped
    episodes = episodes_of_each_kind(pool, replayed)
    assert set(episodes) == replayed.ends
    for (_, truncated, _), episode in episodes.items():
        assert (len(episode.steps) == pool.max_episode_steps) == truncated
        gymnasium.reset()
        replayed.put(env, episode.start)
        for t, (before, action, (obs, reward, *flags)) in enumerate(episode.steps):
            if replayed.every_step:
                replayed.put(env, before)
            step = gymnasium.step(action[None])
            other_obs, other_reward, *other_flags = outcome(gymnasium, step, 0)
            if replayed.apart is None or not replayed.apart(obs):
                jax.tree.map(
                    lambda one, two: np.testing.assert_allclose(one, two, rtol=0, atol=replayed.apart_by),
                    obs,
                    other_obs,
                )
            np.testing.assert_allclose(reward, other_reward, rtol=0, atol=1e-5)
            assert str(flags) == str(other_flags), (env_id, t)  # as text, for NaN is unequal to itself


def test_an_end_in_the_very_step_of_the_time_limit_is_told_by_gymnasium_only():
    """The one difference in flags: EnvPool says truncated, Gymnasium both. See docs/environments.md."""
    told = []
    for vector in both("MountainCar-v0", 256):
        obs = np.array(vector.reset())
        wait = 60 + np.arange(256) % 50
        active = np.ones(256, bool)
        for t in range(200):
            step = vector.step(np.where(t < wait, 1, np.where(obs[:, 1] >= 0, 2, 0)), active)
            obs = np.array(step.obs)
            at_flag = active & (obs[:, 0] >= 0.5)
            active &= ~(step.terminated | step.truncated)
        assert at_flag.any()
        told.append({*zip(step.terminated[at_flag].tolist(), step.truncated[at_flag].tolist(), strict=True)})
    assert told == [{(True, True)}, {(False, True)}]


def test_a_pendulum_at_its_top_speed_turns_further_in_envpool():
    """Gymnasium turns it by the speed clipped to 8 rad/s, EnvPool by the speed before clipping. See docs/environments.md."""
    pool = make_vector("Pendulum-v1", 16, "envpool", seed=0)
    obs, reached = np.array(pool.reset(), np.float64), 0
    for _ in range(199):
        action = 2.0 * np.sign(obs[:, 2:]).astype(np.float32)  # along the way that it turns
        next_obs = np.array(pool.step(action).obs, np.float64)
        speed = obs[:, 2] + 0.05 * (15.0 * obs[:, 1] + 3.0 * action[:, 0])  # g = 10, m = l = 1, dt = 0.05
        angle = np.arctan2(obs[:, 1], obs[:, 0]) + 0.05 * speed
        np.testing.assert_allclose(next_obs[:, :2], np.stack([np.cos(angle), np.sin(angle)], axis=1), atol=1e-5)
        np.testing.assert_allclose(next_obs[:, 2], np.clip(speed, -8, 8), atol=1e-5)
        reached += int((np.abs(speed) > 8.1).sum())
        obs = next_obs
    assert reached > 100


def starts(env_id):
    """The first observations of 200 episodes, with a row of numbers for each, in Gymnasium and in EnvPool."""
    for vector in both(env_id, 10):
        observations = [jax.tree.leaves(jax.tree.map(np.array, vector.reset()))]
        observations += [
            jax.tree.leaves(jax.tree.map(np.array, vector.reset_done(np.ones(10, bool)))) for _ in range(19)
        ]
        yield np.concatenate([np.concatenate(leaves, axis=1) for leaves in observations]).astype(np.float64)


@pytest.mark.parametrize("env_id", only({*COMPARED} - {"parking-v0"}, COMPARED))
def test_episodes_begin_alike(env_id):
    """Every number of the first observation has the same distribution (Kolmogorov and Smirnov's test, p above 0.001)."""
    one, two = (np.round(start, 5) for start in starts(env_id))
    assert one.shape == two.shape
    for column in range(one.shape[1]):
        if np.ptp(one[:, column]) < 1e-4:
            np.testing.assert_allclose(two[:, column], one[0, column], atol=1e-4)
        else:
            assert stats.ks_2samp(one[:, column], two[:, column]).pvalue > 1e-3, column


def moments(env_id):
    """The means and standard deviations of the numbers of first observations, in Gymnasium and in EnvPool."""
    return [(numbers.mean(axis=0), numbers.std(axis=0)) for numbers in starts(env_id)]


@pytest.mark.parametrize("env_id", only({"PointMaze_UMaze-v3"}, BEGIN_ALIKE))
def test_robots_begin_alike_within_centimeters(env_id):
    (mean, deviation), (pool_mean, pool_deviation) = moments(env_id)
    np.testing.assert_array_less(np.abs(mean - pool_mean), 0.02 + 5 * (deviation + pool_deviation) / np.sqrt(200))
    np.testing.assert_allclose(deviation, pool_deviation, rtol=0.15, atol=0.02)


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning", "ignore:builtin type:DeprecationWarning")
@pytest.mark.parametrize("env_id", sorted(DIFFERENT))
def test_environments_said_to_differ_begin_otherwise(env_id):
    version = max(name.rpartition("-v")[2] for name in envpool.list_all_envs() if name.rpartition("-v")[0] == env_id)
    with pytest.warns(UserWarning, match="differs from Gymnasium's"):
        (mean, deviation), (pool_mean, pool_deviation) = moments(f"{env_id}-v{version}")
    apart = np.abs(mean - pool_mean) > 1e-3 + 5 * (deviation + pool_deviation) / np.sqrt(200)
    assert (apart | (np.abs(deviation - pool_deviation) > 0.01 + 0.3 * deviation)).any()


# LunarLander.


def shaping(obs):
    """The potential whose increase is LunarLander's reward (its documentation, "Rewards")."""
    far, fast = np.hypot(obs[:, 0], obs[:, 1]), np.hypot(obs[:, 2], obs[:, 3])
    return -100 * (far + fast + np.abs(obs[:, 4])) + 10 * (obs[:, 6] + obs[:, 7])


def fuel(action):
    """0.3 for the main engine's power and 0.03 for a side engine's."""
    if action.ndim == 1:
        return 0.3 * (action == 2) + 0.03 * ((action == 1) | (action == 3))
    main, side = action.astype(np.float64).T
    return 0.3 * np.where(main > 0, 0.5 + 0.5 * main, 0.0) + 0.03 * np.where(np.abs(side) > 0.5, np.abs(side), 0.0)


def anything(vector, obs, rng):
    return (
        rng.integers(4, size=vector.n_envs)
        if vector.action_space.shape == ()
        else rng.uniform(-1, 1, (vector.n_envs, 2)).astype(np.float32)
    )


def nothing(vector, obs, rng):
    return np.zeros((vector.n_envs, *vector.action_space.shape), np.float32 if vector.action_space.shape else np.int64)


class Walk(NamedTuple):
    obs: np.ndarray
    action: np.ndarray
    next_obs: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray


def walk(vector, policy, n_steps):
    """So many steps of all environments."""
    rng, rows, obs = np.random.default_rng(0), [], np.array(vector.reset(), np.float64)
    for _ in range(n_steps):
        action = policy(vector, obs, rng)
        step = vector.step(action)
        next_obs = np.array(step.obs, np.float64)
        rows.append((obs, action, next_obs, np.array(step.reward), np.array(step.terminated)))
        done = step.terminated | step.truncated
        obs = np.array(vector.reset_done(done), np.float64) if done.any() else next_obs
    return Walk(*(np.concatenate(part) for part in zip(*rows, strict=True)))


@pytest.mark.parametrize("env_id", LANDERS)
def test_landers_get_the_documented_reward(env_id):
    for vector in both(env_id, 8):
        seen = walk(vector, anything, 500)
        expected = shaping(seen.next_obs) - shaping(seen.obs) - fuel(seen.action)
        on = ~seen.terminated
        np.testing.assert_allclose(seen.reward[on], expected[on], rtol=0, atol=1e-3)
        assert set(seen.reward[seen.terminated].tolist()) <= {-100.0, 100.0}


@pytest.mark.parametrize("env_id", LANDERS)
def test_landers_fall_alike(env_id):
    """Without engine the state follows from the state before: fitted on the one side, it holds on the other."""
    falls = []
    for vector in both(env_id, 8):
        seen = walk(vector, nothing, 600)
        high = (seen.next_obs[:, 1] > 0.6) & ~seen.terminated
        falls.append((np.c_[seen.obs[high, :6], np.ones(high.sum())], seen.next_obs[high, :6]))
    (before, after), (other_before, other_after) = falls
    step, *_ = np.linalg.lstsq(before, after, rcond=None)
    fitted, held = (np.abs(x @ step - y).mean(axis=0) for x, y in ((before, after), (other_before, other_after)))
    np.testing.assert_array_less(held, 1.5 * fitted + 1e-6)
    np.testing.assert_allclose(held, 0.0, atol=1e-3)
