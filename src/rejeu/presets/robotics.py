"""Gymnasium-Robotics: goal environments with a robot arm."""

from __future__ import annotations

from rejeu.presets.preset import Preset

FETCH_REACH = {
    "replay_buffer_class": "HerReplayBuffer",
    "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    "policy_kwargs": {"net_arch": [64, 64], "layer_norm": True},
    "batch_size": 128,
    "learning_rate": 1e-3,
    "gamma": 0.95,
    "learning_starts": 1_000,
    "buffer_size": 100_000,
}
"""Layer norm replaces the Zoo's observation normalization. Without either, learning takes twice as many steps."""

SOURCE = "RL Baselines3 Zoo, hyperparams/{}.yml, FetchReach-v1, with layer norm instead of normalized observations"

PRESETS = (
    Preset(
        env_id="FetchReach-v4",
        algorithm="SAC",
        hyperparameters=FETCH_REACH,
        n_envs=4,
        total_steps=20_000,
        evaluate_every=2_000,
        evaluate_episodes=100,
        backend="envpool",
        source=SOURCE.format("sac"),
    ),
    Preset(
        env_id="FetchReach-v4",
        algorithm="TQC",
        hyperparameters={**FETCH_REACH, "n_critics": 1},
        n_envs=4,
        total_steps=20_000,
        evaluate_every=2_000,
        evaluate_episodes=100,
        backend="envpool",
        source=SOURCE.format("tqc"),
    ),
)
