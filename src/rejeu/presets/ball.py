"""The ball that must be kept in its box."""

from __future__ import annotations

from rejeu.presets.preset import Preset

LINEAR_ACTOR = {"net_arch": {"pi": [], "qf": [256]}}
"""The push is a tanh of a linear function of the position: near the middle all pushes are worth nearly the same, and a
larger actor follows the critic's errors there."""

OBSERVATIONS = {"norm_obs": True, "norm_reward": False}

PRESETS = (
    # Strong noise on the target's actions loses more balls in the critic's eyes, so that it tells good pushes from bad.
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
        source="rejeu's own tuning on seeds 100 to 104",
    ),
    # The same by strong noise on the actions taken, which returns of four steps contain. Many steps for few updates: the
    # longer its actor learns, the harder it pushes near the middle.
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
        source="rejeu's own tuning on seeds 100 to 104",
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
        source="rejeu's own tuning",
    ),
)
