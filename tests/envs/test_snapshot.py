"""Environments whose state can be taken out and put back, and those where it cannot."""

import importlib.util
import json
import re
import warnings
from contextlib import closing
from functools import partial

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core import records
from rejeu.core.errors import DivergedError
from rejeu.envs.make import make_vector
from rejeu.envs.snapshot import restore, state_of

CARRIED = [
    "CartPole-v1",
    "MountainCar-v0",
    "MountainCarContinuous-v0",
    "Pendulum-v1",
    "Acrobot-v1",
    "rejeu/Ball-v0",
    "rejeu/CartPoleNoVelocity-v0",
]
MUJOCO = ["HalfCheetah-v5", "Hopper-v5", "Reacher-v5"]
has_mujoco = importlib.util.find_spec("mujoco") is not None


def walk(env, actions):
    """Steps an environment, beginning anew where an episode ends, and returns all that it said."""
    said = []
    for action in actions:
        obs, reward, terminated, truncated, _ = env.step(action)
        said.append((np.copy(obs), reward, terminated, truncated))
        if terminated or truncated:
            said.append(np.copy(env.reset()[0]))
    return said


def assert_goes_on_alike(make, n_before=13, n_after=300):
    one, two = make(), make()
    one.action_space.seed(1)
    actions = [one.action_space.sample() for _ in range(n_before + n_after)]
    one.reset(seed=4)
    walk(one, actions[:n_before])
    arrays = {}
    text = json.dumps(records.encode(state_of(one), arrays, "env"), allow_nan=False)
    expected = walk(one, actions[n_before:])
    restore(two, records.decode(json.loads(text), arrays))
    np.testing.assert_equal(walk(two, actions[n_before:]), expected)
    for env in (one, two):
        env.close()


@pytest.mark.parametrize("env_id", CARRIED)
def test_environments_go_on_alike(env_id):
    assert_goes_on_alike(lambda: gym.make(env_id))


@pytest.mark.skipif(not has_mujoco, reason="MuJoCo is not installed")
@pytest.mark.parametrize("env_id", MUJOCO)
def test_mujoco_goes_on_alike(env_id):
    assert_goes_on_alike(lambda: gym.make(env_id), n_after=80)


@pytest.mark.parametrize(
    "wrap",
    [
        rejeu.Monitor,
        gym.wrappers.RecordEpisodeStatistics,
        lambda env: gym.wrappers.RescaleAction(env, -1, 1),
        lambda env: gym.wrappers.TransformReward(env, lambda r: 2 * r),
        lambda env: gym.wrappers.TimeLimit(env, 50),
        gym.wrappers.ClipAction,
        gym.wrappers.FlattenObservation,
    ],
)
def test_wrappers_are_carried(wrap):
    assert_goes_on_alike(lambda: wrap(gym.make("Pendulum-v1")))


def test_monitors_count_on():
    one, two = (rejeu.Monitor(gym.make("CartPole-v1")) for _ in range(2))
    one.reset(seed=0)
    walk(one, [1, 0, 1])
    restore(two, state_of(one))
    assert two.get_total_steps() == 3
    while not (step := two.step(1))[2]:
        pass
    assert step[4]["episode"]["l"] == two.get_total_steps()


def test_an_environment_that_has_not_begun_can_be_carried():
    env = gym.make("Pendulum-v1")
    restore(env, state_of(gym.make("Pendulum-v1")))
    with pytest.raises(gym.error.ResetNeeded):
        env.step(np.zeros(1))


class Remembering(gym.Wrapper):
    """Remembers something, and does not say so."""


@pytest.mark.parametrize(
    "make",
    [
        lambda: Remembering(gym.make("Pendulum-v1")),
        lambda: gym.wrappers.NormalizeObservation(gym.make("Pendulum-v1")),
        lambda: gym.make("FrozenLake-v1"),
    ],
)
def test_what_is_not_known_is_not_carried(make):
    env = make()
    env.reset(seed=0)
    assert state_of(env) is None


def test_box2d_cannot_be_carried():
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DeprecationWarning
        )  # of what SWIG generates, and it crashes where they are errors
        pytest.importorskip("Box2D")
    env = gym.make("LunarLander-v3")
    env.reset(seed=0)
    assert state_of(env) is None


def test_an_heir_of_a_known_environment_is_not_taken_for_it():
    class Heir(gym.envs.classic_control.PendulumEnv):
        """Might remember more."""

    env = Heir()
    env.reset(seed=0)
    assert state_of(env) is None


class Array(gym.Wrapper):
    def get_state(self):
        return np.zeros(3)

    def set_state(self, state):
        raise AssertionError


class Asking(Array):
    def get_state(self, full):
        return {"full": full}


class Holding(Array):
    def get_state(self):
        return {"pieces": {1, 2}}


class Missing(Array):
    def get_state(self):
        raise NotImplementedError


class Own(gym.Wrapper):
    def get_wrapper_state(self):
        return {"env": self.env}

    def set_wrapper_state(self, state):
        raise AssertionError


@pytest.mark.parametrize(
    ("wrapper", "why"),
    [
        (Array, "Array.get_state: the state is of type ndarray, expected a dict"),
        (Asking, "missing 1 required positional argument: 'full'"),
        (Holding, "the state.pieces is a set"),
        (Missing, "Missing.get_state: NotImplementedError"),
        (Own, "Own.get_wrapper_state: the state.env is a "),
    ],
)
def test_methods_of_that_name_for_other_purposes_are_not_taken(wrapper, why):
    env = wrapper(gym.make("Pendulum-v1"))
    env.reset(seed=0)
    with pytest.warns(UserWarning, match=re.escape(why)):
        assert state_of(env) is None


class Inner(gym.Wrapper):
    """Its state has that of the environment inside, which may be unknown."""

    def get_state(self):
        return {"inside": state_of(self.env)}

    def set_state(self, state):
        restore(self.env, state["inside"])


class Two(gym.Wrapper):
    def get_state(self):
        return {"board": np.zeros(9)}

    def set_state(self, board, player):
        raise AssertionError


@pytest.mark.parametrize("backend", ["gymnasium", "gymnasium-async"])
@pytest.mark.parametrize("wrapper", [Inner, Two])
def test_an_environment_that_cannot_put_its_state_back_begins_new_episodes(wrapper, backend, tmp_path):
    with closing(make_vector(partial(wrapped, wrapper), 2, backend, seed=0)) as env:
        agent = rejeu.DQN("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [8]}, learning_starts=10)
        agent.learn(40, callback=Checkpoint(tmp_path, every=20))
    with closing(make_vector(partial(wrapped, wrapper), 2, backend, seed=0)) as env:
        with pytest.warns(UserWarning, match=f"{wrapper.__name__}.set_state"):
            agent = rejeu.DQN.resume(tmp_path, env)
        assert (agent.resumed.step, agent.resumed.exact) == (40, False)
        assert agent.learn(20).run.step == 60


def wrapped(wrapper):
    return wrapper(gym.make("FrozenLake-v1"))


def test_the_state_of_another_environment_is_refused():
    pendulum, cart = gym.make("Pendulum-v1"), gym.make("CartPole-v1")
    pendulum.reset(seed=0)
    with pytest.raises(ValueError, match="expected"):
        restore(cart, state_of(pendulum))
    with pytest.raises(ValueError, match="another environment"):
        restore(pendulum, state_of(pendulum)[:-1])
    with pytest.raises(ValueError, match="another environment"):
        restore(pendulum, [*state_of(pendulum), {}])


def test_the_state_taken_out_does_not_move_with_the_environment():
    env = gym.make("CartPole-v1")
    env.reset(seed=0)
    state = state_of(env)
    before = json.dumps(records.encode(state, arrays := {}, "x")), {k: v.copy() for k, v in arrays.items()}
    walk(env, [0, 1] * 30)
    after = json.dumps(records.encode(state, arrays := {}, "x")), arrays
    np.testing.assert_equal(after, before)

    class Own(gym.Wrapper):
        """Changes its state in place, and gives it away."""

        own = {"steps": [0]}

        def step(self, action):
            self.own["steps"][0] += 1
            return self.env.step(action)

        def give(self):
            return self.own

        def take(self, state):
            self.own = state

    for kind in ("", "wrapper_"):
        kind = type("Saved", (Own,), {f"get_{kind}state": Own.give, f"set_{kind}state": Own.take})
        env = kind(gym.make("Pendulum-v1"))
        env.reset(seed=0)
        before, state = env.own["steps"][0], state_of(env)
        walk(env, np.zeros((3, 1)))
        restore(env, state)
        assert env.own == {"steps": [before]}


@pytest.mark.parametrize(
    ("backend", "n_envs"), [("gymnasium", 1), ("gymnasium", 3), ("gymnasium-async", 2), ("envpool", 3)]
)
def test_a_vector_continues_from_its_snapshot(backend, n_envs):
    def make():
        return make_vector("CartPole-v1", n_envs, backend, seed=2)

    with closing(make()) as one, closing(make()) as two:
        one.record()
        obs = one.reset()
        for _ in range(5):
            obs = one.step(np.ones(n_envs, int)).obs
        saved = records.decode(records.encode(one.snapshot(), arrays := {}, "envs"), arrays)
        assert two.restore(saved, obs.copy()) == []
        assert_vectors_continue_alike(one, two)


def test_a_snapshot_of_another_number_of_environments_is_refused():
    for backend in ("gymnasium", "gymnasium-async"):
        with closing(make_vector("CartPole-v1", 2, backend, seed=2)) as one:
            one.reset()
            with pytest.raises(ValueError, match="not those of 2 environments"):
                one.restore(one.snapshot()[:1], None)


def test_worker_processes_refuse_a_snapshot_of_another_environment():
    with closing(make_vector("CartPole-v1", 1, "gymnasium-async", seed=2)) as one:
        one.reset()
        with pytest.raises(DivergedError, match="environment 0 cannot be restored"):
            one.restore([[{}]], None)


def assert_vectors_continue_alike(one, two):
    n_envs = one.n_envs
    only_first = np.arange(n_envs) == 0
    for active in (only_first, None):
        first, second = one.step(np.zeros(n_envs, int), active), two.step(np.zeros(n_envs, int), active)
        np.testing.assert_array_equal(first.obs, second.obs)
    done = np.ones(n_envs, bool)
    np.testing.assert_array_equal(one.reset_done(done).copy(), two.reset_done(done))


def test_a_worker_that_is_lost_before_a_snapshot_ends_its_episode_at_the_next_step():
    with closing(make_vector("CartPole-v1", 2, "gymnasium-async", seed=0, restart_workers=1)) as env:
        env.reset()
        env.step(np.zeros(2, int))
        env.workers.workers[1].process.kill()
        env.workers.workers[1].process.join()
        with pytest.warns(RuntimeWarning, match="restarted"):
            assert env.snapshot() is None
        step = env.step(np.zeros(2, int))
        assert step.truncated.tolist() == [False, True]
        env.reset_done(step.truncated)
        assert env.snapshot() is not None
        assert not env.step(np.zeros(2, int)).truncated.any()
