"""Search spaces: their ranges, and that every algorithm understands every value of its own."""

import math

import pytest

from rejeu import AGENTS
from rejeu.algorithms.search import HINDSIGHT, OFF_POLICY, Choice, Integers, LogUniform, NearOne, Uniform
from rejeu.core import validation


def built(name, values):
    """Returns the configuration of an algorithm with some values, dotted where they are nested."""
    given = {}
    if any(key in HINDSIGHT for key in values):
        given["replay_buffer_class"] = "HerReplayBuffer"
    for key, value in values.items():
        given = validation.with_value(given, key.split("."), value, key)
    return validation.build(AGENTS[name].algorithm.Config, given)


@pytest.mark.parametrize("name", AGENTS)
def test_every_algorithm_understands_the_ends_of_its_ranges(name):
    space = AGENTS[name].algorithm.Config.search_space
    assert "learning_rate" in space
    for key, dimension in space.items():
        for value in dimension.ends():
            assert dimension.contains(value)
            built(name, {key: value})


@pytest.mark.parametrize(
    ("name", "weights"),
    [("IQL", {"expectile", "inverse_temperature"}), ("TD3BC", {"alpha"}), ("ReBRAC", {"actor_bc", "critic_bc"})],
)
def test_how_far_offline_algorithms_go_from_recorded_actions_is_searched_and_what_only_acts_online_is_not(
    name, weights
):
    assert {*AGENTS[name].algorithm.Config.search_space} == weights | {*OFF_POLICY} - {"learning_starts"}


def test_the_settings_of_hindsight_are_understood():
    for key, dimension in HINDSIGHT.items():
        for value in dimension.ends():
            built("SAC", {key: value})


@pytest.mark.parametrize(
    ("kind", "ends", "message"),
    [
        (Uniform, (1.0, 1.0), "the range from 1.0 to 1.0 is empty"),
        (LogUniform, (1e-2, 1e-4), "is empty; give the lower end first"),
        (LogUniform, (0.0, 1.0), "low=0.0 is no end of a range of LogUniform"),
        (NearOne, (0.9, 1.0), "high=1.0 is no end of a range of NearOne"),
        (Integers, (1, 2.5), "high=2.5 is no end of a range of Integers"),
        (Uniform, (0.0, math.nan), "high=nan is no end"),
        (Uniform, (True, 2.0), "low=True is no end"),
    ],
)
def test_a_range_that_cannot_be_searched_is_refused(kind, ends, message):
    with pytest.raises(ValueError, match=message):
        kind(*ends)


def test_contains():
    assert Uniform(0, 1).contains(0.5)
    assert not Uniform(0, 1).contains(True)
    assert not Uniform(0, 1).contains("lin_0.5")
    assert Integers(1, 5).contains(3)
    assert not Integers(1, 5).contains(3.5)
    assert Choice(([64, 64], [256])).contains((64, 64))
    assert not Choice((1, 2)).contains(None)
