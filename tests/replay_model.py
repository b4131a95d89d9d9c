"""A brute-force reference of the replay buffers: a plain list of all observations of each environment.

Each observation identifies its environment and its index in that list, so that a sampled transition can be looked up
and checked. The reference has no ring buffer: the stored observations are the last ones of the list.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from hypothesis import strategies as st

from rejeu.core import spaces
from rejeu.replay.ring import Ring


@dataclass
class Frame:
    """An observation and the step from it (None for the last one of an episode, or the newest)."""

    episode: int
    step: tuple[float, float, bool] | None = None
    """Action, reward, terminated."""
    closed: bool = False
    """Whether this is the final observation of an episode after which another one has started."""


class Model:
    """The expected contents of a ring with room for ``rows`` observations of each environment."""

    def __init__(self, n_envs: int, rows: int) -> None:
        self.n_envs, self.rows = n_envs, rows
        self.frames: list[list[Frame]] = [[] for _ in range(n_envs)]
        self.must_begin = [True] * n_envs

    def kept(self, env: int) -> range:
        return range(max(len(self.frames[env]) - self.rows, 0), len(self.frames[env]))

    def steps(self) -> list[tuple[int, int]]:
        """Returns all (environment, index) whose step and next observation are stored."""
        return [(env, i) for env in range(self.n_envs) for i in self.kept(env) if self.frames[env][i].step is not None]

    def episode(self, env: int, index: int) -> list[int]:
        """Returns the stored indices of the episode of (env, place) in order, including the final observation."""
        mine = self.frames[env][index].episode
        return [i for i in self.kept(env) if self.frames[env][i].episode == mine]

    def n_step(self, env: int, index: int, n: int, gamma: float) -> tuple[float, int, float]:
        """Returns the return, the index to bootstrap from, and the discount, by iterating over the episode."""
        total, weight = 0.0, 1.0
        for _ in range(n):
            frame = self.frames[env][index]
            if frame.step is None:
                break
            total += weight * frame.step[1]
            weight *= gamma
            index += 1
            if frame.step[2]:
                return total, index, 0.0
        return total, index, weight

    def begin(self, envs: list[int]) -> None:
        for env in envs:
            frames = self.frames[env]
            if frames:
                frames[-1].closed = True
            frames.append(Frame(frames[-1].episode + 1 if frames else 0))
            self.must_begin[env] = False

    def add(self, action: np.ndarray, reward: np.ndarray, ends: list[str]) -> None:
        for env, frames in enumerate(self.frames):
            frames[-1].step = (float(action[env]), float(reward[env]), ends[env] == "terminated")
            frames.append(Frame(frames[-1].episode))
            self.must_begin[env] = ends[env] != "no"


@dataclass
class Turn:
    """An operation on the environments."""

    ends: list[str]
    restarting: list[bool]
    """Environments whose running episode is discarded after the step."""


def turns(n_envs: int, max_size: int = 40) -> st.SearchStrategy[list[Turn]]:
    """Random histories with both kinds of episode ends, and discarded episodes."""
    each = lambda values: st.lists(values, min_size=n_envs, max_size=n_envs)  # noqa: E731
    end = st.sampled_from(["no"] * 6 + ["terminated", "truncated"])
    restart = st.sampled_from([False] * 9 + [True])
    turn = st.builds(Turn, each(end), each(restart))
    return st.lists(turn, min_size=1, max_size=max_size)


OBSERVATION = gym.spaces.Dict(
    {
        "where": gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
        "more": gym.spaces.Tuple([gym.spaces.Discrete(1000), gym.spaces.Box(0, 255, (1,), np.uint8)]),
    }
)
GOAL_OBSERVATION = gym.spaces.Dict(
    {key: gym.spaces.Box(-np.inf, np.inf, (2,), np.float32) for key in ("observation", "achieved_goal", "desired_goal")}
)


@st.composite
def histories(draw: Any) -> tuple[int, int, list[Turn]]:
    """Numbers of environments and of rows of each, and what happens in them."""
    n_envs, rows = draw(st.integers(1, 4)), draw(st.integers(2, 14))
    return n_envs, rows, draw(turns(n_envs))


def observe(n_envs: int, places: list[int]) -> Any:
    """Observations that contain environment and index in every leaf."""
    where = np.array([[env, index] for env, index in enumerate(places)], np.float32)
    coded = np.array([10 * index + env for env, index in enumerate(places)])
    return {"where": where, "more": (coded.astype(np.int32), (coded % 256).astype(np.uint8)[:, None])}


def observe_goal(n_envs: int, places: list[int]) -> Any:
    """The achieved goal contains environment and index. The desired goal is (-1, -1), which is never achieved."""
    where = np.array([[env, index] for env, index in enumerate(places)], np.float32)
    return {"observation": where, "achieved_goal": where, "desired_goal": np.full((n_envs, 2), -1.0, np.float32)}


def make_ring(
    capacity: int, n_envs: int, space: gym.Space = OBSERVATION, counters: Sequence[str] = (), n_actions: int = 1
) -> Ring:
    leaves, structure = spaces.leaves(space), spaces.structure(space)
    return Ring(capacity, n_envs, leaves, structure, (n_actions,), np.float32, counters=counters)


def play(replay: Any, model: Model, history: list[Turn], observe_function: Any = observe, seed: int = 0) -> None:
    """Applies the same operations to ``replay`` and ``model``, like the training loop."""
    rng = np.random.default_rng(seed)
    n_envs = model.n_envs

    def observed() -> Any:
        return observe_function(n_envs, [len(frames) for frames in model.frames])

    def begin(envs: list[int]) -> None:
        if envs:
            replay.begin(observed(), np.array(envs))
            model.begin(envs)

    begin(list(range(n_envs)))
    for turn in history:
        action = rng.uniform(-1, 1, (n_envs, 1)).astype(np.float32)
        reward = rng.normal(size=n_envs).astype(np.float32)
        terminated = np.array([end == "terminated" for end in turn.ends])
        replay.add(action, reward, terminated, observed())
        model.add(action[:, 0], reward, turn.ends)
        begin([env for env in range(n_envs) if model.must_begin[env] or turn.restarting[env]])
