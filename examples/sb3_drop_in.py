"""A script for Stable-Baselines3 in which only the imports were changed."""

from rejeu.sb3 import PPO
from rejeu.sb3.common.callbacks import EvalCallback
from rejeu.sb3.common.env_util import make_vec_env
from rejeu.sb3.common.evaluation import evaluate_policy
from rejeu.sb3.common.vec_env import VecNormalize

env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=4, seed=0))
eval_env = VecNormalize(make_vec_env("Pendulum-v1", seed=1), training=False, norm_reward=False)

model = PPO("MlpPolicy", env, n_steps=1024, gamma=0.9, use_sde=True, sde_sample_freq=4, learning_rate=1e-3, seed=0)
model.learn(100_000, callback=EvalCallback(eval_env, eval_freq=5_000, best_model_save_path="logs"))
model.save("ppo_pendulum")

model = PPO.load("ppo_pendulum")
mean_reward, std_reward = evaluate_policy(model, eval_env, n_eval_episodes=10)
print(f"{mean_reward:.0f} +/- {std_reward:.0f}")
