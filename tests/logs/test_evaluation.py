"""Whole episodes, counted once, and how sure their mean is."""

import subprocess
import sys
from types import SimpleNamespace

import gymnasium as gym
import jax
import numpy as np
import pytest
from scipy import stats

import rejeu
from rejeu.core import xla
from rejeu.envs.make import InProcess
from rejeu.logs.evaluation import Evaluation, evaluate
from tests.environments import Counter, Reach


class Still:
    """A model that always does the same."""

    def __init__(self, action=0.0):
        self.action = action
        self.deterministic = None

    def predict(self, obs, state=None, episode_start=None, deterministic=False):
        self.deterministic = deterministic
        leaf = obs["observation"] if isinstance(obs, dict) else obs
        return np.full((len(leaf), 1), self.action, np.float32), None


def still(obs, began):
    return np.zeros((len(obs), 1), np.float32)


def returns_of(lengths, episodes):
    """A counter's return: 100 times the episode plus the time, summed over its steps."""
    return [sum(100.0 * e + t for t in range(lengths[e % len(lengths)])) for e in range(episodes)]


def test_returns_and_lengths_are_those_of_whole_episodes():
    result = evaluate(still, InProcess([Counter((2, 4))]), 5)
    assert result.lengths.tolist() == [2, 4, 2, 4, 2]
    assert result.returns.tolist() == returns_of((2, 4), 5)
    assert np.isnan(result.successes).all()


def test_every_environment_plays_its_share_so_short_episodes_are_not_counted_more_often():
    """Stable-Baselines3's shares of 5 episodes on 3 environments: (5 + i) // 3 = 1, 2, 2."""
    result = evaluate(still, InProcess([Counter((1,)), Counter((2,)), Counter((30,))]), 5)
    assert sorted(result.lengths.tolist()) == [1, 2, 2, 30, 30]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_exactly_as_many_episodes_are_played_as_asked_for(n_envs):
    envs = lambda: InProcess([Counter((2,)) for _ in range(n_envs)])  # noqa: E731
    assert len(evaluate(still, envs(), 7).returns) == 7
    assert len(rejeu.evaluate_policy(Still(), envs(), 7, return_episode_rewards=True)[0]) == 7


def test_policies_are_told_where_episodes_begin():
    told = []

    def told_policy(obs, began):
        told.extend(zip(began.tolist(), (obs[:, 1] == 0).tolist(), strict=True))
        return still(obs, began)

    model = SimpleNamespace(
        predict=lambda obs, state, episode_start, deterministic: (told_policy(obs, episode_start), None)
    )
    evaluate(told_policy, InProcess([Counter((2, 3)), Counter((4,))]), 6)
    rejeu.evaluate_policy(model, InProcess([Counter((2, 3)), Counter((4,))]), 6)
    assert {*told} == {(True, True), (False, False)}


def timed(monkeypatch, envs, episodes, seconds, compiling=0.0):
    """Returns the lengths of the episodes played where every step of all environments takes one second.

    The first takes ``compiling`` seconds more, of compilation.
    """
    xla.enable_cache()
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr("time.perf_counter", lambda: clock.now)

    def policy(obs, began):
        if clock.now == 0.0:
            clock.now += compiling
            jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", compiling)
        clock.now += 1.0
        return still(obs, began)

    return evaluate(policy, InProcess(envs), episodes, seconds=seconds).lengths.tolist()


def test_when_the_time_is_over_no_episode_begins_and_the_one_under_way_is_played_to_its_end(monkeypatch):
    """Episodes of 3 and 5 steps in turn end after 3, 8 and 11 s: the third began before 10 s, and no fourth begins."""
    assert timed(monkeypatch, [Counter((3, 5))], None, 10.0) == [3, 5, 3]


def test_compilation_takes_none_of_the_time_of_an_evaluation(monkeypatch):
    assert timed(monkeypatch, [Counter((3, 5))], None, 10.0, compiling=100.0) == [3, 5, 3]


def test_long_episodes_under_way_when_the_time_is_over_count(monkeypatch):
    assert sorted(timed(monkeypatch, [Counter((2,)), Counter((30,))], None, 9.0)) == [2, 2, 2, 2, 2, 30]


def test_of_a_number_of_episodes_and_a_time_the_nearer_limit_ends_an_evaluation(monkeypatch):
    assert timed(monkeypatch, [Counter((2,))], 3, 100.0) == [2, 2, 2]
    assert timed(monkeypatch, [Counter((2,))], 100, 3.0) == [2, 2]


def test_an_agent_evaluates_for_minutes_and_refuses_none_or_less():
    agent = rejeu.DDPG("MlpPolicy", Counter((4,)), policy_kwargs={"net_arch": [4]}, seed=0)
    assert agent.evaluate(minutes=1e-9).lengths.tolist() == [4]
    with pytest.raises(ValueError, match="minutes=0 must be a finite number, above 0"):
        agent.evaluate(minutes=0)


def test_success_comes_from_the_last_step():
    result = evaluate(
        lambda obs, began: np.clip(obs["desired_goal"] - obs["achieved_goal"], -1, 1),
        InProcess([Reach(stops=True) for _ in range(2)], seed=0),
        10,
    )
    assert result.success_rate == 1.0
    assert (result.lengths <= 4).all()  # at most 4 apart, one a step


def test_intervals_import_neither_scipys_statistics_nor_matplotlib():
    code = "import sys, numpy as np; from rejeu.logs.evaluation import Evaluation\n"
    code += (
        "x = Evaluation(np.arange(3.0), np.ones(3), np.array([0.0, 1.0, 1.0])); x.return_interval, x.success_interval\n"
    )
    code += "assert not {'scipy.special', 'scipy.stats', 'matplotlib'} & {*sys.modules}"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_statistics_equal_numpy_and_scipy():
    returns, successes = np.array([1.0, 2.0, 4.0, 9.0]), np.array([1.0, 0.0, 1.0, 1.0])
    result = Evaluation(returns, np.array([1, 2, 3, 4]), successes)
    assert (result.mean_return, result.std_return, result.mean_length) == (4.0, pytest.approx(np.std(returns)), 2.5)
    expected = stats.t.interval(0.95, 3, loc=returns.mean(), scale=stats.sem(returns))
    assert result.return_interval == pytest.approx(expected)
    # Wilson's score interval of 3 in 4, from its formula.
    n, p, z = 4, 0.75, stats.norm.ppf(0.975)
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert result.success_interval == pytest.approx((middle - half, middle + half))
    assert "success 75.0%" in str(result)


def test_episodes_of_unknown_success_count_neither_for_the_rate_nor_for_its_interval():
    known = np.array([1.0, 0.0, 1.0, 1.0])
    for n_unknown in (1, 3, 20):
        successes = np.append(known, np.full(n_unknown, np.nan))
        mixed = Evaluation(np.zeros(len(successes)), np.ones(len(successes)), successes)
        alone = Evaluation(np.zeros(4), np.ones(4), known)
        assert (mixed.success_rate, mixed.success_interval) == (alone.success_rate, alone.success_interval)


def test_one_episode_has_no_interval_and_unknown_success_none_either():
    result = Evaluation(np.array([1.0]), np.array([3]), np.array([np.nan]))
    assert np.isnan([*result.return_interval, *result.success_interval, result.success_rate]).all()
    assert "success" not in str(result)


@pytest.mark.parametrize("episodes", [0, -3])
def test_no_episode_is_refused(episodes):
    with pytest.raises(ValueError, match=f"episodes={episodes} must be at least 1"):
        evaluate(still, InProcess([Counter()]), episodes)
    with pytest.raises(ValueError, match=f"n_eval_episodes={episodes} must be at least 1"):
        rejeu.evaluate_policy(Still(), Counter(), episodes)


# evaluate_policy, as Stable-Baselines3 has it.


def test_mean_and_deviation_of_the_return():
    expected = returns_of((2, 4), 4)
    mean, std = rejeu.evaluate_policy(Still(), Counter((2, 4)), 4)
    assert (mean, std) == (pytest.approx(np.mean(expected)), pytest.approx(np.std(expected)))


def test_lists_of_returns_and_lengths_on_request():
    returns, lengths = rejeu.evaluate_policy(Still(), Counter((2, 4)), 3, return_episode_rewards=True)
    assert returns == returns_of((2, 4), 3)
    assert lengths == [2, 4, 2]
    assert type(returns[0]) is float
    assert type(lengths[0]) is int


def test_actions_of_the_model_are_in_the_range_of_the_environment():
    env = Counter(low=[2.0], high=[6.0])
    rejeu.evaluate_policy(Still(5.0), env, 1)
    assert [float(action[0]) for action in env.actions] == [5.0] * 3


@pytest.mark.parametrize("deterministic", [True, False])
def test_the_model_is_told_whether_to_be_deterministic(deterministic):
    model = Still()
    rejeu.evaluate_policy(model, Counter(), 1, deterministic=deterministic)
    assert model.deterministic is deterministic


def test_the_callback_is_called_after_every_step_that_counts_with_what_it_may_want():
    seen = []
    rejeu.evaluate_policy(
        Still(),
        gym.vector.SyncVectorEnv([lambda: Counter((2,)), lambda: Counter((3,))]),
        2,
        callback=lambda local, _: seen.append((local["i"], float(local["reward"]), bool(local["done"]))),
    )
    assert sorted(seen) == [(0, 0.0, False), (0, 1.0, True), (1, 0.0, False), (1, 1.0, False), (1, 2.0, True)]


def test_a_mean_below_the_threshold_is_an_error():
    with pytest.raises(AssertionError, match=r"mean return 3.00 is not above reward_threshold=5.00"):
        rejeu.evaluate_policy(Still(), Counter(), 1, reward_threshold=5.0)


def test_each_episode_keeps_the_goal_that_it_had():
    class Plane(Reach):
        """A goal in a plane, whose first number is the seed."""

        observation_space = gym.spaces.Dict(
            {
                key: gym.spaces.Box(-20.0, 20.0, (4,), np.float32)
                for key in ("observation", "achieved_goal", "desired_goal")
            }
        )

        def reset(self, *, seed=None, options=None):
            _, info = super().reset(seed=seed)
            self.goal = np.array([-1.0 if seed is None else seed, 2, 3, 4], np.float32)
            return self._observe(), info

        def _observe(self):
            position = np.repeat(self.position, 4)
            return {"observation": position, "achieved_goal": position, "desired_goal": self.goal}

    envs = InProcess([Plane(), Plane()])
    result = evaluate(lambda obs, began: np.zeros((2, 1), np.float32), envs, 3, seed=5)
    assert result.goals.tolist() == [[5, 2, 3], [6, 2, 3], [-1, 2, 3]]
    assert evaluate(lambda obs, began: np.zeros((1, 1), np.float32), InProcess([Reach()]), 1).goals.shape == (0, 0)
