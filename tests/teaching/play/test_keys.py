"""Which action the keys held stand for."""

from __future__ import annotations

from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary

from rejeu.teaching.play.keys import KNOWN, keys_for

LANDER, MOUNTAIN = Discrete(4), Discrete(3)


def actions(env_id, space, *held, step=0):
    return [
        np.asarray(keys_for(env_id, space).action(names.split("+") if names else [], step)).tolist() for names in held
    ]


ENGINES = Box(-1, 1, (2,), np.float32)
CAR = Box(np.array([-1, 0, 0], np.float32), np.array([1, 1, 1], np.float32))
MEANT = {
    "MountainCar-v0": (MOUNTAIN, {"a": 0, "": 1, "d": 2, "a+d": 1, "left": 0, "right": 2}),
    "LunarLander-v3": (LANDER, {"": 0, "a": 1, "w": 2, "d": 3, "up": 2, "s": 0}),
    "LunarLanderContinuous-v3": (
        ENGINES,
        {"": [0, 0], "w": [1, 0], "a": [0, -1], "d": [0, 1], "a+w": [1, -1], "a+d+w": [1, 0]},
    ),
    "CarRacing-v3": (CAR, {"": [0, 0, 0], "a+w": [-1, 1, 0], "d+s": [1, 0, 0.8], "w+s": [0, 1, 0.8]}),
    "parking-v0": (ENGINES, {"w": [1, 0], "s": [-1, 0], "a": [0, -1], "d": [0, 1], "w+d": [1, 1]}),
    "rejeu/Ball-v0": (Box(-2, 2, (2,), np.float32), {"a": [-2, 0], "d": [2, 0], "w+d": [2, 2], "s": [0, -2]}),
    "MountainCarContinuous-v0": (Box(-1, 1, (1,), np.float32), {"a": [-1], "": [0], "d": [1]}),
}
"""What the keys do by the documentation of each environment: engines, steering, gas and brake."""


@pytest.mark.parametrize("env_id", MEANT)
def test_keys_do_what_the_environment_says_of_its_actions(env_id):
    space, meant = MEANT[env_id]
    for held, action in meant.items():
        np.testing.assert_allclose(actions(env_id, space, held)[0], action, rtol=1e-6, err_msg=held)


def test_cart_pole_pushes_left_and_right_in_turn_while_nothing_is_held():
    # There is no action for nothing: 0 pushes to the left, 1 to the right.
    bound = keys_for("CartPole-v1", Discrete(2))
    assert [int(bound.action([], step)) for step in range(4)] == [0, 1, 0, 1]
    assert [int(bound.action(["a", "d"], step)) for step in range(4)] == [0, 1, 0, 1]
    assert [int(bound.action(["d"], step)) for step in range(3)] == [1, 1, 1]


@pytest.mark.parametrize("env_id", KNOWN)
def test_every_combination_of_keys_gives_an_action_of_the_environment(env_id):
    n_numbers = max((len(action) for action, _ in KNOWN[env_id].values() if isinstance(action, list)), default=0)
    if isinstance(KNOWN[env_id]["a"][0], int):
        space = Discrete(1 + max(action for action, _ in KNOWN[env_id].values() if isinstance(action, int)))
    else:
        space = Box(-2, 2, (n_numbers,), np.float32)
    bound = keys_for(env_id, space)
    names = [*"asdw", "left", "right", "up", "down", "x"]
    for n in range(len(names) + 1):
        for held in combinations(names, n):
            for step in range(3):
                assert space.contains(bound.action(held, step)), (held, step)


def test_a_box_without_bounds_or_without_nought_rests_within_it():
    free = keys_for("Other-v0", Box(-np.inf, np.inf, (1,), np.float32))
    assert [free.action(held, 0).tolist() for held in ("a", "", "d")] == [[-1], [0], [1]]
    far = keys_for("Other-v0", Box(2, 6, (1,), np.float32))
    assert [far.action(held, 0).tolist() for held in ("a", "", "d", "ad")] == [[2], [4], [6], [4]]


def test_arguments_that_change_the_actions_of_an_environment_change_its_keys():
    box = lambda n, bound: Box(-bound, bound, (n,), np.float32)  # noqa: E731
    assert actions("rejeu/Ball-v0", box(1, 2), "a", "", "d") == [[-2], [0], [2]]
    assert actions("rejeu/Ball-v0", box(3, 2), "d+w+l") == [[2, 2, 2]]
    assert actions("LunarLander-v3", box(2, 1), "a+w") == [[1, -1]]  # continuous=True
    assert actions("LunarLanderContinuous-v3", LANDER, "a") == [1]
    assert actions("CarRacing-v3", Discrete(5), "3") == [3]  # continuous=False


@pytest.mark.parametrize(
    ("space", "own", "message"),
    [
        (MOUNTAIN, {"a": 3}, r"a=3 must be an integer from 0 to 2"),
        (MOUNTAIN, {"a": 1.0}, r"a=1.0 must be an integer"),
        (MOUNTAIN, {"a": True}, r"a=True must be"),
        (MOUNTAIN, {"none": [1, 7]}, r"none=7 must be"),
        (MOUNTAIN, {"lefft": 1}, r"unknown key 'lefft'; did you mean left\?"),
        (MOUNTAIN, {"a+": 1}, r"unknown key ''"),
        (MOUNTAIN, {"r": 1}, r"'r' cannot be bound: it is reserved for the window \(restart\)"),
        (Box(-1, 1, (2,)), {"a": 1}, r"a=1 must be 2 numbers"),
        (Box(-1, 1, (2,)), {"a": [1, "x"]}, r"a=\[1, x\] must be 2 numbers"),
        (Box(-1, 1, (2,)), {"a": [1, 1.5]}, r"a=\[1, 1.5\] is outside"),
        (Box(-1, 1, (2,)), {"a": [1, float("nan")]}, r"is outside"),
        (Box(-1, 1, (6,)), {}, r"the actions have 6; .* a=\[1,0,0,0,0,0\]"),
        (MultiBinary(3), {}, r"MultiBinary\(3\) cannot be played by hand"),
        (gym.spaces.Dict(), {"a": 1}, r"cannot be played by hand"),
    ],
)
def test_what_cannot_be_bound_is_named(space, own, message):
    with pytest.raises(ValueError, match=message):
        keys_for("Other-v0", space, own)
