"""A time limit as a terminal state, and in environments of the old package gym."""

from types import SimpleNamespace

import numpy as np
import pytest

import rejeu
from tests.environments import Counter
from tests.helpers import small_sac


def test_with_the_wrapper_nothing_is_bootstrapped_from_the_end_that_a_time_limit_makes():
    """Episodes of 3 steps that are cut off: without the wrapper none terminates, with it every third step does."""
    kinds = []
    for env in (Counter((3,), "truncated"), rejeu.TimeLimitTerminates(Counter((3,), "truncated"))):
        buffer = small_sac(env, learning_starts=100).learn(9).replay_buffer
        batch = buffer.sample(np.random.default_rng(0), (64,))
        kinds.append(sorted({float(discount) for discount in batch.discount}))
    gamma = float(np.float32(0.99))
    assert kinds == [[gamma], [0.0, gamma]]


class Old:
    """In the style of the old package gym, with spaces of its own; the third step is the last."""

    observation_space = SimpleNamespace(shape=[2], low=[-10, -10], high=[10, 10])
    action_space = SimpleNamespace(n=3)

    def __init__(self, info):
        self.info = info

    def reset(self):
        self.count = 0
        return np.zeros(2)

    def step(self, action):
        self.count += 1
        return np.full(2, float(self.count)), 1, self.count == 3, self.info


@pytest.mark.parametrize(("info", "end"), [({}, (True, False)), ({"TimeLimit.truncated": True}, (False, True))])
def test_an_environment_of_the_old_package_gym_is_stepped_as_one_of_gymnasium(info, end):
    env = rejeu.OldEnvironment(Old(info))
    assert (env.observation_space.shape, env.observation_space.low.tolist(), env.action_space.n) == (
        (2,),
        [-10, -10],
        3,
    )
    vector = rejeu.make_vector(env)
    assert np.asarray(vector.reset(0)).tolist() == [[0, 0]]
    steps = [vector.step(np.array([0])) for _ in range(3)]
    assert [(bool(s.terminated[0]), bool(s.truncated[0])) for s in steps] == [(False, False)] * 2 + [end]
    assert np.asarray(steps[-1].obs).tolist() == [[3, 3]]


def test_a_space_without_bounds_or_choices_is_refused():
    old = Old({})
    old.action_space = SimpleNamespace(shape=[2])
    with pytest.raises(ValueError, match="with low and high, or with n, got SimpleNamespace"):
        rejeu.OldEnvironment(old)
