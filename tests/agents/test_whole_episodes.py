"""Rollouts of whole episodes: everybody plays the same number, who is done waits, and nothing else is learnt from."""

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms.actor_critic.steps import samples
from rejeu.envs.make import InProcess, make_vector
from tests.environments import Counter
from tests.tiers import only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [4]}, "gamma": 0.9, "seed": 0}
LENGTHS = ((2, 5, 3), (4,), (7, 1))


def counters(lengths=LENGTHS, ends="terminated"):
    """Counters of these episode lengths; each refuses to be stepped once an episode is over."""
    return InProcess([Counter(one, ends) for one in lengths], seed=0)


def small(env, algorithm=rejeu.A2C, **settings):
    return algorithm("MlpPolicy", env, **{**SMALL, "n_steps": 20, **settings})


def until(step):
    """Returns a callback that stops training at a step."""
    return lambda agent, turn: turn.step < step


def rollouts_of(agent, n_steps=None, **kwargs):
    """Trains, and returns what each update was given, and the state before it."""
    seen, update = [], agent.learner.update

    def keep(state, batch, clock):
        seen.append((agent.state, jax.tree.map(np.array, batch)))
        return update(state, batch, clock)

    agent.learner.update = keep
    agent.learn(n_steps, **kwargs)
    agent.learner.update = update
    return seen


@pytest.mark.parametrize("n_episodes", [1, 2])
def test_every_environment_plays_its_episodes_and_waits_for_the_others(n_episodes):
    """Steps are counted by the environments, of which one played 2, 5, 3 steps, one 4 and one 7, 1, by turns."""
    env = counters()
    agent = small(env, n_episodes=n_episodes, n_steps=7)
    played = [[lengths[i % len(lengths)] for i in range(12)] for lengths in LENGTHS]
    total, shares = 0, []
    for update in range(3):
        shares = [sum(one[: (update + 1) * n_episodes]) for one in played]
        total = sum(shares)
        agent.learn(total - sum(sum(one[: update * n_episodes]) for one in played))
        assert agent.run.step == total
        assert [len(one.actions) for one in env.envs] == shares
        assert agent.n_updates == update + 1
    counts = np.bincount([e.env for e in agent.history.episodes])
    assert counts.tolist() == [3 * n_episodes] * 3
    for e in range(3):
        lengths = [episode.length for episode in agent.history.episodes if episode.env == e]
        assert lengths == played[e][: 3 * n_episodes]


def test_what_is_learnt_from_is_each_step_once_and_nothing_of_the_waiting():
    agent = small(counters(), n_episodes=2, n_steps=7)
    (_, rollout), *_ = rollouts_of(agent, 2 + 5 + 4 + 4 + 7 + 1)
    assert rollout.valid.sum(axis=0).tolist() == [7, 8, 8]
    for e, lengths in enumerate(((2, 5), (4, 4), (7, 1))):
        n = sum(lengths)
        assert rollout.valid[:n, e].all()
        expected = [[episode, t] for episode, length in enumerate(lengths) for t in range(length)]
        assert rollout.obs[:n, e, :2].tolist() == expected
        assert rollout.reward[:n, e].tolist() == [100.0 * episode + t for episode, t in expected]
        assert np.flatnonzero(rollout.ended[:n, e]).tolist() == [lengths[0] - 1, n - 1]
        assert (rollout.discount[:n, e] == np.where(rollout.ended[:n, e], 0.0, np.float32(0.9))).all()


@pytest.mark.parametrize("algorithm", only([rejeu.PPO], [rejeu.A2C, rejeu.PPO]))
def test_what_the_padding_holds_changes_nothing(algorithm):
    agent = small(counters(), algorithm, n_episodes=1, n_steps=7)
    (state, rollout), *_ = rollouts_of(agent, 2 + 4 + 7)
    spoil = lambda x: np.where(rollout.valid.reshape(7, 3, *[1] * (x.ndim - 2)), x, x + x.dtype.type(77))  # noqa: E731
    fields = {key: spoil(getattr(rollout, key)) for key in ("obs", "action", "reward", "next_obs", "discount")}
    inner = agent.learner.algorithm
    clock = rejeu.core.algorithm.Clock(np.uint32(0), np.uint32(0), np.float32(0))
    update = jax.jit(inner.update)
    one, other = update(state, rollout, clock)[0], update(state, rollout._replace(**fields), clock)[0]
    for a, b in zip(jax.tree.leaves(one.network), jax.tree.leaves(other.network), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    moved = [np.abs(a - b).max() for a, b in zip(*map(jax.tree.leaves, (one.network, state.network)), strict=True)]
    assert max(moved) > 1e-4


@pytest.mark.parametrize("ends", ["terminated", "truncated"])
def test_with_lambda_1_advantages_are_returns_to_go_minus_the_value(ends):
    agent = small(counters(ends=ends), n_episodes=2, n_steps=7, gae_lambda=1.0)
    (state, rollout), *_ = rollouts_of(agent, 23)
    data = samples(state.network, rollout, 1.0)
    advantage, value = (np.float64(x).reshape(14, 3) for x in (data.advantage, data.value))
    for e, lengths in enumerate(((2, 5), (4, 4), (7, 1))):
        at = 0
        for length in lengths:
            last = rollout.next_obs[at + length - 1, e][None]
            to_go = float(state.network.value(last)[0]) if ends == "truncated" else 0.0
            for t in reversed(range(at, at + length)):
                to_go = float(rollout.reward[t, e]) + 0.9 * to_go
                assert advantage[t, e] == pytest.approx(to_go - value[t, e], rel=1e-4, abs=1e-3)
            at += length


def test_a_rollout_in_which_the_number_of_steps_is_reached_is_completed():
    agent = small(counters(), n_episodes=1, n_steps=7)
    seen = rollouts_of(agent, 11)
    assert agent.num_timesteps == 2 + 4 + 7
    assert [rollout.valid.sum(axis=0).tolist() for _, rollout in seen] == [[2, 4, 7]]
    assert agent.history["length"].tolist() == [2, 4, 7]


def test_episodes_that_an_update_cut_off_do_not_run_on_in_the_history():
    """The environment of long episodes is cut after 4 steps by n_steps, and begun anew: those 4 count for nothing."""
    agent = small(counters(((3,), (50, 2), (4, 4))), n_episodes=1, n_steps=4).learn(11).learn(9)
    second = [(e.length, e.episode_return) for e in agent.history.episodes if e.env == 1]
    assert second == [(2, 100.0 + 101.0)]


def test_a_run_that_stopped_within_an_episode_goes_on_with_it():
    env = counters(((6,), (6,)))
    agent = small(env, n_episodes=1, n_steps=6).learn(12, until(4)).learn(8)
    assert [(e.length, e.episode_return) for e in agent.history.episodes] == [(6, 15.0)] * 2
    assert agent.n_updates == 1


def test_a_rollout_of_whole_episodes_begins_again_where_new_episodes_must_begin():
    env = counters(((6,), (6,)))
    agent = small(env, n_episodes=1, n_steps=6).learn(12, until(4))
    agent.evaluate(1)  # in the same environments
    (_, rollout), *_ = rollouts_of(agent, 12)
    assert rollout.valid.sum(axis=0).tolist() == [6, 6]
    assert rollout.ended[:, 0].tolist() == [False] * 5 + [True]


class Coin(Counter):
    """Ends with probability 0.2 after each step."""

    def _over(self):
        if not hasattr(self, "coins") or self.time == 0:
            self.coins = self.np_random.random(500) < 0.2
        return bool(self.coins[: self.time].any())


def test_long_episodes_are_not_lost():
    """Lengths are geometric with mean 5 and deviation sqrt(20): stopping at the first to end would shorten them."""
    env = InProcess([Coin() for _ in range(8)], seed=3)
    agent = small(env, n_episodes=1, n_steps=200).learn(episodes=400)
    lengths = [e.length for e in agent.history.episodes]
    assert np.mean(lengths) == pytest.approx(5.0, abs=4 * np.sqrt(20 / 400))
    per_env = np.bincount([e.env for e in agent.history.episodes])
    assert per_env.max() - per_env.min() <= 1


def test_normalisation_does_not_see_who_waits():
    env = counters()
    agent = small(env, n_episodes=1, n_steps=7, normalize=True).learn(2 + 4 + 7)
    shown = np.array([[0, t] for length in (2, 4, 7) for t in range(length)], np.float64)
    moments = agent.state.statistics.obs[0]
    assert float(moments.n_seen) == 13
    np.testing.assert_allclose(moments.mean[:2], shown.mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(moments.variance[:2], shown.var(axis=0), atol=1e-4)
    returns = []
    for length in (2, 4, 7):
        total = 0.0
        for t in range(length):
            total = 0.9 * total + t
            returns.append(total)
    assert float(agent.state.statistics.returns.variance) == pytest.approx(np.var(returns), rel=1e-4)


@pytest.mark.parametrize("backend", only(["envpool"], ["envpool", "gymnasium"]))
def test_it_works_where_episodes_end_by_themselves(backend):
    env = make_vector("CartPole-v1", 4, backend, seed=0)
    agent = small(env, rejeu.PPO, n_episodes=2, batch_size=64, n_epochs=1).learn(episodes=24)
    counts = np.bincount([e.env for e in agent.history.episodes])
    assert counts.tolist() == [6] * 4
    assert sum(e.length for e in agent.history.episodes) == agent.num_timesteps
    assert agent.state.n_rollouts == 3
    assert all(e.episode_return == e.length for e in agent.history.episodes)


def test_a_time_limit_sets_how_long_a_rollout_may_be():
    env = InProcess([gym.wrappers.TimeLimit(Counter((50,)), 9) for _ in range(2)], seed=0)
    env.max_episode_steps = 9
    agent = small(env, n_episodes=2, n_steps=4).learn(36)
    assert [e.length for e in agent.history.episodes] == [9] * 4
    assert agent.n_updates == 1


def test_without_a_time_limit_n_steps_says_how_long_a_rollout_may_be():
    """EnvPool's CliffWalking-v0 has none; 8 GiB were once reserved for it."""
    agent = small(make_vector("CliffWalking-v0", 1, "envpool", seed=0), n_episodes=2, n_steps=8).learn(40)
    assert agent.run.replay.n_steps == 2 * 8
