"""Gymnasium's Box2D environments."""

from __future__ import annotations

from rejeu.presets.preset import Preset

LUNAR_LANDER = {"n_steps": 1024, "batch_size": 64, "gae_lambda": 0.98, "gamma": 0.999, "n_epochs": 4, "ent_coef": 0.01}

PRESETS = (
    Preset(
        env_id="LunarLanderContinuous-v3",
        algorithm="PPO",
        hyperparameters={**LUNAR_LANDER, "learning_rate": "lin_6e-4"},
        n_envs=16,
        total_steps=1_000_000,
        evaluate_every=100_000,
        evaluate_episodes=32,
        backend="envpool",
        source="RL Baselines3 Zoo, hyperparams/ppo.yml, with a learning rate tuned on seeds 100 to 103",
    ),
    Preset(
        env_id="LunarLander-v3",
        algorithm="PPO",
        hyperparameters=LUNAR_LANDER,
        n_envs=16,
        total_steps=1_000_000,
        evaluate_every=100_000,
        evaluate_episodes=32,
        backend="envpool",
        source="RL Baselines3 Zoo, hyperparams/ppo.yml",
    ),
)
