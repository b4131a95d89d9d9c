"""Names of the policies. The observation space determines the network."""

MlpPolicy = "MlpPolicy"
CnnPolicy = "CnnPolicy"
MultiInputPolicy = "MultiInputPolicy"

__all__ = ["CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
