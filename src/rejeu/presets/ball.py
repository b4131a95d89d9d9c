"""The ball that must be kept in its box."""

from __future__ import annotations

from rejeu.presets.preset import Preset

RESULT = "after one minute, seeds 0 to 2, of 200 episodes each held: {} % with sigma 1, {} % with sigma 2"

PRESETS = tuple(
    Preset(
        env_id="rejeu/Ball-v0",
        algorithm=algorithm,
        hyperparameters={
            "learning_rate": "lin_1e-3",
            "learning_starts": 1_000,
            "buffer_size": 200_000,
            "batch_size": 128,
            "policy_kwargs": {"net_arch": [64, 64]},
            **extra,
        },
        n_envs=8,
        total_steps=150_000,
        evaluate_every=15_000,
        evaluate_episodes=50,
        backend="gymnasium",
        source="rejeu's own tuning",
        result=result,
    )
    for algorithm, extra, result in (
        ("SAC", {"target_entropy": -6.0}, RESULT.format("99.5, 100 and 100", "75.5, 81.5 and 76")),
        (
            "DDPG",
            {"action_noise": {"noise": "normal", "mean": [0.0, 0.0], "sigma": [0.2, 0.2]}},
            RESULT.format("100, 100 and 100", "78, 76.5 and 81.5"),
        ),
    )
)
