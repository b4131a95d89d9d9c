"""Callbacks are called in order, told about start and end, and restored with the run."""

import pytest

from rejeu.callbacks import Checkpoint, TrainingCallback
from tests.helpers import small_sac

pytestmark = pytest.mark.usefixtures("learners_are_shared")

BALL = "rejeu/Ball-v0"


class Noting(TrainingCallback):
    """Notes what it is told; stops training, or raises, at a step."""

    def __init__(self, notes, name, stop_at=None, raise_at=None):
        self.notes, self.name, self.stop_at, self.raise_at = notes, name, stop_at, raise_at

    def before_training(self, agent):
        self.notes.append((self.name, "before", agent.num_timesteps))

    def __call__(self, agent, progress):
        self.notes.append((self.name, progress.step))
        if progress.step == self.raise_at:
            raise RuntimeError("stopped by the test")
        return progress.step != self.stop_at

    def after_training(self, agent, error):
        self.notes.append((self.name, "after", type(error).__name__))


class Last(Noting):
    runs_last = True


class Counting:
    """A callback with a state."""

    def __init__(self):
        self.n = 0

    def __call__(self, agent, progress):
        self.n += 1

    def state_dict(self):
        return {"n": self.n}

    def load_state_dict(self, state):
        self.n = state["n"]


def test_the_error_that_ended_training_is_told_with_a_later_one():
    class Failing(Noting):
        def after_training(self, agent, error):
            super().after_training(agent, error)
            raise OSError("no room")

    notes = []
    with pytest.raises(OSError, match="no room") as raised:
        small_sac(BALL).learn(30, [Failing(notes, "a", raise_at=2), Noting(notes, "b")])
    assert str(raised.value.__context__) == "stopped by the test"
    assert [note for note in notes if "after" in note] == [
        ("a", "after", "RuntimeError"),
        ("b", "after", "RuntimeError"),
    ]


def test_callbacks_are_called_in_the_given_order_and_those_that_run_last_after_the_others():
    notes = []
    small_sac(BALL).learn(
        2, [Last(notes, "last"), Noting(notes, "a"), lambda agent, progress: notes.append("function")]
    )
    assert notes == [
        ("a", "before", 0),
        ("last", "before", 0),
        *[note for step in (1, 2) for note in (("a", step), "function", ("last", step))],
        ("a", "after", "NoneType"),
        ("last", "after", "NoneType"),
    ]


def test_an_error_is_told_to_all_callbacks_that_had_started():
    notes = []
    with pytest.raises(RuntimeError, match="stopped by the test"):
        small_sac(BALL).learn(9, [Noting(notes, "a"), Noting(notes, "b", raise_at=2)])
    assert notes[-2:] == [("a", "after", "RuntimeError"), ("b", "after", "RuntimeError")]


def test_a_callback_that_fails_to_start_is_not_told_of_the_end():
    class Failing(Noting):
        def before_training(self, agent):
            raise RuntimeError("it cannot start")

    notes = []
    with pytest.raises(RuntimeError, match="it cannot start"):
        small_sac(BALL).learn(9, [Noting(notes, "a"), Failing(notes, "b"), Noting(notes, "c")])
    assert notes == [("a", "before", 0), ("a", "after", "RuntimeError")]


def test_a_callback_reads_the_limits_of_the_call():
    seen = []

    class Reading(Noting):
        def before_training(self, agent):
            seen.append((agent.call.training_call.n_steps, agent.call.training_call.last_step))

    agent = small_sac(BALL).learn(3, Reading([], "a"))
    agent.learn(4, Reading([], "a"), reset_num_timesteps=False)
    assert seen == [(3, 3), (4, 7)]


def stopped_run(folder):
    agent = small_sac(BALL)
    agent.learn(40, [Counting(), Checkpoint(folder, every=10), lambda agent, progress: progress.step < 20])
    return agent


def test_the_checkpoint_at_the_start_of_a_resumed_run_contains_the_restored_state(tmp_path):
    agent = type(stopped_run(tmp_path / "one")).resume(tmp_path / "one")
    stop = lambda agent, progress: progress.step < 21  # noqa: E731
    agent.learn(callback=[Counting(), Checkpoint(tmp_path / "two", every=1000), stop])
    again = type(agent).resume(tmp_path / "two")
    assert again.call.saved_callbacks == [("Counting", {"n": 21})]
