"""Stepping only some environments: what whole-episode rollouts need, in which those that have ended wait for the others."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from rejeu.envs.make import EnvPool, GymnasiumVector, InProcess, make_vector
from rejeu.sb3.common.vec_env import DummyVecEnv, VecMonitor
from tests.environments import Counter, Reach
from tests.tiers import only

LENGTHS = 2, 3, 5
"""Of every episode of three environments."""


def counters():
    return [lambda length=length: Counter((length,)) for length in LENGTHS]


def synchronous(mode):
    return GymnasiumVector(SyncVectorEnv(counters(), autoreset_mode=mode), seed=7)


def workers(mode):
    return GymnasiumVector(AsyncVectorEnv(counters(), autoreset_mode=mode, context="forkserver"), seed=7)


def in_process():
    return InProcess([make() for make in counters()], seed=7)


EVERY = {
    "in-process": in_process,
    **{f"synchronous-{mode.name}": lambda mode=mode: synchronous(mode) for mode in AutoresetMode},
    **{f"workers-{mode.name}": lambda mode=mode: workers(mode) for mode in AutoresetMode},
}

HERE = [name for name in EVERY if "workers" not in name]


def no_action(vector):
    return np.zeros((vector.n_envs, *vector.action_space.shape), np.float32)


every_vector = pytest.mark.parametrize("name", only(HERE, EVERY))


@every_vector
def test_whole_episodes_are_seen_while_those_that_ended_wait(name):
    """Counter's rewards are 100 times the episode plus the time, and it fails when it is stepped beyond its end."""
    vector = EVERY[name]()
    obs = vector.reset()
    for _ in range(3):
        np.testing.assert_array_equal(obs[:, 1], 0.0)
        drawn = obs[:, 2].copy()
        for time in range(max(LENGTHS)):
            active = np.array(LENGTHS) > time
            step = vector.step(no_action(vector), active)
            np.testing.assert_array_equal(step.obs[:, 1], np.minimum(time + 1, LENGTHS))
            np.testing.assert_array_equal(step.obs[:, 2], drawn)
            np.testing.assert_array_equal(step.reward % 100, np.where(active, time, 0))
            np.testing.assert_array_equal(step.truncated, np.array(LENGTHS) == time + 1)
            assert not step.terminated.any()
            assert (step.obs.dtype, step.reward.dtype) == (np.float32, np.float32)
            assert (step.terminated.dtype, step.truncated.dtype) == (bool, bool)
        obs = vector.reset_done(np.ones(3, bool))
        assert (obs[:, 2] != drawn).all()
    vector.close()


@every_vector
def test_environments_that_waited_can_begin_anew_while_others_go_on(name):
    vector = EVERY[name]()
    vector.reset()
    for _ in range(2):
        vector.step(no_action(vector))
    vector.step(no_action(vector), np.array([False, True, True]))
    step = vector.step(no_action(vector), np.array([False, False, True]))
    np.testing.assert_array_equal(step.obs[:, 1], [2, 3, 4])
    obs = vector.reset_done(np.array([True, True, False]))
    np.testing.assert_array_equal(obs[:, 1], [0, 0, 4])
    step = vector.step(no_action(vector))
    np.testing.assert_array_equal(step.obs[:, 1], [1, 1, 5])
    np.testing.assert_array_equal(step.truncated, [False, False, True])
    vector.close()


@pytest.mark.parametrize(
    ("name", "begun"),
    [*((name, begun) for name in HERE for begun in ("reset", [1, 1, 1], [1, 0, 1])), ("wrapped", "reset")],
)
def test_environments_that_waited_are_afterwards_like_any_other(name, begun):
    """Each end of an episode is followed by the next episode, and by no second reset."""
    vector = make_vector(VecMonitor(DummyVecEnv(counters()))) if name == "wrapped" else EVERY[name]()
    vector.reset()
    vector.step(no_action(vector), np.array([False, True, False]))
    obs = vector.reset() if begun == "reset" else vector.reset_done(np.array(begun, bool))
    episode, time = obs[:, :2].T.copy()
    for _ in range(12):
        np.testing.assert_array_equal(obs[:, :2], np.stack([episode, time], axis=1))
        step = vector.step(no_action(vector))
        done = np.array(LENGTHS) == time + 1
        np.testing.assert_array_equal(step.truncated, done)
        obs, episode, time = (vector.reset_done(done) if done.any() else step.obs), episode + done, (time + 1) * ~done


@pytest.mark.parametrize("name", ["in-process", "synchronous-DISABLED"])
def test_actions_of_environments_left_out_never_reach_one(name):
    vector = EVERY[name]()
    vector.reset()
    vector.step(np.array([[0.5], [np.nan], [np.nan]], np.float32), np.array([True, False, False]))
    envs = vector.envs if isinstance(vector, InProcess) else vector.env.envs
    assert {float(action[0]) for env in envs for action in env.actions} == {0.5}


def test_envpool_steps_each_environment_as_if_it_were_alone():
    """Environment i of a pool with seed s is the one environment of a pool with seed s + i."""
    rng, n_envs = np.random.default_rng(0), 5
    together = EnvPool("CartPole-v1", n_envs, seed=3)
    alone = [EnvPool("CartPole-v1", 1, seed=3 + i) for i in range(n_envs)]
    obs = np.array(together.reset())
    np.testing.assert_array_equal(obs, np.concatenate([one.reset() for one in alone]))
    ended = 0
    for _ in range(300):
        active = rng.uniform(size=n_envs) < 0.5
        if not active.any():
            continue
        action = rng.integers(2, size=n_envs, dtype=np.int32)
        step = together.step(action, active)
        for i, one in enumerate(alone):
            if active[i]:
                expected = one.step(action[[i]])
                for part, other in zip(step[:4], expected[:4], strict=True):
                    np.testing.assert_array_equal(part[[i]], other)
            else:
                np.testing.assert_array_equal(step.obs[i], obs[i])
                assert (step.reward[i], step.terminated[i], step.truncated[i]) == (0.0, False, False)
        assert [part.dtype for part in step[:4]] == [np.float32, np.float32, bool, bool]
        done = step.terminated | step.truncated
        obs = np.array(together.reset_done(done) if done.any() else step.obs)
        for i in np.flatnonzero(done):
            np.testing.assert_array_equal(obs[i], alone[i].reset_done(np.ones(1, bool))[0])
            ended += 1
    assert ended > 20
    for vector in (together, *alone):
        vector.close()


def test_goal_environments_of_envpool_are_stepped_in_part():
    one, two = (make_vector("parking-v0", 4, "envpool", seed=0) for _ in range(2))
    before = {key: value.copy() for key, value in one.reset().items()}
    two.reset()
    active = np.array([False, True, False, True])
    action = np.random.default_rng(0).uniform(-1, 1, (4, 2)).astype(np.float32)
    part, whole = one.step(action, active), two.step(action)
    for key, value in part.obs.items():
        np.testing.assert_array_equal(value[active], whole.obs[key][active])
        np.testing.assert_array_equal(value[~active], before[key][~active])
    np.testing.assert_array_equal(part.reward, np.where(active, whole.reward, 0.0))
    assert [one.success(part, i) for i in (1, 3)] == [two.success(whole, i) for i in (1, 3)] == [0.0, 0.0]


@pytest.mark.parametrize("mode", [None, AutoresetMode.DISABLED, AutoresetMode.SAME_STEP])
def test_success_is_that_of_the_environments_stepped(mode):
    vector = (
        InProcess([Reach(stops=True), Reach(stops=True)], seed=0)
        if mode is None
        else GymnasiumVector(SyncVectorEnv([lambda: Reach(stops=True)] * 2, autoreset_mode=mode), seed=0)
    )
    obs, active, outcomes = vector.reset(), np.ones(2, bool), []
    for t in range(60):
        towards = np.clip(obs["desired_goal"] - obs["achieved_goal"], -1, 1)
        step = vector.step(towards if t % 20 < 10 else -np.sign(towards + 1e-9), active)
        done = step.terminated | step.truncated
        for i in np.flatnonzero(done):
            assert active[i]
            reached = abs(step.obs["achieved_goal"][i, 0] - step.obs["desired_goal"][i, 0]) < 0.5
            assert vector.success(step, i) == float(reached)
            outcomes.append(bool(reached))
        active &= ~done
        obs = step.obs
        if not active.any():
            obs, active = vector.reset_done(np.ones(2, bool)), np.ones(2, bool)
    assert set(outcomes) == {True, False}


def test_a_vector_that_overwrites_its_observations_keeps_those_left_out():
    vector = GymnasiumVector(SyncVectorEnv(counters(), copy=False, autoreset_mode=AutoresetMode.DISABLED), seed=7)
    vector.reset()
    vector.step(no_action(vector))
    step = vector.step(no_action(vector), np.array([True, False, True]))
    np.testing.assert_array_equal(step.obs[:, 1], [2, 1, 2])


class Ticking(gym.vector.VectorEnv):
    """Two environments of three steps which reset themselves within the step, and know no masked reset."""

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}
    num_envs = 2
    single_observation_space = gym.spaces.Box(0, 9, (1,), np.float32)
    single_action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        assert options is None
        self.time = np.zeros((2, 1), np.float32)
        return self.time.copy(), {}

    def step(self, action):
        self.time += 1
        over = self.time[:, 0] == 3
        info = {"final_obs": list(self.time.copy())}
        self.time[over] = 0
        return self.time.copy(), np.ones(2), np.zeros(2, bool), over, info


def test_where_a_vector_resets_itself_those_left_out_begin_anew_only_together():
    vector = make_vector(Ticking())
    vector.reset()
    one = np.array([True, False])
    np.testing.assert_array_equal(vector.step(no_action(vector), one).obs[:, 0], [1, 0])
    with pytest.raises(ValueError, match=r"Ticking resets by itself .* reset all, or make it with autoreset_mode"):
        vector.reset_done(~one)
    np.testing.assert_array_equal(vector.reset_done(np.ones(2, bool))[:, 0], [0, 0])
    np.testing.assert_array_equal(vector.step(no_action(vector)).obs[:, 0], [1, 1])


@pytest.mark.parametrize(
    ("active", "words"),
    [
        (np.array([0, 2]), r"active=array\(\[0, 2\]\) must be a bool array of shape \(3,\), or None"),
        (np.ones(2, bool), r"must be a bool array of shape \(3,\)"),
        ([True, False, True], r"must be a bool array of shape \(3,\)"),
        (np.zeros(3, bool), "leaves out every environment"),
    ],
)
def test_a_wrong_choice_of_environments_is_refused(active, words):
    vector = in_process()
    vector.reset()
    with pytest.raises(ValueError, match=words):
        vector.step(no_action(vector), active)
