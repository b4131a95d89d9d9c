"""Ball-v0, a toy environment: keep a ball inside a box."""

from __future__ import annotations

from rejeu.presets.preset import Preset

LINEAR_ACTOR = {"net_arch": {"pi": [], "qf": [256]}}
"""A linear actor. Near the center all actions have nearly the same value, and a larger actor fits errors of the critic."""

OBSERVATIONS = {"norm_obs": True, "norm_reward": False}

PRESETS = (
    # Strong target policy noise increases the differences between the values of good and bad actions.
    Preset(
        env_id="rejeu/Ball-v0",
        algorithm="TD3",
        hyperparameters={
            "learning_rate": "lin_3e-4",
            "learning_starts": 20_000,
            "buffer_size": 500_000,
            "batch_size": 256,
            "action_noise": {"noise": "normal", "mean": [0.0, 0.0], "sigma": [0.5, 0.5]},
            "target_policy_noise": 1.0,
            "target_noise_clip": 1.0,
            "normalize": OBSERVATIONS,
            "policy_kwargs": LINEAR_ACTOR,
        },
        n_envs=8,
        total_steps=150_000,
        evaluate_every=15_000,
        evaluate_episodes=50,
        backend="gymnasium",
        source="tuned for rejeu on seeds 100 to 104",
    ),
    # The same by strong action noise with 4-step returns. Few updates per step: with more updates the actions near the
    # center grow too large.
    Preset(
        env_id="rejeu/Ball-v0",
        algorithm="DDPG",
        hyperparameters={
            "learning_rate": "lin_1e-4",
            "learning_starts": 50_000,
            "buffer_size": 1_000_000,
            "batch_size": 1024,
            "train_freq": 16,
            "gradient_steps": 4,
            "n_steps": 4,
            "action_noise": {"noise": "normal", "mean": [0.0, 0.0], "sigma": [1.0, 1.0]},
            "normalize": OBSERVATIONS,
            "policy_kwargs": LINEAR_ACTOR,
        },
        n_envs=16,
        total_steps=350_000,
        evaluate_every=35_000,
        evaluate_episodes=50,
        backend="gymnasium",
        source="tuned for rejeu on seeds 100 to 104",
    ),
    Preset(
        env_id="rejeu/Ball-v0",
        algorithm="SAC",
        hyperparameters={
            "learning_rate": "lin_1e-3",
            "learning_starts": 1_000,
            "buffer_size": 200_000,
            "batch_size": 128,
            "policy_kwargs": {"net_arch": [64, 64]},
            "target_entropy": -6.0,
        },
        n_envs=8,
        total_steps=150_000,
        evaluate_every=15_000,
        evaluate_episodes=50,
        backend="gymnasium",
        source="tuned for rejeu",
    ),
)
