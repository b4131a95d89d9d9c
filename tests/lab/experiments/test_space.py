"""Search spaces between the command line, files and Optuna."""

import pytest

from rejeu.algorithms.search import Choice, Integers, LogUniform, NearOne, Uniform
from rejeu.lab.experiments import space

pytest.importorskip("optuna")
SPACE = {
    "learning_rate": LogUniform(1e-5, 1e-2),
    "gamma": NearOne(0.9, 0.9999),
    "policy_delay": Integers(1, 4),
    "policy_kwargs.net_arch": Choice(([64, 64], [256, 256])),
    "exploration_final_eps": Uniform(0.0, 0.2),
}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("learning_rate=1e-4..1e-3", ("learning_rate", LogUniform(1e-4, 1e-3))),
        ("gamma=0.95..0.99", ("gamma", NearOne(0.95, 0.99))),
        ("policy_delay=2..8", ("policy_delay", Integers(2, 8))),
        ("tau=0.1..1.0", ("tau", Uniform(0.1, 1.0))),
        ("n_steps=1..5", ("n_steps", Integers(1, 5))),
        ("tau=log:0.001..0.1", ("tau", LogUniform(0.001, 0.1))),
        ("learning_rate=uniform:0..1", ("learning_rate", Uniform(0, 1))),
        ("batch_size=[64,128]", ("batch_size", Choice((64, 128)))),
        ('policy_kwargs.activation_fn=["tanh", "relu"]', ("policy_kwargs.activation_fn", Choice(("tanh", "relu")))),
        ("policy_kwargs.net_arch=[[8],[16,16]]", ("policy_kwargs.net_arch", Choice(([8], [16, 16])))),
    ],
)
def test_ranges_and_lists_of_the_command_line(text, expected):
    name, dimension = space.parse(text, SPACE)
    assert (name, dimension, type(dimension)) == (*expected, type(expected[1]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("learning_rate", "must be name=low..high or name=[a,b]"),
        ("=1..2", "must be name=low..high"),
        ("learning_rate=1e-2..1e-4", "--search learning_rate: the range from 0.01 to 0.0001 is empty"),
        ("learning_rate=0..1e-2", "low=0 is no end of a range of LogUniform"),
        ("learning_rate=3e-4", "--set fixes a value"),
        ("learning_rate=a..b", "must be low..high, such as 1e-4..1e-2"),
        ("learning_rate=exp:1..2", "'exp' is no kind of range; there are uniform, log, near-one, int"),
        ("batch_size=[64", "is no list of JSON values"),
        ("batch_size=[64]", "two or more different values"),
        ("gamma=0.9..1.0", "high=1.0 is no end of a range of NearOne"),
        ("policy_delay=1..inf", "high=inf is no end of a range"),
    ],
)
def test_mistakes_are_explained(text, message):
    with pytest.raises(ValueError, match="--search") as error:
        space.parse(text, SPACE)
    assert message in str(error.value)


def test_a_dimension_of_a_file_is_the_one_that_was_written():
    for name, dimension in SPACE.items():
        assert space.from_json(name, space.to_json(dimension)) == dimension


@pytest.mark.parametrize(
    "record",
    [
        {},
        {"kind": "Uniform"},
        {"kind": "os.system", "low": 0, "high": 1},
        {"kind": "Uniform", "low": 0, "high": 1, "more": 2},
        {"kind": "Uniform", "low": 2, "high": 1},
        {"kind": "Choice", "values": 3},
        {"kind": ["Uniform"], "low": 0, "high": 1},
    ],
)
def test_a_damaged_dimension_is_refused(record):
    with pytest.raises(ValueError, match=r"dimension of a search space|is empty"):
        space.from_json("gamma", record)


def test_values_survive_optuna():
    values = {
        "learning_rate": 1e-3,
        "gamma": 0.99,
        "policy_delay": 2,
        "policy_kwargs.net_arch": [256, 256],
        "exploration_final_eps": 0.1,
    }
    params = space.encoded(SPACE, values)
    assert params.keys() == space.distributions(SPACE).keys()
    assert space.decoded(SPACE, params) == values
    for name, one in space.distributions(SPACE).items():
        assert one.to_external_repr(one.to_internal_repr(params[name])) == params[name]


def test_values_outside_of_the_space_are_left_out():
    assert space.encoded(SPACE, {"learning_rate": 1.0, "gamma": "lin_0.9", "policy_delay": 1.5, "tau": 0.1}) == {}


def test_a_value_replaces_the_start_of_a_schedule():
    line = {"schedule": "linear", "start": 1e-3, "end": 1e-4, "fraction": 0.5}
    found = space.applied({"learning_rate": line}, {"learning_rate": 1e-2})
    assert found["learning_rate"] == {"schedule": "linear", "start": 1e-2, "end": pytest.approx(1e-3), "fraction": 0.5}
