"""Records the files in ``sb3_monitor``: run it there with Stable-Baselines3 2.9.2, PyTorch 2.13.0 and tensorboard."""

from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env

env = make_vec_env("CartPole-v1", n_envs=2, seed=0, monitor_dir="ppo/CartPole-v1_1")
PPO("MlpPolicy", env, n_steps=128, batch_size=64, n_epochs=2, seed=0, tensorboard_log="tb").learn(1024)
