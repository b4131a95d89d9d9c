"""Search spaces between the command line, files and Optuna."""

import pytest

from rejeu.algorithms.search import Choice, Integers, LogUniform, NearOne, Uniform
from rejeu.lab.experiments import space

optuna = pytest.importorskip("optuna")
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


@pytest.mark.parametrize("dimension", [*SPACE.values(), Choice(("tanh", None, 0.5, True)), Uniform(-1e-17, 0.1 + 0.2)])
def test_a_dimension_is_read_as_it_was_written(dimension):
    again = space.dimension_of(str(dimension))
    assert (again, type(again)) == (dimension, type(dimension))


@pytest.mark.parametrize(
    "text", ["", "os:1..2", "uniform:0..1..2", "uniform:2..1", "[3", "[" * 9_000, '{"a": 1}', "log:"]
)
def test_a_damaged_dimension_is_refused(text):
    with pytest.raises(ValueError, match=r"no kind of range|must be low\.\.high|is empty|is no list of JSON values"):
        space.dimension_of(text)


def test_values_survive_optuna():
    values = {"learning_rate": 1e-3, "gamma": 0.99, "policy_delay": 2, "exploration_final_eps": 0.1}
    values["policy_kwargs.net_arch"] = [256, 256]
    config = values | {
        "policy_kwargs": {"net_arch": [256.0, 256]},
        "learning_rate": {"schedule": "linear", "start": 1e-3},
    }
    study = optuna.create_study()
    study.enqueue_trial(space.parameters(SPACE, config))
    trial = study.ask()
    assert space.suggested(trial, SPACE) == values
    study.tell(trial, 0.0)
    assert space.suggested(study.trials[0], SPACE) == values


def test_samples_lie_in_the_space():
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(50):
        trial = study.ask()
        values = space.suggested(trial, SPACE)
        assert values.keys() == SPACE.keys()
        assert all(dimension.contains(values[name]) for name, dimension in SPACE.items())
        study.tell(trial, 0.0)
    medians = {key: sorted(trial.params[key] for trial in study.trials)[25] for key in ("learning_rate", "1 - gamma")}
    assert all(1e-4 < median < 1e-2 for median in medians.values())  # logarithmic: 3e-4 and 3e-3


def test_values_outside_of_the_space_are_left_out():
    config = {"learning_rate": 1.0, "gamma": "lin_0.9", "policy_delay": 1.5, "tau": 0.1, "policy_kwargs": None}
    assert space.parameters(SPACE, config) == {}


def test_a_value_replaces_the_start_of_a_schedule():
    line = {"schedule": "linear", "start": 1e-3, "end": 1e-4, "fraction": 0.5}
    found = space.applied({"learning_rate": line}, {"learning_rate": 1e-2})
    assert found["learning_rate"] == {"schedule": "linear", "start": 1e-2, "end": pytest.approx(1e-3), "fraction": 0.5}
