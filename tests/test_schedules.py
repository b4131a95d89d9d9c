"""Schedules: their values, and the ways to write them."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

from rejeu.schedules import Exponential, Linear, at, parse, to_json


@pytest.mark.parametrize(("progress", "value"), [(0.0, 1.0), (0.25, 0.55), (0.5, 0.1), (0.8, 0.1), (1.0, 0.1)])
def test_linear_is_a_line_to_its_fraction_and_constant_after(progress, value):
    assert Linear(1.0, 0.1, fraction=0.5)(progress) == pytest.approx(value)


@pytest.mark.parametrize(("progress", "value"), [(0.0, 1.0), (0.25, 0.1), (0.5, 0.01), (1.0, 0.01)])
def test_exponential_falls_by_the_same_factor_for_the_same_stretch(progress, value):
    assert Exponential(1.0, 0.01, fraction=0.5)(progress) == pytest.approx(value)


@pytest.mark.parametrize("schedule", [Linear(3e-4, 1e-5, 0.7), Exponential(3e-4, 1e-5, 0.7)])
def test_traced_progress_gives_what_a_number_gives(schedule):
    progress = np.linspace(-0.1, 1.1, 13, dtype=np.float32)
    traced = jax.jit(jax.vmap(schedule))(progress)
    np.testing.assert_allclose(traced, [schedule(float(p)) for p in progress], rtol=1e-5)


def test_progress_beyond_the_run_does_not_extrapolate():
    assert Linear(1.0, 0.0)(1.5) == 0.0
    assert Linear(1.0, 0.0)(-0.5) == 1.0


def test_a_number_is_its_own_value_at_all_times():
    assert at(0.3, 0.9) == 0.3
    assert at(Linear(1.0, 0.0), 0.25) == 0.75


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (3e-4, 3e-4),
        (1, 1.0),
        ("lin_3e-4", Linear(3e-4, 0.0)),
        (Exponential(1.0, 0.1), Exponential(1.0, 0.1)),
        ({"schedule": "linear", "start": 1, "end": 0, "fraction": 0.5}, Linear(1.0, 0.0, 0.5)),
        ({"schedule": "exponential", "start": 1, "end": 0.1}, Exponential(1.0, 0.1)),
    ],
)
def test_everything_that_may_be_written_is_read(given, meant):
    assert parse("learning_rate", given) == meant


@pytest.mark.parametrize("schedule", [Linear(1.0, 0.25, 0.5), Exponential(1.0, 0.1)])
def test_a_schedule_survives_json(schedule):
    assert parse("x", json.loads(json.dumps(to_json(schedule)))) == schedule


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (
            lambda progress: 3e-4,
            TypeError,
            "learning_rate=.* must be a number, .*a function cannot be saved with the model",
        ),
        (True, TypeError, "learning_rate=True must be a number"),
        (None, TypeError, "learning_rate=None must be a number"),
        ("3e-4", TypeError, "learning_rate='3e-4' must be a number"),
        ("lin_fast", ValueError, "learning_rate='lin_fast'"),
        (float("nan"), ValueError, "learning_rate=nan must be finite"),
        (float("inf"), ValueError, "learning_rate=inf must be finite"),
        ("lin_inf", ValueError, "learning_rate"),
        ({"schedule": "cosine", "start": 1}, TypeError, "learning_rate="),
        ({"schedule": "linear", "stop": 1}, TypeError, "learning_rate="),
        ({"schedule": "linear", "start": "nan"}, ValueError, "learning_rate="),
    ],
)
def test_what_is_no_schedule_is_refused_by_name(given, error, words):
    with pytest.raises(error, match=words):
        parse("learning_rate", given)


@pytest.mark.parametrize("make", [lambda: Linear(1.0, 0.0, fraction=0.0), lambda: Linear(1.0, 0.0, fraction=1.5)])
def test_a_fraction_outside_the_run_is_refused(make):
    with pytest.raises(ValueError, match=r"fraction=.* must be above 0 and at most 1"):
        make()


@pytest.mark.parametrize("ends", [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0)])
def test_an_exponential_needs_positive_ends(ends):
    with pytest.raises(ValueError, match="exponential schedule needs positive ends"):
        Exponential(*ends)
