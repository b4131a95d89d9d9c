"""Records files of the current schema and their contents for ``tests/core/test_schemas.py``.

Run it when the schema changes, with the folder removed::

    python tests/golden/record_files.py

It writes the folder ``files`` beside this script: models, a replay buffer and normalization statistics as saved by rejeu,
and ``expected.npz``, which contains the same arrays and the predictions of the models without rejeu's format.
"""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

import rejeu
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from tests.environments import Counter, Reach, Sampled

NARROW = {"policy_kwargs": {"net_arch": [3]}, "seed": 0}
OFF_POLICY = {**NARROW, "learning_starts": 8, "batch_size": 4, "buffer_size": 40}
HINDSIGHT = {"replay_buffer_class": rejeu.HerReplayBuffer}
DISCRETE = gym.spaces.Dict({"b": gym.spaces.Discrete(3, start=-1), "a": gym.spaces.Box(-np.inf, np.inf, (2,))})


def models() -> dict[str, rejeu.Agent]:
    """Returns trained agents of several algorithms, which together use every kind of setting."""
    noise = rejeu.NormalActionNoise([0.0], [0.1])
    return {
        "sac": rejeu.SAC("MlpPolicy", Counter((5,)), **OFF_POLICY, learning_rate=rejeu.Linear(1e-2, 1e-3)).learn(20),
        "td3": rejeu.TD3("MlpPolicy", Counter((5,)), **OFF_POLICY, action_noise=noise, normalize=True).learn(20),
        "dqn": rejeu.DQN(
            "MultiInputPolicy", Sampled(DISCRETE, gym.spaces.Discrete(2)), **OFF_POLICY, priorities={}
        ).learn(20),
        "ppo": rejeu.PPO("MlpPolicy", Counter((5,)), **NARROW, n_steps=16, batch_size=8, n_epochs=2).learn(16),
    }


def observations(name: str) -> object:
    """Returns the observations for the predictions of a model."""
    rng = np.random.default_rng(7)
    box = rng.normal(size=(5, 3)).astype(np.float32)
    return {"a": box[:, :2], "b": np.array([-1, 0, 1, 0, -1])} if name == "dqn" else box


def flat(agent: rejeu.Agent) -> np.ndarray:
    """Returns all parameters of an agent as one vector, sorted by name."""
    arrays = agent.get_parameters()
    return np.concatenate([arrays[name].ravel().astype(np.float64) for name in sorted(arrays)])


def replay_agent() -> rejeu.SAC:
    """Returns an agent with an empty buffer of the recorded kind."""
    settings = {**OFF_POLICY, "learning_starts": 10**6, **HINDSIGHT}
    return rejeu.SAC("MultiInputPolicy", Reach(), **settings)


def record(folder: Path) -> None:
    """Writes files of every kind."""
    expected: dict[str, np.ndarray] = {}
    for name, agent in models().items():
        agent.save(folder / f"{name}.safetensors")
        expected[f"{name}.predictions"] = agent.predict(observations(name), deterministic=True)[0]
        expected[f"{name}.parameters"] = flat(agent)
    agent = replay_agent().learn(23)
    agent.save_replay_buffer(folder / "replay.safetensors")
    expected |= {f"replay.{key}": value for key, value in agent.replay_buffer.arrays().items()}
    env = VecNormalize(DummyVecEnv([lambda: Counter((5,))]), clip_obs=7.0)
    env.reset()
    for _ in range(9):
        env.step(np.zeros((1, 1), np.float32))
    env.save(folder / "vec_normalize.safetensors")
    for key, moments in (("obs", env.obs_rms), ("returns", env.ret_rms)):
        expected |= {
            f"vec_normalize.{key}.{part}": np.array(getattr(moments, part)) for part in ("mean", "var", "count")
        }
    np.savez_compressed(folder / "expected.npz", **expected)


if __name__ == "__main__":
    folder = Path(__file__).with_name("files")
    folder.mkdir()
    record(folder)
