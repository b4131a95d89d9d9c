"""What Stable-Baselines3 has in ``common``."""
