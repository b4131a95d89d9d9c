"""Functions of an algorithm that return something else than they must are errors in one line."""

import re
from dataclasses import dataclass
from types import SimpleNamespace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import rejeu
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.contract import checked
from rejeu.core.algorithm import TD_ERROR, Clock

BOX, DISCRETE = spaces.Box(-1.0, 1.0, (2,), np.float32), spaces.Discrete(3)
OBS, KEY, CLOCK = np.zeros((4, 5), np.float32), jax.random.PRNGKey(0), Clock(0, 0, 0.0)
STATE = {"weight": jnp.zeros(3)}


def algorithm(space, action=None, update=None):
    """An algorithm without a network, whose functions return what is given; checked."""
    made = rejeu.Algorithm(
        lambda key: STATE,
        lambda state: state,
        lambda actor, obs, key, clock: action,
        lambda actor, obs: action,
        lambda state, batch, clock: update,
    )
    return checked(made, space)


@pytest.mark.parametrize(
    ("space", "action", "message"),
    [
        (
            BOX,
            jnp.zeros(2),
            "float32[2], expected float32[4, 2]: one for each of the 4 observations of its batch, in [-1, 1]",
        ),
        (BOX, jnp.zeros((1, 2)), "float32[1, 2], expected float32[4, 2]"),
        (BOX, jnp.zeros((4, 2), int), "int32[4, 2], expected float32[4, 2]"),
        (DISCRETE, jnp.zeros((4, 1), int), "int32[4, 1], expected int32[4]: one for each of the 4 observations"),
        (DISCRETE, jnp.zeros(4), "float32[4], expected int32[4]"),
        (DISCRETE, 1, "1, expected int32[4]"),
        (DISCRETE, None, "None, expected int32[4]"),
    ],
)
def test_actions_of_another_shape_or_kind_are_refused(space, action, message):
    made = algorithm(space, action)
    with pytest.raises(TypeError, match=re.escape(f"explore returned the actions {message}")):
        made.explore(STATE, OBS, KEY, CLOCK)
    with pytest.raises(TypeError, match=re.escape(f"exploit returned the actions {message}")):
        made.exploit(STATE, OBS)


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (STATE, "update returned (dict), expected (state, metrics)"),
        (None, "update returned (NoneType), expected (state, metrics)"),
        ((STATE, {}, 1), "update returned (dict, dict, int), expected (state, metrics)"),
        ((STATE, 0.5), "update returned (dict, float), expected (state, metrics)"),
        ((STATE, {"loss": jnp.zeros(7)}), "update returned the metric 'loss' as float32[7], expected a scalar"),
        (
            ({"weight": jnp.zeros(2)}, {}),
            "update returned a state with weight: float32[2], expected an array float32[3]",
        ),
        (({"bias": jnp.zeros(3)}, {}), "weight: no such leaf, expected an array float32[3]"),
    ],
)
def test_updates_that_return_something_else_are_refused(returned, message):
    with pytest.raises(TypeError, match=re.escape(message)):
        algorithm(BOX, update=returned).update(STATE, None, CLOCK)


def test_what_is_right_is_returned_unchanged():
    update = (STATE, {"loss": 0.5, "value": jnp.float32(1), TD_ERROR: jnp.zeros(6)})
    assert algorithm(BOX, update=update).update(STATE, None, CLOCK) is update
    for space, action in ((BOX, jnp.zeros((4, 2))), (DISCRETE, jnp.zeros(4, int))):
        assert algorithm(space, action).explore(STATE, OBS, KEY, CLOCK) is action
        assert algorithm(space, action).exploit(STATE, {"a": OBS, "b": OBS}) is action


@pytest.mark.parametrize("base", [OffPolicyConfig, rejeu.PPO.algorithm.Config])
def test_a_configuration_that_does_not_check_its_base_is_refused(base):
    @dataclass(frozen=True, kw_only=True)
    class Careless(base):
        name: ClassVar[str] = "Careless"

        def __post_init__(self):
            pass

    class Agent(rejeu.OffPolicyAgent):
        algorithm = SimpleNamespace(Config=Careless, make=None)

    message = (
        r"Careless\.__post_init__ of Careless does not call super\(\)\.__post_init__\(\), .*; begin it with this call"
    )
    with pytest.raises(TypeError, match=message):
        Agent("MlpPolicy", "CartPole-v1")
