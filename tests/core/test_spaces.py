"""What the library reads from spaces, and how it scales actions."""

import json
from collections import OrderedDict

import jax
import numpy as np
import pytest
from gymnasium import spaces as gym_spaces

from rejeu.core import spaces
from tests.replay_model import GOAL_OBSERVATION

BOX = gym_spaces.Box(-1.0, 1.0, (2,), np.float64)
NESTED = gym_spaces.Dict(
    {
        "z": gym_spaces.Tuple([gym_spaces.Discrete(3, start=5), gym_spaces.Box(0, 255, (4, 4, 3), np.uint8)]),
        "a": BOX,
        "m": gym_spaces.Dict(
            {"bits": gym_spaces.MultiBinary(4), "many": gym_spaces.MultiDiscrete([2, 3], start=[1, 0])}
        ),
    }
)
EVERY = [
    BOX,
    gym_spaces.Box(np.float32([-np.inf, 0.0]), np.float32([np.inf, 5.0])),
    gym_spaces.Box(0, 255, (2, 2, 1), np.uint8),
    gym_spaces.Discrete(4, start=-2),
    gym_spaces.MultiDiscrete([[2, 3], [4, 5]], start=[[0, 1], [2, 3]]),
    gym_spaces.MultiBinary([2, 3]),
    gym_spaces.Tuple([BOX, gym_spaces.Discrete(2)]),
    NESTED,
]


def test_leaves_stand_in_the_order_of_jax():
    observation = spaces.cast(NESTED, spaces.leaves(NESTED), NESTED.sample())
    paths = [
        jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in jax.tree.leaves_with_path(observation)
    ]
    assert [leaf.path for leaf in spaces.leaves(NESTED)] == paths == ["a", "m.bits", "m.many", "z.0", "z.1"]


@pytest.mark.parametrize("space", EVERY, ids=str)
def test_leaves_have_the_shapes_and_dtypes_of_cast_observations(space):
    leaves = spaces.leaves(space)
    arrays = jax.tree.leaves(spaces.cast(space, leaves, space.sample()))
    assert [(a.shape, a.dtype.name) for a in arrays] == [(leaf.shape, leaf.dtype) for leaf in leaves]
    assert jax.tree.structure(spaces.plain(space, space.sample())) == spaces.structure(space)


@pytest.mark.parametrize(
    ("dtype", "kept"),
    [
        ("float64", "float32"),
        ("float32", "float32"),
        ("float16", "float16"),
        ("int64", "int32"),
        ("uint64", "uint32"),
        ("int16", "int16"),
        ("uint8", "uint8"),
        ("bool", "int8"),
    ],
)
def test_only_what_has_64_bits_is_narrowed(dtype, kept):
    assert spaces.narrow(np.dtype(dtype)) == kept


@pytest.mark.parametrize(
    ("space", "stored"),
    [
        (gym_spaces.Box(0, 2**31 - 1, (1,), np.int64), "int32"),
        (gym_spaces.Box(0, 2**31, (1,), np.int64), "float32"),
        (gym_spaces.Box(-(2**31), 0, (1,), np.int64), "int32"),
        (gym_spaces.Box(0, 2**32 - 1, (1,), np.uint64), "uint32"),
        (gym_spaces.Box(0, 2**64 - 1, (1,), np.uint64), "float32"),
    ],
)
def test_integers_whose_bounds_need_64_bits_are_stored_as_floats(space, stored):
    (leaf,) = leaves = spaces.leaves(space)
    assert leaf.dtype == stored
    np.testing.assert_array_equal(spaces.cast(space, leaves, space.high[None])[0], space.high.astype(stored))
    again = spaces.rebuild(json.loads(json.dumps(spaces.describe(space))))
    assert spaces.leaves(again) == leaves
    assert (again.low == space.low).all()
    assert (again.high == space.high).all()


@pytest.mark.parametrize(
    "space", [gym_spaces.Discrete(3, start=2**31 - 2), gym_spaces.MultiDiscrete([2, 3], start=[0, -(2**31) - 1])]
)
def test_choices_with_numbers_beyond_32_bits_are_refused(space):
    with pytest.raises(TypeError, match="numbers beyond 32 bits; let it start at 0"):
        spaces.leaves(space)
    with pytest.raises(TypeError, match="numbers beyond 32 bits"):
        spaces.action_scaler(space, jax.numpy)


IMAGE = gym_spaces.Box(0, 255, (4, 4, 3), np.uint8)
PAIR = gym_spaces.Dict({"image": IMAGE, "choice": gym_spaces.Discrete(3)})


@pytest.mark.parametrize(
    ("space", "observation", "fault"),
    [
        (IMAGE, np.full((4, 4, 3), 0.5), "has the dtype float64, and uint8 cannot .* multiply by 255"),
        (IMAGE, np.full((2, 4, 4, 3), 256), "has the dtype int64, and uint8 cannot"),
        (gym_spaces.Discrete(3), 7, "has the number 7, expected 0 to 2"),
        (gym_spaces.Discrete(3, start=-1), [0, -2], "has the number -2, expected -1 to 1"),
        (gym_spaces.Discrete(3), 1.5, "has the dtype float64, and int32 cannot"),
        (gym_spaces.MultiDiscrete([2, 3]), [0, 3], "has the number 3"),
        (gym_spaces.MultiBinary(2), [0, 2], "has the number 2, expected 0 to 1"),
        (BOX, [np.nan, 0.0], "NaN or infinite"),
        (BOX, [[1e300, 0.0]], "NaN or infinite"),
        (BOX, ["0", "1"], "has the structure list, expected Box.*something else than numbers"),
        (gym_spaces.Box(0, 9, (1,), np.int64), np.array([2**40]), "has the dtype int64, and int32 cannot"),
        (PAIR, {"image": np.zeros((4, 4, 3)), "choice": 3}, "of 'choice' has the number 3"),
    ],
)
def test_observations_that_training_would_refuse_are_refused(space, observation, fault):
    with pytest.raises(ValueError, match=fault):
        spaces.as_batch(observation, space, spaces.leaves(space))


def test_observations_of_other_dtypes_with_the_same_numbers_are_taken():
    for given in (
        {"image": np.full((4, 4, 3), 7.0), "choice": np.float32(2)},
        {"image": [[[7] * 3] * 4] * 4, "choice": 2},
    ):
        batch, single = spaces.as_batch(given, PAIR, spaces.leaves(PAIR))
        assert single
        assert batch["choice"].tolist() == [2]
        np.testing.assert_array_equal(batch["image"], np.full((1, 4, 4, 3), 7, np.uint8))


def test_features_count_one_hot_places():
    features = {leaf.path: (leaf.kind, leaf.n_features) for leaf in spaces.leaves(NESTED)}
    assert features == {
        "a": ("continuous", 2),
        "m.bits": ("binary", 4),
        "m.many": ("categorical", 5),
        "z.0": ("categorical", 3),
        "z.1": ("image", 48),
    }


def test_plain_takes_values_by_key_not_by_place():
    space = gym_spaces.Dict({"a": BOX, "b": gym_spaces.Tuple([BOX, BOX])})
    given = OrderedDict([("b", [2, 3]), ("a", 1)])
    assert jax.tree.leaves(spaces.plain(space, given)) == [1, 2, 3]


# Actions.

ASYMMETRIC = gym_spaces.Box(np.float32([-1.0, 0.0, -3.0]), np.float32([3.0, 0.5, -1.0]))


BIG = float(np.float32(9e9))  # just below what counts as unbounded


@pytest.mark.parametrize(
    ("space", "action", "scaled"),
    [
        (ASYMMETRIC, [[-1.0] * 3, [1.0] * 3, [0.0] * 3], [ASYMMETRIC.low, ASYMMETRIC.high, [1.0, 0.25, -2.0]]),
        (gym_spaces.Box(-2.0, 2.0, (2, 3), np.float64), np.zeros((4, 6)), np.zeros((4, 2, 3))),
        (gym_spaces.Box(-BIG, BIG, (1,), np.float32), [[-1.0], [1.0]], [[-BIG], [BIG]]),
        (gym_spaces.Discrete(3, start=4), np.array([0, 2], np.int32), [4, 6]),
    ],
)
def test_the_ends_of_the_range_become_the_bounds_exactly_in_the_shape_and_dtype_of_the_space(space, action, scaled):
    found = spaces.scale_action(space, np.asarray(action, None if space.shape == () else np.float32))
    assert found.dtype == space.dtype
    np.testing.assert_array_equal(found, scaled)


def test_scaled_actions_never_leave_bounds_that_float32_rounds():
    space = gym_spaces.Box(np.float32(-0.1), np.float32(0.3), (1,), np.float32)
    action = np.linspace(-1.0, 1.0, 1001, dtype=np.float32)[:, None]
    assert all(space.contains(a) for a in spaces.scale_action(space, action))


def test_a_whole_number_of_one_value_is_an_action():
    """Of RubiksCube in EnvPool, the depth of the slice to turn."""
    space = gym_spaces.Box(np.int32([0, 0]), np.int32([5, 0]), dtype=np.int32)
    assert spaces.check_box_action(space, "SAC") is space
    scaled = spaces.scale_action(space, np.float32([[-1.0, -1.0], [1.0, 1.0]]))
    np.testing.assert_array_equal(scaled, [[0, 0], [5, 0]])
    np.testing.assert_array_equal(spaces.unscale_action(space, scaled)[:, 1], [0, 0])


def test_random_actions_fill_the_range_of_the_algorithm():
    action = spaces.random_action(ASYMMETRIC, 2000, np.random.default_rng(0))
    assert (action.shape, action.dtype) == ((2000, 3), np.float32)
    assert (np.abs(action) <= 1).all()
    assert (action.min(axis=0) < -0.99).all()
    assert (action.max(axis=0) > 0.99).all()
    discrete = spaces.random_action(gym_spaces.Discrete(3, start=4), 100, np.random.default_rng(0))
    assert set(discrete.tolist()) == {0, 1, 2}


# Descriptions in files.


@pytest.mark.parametrize("space", EVERY, ids=str)
def test_a_space_survives_its_description_as_json(space):
    text = json.dumps(spaces.describe(space), allow_nan=False)
    again = spaces.rebuild(json.loads(text))
    assert spaces.describe(again) == spaces.describe(space)
    assert spaces.leaves(again) == spaces.leaves(space)
    assert jax.tree.structure(spaces.plain(again, again.sample())) == spaces.structure(space)


def test_bounds_of_a_box_survive_exactly():
    low, high = np.float32([0.1, -np.inf]), np.float32([1 / 3, np.inf])
    again = spaces.rebuild(spaces.describe(gym_spaces.Box(low, high)))
    np.testing.assert_array_equal(again.low, low)
    np.testing.assert_array_equal(again.high, high)


@pytest.mark.parametrize(
    "description",
    [
        None,
        [],
        {},
        {"Box": None},
        {"Box": {"low": 0, "high": 1, "shape": [2], "dtype": "object"}},
        {"Box": {"low": 0, "high": 1, "shape": [-2], "dtype": "float32"}},
        {"Box": {"low": [0, 1, 2], "high": 1, "shape": [2], "dtype": "float32"}},
        {"Box": {"low": "x", "high": 1, "shape": [2], "dtype": "float32"}},
        {"Box": {"low": 0, "high": 1, "shape": [2], "dtype": "float32"}, "Discrete": {"n": 2, "start": 0}},
        {"Box": {"low": 0, "high": 1, "shape": [10**15], "dtype": "float32"}},
        {"Tuple": [{"MultiBinary": {"shape": [2**19]}}] * 3},
        {"MultiDiscrete": {"nvec": [2**62, 2**62], "start": [0, 0]}},
        {"Discrete": {"n": 0, "start": 0}},
        {"Discrete": {"n": 3}},
        {"Tuple": 3},
        {"Dict": []},
        {"MultiBinary": {"shape": "many"}},
        {"MultiDiscrete": {"nvec": [], "start": [1]}},
        {"os.system": "true"},
    ],
    ids=str,
)
def test_a_damaged_description_is_refused(description):
    with pytest.raises(ValueError, match="not the description of a space"):
        spaces.rebuild(description)


GOALS = dict(GOAL_OBSERVATION.spaces)


@pytest.mark.parametrize(
    ("check", "space", "error", "words"),
    [
        (spaces.leaves, gym_spaces.Dict({"deep": gym_spaces.Dict({"text": gym_spaces.Text(5)})}), TypeError,
         r"observation space at 'deep\.text' is Text.*expected Box, Discrete"),
        (spaces.leaves, gym_spaces.Dict(), TypeError, "which holds nothing"),
        (spaces.leaves, gym_spaces.Tuple([gym_spaces.Discrete(2), gym_spaces.Dict()]), TypeError, "which holds nothing"),
        (spaces.check_action, gym_spaces.Box(-1.0, 1.0, (0,)), ValueError, "has no component, so there is nothing to"),
        (spaces.check_box_action, gym_spaces.Box(-1.0, 1.0, (0,)), ValueError, "has no component, so there is nothing"),
        (spaces.check_box_action, gym_spaces.Discrete(2), ValueError,
         r"SAC needs a Box action space, got Discrete\(2\); .* use DQN"),
        (spaces.check_box_action, gym_spaces.MultiDiscrete([2, 2]), ValueError, "needs a Box action space, .*ActionWra"),
        (spaces.check_box_action, gym_spaces.Box(-np.inf, np.inf, (1,)), ValueError,
         "SAC needs finite action bounds, .*RescaleAction"),
        (spaces.check_box_action, gym_spaces.Box(np.float32([0.0, 1.0]), np.float32([1.0, 1.0])), ValueError,
         "every action bound must satisfy low < high"),
        (spaces.check_goal_space, gym_spaces.Dict({key: GOALS[key] for key in ("observation", "achieved_goal")}),
         ValueError, r"desired_goal is missing from a Dict with the keys .*replay_buffer_class=None"),
        (spaces.check_goal_space, BOX, ValueError, "observation, achieved_goal, desired_goal is missing from Box"),
        (spaces.check_goal_space, gym_spaces.Dict(GOALS | {"desired_goal": gym_spaces.Box(-1.0, 1.0, (3,))}),
         ValueError, "must be the same space"),
    ],
)  # fmt: skip
def test_a_space_that_does_not_fit_is_refused(check, space, error, words):
    with pytest.raises(error, match=words):
        check(space, *(["SAC"] if check in (spaces.check_action, spaces.check_box_action) else []))


def test_what_fits_passes_and_a_missing_key_does_not():
    spaces.check_goal_space(GOAL_OBSERVATION)
    with pytest.raises(KeyError, match="b"):
        spaces.plain(gym_spaces.Dict({"a": BOX, "b": BOX}), {"a": 1})


def test_observation_bounds_do_not_tell_spaces_apart_and_action_bounds_do():
    one, two = gym_spaces.Box(-1.0, 1.0, (2,)), gym_spaces.Box(-2.0, 2.0, (2,))
    assert spaces.same(one, two, bounds=False)
    assert not spaces.same(one, two, bounds=True)
    assert not spaces.same(one, gym_spaces.Box(-1.0, 1.0, (3,)), bounds=False)
    assert not spaces.same(gym_spaces.Dict({"a": BOX}), gym_spaces.Dict({"b": BOX}), bounds=False)


def test_actions_of_both_precisions_are_the_same_and_other_bounds_are_not():
    low, high = np.float32(-0.4), np.float32(0.4)
    one, two = gym_spaces.Box(low, high, (2,)), gym_spaces.Box(-0.4, 0.4, (2,), np.float64)
    assert spaces.same(one, two, bounds=True)
    assert spaces.same(gym_spaces.Tuple([one, BOX]), gym_spaces.Tuple([two, BOX]), bounds=True)
    assert not spaces.same(one, gym_spaces.Box(-0.4, 0.5, (2,), np.float64), bounds=True)


def test_flat_keys_are_those_of_dicts_of_arrays_alone():
    box = gym_spaces.Box(-1.0, 1.0, (2,))
    flat = gym_spaces.Dict({"z": box, "a.b": gym_spaces.Discrete(3), "m": box})
    assert spaces.flat_keys(spaces.structure(flat)) == [leaf.path for leaf in spaces.leaves(flat)] == ["a.b", "m", "z"]
    for other in (box, gym_spaces.Tuple([box]), gym_spaces.Dict({"a": gym_spaces.Dict({"b": box})})):
        assert spaces.flat_keys(spaces.structure(other)) is None


def test_every_whole_number_of_a_box_of_integers_gets_an_equal_part_of_the_range():
    space = gym_spaces.Box(np.array([0, -2], np.int64), np.array([3, 2], np.int64), dtype=np.int64)
    spread = np.linspace(-1.0, 1.0, 2001, dtype=np.float32)
    actions = spaces.scale_action(space, np.stack([spread, spread], axis=1))
    assert actions.dtype == np.int64
    for column, numbers in enumerate((np.arange(4), np.arange(-2, 3))):
        found, counts = np.unique(actions[:, column], return_counts=True)
        np.testing.assert_array_equal(found, numbers)
        np.testing.assert_allclose(counts, 2001 / len(numbers), atol=2)
    assert spaces.scale_action(space, np.float32([[-7.0, 7.0]])).tolist() == [[0, 2]]
    assert space.contains(actions[0])
