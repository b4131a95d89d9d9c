"""Which backend ``auto`` takes: the fastest one measured, by a clear margin, and the same one ever after."""

from __future__ import annotations

import json
import random
import time

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import rejeu
from rejeu.envs import measuring
from rejeu.envs.make import make_vector
from rejeu.envs.measuring import Choice
from tests.environments import Counter


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where choices are kept."""
    monkeypatch.setenv("REJEU_CACHE_DIR", str(tmp_path))
    return tmp_path / "backends"


@pytest.fixture
def rates(folder, monkeypatch):
    """Steps per second that measuring is to find, by backend; ``asked`` lists what was measured, with how many."""
    found = {"envpool": 1e5, "gymnasium": 1e4, "gymnasium-async": 1e4}

    def measure(make, backends, n_envs):
        found.setdefault("asked", []).append((*backends, n_envs))
        return Choice("", {backend: found[backend] for backend in backends if backend in found})

    monkeypatch.setattr(measuring, "measure", measure)
    monkeypatch.setattr(measuring, "cores", lambda: 4)
    return found


def choose(n_envs=8, known=True, **env_kwargs):
    return measuring.choose(None, "Some-v0", n_envs, env_kwargs, lambda: known)


# What is taken.


@pytest.mark.parametrize(
    ("measured", "backend"),
    [
        ({"envpool": 100.0, "gymnasium": 119.0}, "envpool"),
        ({"envpool": 100.0, "gymnasium": 121.0}, "gymnasium"),
        ({"envpool": 100.0, "gymnasium": 50.0, "gymnasium-async": 119.0}, "envpool"),
        ({"gymnasium": 100.0, "gymnasium-async": 119.0}, "gymnasium"),
        ({"gymnasium": 100.0, "gymnasium-async": 121.0}, "gymnasium-async"),
        ({"gymnasium": 1.0}, "gymnasium"),
    ],
)
def test_a_backend_must_be_a_fifth_faster_than_the_preferred_one(measured, backend):
    assert measuring.fastest(Choice("", measured)).backend == backend


def test_both_sides_are_measured_for_what_envpool_knows(rates):
    assert choose() == Choice("envpool", {"envpool": 1e5, "gymnasium": 1e4})
    assert rates["asked"] == [("envpool", "gymnasium", 8)]


@pytest.mark.parametrize(
    ("n_envs", "step_seconds", "tried"), [(8, 0.9e-3, False), (8, 1.1e-3, True), (2, 1.1e-3, True), (1, 1.0, False)]
)
def test_workers_are_tried_for_several_environments_of_slow_steps(rates, n_envs, step_seconds, tried):
    rates["envpool"], rates["gymnasium"] = 0.1, 1 / step_seconds
    rates["gymnasium-async"] = 3 / step_seconds
    assert choose(n_envs).backend == ("gymnasium-async" if tried else "gymnasium")
    assert rates["asked"][1:] == ([("gymnasium-async", min(n_envs, 4))] if tried else [])


def test_workers_are_not_tried_on_one_core(rates, monkeypatch):
    monkeypatch.setattr(measuring, "cores", lambda: 1)
    rates["gymnasium"] = 10.0
    assert choose(known=False) == Choice("gymnasium")
    assert "asked" not in rates


def test_workers_that_bring_little_are_not_taken(rates):
    rates["gymnasium"], rates["gymnasium-async"] = 100.0, 119.0
    assert choose(known=False) == Choice("gymnasium", {"gymnasium": 100.0, "gymnasium-async": 119.0})


def test_workers_are_not_tried_by_a_script_that_they_would_run_again(rates, monkeypatch):
    rates["gymnasium"] = 100.0
    monkeypatch.setattr("rejeu.envs.workers.pool.main_runs_again", lambda: True)
    choice = choose(known=False)
    assert choice.backend == "gymnasium"
    assert "outside of `if __name__ == '__main__':`" in choice.passed_over["gymnasium-async"]
    monkeypatch.setattr("rejeu.envs.workers.pool.main_runs_again", lambda: False)
    rates["gymnasium-async"] = 300.0
    assert choose(known=False).backend == "gymnasium-async"
    assert rates["asked"] == [("gymnasium", 8), ("gymnasium-async", 4)]  # what was known stayed known


def test_one_environment_that_only_gymnasium_has_is_not_measured(rates, folder):
    assert choose(1, known=False) == Choice("gymnasium")
    assert "asked" not in rates
    assert not [*folder.iterdir()]


# What is kept.


def test_a_choice_is_made_once(rates):
    first = choose()
    rates["envpool"], rates["gymnasium"] = 1.0, 2.0
    assert choose() == first
    assert len(rates["asked"]) == 1


def test_a_kept_choice_needs_no_envpool(rates):
    rates["envpool"] = 1.0
    choose()

    def importing():
        raise AssertionError("asked again")

    assert measuring.choose(None, "Some-v0", 8, {}, importing).backend == "gymnasium"


def test_a_choice_is_for_one_number_of_environments_and_one_set_of_arguments_and_versions(rates, monkeypatch):
    choose(8)
    choose(4)
    choose(8, g=9.0)
    choose(8, g=9.5)
    monkeypatch.setattr(measuring, "versions", lambda: {"envpool": "99"})
    choose(8)
    assert len(rates["asked"]) == 5


def test_the_first_of_several_processes_decides_for_all(rates, folder):
    key = measuring.describe("Some-v0", 8, {})

    def slowly():
        """While this process measures, another one finishes."""
        assert measuring.remembered(folder, key, lambda: Choice("envpool", {"envpool": 7.0})).backend == "envpool"
        return Choice("gymnasium", {"gymnasium": 9.0})

    assert measuring.remembered(folder, key, slowly) == Choice("envpool", {"envpool": 7.0})
    assert len([*folder.iterdir()]) == 1


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"key": 1}', '{"key": {}, "backend": "x", "measured": {"x": 1}, "passed_over": {}}']
)
def test_a_damaged_file_is_replaced(rates, folder, text):
    choose()
    (path,) = folder.iterdir()
    path.write_text(text)
    assert choose().backend == "envpool"
    assert json.loads(path.read_text())["backend"] == "envpool"
    assert len(rates["asked"]) == 2


def test_files_that_cannot_be_linked_are_kept_all_the_same(rates, folder, monkeypatch):
    def link(*_):
        raise PermissionError("no links here")

    monkeypatch.setattr(measuring.os, "link", link)
    assert choose() == choose()
    assert len(rates["asked"]) == len([*folder.iterdir()]) == 1


@pytest.mark.parametrize(("again", "words"), [(True, "outside of `if __name__"), (None, "may be another thread")])
def test_it_is_said_why_workers_were_not_tried(rates, monkeypatch, again, words):
    rates["gymnasium"] = 100.0
    monkeypatch.setattr("rejeu.envs.workers.pool.main_runs_again", lambda: again)
    assert words in choose(known=False).passed_over["gymnasium-async"]
    assert rates["asked"] == [("gymnasium", 8)]


@pytest.mark.parametrize("known", [True, False])
def test_nothing_is_measured_where_the_choice_cannot_be_kept(rates, monkeypatch, tmp_path, known):
    """Otherwise two runs with one seed could differ by what else the machine was doing."""
    expected = Choice("envpool" if known else "gymnasium")
    monkeypatch.setenv("REJEU_CACHE_DIR", "")
    assert choose(known=known) == expected
    (tmp_path / "file").touch()
    monkeypatch.setenv("REJEU_CACHE_DIR", str(tmp_path / "file"))
    assert choose(known=known) == expected
    assert "asked" not in rates


@pytest.mark.parametrize("env_kwargs", [{"render_mode": "human"}, {"thing": object()}, {"number": float("nan")}])
def test_arguments_that_show_windows_or_cannot_be_written_down_are_not_measured(rates, env_kwargs):
    assert choose(known=False, **env_kwargs) == Choice("gymnasium")
    assert "asked" not in rates


# What is measured.


def test_what_was_measured_can_be_read_from_the_environments(folder):
    vector = make_vector("Pendulum-v1", 4, seed=0)
    assert set(vector.measured) == {"envpool", "gymnasium"}
    assert vector.backend == measuring.fastest(Choice("", vector.measured)).backend
    assert all(1_000 < rate < 10_000_000 for rate in vector.measured.values())
    assert vector.passed_over == {}
    again = make_vector("Pendulum-v1", 4, seed=0)
    assert (again.backend, again.measured) == (vector.backend, vector.measured)


def test_measuring_disturbs_nothing_that_is_random(folder):
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002
    before = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    vector = make_vector("Pendulum-v1", 3, seed=5)
    assert len(vector.measured) == 2
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before  # noqa: NPY002
    explicit = make_vector("Pendulum-v1", 3, vector.backend, seed=5)
    np.testing.assert_array_equal(vector.reset(), explicit.reset())
    action = np.zeros((3, 1), np.float32)
    np.testing.assert_array_equal(vector.step(action).obs, explicit.step(action).obs)


class Timed(Counter):
    """Episodes of two steps; says how long a step and a reset take, and counts the open environments."""

    open = 0

    def __init__(self, step_seconds=0.0, reset_seconds=0.0, fails_at=None):
        super().__init__((2,))
        self.step_seconds, self.reset_seconds, self.fails_at = step_seconds, reset_seconds, fails_at
        Timed.open += 1

    def reset(self, **arguments):
        time.sleep(self.reset_seconds)
        np.random.uniform(), random.random()  # noqa: NPY002 - as environments do that know no better
        return super().reset(**arguments)

    def step(self, action):
        time.sleep(self.step_seconds)
        if self.fails_at is not None and len(self.actions) == self.fails_at:
            raise RuntimeError("out\nof order")
        return super().step(action)

    def close(self):
        Timed.open -= 1


@pytest.fixture
def timed(monkeypatch):
    monkeypatch.setitem(gym.registry, "Timed-v0", EnvSpec("Timed-v0", Timed))
    monkeypatch.setattr(Timed, "open", 0)
    return lambda backend, n, **arguments: make_vector("Timed-v0", n, backend, 0, **arguments)


def test_environments_that_were_measured_are_closed_and_globals_put_back(timed):
    np.random.seed(1)  # noqa: NPY002
    before = np.random.get_state()[1].tolist()  # noqa: NPY002
    choice = measuring.measure(timed, ("gymnasium",), 3)
    assert choice.measured["gymnasium"] > 1_000
    assert Timed.open == 0
    assert np.random.get_state()[1].tolist() == before  # noqa: NPY002


def test_resets_count(timed):
    """Two steps and a reset of 4 ms: at most 500 steps a second, whatever the steps take."""
    rates = measuring.measure(lambda b, n: timed(b, n, reset_seconds=0.004), ("gymnasium",), 2).measured
    assert 100 < rates["gymnasium"] < 500


def test_slow_environments_are_measured_briefly(timed):
    began = time.perf_counter()
    rates = measuring.measure(lambda b, n: timed(b, n, step_seconds=0.2), ("gymnasium",), 16).measured
    assert 3 < rates["gymnasium"] < 5
    assert time.perf_counter() - began < 2.0


@pytest.mark.parametrize("fails_at", [0, 20])
def test_a_backend_that_fails_is_passed_over_with_its_reason(timed, fails_at):
    def make(backend, n):
        return (
            make_vector("Pendulum-v1", n, "envpool", 0)
            if backend == "envpool"
            else timed("gymnasium", n, fails_at=fails_at)
        )

    found = measuring.fastest(measuring.measure(make, ("envpool", "gymnasium"), 2))
    assert found.backend == "envpool"
    assert [*found.measured] == ["envpool"]
    assert found.passed_over == {"gymnasium": "RuntimeError: out of order"}
    assert Timed.open == 0


def test_where_every_backend_fails_the_error_is_that_of_making_the_environment(folder):
    with pytest.raises(ValueError, match="no environment is called 'Pendulun-v1'"):
        make_vector("Pendulun-v1", 4)
    assert not [*folder.iterdir()]


def test_slow_environments_go_to_workers(timed, folder, monkeypatch):
    """A step sleeps for 5 ms, so two workers step two environments in the time of one, on however many cores."""
    monkeypatch.setattr(measuring, "cores", lambda: 2)
    vector = make_vector("Timed-v0", 2, seed=0, step_seconds=0.005)
    assert vector.backend == "gymnasium-async"
    assert vector.measured["gymnasium-async"] > 1.2 * vector.measured["gymnasium"]
    assert vector.measured["gymnasium"] < 200
    vector.reset()
    assert vector.step(np.zeros((2, 1), np.float32)).obs[:, 1].tolist() == [1.0, 1.0]
    vector.close()


# What is said.


def test_the_choice_is_said_in_a_line():
    vector = make_vector("Pendulum-v1", 1, "envpool")
    assert measuring.sentence(vector) == "envpool"
    vector.measured = {"gymnasium": 5_200.4, "envpool": 61_000.0}
    assert measuring.sentence(vector) == "envpool (61,000 steps/s; gymnasium 5,200)"
    vector.measured, vector.passed_over = {"envpool": 61_000.0}, {"gymnasium": "MissingExtra: it needs highway-env"}
    assert measuring.sentence(vector) == "envpool (61,000 steps/s); not gymnasium: MissingExtra: it needs highway-env"


def test_two_agents_of_one_seed_are_stepped_by_the_same_backend(folder):
    one, two = (rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=3, learning_starts=99).learn(30) for _ in range(2))
    np.testing.assert_array_equal(one.run.obs, two.run.obs)
