"""After an exception of an environment, and after somebody else stepped it, ``learn`` goes on with new episodes."""

import functools
from typing import ClassVar

import gymnasium as gym
import jax
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.core.errors import BadEnvironmentError, WorkerError
from rejeu.envs import snapshot
from rejeu.envs.make import EnvPool, make_vector
from rejeu.sb3.common.monitor import Monitor
from rejeu.sb3.common.vec_env import DummyVecEnv, VecFrameStack, VecMonitor, VecNormalize
from tests.tiers import crossed, exhaustive, only

LENGTH = 5
"""Of every episode."""


class Fragile(gym.Env):
    """Observes its episode and its time; raises once at each of ``faults``, ``(method, episode, time, exception)``.

    It must be reset after that, and after the end of an episode.
    """

    observation_space = spaces.Box(-100.0, 100.0, (2,), np.float32)
    action_space = spaces.Discrete(2)
    faults: ClassVar[list[tuple[str, int, int, type[BaseException]]]] = []

    def __init__(self, faults=None):
        self.left = list(self.faults if faults is None else faults)
        self.episode, self.time, self.is_running = 0, 0, False

    def observe(self):
        return np.array([self.episode, self.time], np.float32)

    def fail(self, method):
        for fault in self.left:
            if fault[:3] == (method, self.episode, self.time):
                self.left.remove(fault)
                self.is_running = False
                raise fault[3](method)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.time, self.is_running = self.episode + 1, 0, True
        self.fail("reset")
        return self.observe(), {}

    def step(self, action):
        assert self.is_running, "stepped without a reset"
        self.time += 1
        self.fail("step")
        self.is_running = self.time < LENGTH
        return self.observe(), 1.0, False, not self.is_running, {}


class Shifted(Fragile):
    """The second environment of a vector, which fails elsewhere."""

    faults: ClassVar = [("reset", 6, 0, OSError)]


FAULTS = [("step", 2, 3, ConnectionError), ("reset", 4, 0, ValueError), ("step", 12, LENGTH, KeyboardInterrupt)]
ENVS = [functools.partial(Fragile, FAULTS), Shifted]
MONITORED = [lambda make=make: Monitor(make(), allow_early_resets=True) for make in ENVS]
IN_PROCESS = {
    "functions": lambda: DummyVecEnv(MONITORED),
    "synchronous": lambda: SyncVectorEnv(ENVS),
    "same step": lambda: gym.wrappers.vector.RecordEpisodeStatistics(
        SyncVectorEnv(ENVS, autoreset_mode=AutoresetMode.SAME_STEP)
    ),
    "statistics": lambda: gym.wrappers.vector.RecordEpisodeStatistics(SyncVectorEnv(ENVS)),
    "monitored": lambda: VecMonitor(DummyVecEnv(ENVS)),
    "normalized": lambda: VecNormalize(DummyVecEnv(MONITORED), norm_obs=False),
    "stacked": lambda: VecFrameStack(DummyVecEnv(ENVS), 1),
}
SMALL = {"policy_kwargs": {"net_arch": [4]}, "seed": 0}
OFF = {"learning_starts": 20, "buffer_size": 500, "batch_size": 4, **SMALL}
MEMORY = {"net_arch": [4], "lstm_hidden_size": 4, "sequence_length": 2}
AGENTS = {
    "DQN": lambda env: rejeu.DQN("MlpPolicy", env, **OFF),
    "PPO": lambda env: rejeu.PPO("MlpPolicy", env, n_steps=300, batch_size=20, n_epochs=1, **SMALL),
    "short rollouts": lambda env: rejeu.PPO("MlpPolicy", env, n_steps=LENGTH, batch_size=5, n_epochs=1, **SMALL),
    "RecurrentPPO": lambda env: rejeu.RecurrentPPO("MlpPolicy", env, n_steps=300, batch_size=20, n_epochs=1, **SMALL),
    "memory": lambda env: rejeu.DQN("MlpPolicy", env, **OFF | {"policy_kwargs": MEMORY}),
}


def learned(agent, n_steps):
    """Returns the exceptions of as many calls of ``learn`` as it takes."""
    raised = []
    while agent.num_timesteps < n_steps:
        try:
            agent.learn(n_steps - agent.num_timesteps, reset_num_timesteps=False)
        except (OSError, ValueError, WorkerError, KeyboardInterrupt) as error:
            raised.append(type(error))
        assert len(raised) < 10
    return raised


def check(agent):
    """Every stored step leads to the next time of its own episode, and every recorded episode is complete."""
    replay = agent.run.replay
    if hasattr(replay, "ring"):
        batch = replay.draw(np.random.default_rng(0), (2000,), 1.0)[0]
        obs, after = (getattr(part, "steps", part) for part in (batch.obs, batch.next_obs))
    else:
        n = replay.length or agent.num_timesteps // 2  # which the last update has learned from
        obs, after, inside = replay.obs[0][:n], replay.next_obs[0][:n], ~replay.ended[: n - 1]
        np.testing.assert_array_equal(obs[1:][inside], after[:-1][inside])
    obs, after = (np.reshape(jax.tree.leaves(part)[0], (-1, 2)) for part in (obs, after))
    np.testing.assert_array_equal(after - obs, np.tile([0, 1], (len(obs), 1)))
    assert set(agent.history["length"]) <= {LENGTH}
    assert len(agent.history)


@pytest.mark.parametrize(("vector", "algorithm"), crossed(list(IN_PROCESS), list(AGENTS)))
def test_after_an_exception_new_episodes_begin(vector, algorithm):
    env = IN_PROCESS[vector]()
    agent = AGENTS[algorithm](env)
    raised = learned(agent, 200)
    assert raised.count(ConnectionError) == raised.count(ValueError) == raised.count(KeyboardInterrupt) == 1
    if algorithm not in ("short rollouts", "memory"):
        check(agent)
    assert set(agent.history["length"]) <= {LENGTH}


@exhaustive
def test_after_an_exception_in_a_worker_new_episodes_begin():
    env = make_vector(functools.partial(Fragile, FAULTS[:2]), 2, "gymnasium-async")
    try:
        agent = AGENTS["DQN"](env)
        assert learned(agent, 120) == [WorkerError, WorkerError]
        check(agent)
    finally:
        env.close()


@exhaustive
@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("fault", [ValueError, ConnectionError])
def test_a_vector_whose_worker_ended_with_an_exception_is_to_be_made_again(fault):
    agent = AGENTS["DQN"](
        AsyncVectorEnv([functools.partial(Fragile, [("step", 2, 3, fault)])] * 2, context="forkserver")
    )
    with pytest.raises((WorkerError, BadEnvironmentError)):
        agent.learn(40)
    with pytest.raises(WorkerError, match="make the vector again and give it to set_env"):
        agent.learn(40)
    agent.set_env(AsyncVectorEnv([Fragile] * 2, context="forkserver"))
    check(agent.learn(40))
    agent.env.close()


def test_a_vector_in_processes_that_was_interrupted_in_a_step_is_reset():
    env = AsyncVectorEnv([Fragile] * 2, context="forkserver")
    try:
        agent = AGENTS["DQN"](env).learn(20)
        env.step_async(np.zeros(2, int))  # as Ctrl-C leaves it
        agent.learn(80, reset_num_timesteps=False)
        check(agent)
    finally:
        env.close()


def test_a_monitor_that_allows_no_early_resets_lets_a_broken_episode_be_reset():
    env = DummyVecEnv([lambda: Monitor(Fragile(FAULTS[:2]), allow_early_resets=False)])
    agent = AGENTS["DQN"](env)
    assert learned(agent, 60) == [ConnectionError, ValueError]
    check(agent)


# Steps by somebody else.


def by_hand(env):
    env.reset()
    for _ in range(3):
        env.step(env.action_space.sample())


class State:
    """What an environment changes in place."""

    def __init__(self):
        self.times = {"now": [0]}


class InPlace(Fragile):
    """Has no attribute that a step replaces."""

    def __init__(self):
        self.state = State()
        super().__init__([])

    @property
    def time(self):
        return self.state.times["now"][0]

    @time.setter
    def time(self, value):
        self.state.times["now"][0] = value


@pytest.mark.parametrize("algorithm", only(["DQN"], ["DQN", "PPO"]))
@pytest.mark.parametrize("kind", [Fragile, InPlace])
def test_an_environment_that_was_stepped_by_hand_begins_a_new_episode(kind, algorithm):
    env = kind()
    agent = AGENTS[algorithm](make_vector(env))
    for _ in range(4):
        agent.learn(22, reset_num_timesteps=False)
        by_hand(env)
    if algorithm == "DQN":
        check(agent)
    assert set(agent.history["length"]) == {LENGTH}


def test_an_environment_of_two_agents_begins_a_new_episode_for_each():
    env = Fragile()
    agents = [AGENTS["DQN"](env) for _ in range(2)]
    for _ in range(3):
        for agent in agents:
            agent.learn(22, reset_num_timesteps=False)
    for agent in agents:
        check(agent)


@pytest.mark.parametrize("make", [lambda: EnvPool("CartPole-v1", 2), lambda: make_vector("jax/CartPole-v1", 2)])
def test_a_vector_that_was_stepped_by_hand_is_reset(make):
    env = make()
    agent = AGENTS["DQN"](env).learn(22)
    before = jax.tree.map(np.copy, agent.run.obs)
    assert agent.learn(2, reset_num_timesteps=False).run.episode_length.max() > 2
    env.reset()
    env.step(np.zeros(2, int))
    agent.learn(2, reset_num_timesteps=False)
    assert agent.run.episode_length.tolist() == [1, 1]
    assert not np.array_equal(before, agent.run.obs)


GOING_ON = {
    "own": lambda: make_vector(Fragile()),
    "gymnasium": lambda: make_vector("CartPole-v1"),
    "envpool": lambda: EnvPool("CartPole-v1", 1),
    "jax": lambda: make_vector("jax/CartPole-v1"),
    "workers": lambda: make_vector(Fragile, 1, "gymnasium-async"),
}


@pytest.mark.parametrize("kind", only(["own", "gymnasium", "envpool", "jax"], GOING_ON))
def test_where_nobody_stepped_it_the_episode_goes_on(kind, tmp_path):
    env = GOING_ON[kind]()
    agent = rejeu.DQN("MlpPolicy", env, learning_starts=1000, buffer_size=100, **SMALL)
    for i in range(2):
        agent.learn(2, callback=Checkpoint(tmp_path / f"{i}"))
        agent.save(tmp_path / "model")
        agent.predict(env.observation_space.sample())
        env.action_space.sample()
    assert agent.run.episode_length.tolist() == [4]
    env.close()


def test_a_fingerprint_is_small_however_much_there_is():
    class Large:
        def __init__(self):
            self.history, self.time = [list(range(10)) for _ in range(100_000)], 0
            self.itself = self

    large = Large()
    before = snapshot.fingerprint(large)
    assert snapshot.fingerprint(large) == before
    large.history[-1][0] += 1
    assert snapshot.fingerprint(large) != before
