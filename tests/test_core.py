"""Fields of a state that average others."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from gymnasium import spaces

from rejeu import core
from rejeu.algorithms import a2c, crossq, ddpg, dqn, ppo, pqn, qrdqn, sac, td3, tqc
from rejeu.io.checkpoint import names

BOX, DISCRETE = spaces.Box(-1, 1, (2,), np.float32), spaces.Discrete(3)


@pytest.mark.parametrize(
    ("module", "action_space"),
    [(m, BOX) for m in (a2c, crossq, ddpg, ppo, sac, td3, tqc)] + [(m, DISCRETE) for m in (ddpg, dqn, pqn, qrdqn, sac)],
)
def test_averaged_leaves_are_targets_and_first_moments(module, action_space):
    algorithm = module.make(module.Config(), spaces.Box(-1, 1, (3,), np.float32), action_space)
    state = jax.eval_shape(algorithm.init, jax.ShapeDtypeStruct((2,), jnp.uint32))
    for name, is_averaged in zip(names(state), core.averaged_leaves(state), strict=True):
        assert is_averaged == (name.startswith("target_") or ".mu" in name), name


def test_averaged_leaves_follow_dicts_lists_and_modules():
    adam = [optax.scale_by_adam().init(jnp.zeros(2))]
    assert core.averaged_leaves({"a": jnp.zeros(1), "b": adam}) == [False, False, True, False]
