"""Which action the keys held stand for."""

from itertools import combinations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, MultiBinary

from rejeu.teaching.play import keys
from rejeu.teaching.play.keys import KNOWN, full_name, keys_for
from rejeu.teaching.play.window import legend

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


def test_discrete_engines_held_together_fire_in_turn():
    bound = keys_for("LunarLander-v3", LANDER)
    assert {int(bound.action(["a", "w"], step)) for step in (0, 1)} == {1, 2}
    assert {int(bound.action(["w", "d", "a"], step)) for step in range(6)} == {2}


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


def test_unknown_discrete_actions_have_number_keys_and_letters():
    assert keys.default_keys(Discrete(2)) == {"0": (0, ""), "1": (1, ""), "a": (0, ""), "d": (1, "")}
    four = keys.keys_for("none", Discrete(4, start=5))
    assert [int(four.action([key], 0)) for key in "0123asdw"] == [5, 6, 7, 8, 5, 6, 7, 8]
    assert len([key for key in keys.default_keys(Discrete(18)) if key.isdigit()]) == 10


def test_unknown_discrete_actions_wait_for_a_key_unless_there_are_three():
    assert keys_for("Other-v0", Discrete(4)).action([], 0) is None
    assert keys_for("Other-v0", Discrete(4)).action(["a", "d"], 0) is None
    assert keys_for("Other-v0", Discrete(3)).action([], 0) == 1


def test_unknown_box_actions_have_a_pair_of_keys_for_each_number():
    bound = keys_for("Other-v0", Box(np.array([-1, -3, 0, -1], np.float32), np.array([1, 5, 1, 1], np.float32)))
    assert bound.action(["a", "w", "l", "k"], 0).tolist() == [-1, 5, 1, -1]
    assert bound.action([], 0).tolist() == [0, 0, 0, 0]


def test_a_box_without_bounds_or_without_nought_rests_within_it():
    free = keys_for("Other-v0", Box(-np.inf, np.inf, (1,), np.float32))
    assert [free.action(held, 0).tolist() for held in ("a", "", "d")] == [[-1], [0], [1]]
    far = keys_for("Other-v0", Box(2, 6, (1,), np.float32))
    assert [far.action(held, 0).tolist() for held in ("a", "", "d", "ad")] == [[2], [4], [6], [4]]


def test_unknown_actions_are_labelled_by_number():
    assert [b.label for b in keys_for("Other-v0", Box(-1, 1, (2,))).bindings] == [
        "number 1 down", "number 1 up", "number 2 down", "number 2 up"
    ]  # fmt: skip
    assert [b.label for b in keys_for("Other-v0", Discrete(2, start=3), {"j": 4}).bindings][-2:] == [
        "action 4",
        "action 4",
    ]


def test_box_actions_keep_their_shape_and_type():
    space = Box(-1, 1, (2, 1), np.float64)
    action = keys_for("Other-v0", space).action("aw", 0)
    assert action.dtype == np.float64
    assert action.tolist() == [[-1], [1]]


def test_own_keys_change_those_that_are_known():
    bound = keys_for("MountainCar-v0", MOUNTAIN, {"D": 0, "j": 2})
    assert [int(bound.action([key], 0)) for key in "adj"] == [0, 0, 2]
    assert [binding.label for binding in bound.bindings] == ["left", "left", "right"]


def test_the_legend_has_one_entry_for_an_action_with_all_its_keys():
    bound = keys_for("Taxi-v4", Discrete(6), {"s": 0, "w": 1, "d": 2, "a": 3, "space": 4, "return": 5})
    shown = [([key for key, _ in entry.keys], entry.label) for entry in legend(bound)]
    assert shown == [
        (["0", "s"], "action 0"),
        (["1", "w"], "action 1"),
        (["2", "d"], "action 2"),
        (["3", "a"], "action 3"),
        (["4", "space"], "action 4"),
        (["5", "return"], "action 5"),
    ]


def test_a_combination_has_an_action_of_its_own():
    bound = keys_for("LunarLander-v3", LANDER, {"a+w": 0, "a+d": 2})
    assert {int(bound.action(["w", "left"], step)) for step in range(4)} == {0}
    assert {int(bound.action(["a", "d"], step)) for step in range(4)} == {2}
    box = keys.bind(Box(-1, 1, (2,)), {"a": [-1, 0], "w": [0, 1], "a+w": [0.5, 0.5]})
    assert box.action(["a", "w"], 0).tolist() == [0.5, 0.5]


def test_arguments_that_change_the_actions_of_an_environment_change_its_keys():
    box = lambda n, bound: Box(-bound, bound, (n,), np.float32)  # noqa: E731
    assert actions("rejeu/Ball-v0", box(1, 2), "a", "", "d") == [[-2], [0], [2]]
    assert actions("rejeu/Ball-v0", box(3, 2), "d+w+l") == [[2, 2, 2]]
    assert actions("LunarLander-v3", box(2, 1), "a+w") == [[1, -1]]  # continuous=True
    assert actions("LunarLanderContinuous-v3", LANDER, "a") == [1]
    assert actions("CarRacing-v3", Discrete(5), "3") == [3]  # continuous=False


def test_an_arrow_bound_itself_is_no_longer_a_letter():
    bound = keys_for("MountainCar-v0", MOUNTAIN, {"left": 2})
    assert [int(bound.action([key], 0)) for key in ("left", "a", "right")] == [2, 0, 2]
    assert bound.names == {"a", "d", "left", "right"}


def test_nothing_held_can_wait_or_rest_elsewhere():
    assert keys_for("MountainCar-v0", MOUNTAIN, {"none": "wait"}).action([], 0) is None
    assert keys_for("Other-v0", Box(-1, 1, (1,)), {"none": 0.5}).action([], 0).tolist() == [0.5]


def test_short_names_are_those_of_the_course():
    assert [full_name(name) for name in ("Car", "mountain", "Lunar", "Carts-v0")] == [
        "CarRacing-v3", "MountainCar-v0", "LunarLander-v3", "Carts-v0"
    ]  # fmt: skip


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


def test_many_numbers_can_be_bound_by_hand():
    bound = keys_for("Other-v0", Box(-1, 1, (6,)), {"a": [1, 0, 0, 0, 0, -1]})
    assert bound.action(["a"], 0).tolist() == [1, 0, 0, 0, 0, -1]
    assert bound.action([], 0).tolist() == [0] * 6
