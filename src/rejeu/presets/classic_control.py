"""Gymnasium's classic control problems."""

from __future__ import annotations

from rejeu.presets.preset import Preset

PRESETS = (
    Preset(
        env_id="Pendulum-v1",
        algorithm="SAC",
        hyperparameters={"learning_rate": 1e-3, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}},
        n_envs=1,
        total_steps=20_000,
        evaluate_every=2_000,
        evaluate_episodes=20,
        source="RL Baselines3 Zoo, hyperparams/sac.yml, with smaller networks and batches",
        result="",
    ),
    Preset(
        env_id="Pendulum-v1",
        algorithm="TQC",
        hyperparameters={"learning_rate": 1e-3, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}},
        n_envs=1,
        total_steps=20_000,
        evaluate_every=2_000,
        evaluate_episodes=20,
        backend="gymnasium",
        source="RL Baselines3 Zoo, hyperparams/tqc.yml, with smaller networks and batches",
        result="",
    ),
    Preset(
        env_id="Pendulum-v1",
        algorithm="CrossQ",
        hyperparameters={"policy_delay": 2, "batch_size": 64, "policy_kwargs": {"net_arch": [64, 64]}},
        n_envs=1,
        total_steps=20_000,
        evaluate_every=2_000,
        evaluate_episodes=20,
        backend="gymnasium",
        source="RL Baselines3 Zoo, hyperparams/crossq.yml, with smaller networks and batches",
        result="",
    ),
)
