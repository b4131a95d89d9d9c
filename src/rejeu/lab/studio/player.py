"""An agent that acts for those who watch, by a copy of the weights and in an environment of its own, in a thread."""

from __future__ import annotations

import base64
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import jax
import numpy as np

from rejeu.agents import Agent, OnPolicyAgent, load
from rejeu.checkpoints.model_files import Counters
from rejeu.checkpoints.run_folder import RunFolder
from rejeu.core import checkpoint
from rejeu.core.errors import one_line
from rejeu.core.language import said
from rejeu.core.records import convert
from rejeu.core.types import Action, JsonObject, Observation, PyTree
from rejeu.envs.base import success_of
from rejeu.envs.goal_camera import goal_camera, goal_names, project
from rejeu.envs.goals import goals_in
from rejeu.envs.masks import for_agent
from rejeu.envs.rendering import rgb_frame
from rejeu.lab.runs import requests
from rejeu.lab.runs.arguments import RunOptions
from rejeu.lab.runs.config import read_folder
from rejeu.lab.runs.environment import from_run
from rejeu.lab.runs.read import is_locked
from rejeu.lab.studio.deciding import Bar, bars_of
from rejeu.lab.studio.screen import jpeg
from rejeu.lab.studio.speech import speaking
from rejeu.logs import charts
from rejeu.logs.charts import Chart
from rejeu.logs.video import playback_fps

LEAST_FPS = 20.0
"""Frames a second of environments that are slower; of faster ones not every step is shown, but at least so many a second."""
MOST_FPS = 1000.0
"""Steps a second of environments that are faster."""
RENEW = 2.0
"""Seconds between two looks for new weights, and two requests for them."""
PAUSED = 0.05
"""Seconds between two looks whether a pause has ended."""
REST = 0.8
"""Seconds for which the end of an episode is shown."""
SEEDS, SEARCH = 100, 2.0
"""Most seeds that are tried for a goal, and seconds after which no further one is."""
NICE = 10
CURRENT, BEST = "current", "best"
"""The policy that is being trained, or the last one; and the one that evaluated best."""


class GoalView(NamedTuple):
    """The names of an environment's goals, and where they are in a picture of the start of an episode."""

    names: list[str]
    """Of the first two numbers of a goal."""
    camera: np.ndarray | None
    """As :func:`rejeu.envs.goal_camera.goal_camera` returns it."""
    picture: np.ndarray
    """``uint8 (height, width, 3)``."""

    def draw(self, chart: Chart) -> Chart:
        """Returns a map of goals on the picture, or with the names at its axes."""
        if self.camera is None:
            return {**chart, "x": self.names[0], "y": self.names[1]}
        goals = np.array([goal_place["goal"] for goal_place in chart["places"]])
        address = "data:image/jpeg;base64," + base64.b64encode(jpeg(self.picture)).decode()
        height, width = self.picture.shape[:2]
        return charts.on_picture(chart, project(self.camera, goals), address, (width, height))


@dataclass
class LiveEpisode:
    """An episode that was watched. Mutable until it ends."""

    model: str
    """Which policy acts."""
    seed: int
    step: int
    """Of the training, at which the policy was saved."""
    rewards: list[float] = field(default_factory=list)
    values: list[float] = field(default_factory=list)
    """The critic's value of each step; empty without a critic."""
    success: float = math.nan
    is_over: bool = False
    is_cut: bool = False
    """Whether a time limit ended it."""
    extents: list[float] = field(default_factory=list)
    """Differences between the highest and the least value of the actions at each step that was shown."""
    expected: float = math.nan
    """The value that the critic expected beyond the time limit."""

    def to_go(self, gamma: float) -> np.ndarray:
        """Returns the discounted return from each step on."""
        result, total = np.zeros(len(self.rewards)), 0.0
        for i in range(len(self.rewards) - 1, -1, -1):
            result[i] = total = self.rewards[i] + gamma * total
        return result


class LivePlayer:
    """A thread in which an agent acts until ``close``. Mutable: ``choose`` changes who acts.

    Args:
        folder: of the run.
        options: of the command line, about environments.
        show: called with the pictures and captions of each step.
    """

    def __init__(self, folder: Path, options: RunOptions, show: Callable[..., object], is_seen: bool = True) -> None:
        self.folder, self.options, self.show = RunFolder(folder), options, show
        self.episode: LiveEpisode | None = None
        """The episode that is played, or was played last."""
        self.complete: LiveEpisode | None = None
        """The last episode that was played to its end."""
        self.goal_view: GoalView | None = None
        """None until the first episode has begun."""
        self.gamma = 1.0
        self.problem = ""
        """Why nothing is shown."""
        self.is_seen = is_seen
        """Whether anybody looks; else the agent rests, and nothing is loaded."""
        self.model, self._next_seed = CURRENT, 0
        self.seed: int | None = None
        """From which its episodes begin; None for new ones."""
        self.goal: Sequence[float] | None = None
        """The goal near which that of its episodes is to be; None for any."""
        self.speed = 1.0
        """Multiplies the frames a second."""
        self.is_paused = False
        """Whether it waits before each step for :meth:`step`."""
        self._changed, self._closed, self._stepped = threading.Event(), threading.Event(), threading.Event()
        self._renew_at, self._step = 0.0, 0
        self._stamp: object = None
        self._thread = threading.Thread(target=speaking(self._run), daemon=True)
        self._thread.start()

    def choose(self, model: str, seed: int | None = None, goal: Sequence[float] | None = None) -> None:
        """Ends the episode; then a policy acts: "current", "best" or the name of a model; from a seed, or from a new one.

        With a goal it is the seed, of the first hundred, whose goal is nearest.
        """
        self.model, self.seed, self.goal = model, seed, goal
        self._changed.set()

    def step(self) -> None:
        """Takes one step, and pauses before the next."""
        self.is_paused = True
        self._stepped.set()

    def close(self) -> None:
        """Ends the thread."""
        self._closed.set()
        self._changed.set()

    def _run(self) -> None:
        lower_priority()
        while not self._closed.is_set():
            self._changed.clear()
            if not self.is_seen:
                self._changed.wait(0.1)
                continue
            try:
                environment = from_run(read_folder(self.folder), self.folder.path, self.options)
                with closing(environment.rendering()) as env:
                    self._act(env)
            except Exception as error:  # the environment can raise anything
                self.problem = one_line(error)
                self._changed.wait(RENEW)
        with suppress(OSError):
            self.folder.watch.unlink(missing_ok=True)

    def _act(self, env: gym.Env) -> None:
        agent: Agent | None = None
        while not self._closed.is_set():
            self._changed.clear()
            self.problem = ""
            agent, name = self._load(agent), self.model
            playing = for_agent(agent, env)
            self.gamma = float(getattr(agent.config, "gamma", 1.0))
            if self.goal is not None:
                self.seed, self.goal = nearest_seed(env, self.goal), None
            self.episode = LiveEpisode(name, self._next_seed if self.seed is None else self.seed, self._step)
            self._next_seed += self.seed is None
            self._play(agent, playing, self.episode)
            self.complete = self.episode if self.episode.is_over else self.complete
            self._changed.wait(REST)

    def _play(self, agent: Agent, env: gym.Env, episode: LiveEpisode) -> None:
        """Plays one episode, with new weights as they come; another choice ends it."""
        obs, _ = env.reset(seed=episode.seed)
        fps, memory, due = max(min(playback_fps(env), MOST_FPS), LEAST_FPS), None, time.perf_counter()
        bars: Sequence[Bar] = ()
        if self.goal_view is None:  # the first action may be compiled for seconds
            self._show(env, episode, bars)
            self.goal_view = GoalView(goal_names(env, 2), goal_camera(env), rgb_frame(env))
        while not (episode.is_over or self._changed.is_set() or self._closed.is_set()):
            if not self.is_seen:
                time.sleep(0.1)
                continue
            if episode.model == CURRENT and time.monotonic() >= self._renew_at:
                self._load(agent)
                episode.step = self._step
            action, following = agent.predict(obs, memory, deterministic=True)
            episode.values += value_of(agent, obs, memory, action)
            stride = 1 if self.is_paused else max(int(fps * self.speed / LEAST_FPS), 1)
            if len(episode.rewards) % stride == 0:
                bars = bars_of(agent, env, (obs, memory, action), episode.extents)
                self._show(env, episode, bars)
            due = self._wait(due, 1 / (fps * self.speed))
            memory = following
            obs, reward, terminated, truncated, info = env.step(action)
            episode.rewards.append(float(reward))
            episode.is_over, episode.is_cut = bool(terminated or truncated), bool(truncated and not terminated)
            episode.success = success_of(info) if episode.is_over else math.nan
        if episode.is_cut:
            action, _ = agent.predict(obs, memory, deterministic=True)
            episode.expected = (value_of(agent, obs, memory, action) or [math.nan])[0]
        if episode.is_over:
            self._show(env, episode, bars)

    def _wait(self, due: float, period: float) -> float:
        """Waits until a step is due, and while it is paused; returns when the next one is."""
        due = max(due + period, time.perf_counter() - period)
        self._changed.wait(max(due - time.perf_counter(), 0.0))
        while self.is_paused and not self._changed.is_set() and not self._stepped.wait(PAUSED):
            due = time.perf_counter()
        self._stepped.clear()
        return due

    def _show(self, env: gym.Env, episode: LiveEpisode, bars: Sequence[Bar]) -> None:
        self.show([rgb_frame(env)], [{**caption(episode), "bars": [bar._asdict() for bar in bars]}])

    def _load(self, agent: Agent | None) -> Agent:
        """Returns the agent with the weights that are asked for; an older agent is given them if they have changed."""
        if self.model == CURRENT and is_locked(self.folder.lock):
            requests.ask(self.folder.watch)
        self._renew_at = time.monotonic() + RENEW
        path = self._path()
        stamp = path, path.stat().st_mtime_ns
        if agent is None:
            agent = load(path, device="cpu")
        elif stamp != self._stamp:
            agent.set_parameters(path)
        if stamp != self._stamp:
            self._step = step_of(path)
        self._stamp = stamp
        return agent

    def _path(self) -> Path:
        """Returns the file of the model that is asked for.

        Raises:
            FileNotFoundError: if there is none yet.
        """
        folder = self.folder
        models = requests.models(folder.models)
        matching = [path for path in models if path.stem == self.model]
        files = {CURRENT: (folder.live, folder.agent, *models[-1:], folder.best), BEST: (folder.best, folder.agent)}
        for path in files.get(self.model, matching):
            if path.is_file():
                return path
        ended = "there is no model; the run has ended before it wrote one"
        waiting = "there is no policy yet; the first is shown when functions are compiled and training has begun"
        raise FileNotFoundError(waiting if is_locked(folder.lock) else ended)


def nearest_seed(env: gym.Env, goal: Sequence[float]) -> int:
    """Returns the seed from which an environment has the goal nearest to this one, of those that are tried in a moment."""
    end, distances = time.monotonic() + SEARCH, []
    for seed in range(SEEDS):
        goals = goals_in(jax.tree.map(lambda leaf: np.asarray(leaf)[None], env.reset(seed=seed)[0]), 1)
        distances.append(math.inf if goals is None else math.dist(goals[0, : len(goal)], goal[: goals.shape[1]]))
        if time.monotonic() > end:
            break
    return int(np.argmin(distances))


def step_of(model: Path) -> int:
    """Returns the step of the training at which a model was saved."""
    counters = convert(checkpoint.read_header(model, "agent").get("counters"), Counters)
    return counters.step - counters.steps_before


def value_of(agent: Agent, obs: Observation, memory: PyTree, action: Action) -> list[float]:
    """Returns the value that the critic gives to what the agent does, as a list that is empty without a critic."""
    algorithm = agent.learner.algorithm
    if isinstance(agent, OnPolicyAgent):
        return [float(agent.value(obs, memory))] if algorithm.state_value is not None else []
    return [float(agent.q_values(obs, action, "mean"))] if algorithm.action_values is not None else []


def caption(episode: LiveEpisode) -> JsonObject:
    """Returns the texts of the picture."""
    return {
        "name": said("the policy at step {}", f"{episode.step:,}"),
        "score": said("return {} · step {}", f"{sum(episode.rewards):,.2f}", f"{len(episode.rewards):,}"),
        "about": said("seed {}", episode.seed),
        "message": end_of(episode) if episode.is_over else "",
        "won": episode.success == 1.0,
    }


def end_of(episode: LiveEpisode) -> str:
    """Returns how an episode has ended.

    >>> end_of(LiveEpisode("best", 0, 0, success=1.0)), end_of(LiveEpisode("best", 0, 0, is_cut=True, expected=2.5))
    ('reached', 'the time limit cut the episode here; the critic expected 2.5 more')
    """
    if episode.success == 1.0:
        return said("reached")
    if episode.is_cut and math.isfinite(episode.expected):
        return said("the time limit cut the episode here; the critic expected {} more", f"{episode.expected:,.4g}")
    if episode.is_cut:
        return said("the time limit cut the episode here")
    return said("not reached" if episode.success == 0.0 else "the episode has ended")


def lower_priority() -> None:
    """Lets training go first, where a system has priorities of threads."""
    if sys.platform == "linux":
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), os.getpriority(os.PRIO_PROCESS, 0) + NICE)
