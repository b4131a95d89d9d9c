"""The monitor finds the first bad update, however many calls ago the state was copied, and never waits for the newest."""

import numpy as np
import pytest

from rejeu.core.algorithm import Clock, Transition
from rejeu.training.finite import MAX_CALLS, NonFiniteMonitor, NonFiniteUpdate

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0))


class Reading:
    """What an update reports. It must not be read while the update is the newest."""

    def __init__(self, n_bad, place, newest):
        self._n_bad, self.place, self.newest = n_bad, place, newest

    @property
    def n_bad(self):
        assert self.place < self.newest[0], "waits for the newest update"
        return self._n_bad


def train(bad, is_reported, n_updates=4 * MAX_CALLS):
    """Runs a loop whose update number ``bad`` leaves NaN; readings show it, or only a look at the state does."""

    newest = [-1]

    def update(state, batch, clock):
        number = int(batch.reward[0])
        after = [np.append(state[0], np.nan if number == bad else float(number))[-3:]]
        if not np.isfinite(state[0]).all():
            after = [np.full(3, np.nan)]
        is_bad = is_reported and not np.isfinite(after[0]).all()
        return after, Reading(int(is_bad), number, newest), None

    copies = []
    copy = lambda state: copies.append(state) or [array.copy() for array in state]  # noqa: E731
    monitor = NonFiniteMonitor(copy, lambda state: bool(np.isfinite(state[0]).all()), skips=False)
    state = [np.zeros(3)]
    for number in range(n_updates):
        n_unread, newest[0] = len(monitor), number
        batch = Transition(None, None, np.array([float(number)]), None, None)
        state = monitor.update(update, state, batch, CLOCK, number)[0]
        monitor.read(n_unread)
    return copies


@pytest.mark.parametrize("is_reported", [True, False])
@pytest.mark.parametrize("bad", [0, MAX_CALLS - 1, MAX_CALLS, 3 * MAX_CALLS - 7])
def test_the_first_bad_update_and_the_state_before_it_are_found(bad, is_reported):
    with pytest.raises(NonFiniteUpdate) as error:
        train(bad, is_reported)
    assert error.value.n_updates == bad == int(error.value.batches.reward[0])
    expected = [0.0, 0.0, 0.0, *map(float, range(bad))][-3:]
    np.testing.assert_array_equal(error.value.state[0], expected)


def test_the_state_is_copied_once_in_many_updates():
    assert len(train(bad=None, is_reported=True)) == pytest.approx(4, abs=1)
