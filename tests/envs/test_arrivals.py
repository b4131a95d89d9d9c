"""Environments that step on their own, and results that are taken as they arrive."""

from __future__ import annotations

import contextlib
import functools

import numpy as np
import pytest

from rejeu.agents import PPO
from rejeu.core.errors import WorkerError
from rejeu.envs.make import make_vector
from tests.tiers import only
from tests.worker_environments import Gated, Losable, Paced, in_order


@contextlib.contextmanager
def opened(make, n_envs=3, wait_for=1, **options):
    with contextlib.closing(
        make_vector(make, n_envs, "gymnasium-async", seed=0, wait_for=wait_for, **{"worker_timeout": 20.0, **options})
    ) as vector:
        yield vector


ZERO = np.zeros((3, 1), np.float32)


def test_the_others_do_not_wait_for_a_slow_step(tmp_path):
    gate = tmp_path / "gate"
    with opened(functools.partial(Gated, gate), wait_for=2) as vector:
        vector.reset()
        gate.touch()
        for _ in range(2):
            vector.send(ZERO)
            assert vector.receive().which.tolist() == [1, 2]
        gate.unlink()
        vector.send(ZERO)
        while 0 not in vector.receive().which:
            vector.send(ZERO)


def test_infos_are_those_of_the_results_that_were_taken():
    with opened(Paced) as vector:
        vector.reset()
        said = []
        while len(said) < 3:
            vector.send(ZERO)
            step = vector.receive()
            (i,) = step.which
            assert vector.infos()[i] is step.info[i]
            said += [vector.infos()[i]["is_success"]] if (step.terminated | step.truncated)[i] else []


def test_rows_of_environments_that_still_step_keep_their_observation():
    with opened(functools.partial(Paced, 0.01)) as vector:
        first = vector.reset().copy()
        vector.send(ZERO + 0.5)
        step = vector.receive()
        (i,) = step.which
        rest = np.arange(3) != i
        np.testing.assert_array_equal(step.obs[rest], first[rest])
        np.testing.assert_allclose(step.obs[i], first[i] + [1, 0.5, 0])
        assert (step.reward[rest] == 0).all()
        assert not (step.terminated | step.truncated)[rest].any()


def test_episodes_end_with_the_true_successor_and_begin_by_themselves():
    with opened(Paced, 1) as vector, contextlib.closing(make_vector(Paced, 1, "gymnasium", seed=0)) as other:
        np.testing.assert_array_equal(vector.reset(), other.reset())
        for _ in range(30):
            vector.send(ZERO)
            ours, theirs = vector.receive(), other.step(ZERO)
            np.testing.assert_array_equal(ours.obs, theirs.obs)
            np.testing.assert_array_equal(ours.reward, theirs.reward)
            np.testing.assert_array_equal((ours.terminated, ours.truncated), (theirs.terminated, theirs.truncated))
            done = ours.terminated | ours.truncated
            if done.any():
                assert vector.success(ours, 0) == other.success(theirs, 0)
                np.testing.assert_array_equal(vector.reset_done(done), other.reset_done(done))


def test_a_slow_reset_does_not_keep_the_others_waiting(tmp_path):
    slow = tmp_path / "gate.reset"

    def turn():
        vector.send(ZERO)
        step = vector.receive()
        obs = step.obs.copy()
        return step._replace(obs=obs), vector.reset_done(step.truncated)

    with opened(functools.partial(Gated, tmp_path / "gate"), 2) as vector:
        vector.reset()
        slow.touch()
        taken: list[int] = []
        while taken.count(0) < 2:
            taken += turn()[0].which.tolist()
        # the third step of the first ends its episode
        assert [turn()[0].which.tolist() for _ in range(18)] == [[1]] * 18
        slow.unlink()
        step, begun = turn()
        while 0 not in step.which:
            step, begun = turn()
        assert (step.truncated[0], step.obs[0, 1], begun[0, 1]) == (True, 3, 0)


@pytest.mark.parametrize("act", only([1], [1, 2]))
def test_a_lost_worker_is_replaced_while_the_others_step(act):
    with opened(Losable, 2, worker_timeout=2.0, restart_workers=1) as vector:
        before = vector.reset().copy()
        vector.send(np.array([[0], [act]], np.float32))
        with pytest.warns(RuntimeWarning, match=r"environment 1 .*'step'.*restarted \(1 of at most 1 times\)"):
            which, step = [vector.receive().which.tolist(), vector.receive()]
        assert (which, step.which.tolist()) == ([0], [1])
        assert (step.truncated.tolist(), step.terminated.tolist(), step.reward[1]) == ([False, True], [False, False], 0)
        assert "environment 1" in step.info[1]["worker_restarted"]
        np.testing.assert_array_equal(step.obs[1], before[1])
        begun = vector.reset_done(step.truncated)[1].copy()
        assert begun[1] == 0
        assert begun[2] != before[1, 2]  # drawn from another seed
        vector.send(np.array([[0], [act]], np.float32))
        with pytest.raises(WorkerError, match=r"environment 1 .*and 1 restarts are spent"):
            vector.receive(), vector.receive()


def test_a_snapshot_keeps_the_results_that_wait():
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (40, 3, 1)).astype(np.float32)

    def play(vector, turns):
        rows = []
        for turn in turns:
            vector.send(actions[turn])
            step = vector.receive()
            done = step.terminated | step.truncated
            rows.append((step.which, step.obs[step.which].copy(), step.reward, done))
            if done.any():
                vector.reset_done(done)
        return rows

    with opened(functools.partial(Paced, 0.002)) as vector:
        obs = in_order(vector).reset()
        play(vector, range(20))
        saved = vector.snapshot()
        obs = obs.copy()
        rest = play(vector, range(20, 40))
    assert len(saved["results"]) == 2
    with opened(functools.partial(Paced, 0.002)) as again:
        in_order(again).restore(saved, obs)
        for ours, theirs in zip(play(again, range(20, 40)), rest, strict=True):
            for left, right in zip(ours, theirs, strict=True):
                np.testing.assert_array_equal(left, right)
    with opened(Paced, wait_for=2) as other, pytest.raises(ValueError, match="the run had wait_for=1"):
        other.restore(saved, obs)
    with opened(Paced, wait_for=None) as other, pytest.raises(ValueError, match="wait_for=1"):
        other.restore(saved, obs)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"reward": float("inf")}, "reward"),
        ({"terminated": True, "truncated": True, "begun": None}, "where the next episode begins"),
        ({"obs": [np.zeros(2, np.float32)]}, "observations of"),
        ({"obs": [np.full(3, np.nan, np.float32)]}, "not finite"),
        ({"env": 7}, "not those of 2 environments"),
        ({"more": 1}, "unknown field"),
    ],
)
def test_damaged_snapshots_are_refused(change, words):
    with opened(Paced, 2) as vector:
        obs = vector.reset().copy()
        vector.send(ZERO)
        vector.receive()
        saved = vector.snapshot()
        saved["results"][0] |= change
        with pytest.raises(ValueError, match=words):
            vector.restore(saved, obs)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"wait_for": 4}, "wait_for=4 must be a whole number of at least 1 and at most 3"),
        ({"wait_for": 2, "backend": "gymnasium"}, r"wait_for=2 is for worker processes.*'gymnasium-async' or 'ray'"),
        ({"ray": {"num_cpus": 1}}, "is for backend='ray', got backend='gymnasium-async'"),
    ],
)
def test_options_are_checked(options, words):
    with pytest.raises(ValueError, match=words):
        make_vector(Paced, 3, **{"backend": "gymnasium-async", **options})


def test_algorithms_that_learn_from_rollouts_refuse_it():
    with opened(Paced, 2) as vector, pytest.raises(ValueError, match=r"wait_for=1 is for off-policy .* and PPO learns"):
        PPO("MlpPolicy", vector)
