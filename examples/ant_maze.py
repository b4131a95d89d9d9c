"""An ant that learns to walk where it is told, and then to find its way through a maze by telling directions.

The first agent moves the legs. It is rewarded for the speed in a direction, which changes, and begins anew where it fell::

    rejeu train examples/ant_maze.py:AntWalk-v0 --out walker

The actions of the second agent are directions for the first one, each for half a second. It learns with hindsight replay::

    rejeu train examples/ant_maze.py:AntMazeDirected-v0 --env-kwargs walker=walker --out maze
    rejeu watch maze --env examples/ant_maze.py:AntMazeDirected-v0 --env-kwargs walker=walker

Needs ``pip install "rejeu[robotics]"``.
"""

from functools import cache

import gymnasium as gym
import gymnasium_robotics
import numpy as np
from gymnasium.envs.mujoco.ant_v5 import AntEnv

import rejeu
from rejeu.agents import presets

gym.register_envs(gymnasium_robotics)
load = cache(rejeu.load)
STANDS = 0.5
"""Length of a direction below which the ant stands still."""


def relative(body, direction):
    """What an ant observes of its body, ``(27,)``, and of a direction, as seen from where it faces: ``(28,)``."""
    w, x, y, z = body[1:5]
    up = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    parts = (body[:1], up, body[5:13], turn @ body[13:15], body[15:], turn @ direction)
    return np.concatenate(parts).astype(np.float32)


class Walk(gym.Wrapper):
    """Gymnasium's ant. The reward is a fifth of the speed in a direction, in m/s; an ant on its back ends the episode."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (28,), np.float32)

    def reset(self, *, seed=None, options=None):
        self.obs, info = self.env.reset(seed=seed, options=options)
        self.time = 0
        self.choose_direction()
        return relative(self.obs[2:], self.direction), info

    def step(self, action):
        before, self.time = self.obs[:2], self.time + 1
        self.obs, _, _, truncated, info = self.env.step(action)
        reward = 4 * (self.obs[:2] - before) @ self.direction
        if self.time % 100 == 0:
            self.choose_direction()
        obs = relative(self.obs[2:], self.direction)
        return obs, float(reward), bool(obs[3] < 0), truncated, info

    def choose_direction(self):
        angle = self.np_random.uniform(-np.pi, np.pi)
        self.direction = np.array([np.cos(angle), np.sin(angle)])


class Directed(gym.Wrapper):
    """A maze whose ant is moved by a trained walker. The action is the direction in which it walks; near 0 it stands still."""

    def __init__(self, env, walker):
        super().__init__(env)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.walker = load(walker)

    def reset(self, *, seed=None, options=None):
        self.obs, info = self.env.reset(seed=seed, options=options)
        self.state = None
        return self.obs, info

    def step(self, action):
        length, legs = np.linalg.norm(action), np.zeros(8, np.float32)
        if length < STANDS:
            self.state = None
        else:
            obs = relative(self.obs["observation"], action / length)
            legs, self.state = self.walker.predict(obs, self.state, deterministic=True)
        self.obs, *result = self.env.step(legs)
        return self.obs, *result


def make_walk(**settings):
    return Walk(
        AntEnv(include_cfrc_ext_in_observation=False, exclude_current_positions_from_observation=False, **settings)
    )


def make_directed(walker, env_id="AntMaze_UMaze-v5", **settings):
    return Directed(gym.make(env_id, include_cfrc_ext_in_observation=False, **settings), walker)


gym.register("AntWalk-v0", make_walk, max_episode_steps=400)
gym.register("AntMazeDirected-v0", make_directed)

SHARED = {"n_envs": 4, "backend": "gymnasium", "algorithm": "SAC", "evaluate_every": 10_000, "evaluate_episodes": 20}
walk = presets.Preset(
    **SHARED,
    env_id="AntWalk-v0",
    total_steps=60_000,
    hyperparameters={
        "action_share": 0.25,
        "action_repeat": 4,
        "policy_kwargs": {"net_arch": [256, 256], "layer_norm": True},
        "normalize": {"norm_reward": False},
        "gamma": 0.98,
        "learning_starts": 3_000,
        "buffer_size": 500_000,
    },
)
directed = presets.Preset(
    **SHARED | {"evaluate_every": 5_000},
    env_id="AntMazeDirected-v0",
    total_steps=10_000,
    hyperparameters={
        "action_repeat": 10,
        "replay_buffer_class": "HerReplayBuffer",
        "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        "policy_kwargs": {"net_arch": [128, 128], "layer_norm": True},
        "normalize": {"norm_reward": False},
        "learning_rate": 1e-3,
        "gamma": 0.98,
        "ent_coef": "auto_0.05",
        "learning_starts": 1_000,
        "buffer_size": 200_000,
    },
)
presets.register("SAC", (walk, directed))
