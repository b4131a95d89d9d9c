"""When off-policy learning takes gradient steps, on the host and on the device, against counting step by step."""

from itertools import product
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.training import off_policy
from rejeu.training.compiled import off_policy as on_device
from tests.environments import Counter
from tests.helpers import small_sac


def host_turns(config, learn_from):
    """A function of the steps and the ended episodes of a turn that returns the gradient steps which are due."""
    run = SimpleNamespace(step=0, learn_from=learn_from, owed=0, steps_since_update=0, env=SimpleNamespace())
    run.replay = SimpleNamespace(size=lambda: run.step)

    def turn(taken, ended):
        run.step, run.env.n_envs = run.step + taken, taken
        return off_policy.due(run, config, ended)

    return turn


due_on_device = jax.jit(on_device.due, static_argnums=0)


def device_turns(config, learn_from):
    counts = on_device.Counts(np.uint32(0), *np.zeros(3, np.int32))

    def turn(taken, ended):
        nonlocal counts
        n, counts = due_on_device(config, counts, np.int32(taken), np.int32(ended), np.uint32(learn_from))
        return int(n)

    return turn


@pytest.mark.parametrize("turns", [host_turns, device_turns])
@pytest.mark.parametrize("gradient_steps", [3, -1])
def test_steps_up_to_learning_starts_bring_no_gradient_steps_and_later_ones_one_period_after_the_other(
    turns, gradient_steps
):
    for train_freq in (1, 4):
        config = OffPolicyConfig(train_freq=train_freq, gradient_steps=gradient_steps)
        for n_envs, learn_from in product((1, 3, 8), (0, 5, 16)):
            turn, taken, since = turns(config, learn_from), 0, 0
            for _ in range(12):
                periods = 0
                for _ in range(n_envs):
                    taken += 1
                    since += taken > learn_from
                    periods += taken > learn_from and (taken - learn_from) % train_freq == 0
                expected = periods * gradient_steps if gradient_steps > 0 else since if periods else 0
                since = 0 if periods else since
                assert turn(n_envs, 0) == expected, (train_freq, n_envs, learn_from, taken)


@pytest.mark.parametrize("turns", [host_turns, device_turns])
def test_episodes_count_from_the_first_turn_beyond_learning_starts(turns):
    turn = turns(OffPolicyConfig(train_freq=(2, "episode"), gradient_steps=3), 16)
    ended = [(8, 1), (8, 1), (8, 1), (8, 0), (8, 1), (8, 4), (8, 1), (8, 1)]
    assert [turn(*one) for one in ended] == [0, 0, 0, 0, 3, 6, 0, 3]


def test_periods_end_where_a_multiple_of_their_length_is_crossed():
    for every, n_envs in product((1, 3, 8), (1, 2, 5)):
        config = OffPolicyConfig(train_freq=every)
        for step in range(n_envs, 40, n_envs):
            crossed = any(one % every == 0 for one in range(step - n_envs + 1, step + 1))
            run = SimpleNamespace(step=step, env=SimpleNamespace(n_envs=n_envs))
            assert off_policy.reaches(run, config, 0) == crossed


def test_the_turn_that_reaches_learning_starts_ends_a_period_without_gradient_steps():
    ends = []
    agent = small_sac(Counter(), learning_starts=8, train_freq=4)
    agent.learn(8, lambda agent, progress: ends.append(progress.rollout_ended))
    assert ends == [False, False, False, True] * 2
    assert agent.n_updates == 0


@pytest.mark.parametrize("make", ["off policy", "on policy"])
def test_a_learning_rate_that_falls_to_zero_is_zero_in_the_last_update_and_not_before(make):
    shape = {"learning_rate": rejeu.Linear(0.1, 0.0), "policy_kwargs": {"net_arch": [4]}, "seed": 0}
    if make == "on policy":
        agent = rejeu.PPO("MlpPolicy", Counter(), n_steps=4, batch_size=4, n_epochs=1, **shape)
    else:
        agent = small_sac(Counter(), learning_starts=0, train_freq=4, batch_size=2, **shape)
    weights = []

    def note(agent, progress):
        if progress.rollout_ended:
            arrays = agent.get_parameters()
            weights.append(
                [array for name, array in arrays.items() if name.startswith(("actor.", "critics.", "network."))]
            )

    agent.learn(12, note)
    first, second, last = ([np.array(array) for array in arrays] for arrays in weights)
    assert first
    assert not all(map(np.array_equal, first, second))
    for before, after in zip(second, last, strict=True):
        np.testing.assert_array_equal(before, after)


def test_the_actor_waits_for_updates_and_not_for_the_steps_of_several_environments():
    env = rejeu.make_vector(Counter, 3)
    shape = {"policy_kwargs": {"net_arch": [4]}, "batch_size": 3, "seed": 0, "learning_starts": 3, "train_freq": 3}
    agent, moved, before = rejeu.TD3("MlpPolicy", env, policy_delay=2, **shape), [], None

    def note(agent, progress):
        nonlocal before
        arrays = agent.get_parameters()
        actor = np.concatenate([array.ravel() for name, array in arrays.items() if name.startswith("actor.")])
        if before is not None:
            moved.append(not np.array_equal(before, actor))
        before = actor

    agent.learn(3 * 7, note)
    assert agent.n_updates == 6
    assert moved == [False, True] * 3  # the first turn is the warm-up
