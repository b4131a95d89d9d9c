"""The policies by name: agents take the names, and the observation space decides what is built."""

MlpPolicy = "MlpPolicy"
CnnPolicy = "CnnPolicy"
MultiInputPolicy = "MultiInputPolicy"

__all__ = ["CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
