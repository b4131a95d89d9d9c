"""Registers an environment when it is imported, as environment packages do."""

import gymnasium as gym

from tests.bad_environments import Scalar

gym.register("Bad-v0", Scalar)
