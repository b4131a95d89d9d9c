"""Scripts for Stable-Baselines3 that take the name of the library as their only argument.

``record_vec_env.py`` runs them with Stable-Baselines3 and saves the outputs. ``tests/sb3/test_golden.py`` runs them
with ``rejeu.sb3``. This module imports neither.
"""

from __future__ import annotations

import importlib
import tempfile
from pathlib import Path

import gymnasium as gym
import numpy as np

STEPS = 11


class Walk(gym.Env):
    """Observes (time, a wave, a number sampled at reset). Has ``3 + rank`` steps; terminates if rank is even."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, rank=0, scale=1.0):
        self.rank, self.scale = rank, scale

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time, self.drawn = 0, self.np_random.uniform()
        return self._observe(), {}

    def step(self, action):
        self.time += 1
        over = self.time == 3 + self.rank
        reward = self.scale * (self.time + 0.25 * self.rank)
        info = {"is_success": self.rank == 0} if over else {}
        return self._observe(), reward, over and self.rank % 2 == 0, over and self.rank % 2 == 1, info

    def _observe(self):
        return np.array([self.time, 5 * np.sin(1.7 * self.time + self.rank), self.drawn], np.float32)


class Parts(gym.ObservationWrapper):
    """Observes a Dict: the walk, and a small image of it with its channels first or last."""

    def __init__(self, env, first):
        super().__init__(env)
        shape = (1, 4, 5) if first else (4, 5, 1)
        self.observation_space = gym.spaces.Dict(
            {"walk": env.observation_space, "image": gym.spaces.Box(0, 255, shape, np.uint8)}
        )

    def observation(self, obs):
        image = np.arange(20, dtype=np.uint8).reshape(self.observation_space["image"].shape) + np.uint8(20 * obs[0])
        return {"walk": obs, "image": image}


def module(library, path):
    """Imports a module of the library."""
    return importlib.import_module(f"{library}.{path}")


def watch(env, record, name, seed=3):
    """Steps a vector environment and records all outputs."""
    env.seed(seed)
    seen = {"obs": [flat(env.reset())], "reward": [], "done": [], "limit": [], "last": [], "episode": []}
    for _ in range(STEPS):
        obs, rewards, dones, infos = env.step(np.zeros(env.num_envs, int))
        seen["obs"].append(flat(obs))
        seen["reward"].append(rewards)
        seen["done"].append(dones)
        seen["limit"].append([info["TimeLimit.truncated"] for info in infos])
        width = seen["obs"][0].shape[1]
        seen["last"].append(
            [
                flat(info["terminal_observation"], 0) if "terminal_observation" in info else np.zeros(width)
                for info in infos
            ]
        )
        seen["episode"].append(
            [(info["episode"]["r"], info["episode"]["l"]) if "episode" in info else (0, 0) for info in infos]
        )
    record.update({f"{name}.{key}": np.array(value) for key, value in seen.items()})


def flat(obs, batch_axes=1):
    """Returns an observation as one row per environment, with its entries sorted by name."""
    parts = [obs[key] for key in sorted(obs)] if isinstance(obs, dict) else [obs]
    return np.concatenate([np.asarray(p, float).reshape(*p.shape[:batch_axes], -1) for p in parts], axis=-1)


def vector_environments(library):
    """Records the outputs of vector environments and their wrappers."""
    vec, util = module(library, "common.vec_env"), module(library, "common.env_util")
    monitor = module(library, "common.monitor").Monitor
    record = {}

    def make(n=3, wrap=lambda env: env):
        return vec.DummyVecEnv([lambda i=i: wrap(monitor(Walk(i))) for i in range(n)])

    watch(make(), record, "dummy")
    watch(util.make_vec_env(Walk, n_envs=2, seed=5, env_kwargs={"rank": 1}), record, "make_vec_env")
    watch(vec.VecMonitor(vec.DummyVecEnv([lambda: Walk(0), lambda: Walk(1)])), record, "monitor")
    watch(vec.VecFrameStack(make(), 3), record, "stack")
    for first in (True, False):
        images = make(2, lambda env, first=first: Parts(env, first))
        watch(vec.VecFrameStack(images, 2), record, f"stack.images.{first}")
    watch(vec.VecExtractDictObs(make(2, lambda env: Parts(env, False)), "walk"), record, "extract")
    watch(vec.VecTransposeImage(make(2, lambda env: Parts(env, False))), record, "transpose")

    env = vec.VecNormalize(make(), clip_obs=1.5, clip_reward=0.9, gamma=0.9)
    watch(env, record, "normalize")
    keep_statistics(env, record, "normalize")
    record["normalize.original_obs"] = env.get_original_obs()
    record["normalize.original_reward"] = env.get_original_reward()
    record["normalize.unnormalized"] = env.unnormalize_obs(np.ones((2, 3), np.float32))
    record["normalize.unnormalized_reward"] = env.unnormalize_reward(np.ones(2, np.float32))
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "statistics.pkl")
        env.save(path)
        env = vec.VecNormalize.load(path, make())
    record["normalize.settings"] = np.array([env.clip_obs, env.clip_reward, env.gamma, env.epsilon, env.training])
    env.training = env.norm_reward = False
    watch(env, record, "tested")
    keep_statistics(env, record, "tested")

    env = vec.VecNormalize(make(2, lambda env: Parts(env, False)), norm_obs_keys=["walk"], norm_reward=False)
    watch(env, record, "normalize.parts")
    other = vec.VecNormalize(make(2, lambda env: Parts(env, False)), norm_obs_keys=["walk"], training=False)
    vec.sync_envs_normalization(env, other)
    record["synchronised.mean"] = other.obs_rms["walk"].mean
    record["is_wrapped"] = np.array(
        [vec.is_vecenv_wrapped(env, vec.VecNormalize), vec.is_vecenv_wrapped(env, vec.VecMonitor)]
    )
    return record


def keep_statistics(env, record, name):
    """Records the statistics of a VecNormalize."""
    for key, moments in (("obs", env.obs_rms), ("returns", env.ret_rms)):
        for part in ("mean", "var", "count"):
            record[f"{name}.{key}.{part}"] = np.array(getattr(moments, part), float)
    record[f"{name}.running"] = env.returns


def callbacks(library, name):
    """Records the order of hooks, the output of callbacks, and when they stop; ``name`` is PPO or DQN."""
    hooks, util = module(library, "common.callbacks"), module(library, "common.env_util")
    results = module(library, "common.results_plotter")
    algorithm = getattr(importlib.import_module(library), name)
    record = {}

    class Log(hooks.BaseCallback):
        def __init__(self):
            super().__init__()
            self.events = []

        def note(self, kind):
            self.events.append((kind, self.n_calls, self.num_timesteps))

        def _on_training_start(self):
            self.note(0)

        def _on_rollout_start(self):
            self.note(1)

        def _on_step(self):
            self.note(2)
            infos, dones = self.locals["infos"], self.locals["dones"]
            assert [("terminal_observation" in info) for info in infos] == list(dones)
            self.events += [(5, info["episode"]["l"], info["episode"]["r"]) for info in infos if "episode" in info]
            self.events += [(6, i, reward) for i, reward in enumerate(self.locals["rewards"])]
            self.events += [(7, *obs[:2]) for obs in self.locals["new_obs"]]
            return True

        def _on_rollout_end(self):
            self.note(3)

        def _on_training_end(self):
            self.note(4)

    def model(folder=None):
        n_envs = 2 if name == "PPO" else 1
        env = util.make_vec_env(Walk, n_envs=n_envs, env_kwargs={"rank": 1}, monitor_dir=folder)
        settings = {"n_steps": 8, "batch_size": 8, "n_epochs": 1} if name == "PPO" else {"learning_starts": 8}
        return algorithm("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [4]}, **settings)

    def evaluation(folder=None, every=5, **kwargs):
        env = util.make_vec_env(Walk, n_envs=2, env_kwargs={"rank": 2})
        return hooks.EvalCallback(env, n_eval_episodes=3, eval_freq=every, log_path=folder, verbose=0, **kwargs)

    with tempfile.TemporaryDirectory() as folder:
        log, seen = Log(), evaluation(folder)
        checkpoint = hooks.CheckpointCallback(6, str(Path(folder) / "models"), name_prefix="m")
        model(folder).learn(64, callback=[log, seen, checkpoint])
        record["events"] = np.array(log.events, float)
        with np.load(Path(folder) / "evaluations.npz", allow_pickle=False) as file:
            record.update({f"evaluations.{key}": np.array(file[key]) for key in file})
        record["evaluation.best"] = np.array([seen.best_mean_reward, seen.last_mean_reward])
        record["checkpoints"] = np.array(sorted(path.stem for path in (Path(folder) / "models").iterdir()))
        table = results.load_results(folder)
        # the rewards of Walk do not depend on the actions, but rows with equal times are sorted by the clock
        record["table"] = np.array(sorted(zip(table["r"], table["l"], strict=True)))
        for axis in (results.X_TIMESTEPS, results.X_EPISODES):
            record[f"xy.{axis}"] = np.array(results.ts2xy(table, axis))

    ticks = []
    tick = hooks.ConvertCallback(lambda locals_, globals_: ticks.append(agent.num_timesteps) or True)
    agent = model()
    agent.learn(64, callback=hooks.EveryNTimesteps(10, tick))
    record["every"] = np.array(ticks)

    def stopped(callback):
        agent = model()
        agent.learn(64, callback=callback)
        return agent.num_timesteps

    record["stopped"] = np.array(
        [
            stopped(hooks.StopTrainingOnMaxEpisodes(3)),
            stopped(evaluation(callback_on_new_best=hooks.StopTrainingOnRewardThreshold(10.0), every=7)),
            stopped(evaluation(callback_on_new_best=hooks.StopTrainingOnRewardThreshold(1e9), every=7)),
            stopped(evaluation(callback_after_eval=hooks.StopTrainingOnNoModelImprovement(1, min_evals=1), every=3)),
            stopped(hooks.CallbackList([hooks.StopTrainingOnMaxEpisodes(2), Log()])),
        ]
    )
    return record
