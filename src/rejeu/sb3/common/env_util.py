"""Making environments."""

from rejeu.envs.make_vec_env import make_vec_env
from rejeu.envs.vec_env import is_wrapped, unwrap_wrapper

__all__ = ["is_wrapped", "make_vec_env", "unwrap_wrapper"]
