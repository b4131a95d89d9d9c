"""One of the vector environments."""

from rejeu.envs.vec_env import VecEnv, VecEnvWrapper

__all__ = ["VecEnv", "VecEnvWrapper"]
