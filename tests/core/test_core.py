"""Fields of a state that average others."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from rejeu.algorithms import a2c, crossq, ddpg, dqn, ppo, pqn, qrdqn, sac, td3, tqc
from rejeu.core import algorithm as core

BOX, DISCRETE = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)


@pytest.mark.parametrize(
    ("module", "action_space"),
    [(m, BOX) for m in (a2c, crossq, ddpg, ppo, sac, td3, tqc)] + [(m, DISCRETE) for m in (ddpg, dqn, pqn, qrdqn, sac)],
)
def test_averaged_fields_are_the_targets(module, action_space):
    algorithm = module.make(module.Config(), spaces.Box(-1, 1, (3,), np.float32), action_space)
    state = jax.eval_shape(algorithm.init, jax.ShapeDtypeStruct((2,), jnp.uint32))
    targets = {field.name for field in dataclasses.fields(state) if field.name.startswith("target_")}
    assert core.averaged_fields(type(state)) == targets
