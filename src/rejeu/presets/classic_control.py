"""Gymnasium's classic control problems."""

from __future__ import annotations

from rejeu.presets.preset import Preset

PRESETS = (
    Preset(
        env_id="Pendulum-v1",
        algorithm="SAC",
        hyperparameters={"learning_rate": 1e-3},
        n_envs=1,
        total_steps=20_000,
        evaluate_every=2_000,
        evaluate_episodes=20,
        source="RL Baselines3 Zoo, hyperparams/sac.yml",
        result="",
    ),
)
