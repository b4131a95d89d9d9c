"""Frames stored once, stacks built when sampled: against a list of every observation ever seen."""

import tracemalloc

import gymnasium as gym
import jax
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FrameStackObservation
from hypothesis import given, settings, strategies as st

import rejeu
from rejeu.core.spaces import leaves, structure
from rejeu.envs.goals import GoalFunctions
from rejeu.replay.hindsight import HerReplayBuffer, HindsightConfig
from rejeu.replay.prioritized import Priorities, PriorityConfig
from rejeu.replay.ring import Ring, check_memory
from rejeu.replay.uniform import ReplayBuffer
from tests.environments import Timed

SIZE = (2, 3)


pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {
    "buffer_size": 40,
    "learning_starts": 1000,
    "batch_size": 8,
    "policy_kwargs": {"net_arch": [4]},
    "seed": 0,
}
"""An agent that compiles quickly and does not learn."""


class Film(Timed):
    """Every frame is a new image that says its number; episodes last ``length`` steps."""

    number = 0

    def __init__(self, length=4, shape=SIZE):
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)
        self.length = length

    def observe(self):
        self.number += 1
        return np.full(self.observation_space.shape, self.number % 256, np.uint8)


def make_ring(capacity, n_envs, stack, shape=SIZE):
    space = spaces.Dict(
        camera=spaces.Box(0, 255, (stack, *shape), np.uint8), pose=spaces.Box(-np.inf, np.inf, (2,), np.float32)
    )
    return Ring(capacity, n_envs, leaves(space), structure(space), (1,), np.float32, stack)


class History:
    """What a ring of ``rows`` rows ought to hold: for each environment all its observations, in order.

    An observation is ``(start, ended)``: the place where its episode began, and whether no step was taken from it. Its
    frame is a picture of its place; its stack is that of the places before it, none before ``start``.
    """

    def __init__(self, n_envs, rows, stack):
        self.n_envs, self.rows, self.stack = n_envs, rows, stack
        self.starts = [[] for _ in range(n_envs)]
        self.stepped = [[] for _ in range(n_envs)]

    def frame(self, env, place):
        return np.full(SIZE, (40 * env + 7 * place) % 251, np.uint8)

    def seen(self, env, place, oldest=0):
        """The stack that the agent saw there, if frames before ``oldest`` are gone."""
        first = max(self.starts[env][place], oldest)
        places = [max(place - back, first) for back in reversed(range(self.stack))]
        return np.stack([self.frame(env, p) for p in places])

    def obs(self):
        """The newest observation of each environment, batched."""
        newest = [len(starts) - 1 for starts in self.starts]
        return {
            "camera": np.stack([self.seen(env, place) for env, place in enumerate(newest)]),
            "pose": np.array([[env, place] for env, place in enumerate(newest)], np.float32),
        }

    def begin(self, envs):
        for env in envs:
            self.starts[env].append(len(self.starts[env]))
            self.stepped[env].append(False)

    def step(self):
        for env in range(self.n_envs):
            self.stepped[env][-1] = True
            self.starts[env].append(self.starts[env][-1])
            self.stepped[env].append(False)

    def oldest(self, env):
        return max(len(self.starts[env]) - self.rows, 0)

    def steps(self):
        return {
            (e, p) for e in range(self.n_envs) for p in range(self.oldest(e), len(self.starts[e])) if self.stepped[e][p]
        }


def play(buffer, history, ends):
    """Plays the turns ``ends``: after each step the environments named there begin an episode."""
    ring, n = buffer.ring, history.n_envs
    history.begin(range(n))
    buffer.begin(history.obs())
    for ended in ends:
        history.step()
        buffer.add(np.zeros((n, 1), np.float32), np.zeros(n, np.float32), np.zeros(n, bool), history.obs())
        if ended:
            history.begin(ended)
            buffer.begin(history.obs(), np.array(ended))
    assert len(ring) == len(history.steps())


@st.composite
def plays(draw):
    n_envs = draw(st.integers(1, 3))
    stack = draw(st.integers(1, 5))
    rows = draw(st.integers(stack + 1, 14))
    ends = st.lists(st.sampled_from(range(n_envs)), unique=True).map(sorted)
    return n_envs, stack, rows, draw(st.lists(st.one_of(st.just([]), ends), min_size=1, max_size=40))


@settings(max_examples=60)
@given(case=plays(), n_steps=st.integers(1, 3), prioritised=st.booleans())
def test_sampled_stacks_are_those_that_the_agent_saw(case, n_steps, prioritised):
    n_envs, stack, rows, ends = case
    ring = make_ring(rows * n_envs, n_envs, stack)
    assert ring.obs[0].shape == (rows * n_envs, *SIZE)
    buffer = ReplayBuffer(ring, 0.9, n_steps, Priorities(ring, PriorityConfig()) if prioritised else None)
    history = History(n_envs, rows, stack)
    play(buffer, history, ends)
    if not history.steps():
        return
    batch = buffer.sample(np.random.default_rng(0), (200,))
    assert batch.obs["camera"].shape == (200, stack, *SIZE)
    seen = set()
    for obs, next_obs, i in ((batch.obs, batch.next_obs, i) for i in range(200)):
        (env, place), (_, after) = obs["pose"][i].astype(int), next_obs["pose"][i].astype(int)
        assert place < after <= place + n_steps
        seen.add((int(env), int(place)))
        for found, at in ((obs["camera"][i], place), (next_obs["camera"][i], after)):
            np.testing.assert_array_equal(found, history.seen(env, at, history.oldest(env)))
    assert seen <= history.steps()


def test_stacks_whose_frames_are_all_kept_are_exact():
    n_envs, stack, rows = 2, 4, 30
    ring = make_ring(rows * n_envs, n_envs, stack)
    history = History(n_envs, rows, stack)
    play(ReplayBuffer(ring, 0.9), history, [[0] if i % 7 == 6 else [1] if i % 5 == 4 else [] for i in range(70)])
    exact = 0
    for env in range(n_envs):
        oldest = history.oldest(env)
        for place in range(oldest, len(history.starts[env])):
            _, (camera, _) = ring.read(ring.index(np.array(env), np.array(place)))
            kept = min(place - history.starts[env][place], stack - 1) <= place - oldest
            assert kept == np.array_equal(camera, history.seen(env, place))
            exact += kept
    assert exact >= n_envs * (rows - stack + 1)


@pytest.mark.parametrize("shape", [SIZE, (*SIZE, 3)])
def test_an_agent_replays_the_stacks_of_gymnasiums_wrapper(shape):
    def make(frame_stack):
        env = FrameStackObservation(Film(shape=shape), 3)
        return rejeu.SAC("MlpPolicy", env, frame_stack=frame_stack, **SMALL).learn(35)

    once, whole = make(3), make(None)
    assert (
        once.replay_buffer.ring.obs[0].nbytes * 3 == whole.replay_buffer.ring.obs[0].nbytes == 40 * 3 * np.prod(shape)
    )
    first, second = (agent.replay_buffer.sample(np.random.default_rng(0), (64,)) for agent in (once, whole))
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_hindsight_finds_the_stacks_too():
    space = spaces.Dict(
        observation=spaces.Box(0, 255, (3, *SIZE), np.uint8),
        achieved_goal=spaces.Box(-1, 1, (1,)),
        desired_goal=spaces.Box(-1, 1, (1,)),
    )
    ring = Ring(50, 1, leaves(space), structure(space), (1,), np.float32, 3, ("until_end",))
    goals = GoalFunctions(lambda achieved, desired: np.zeros(len(achieved), np.float32))
    buffer = HerReplayBuffer(ring, 0.9, HindsightConfig(), goals)
    film = FrameStackObservation(Film(length=100), 3)
    frames = [film.reset()[0], *(film.step(0)[0] for _ in range(30))]
    goal = lambda i: np.full((1, 1), i, np.float32)  # noqa: E731
    observations = [
        {"observation": stack[None], "achieved_goal": goal(i), "desired_goal": goal(-1)}
        for i, stack in enumerate(frames)
    ]
    buffer.begin(observations[0])
    for obs in observations[1:]:
        buffer.add(np.zeros((1, 1), np.float32), np.zeros(1, np.float32), np.zeros(1, bool), obs)
    batch = buffer.sample(np.random.default_rng(0), (64,))
    for i in range(64):
        place = int(batch.obs["achieved_goal"][i, 0])
        np.testing.assert_array_equal(batch.obs["observation"][i], frames[place])
        np.testing.assert_array_equal(batch.next_obs["observation"][i], frames[place + 1])


def test_saved_stacks_come_back(tmp_path):
    def make(**settings):
        return rejeu.SAC("MlpPolicy", FrameStackObservation(Film(), 3), **SMALL, **settings)

    agent = make(frame_stack=3).learn(60)
    path = agent.save_replay_buffer(tmp_path / "replay")
    other = rejeu.SAC.load(agent.save(tmp_path / "agent"), FrameStackObservation(Film(), 3))
    assert other.config.frame_stack == 3
    other.load_replay_buffer(path)
    first, second = (a.replay_buffer.sample(np.random.default_rng(0), (32,)) for a in (agent, other))
    jax.tree.map(np.testing.assert_array_equal, first, second)
    with pytest.raises(rejeu.core.errors.CheckpointError, match="saved with another environment or buffer_size"):
        make().load_replay_buffer(path)


class Shuffled(gym.ObservationWrapper):
    """Frames in the wrong order."""

    def observation(self, observation):
        return observation[::-1]


@pytest.mark.parametrize(
    "env",
    [
        lambda: Shuffled(FrameStackObservation(Film(), 3)),
        lambda: FrameStackObservation(Film(), 3, padding_type="zero"),
        lambda: Film(shape=(3, 2, 3)),
    ],
    ids=["newest first", "padded with zeros", "no stack of frames"],
)
def test_observations_that_cannot_be_rebuilt_are_refused(env):
    agent = rejeu.SAC("MlpPolicy", env(), frame_stack=3, **SMALL)
    with pytest.raises(ValueError, match="does not consist of the frames of the steps before"):
        agent.learn(10)


def test_stacks_are_kept_between_two_calls_of_learn():
    envs = gym.vector.SyncVectorEnv([lambda: FrameStackObservation(Film(), 3)] * 3)
    agent = rejeu.SAC("MlpPolicy", envs, frame_stack=3, **SMALL)
    agent.learn(10)  # 4 x 3 steps
    agent.learn(11)
    assert len(agent.replay_buffer.ring) == 24


@pytest.mark.parametrize(
    ("space", "frame_stack"),
    [
        (spaces.Box(-1, 1, (4, 84, 84), np.float32), 4),
        (spaces.Box(0, 255, (84, 84, 4), np.uint8), 4),
        (spaces.Box(0, 255, (4, 84), np.uint8), 4),
    ],
)
def test_observations_that_are_no_stacks_are_refused_at_once(space, frame_stack):
    with pytest.raises(ValueError, match=r"frame_stack=4 needs uint8 observations \(4, height, width"):
        Ring(10, 1, leaves(space), structure(space), (1,), np.float32, frame_stack)


def test_goals_are_never_taken_for_stacks():
    goal = spaces.Box(0, 255, (4, 8, 8), np.uint8)
    space = spaces.Dict(observation=goal, achieved_goal=goal, desired_goal=goal)
    ring = Ring(10, 1, leaves(space), structure(space), (1,), np.float32, 4)
    assert [array.shape for array in ring.obs] == [(10, 4, 8, 8), (10, 4, 8, 8), (10, 8, 8)]


@pytest.mark.parametrize("frame_stack", [None, 4])
def test_the_bytes_of_a_ring_are_told(frame_stack):
    space = spaces.Box(0, 255, (4, 84, 84), np.uint8)
    ring = Ring(100, 2, leaves(space), structure(space), (2,), np.float32, frame_stack)
    # Per row: the frames; two actions and a reward of 4 bytes; the kind; and for stacks the steps since the start.
    frames, since_start = (4, 0) if frame_stack is None else (1, 4)
    assert ring.nbytes == 100 * (frames * 84 * 84 + 2 * 4 + 4 + 1 + since_start)


def test_a_buffer_that_memory_cannot_hold_is_refused_before_anything_is_reserved(monkeypatch):
    monkeypatch.setattr("rejeu.replay.ring.free_memory", lambda: 2**32)
    space = spaces.Box(0, 255, (4, 84, 84), np.uint8)
    per_row = 84 * 84 + 4 + 4 + 1 + 4
    tracemalloc.start()
    try:
        with pytest.raises(MemoryError) as refused:
            Ring(1_000_000, 1, leaves(space), structure(space), (1,), np.float32, 4)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 2**20
    gib, fits = per_row * 1e6 / 2**30, int(1_000_000 * 0.5 * 2**32 / (per_row * 1e6))
    assert f"buffer_size=1000000 takes {gib:.1f} GiB" in str(refused.value)
    assert f"4.0 GiB of memory are free; try buffer_size={fits}" in str(refused.value)
    check_memory(per_row * fits, fits)  # what it advises does fit
