"""highway-env's parking-v0: reach a goal pose, which is different in every episode."""

from __future__ import annotations

from rejeu.presets.preset import Preset

PRESETS = (
    Preset(
        env_id="parking-v0",
        algorithm="SAC",
        hyperparameters={
            "replay_buffer_class": "HerReplayBuffer",
            "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
            "policy_kwargs": {"net_arch": [64, 64, 64], "layer_norm": True},
            "batch_size": 128,
            "learning_rate": "lin_1e-3",
            "gamma": 0.95,
            "learning_starts": 1_024,
            "buffer_size": 100_000,
        },
        n_envs=16,
        total_steps=56_000,
        evaluate_every=8_000,
        evaluate_episodes=100,
        backend="envpool",
        source="highway-env's parking notebook, tuned further",
    ),
)
