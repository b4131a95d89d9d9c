"""Normalisation: moments against NumPy, what is scaled by them, when they move, and that they stay with the agent."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, strategies as st

import rejeu
from rejeu.algorithms.catalog import CATALOG
from rejeu.core.algorithm import Algorithm, Clock, Masked, Rollout, Transition
from rejeu.core.errors import CheckpointError
from rejeu.core.normalization import MAX_COUNT, Moments, NormalizationConfig, merged, no_moments, normalized
from rejeu.core.spaces import leaves, scale_action
from rejeu.envs.make import InProcess
from rejeu.exploration import explorer as exploration
from rejeu.exploration.parameter_space import ParameterNoise
from tests.algorithms.probes.environments import Discretely, Later
from tests.environments import Counter, Reach
from tests.helpers import assert_same_parameters, small_sac
from tests.tiers import exhaustive, only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

GAMMA = 0.9
CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.0))
WIDTH = 8
merge = jax.jit(merged)


def chunked(values, weight, sizes):
    """Moments after the values came in pieces of these sizes, each filled up to one length with weight 0."""
    moments, at = no_moments(values.shape[1:]), 0
    for size in sizes:
        piece, w = np.full((WIDTH, *values.shape[1:]), 1e3, np.float32), np.zeros(WIDTH, np.float32)
        piece[:size], w[:size] = values[at : at + size], weight[at : at + size]
        moments, at = merge(moments, piece, w), at + size
    return moments


# Moments.


@given(
    sizes=st.lists(st.integers(0, WIDTH), min_size=1, max_size=12),
    seed=st.integers(0, 2**16),
    offset=st.sampled_from([0.0, -3.0, 50.0]),
    share=st.sampled_from([0.0, 0.3, 1.0]),
)
def test_moments_are_numpys_however_the_values_come(sizes, seed, offset, share):
    rng = np.random.default_rng(seed)
    values = rng.normal(offset, [0.1, 1.0, 5.0], (sum(sizes), 3)).astype(np.float32)
    weight = (rng.random(sum(sizes)) < share).astype(np.float32)
    moments = chunked(values, weight, sizes)
    seen = np.float64(values[weight > 0])
    assert moments.n_seen == len(seen)
    if len(seen) == 0:
        assert np.array_equal(moments.mean, np.zeros(3))
        assert np.array_equal(moments.variance, np.ones(3))
        return
    np.testing.assert_allclose(moments.mean, seen.mean(axis=0), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(moments.variance, seen.var(axis=0), rtol=2e-4, atol=1e-5)


def test_long_runs_forget_rather_than_stand_still():
    """Beyond 2^24 float32 no longer counts by ones: the share of a new value must not vanish."""
    before = Moments(jnp.float32(0.0), jnp.float32(1.0), jnp.float32(MAX_COUNT))
    after = merge(before, np.full(WIDTH, 1e6, np.float32), np.ones(WIDTH, np.float32))
    share = WIDTH / (MAX_COUNT + WIDTH)
    assert float(after.n_seen) == MAX_COUNT
    assert float(after.mean) == pytest.approx(share * 1e6, rel=1e-6)
    assert float(after.variance) == pytest.approx((1 - share) + (1 - share) * share * 1e12, rel=1e-5)


# What is scaled: the normalized form of an algorithm that shows what it is given.


def showing(space, **settings):
    """An algorithm that learns nothing, acts by showing its observation, and reports the batch that it was given."""
    inner = Algorithm(
        init=lambda key: {"weight": jnp.float32(1.0)},
        actor=lambda state: state,
        explore=lambda actor, obs, key, clock: obs,
        exploit=lambda actor, obs: obs,
        update=lambda state, batch, clock: (state, batch),
        recall=lambda carry, actor, obs, ended: (obs, carry),
    )
    return normalized(inner, exploration.plain(inner), leaves(space), NormalizationConfig(**settings), GAMMA)


def box(*shape):
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def zscore(x, seen, clip=10.0, epsilon=1e-8):
    seen = np.float64(seen)
    return np.clip((np.float64(x) - seen.mean(axis=0)) / np.sqrt(seen.var(axis=0) + epsilon), -clip, clip)


def after_seeing(algorithm, *observations, returns=None):
    state = algorithm.init(jax.random.PRNGKey(0))
    for obs in observations:
        n = len(jax.tree.leaves(obs)[0])
        state = algorithm.observe(state, obs, np.zeros(n, np.float32) if returns is None else returns)
    return state


def test_observations_are_standardised_and_clipped():
    algorithm = showing(box(2), clip_obs=1.5)
    rng = np.random.default_rng(0)
    first, second = rng.normal([3.0, -1.0], [2.0, 0.01], (2, 20, 2)).astype(np.float32)
    state = after_seeing(algorithm, first, second)
    expected = zscore(first, np.concatenate([first, second]), clip=1.5)
    assert np.abs(expected).max() == 1.5
    np.testing.assert_allclose(algorithm.exploit(algorithm.actor(state), first), expected, atol=1e-3)


def test_acting_remembering_and_exploring_see_the_same_scaled_observation():
    algorithm = showing(box(2))
    obs = np.random.default_rng(1).normal(5.0, 3.0, (6, 2)).astype(np.float32)
    actor = algorithm.actor(after_seeing(algorithm, obs))
    key, ended = jax.random.PRNGKey(0), np.zeros(6, bool)
    expected = zscore(obs, obs)
    for shown in (
        algorithm.exploit(actor, obs),
        algorithm.explore(actor, obs, key, CLOCK),
        algorithm.recall((), actor, obs, ended)[0],
        algorithm.explorer.act((), actor, obs, ended, key, CLOCK)[0],
    ):
        np.testing.assert_allclose(shown, expected, atol=1e-4)


def test_only_continuous_parts_of_nested_observations_are_scaled_each_by_itself():
    space = spaces.Dict(
        {
            "a": spaces.Tuple((box(2), spaces.Discrete(5))),
            "b": spaces.Box(0, 255, (4, 4, 3), np.uint8),
            "c": spaces.MultiBinary(3),
            "d": spaces.Box(-1e6, 1e6, (), np.float32),
            "e": spaces.MultiDiscrete([3, 4]),
        }
    )
    rng = np.random.default_rng(2)
    n = 7
    obs = {
        "a": (rng.normal(4.0, 2.0, (n, 2)).astype(np.float32), rng.integers(0, 5, n).astype(np.int32)),
        "b": rng.integers(0, 256, (n, 4, 4, 3), dtype=np.uint8),
        "c": rng.integers(0, 2, (n, 3), dtype=np.int8),
        "d": rng.normal(-1e3, 50.0, n).astype(np.float32),
        "e": rng.integers(0, 3, (n, 2)).astype(np.int32),
    }
    algorithm = showing(space)
    shown = algorithm.exploit(algorithm.actor(after_seeing(algorithm, obs)), obs)
    np.testing.assert_allclose(shown["a"][0], zscore(obs["a"][0], obs["a"][0]), atol=1e-4)
    np.testing.assert_allclose(shown["d"], zscore(obs["d"], obs["d"]), atol=1e-3)
    masked = Masked(obs, np.eye(n, 3) > 0)  # a mask beside the observation is left alone
    assert np.array_equal(algorithm.exploit(algorithm.actor(after_seeing(algorithm, masked)), masked).mask, masked.mask)
    for one, other in ((shown["a"][1], obs["a"][1]), *((shown[key], obs[key]) for key in "bce")):
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)


@pytest.mark.parametrize("shared", [True, False])
def test_achieved_and_desired_goals_share_their_statistics_unless_told_otherwise(shared):
    rng = np.random.default_rng(3)
    obs = {
        "achieved_goal": rng.normal(0.0, 1.0, (9, 1)).astype(np.float32),
        "desired_goal": rng.normal(6.0, 2.0, (9, 1)).astype(np.float32),
        "observation": rng.normal(-9.0, 3.0, (9, 1)).astype(np.float32),
    }
    algorithm = showing(spaces.Dict({key: box(1) for key in obs}), share_goals=shared)
    shown = algorithm.exploit(algorithm.actor(after_seeing(algorithm, obs)), obs)
    both = np.concatenate([obs["achieved_goal"], obs["desired_goal"]])
    seen = {**obs, "achieved_goal": both, "desired_goal": both} if shared else obs
    for key, values in seen.items():
        np.testing.assert_allclose(shown[key], zscore(obs[key], values), atol=1e-4)


def drawn_batch(seed, scale=20.0):
    rng = np.random.default_rng(seed)
    obs, next_obs = rng.normal(1.0, 2.0, (2, 6, 2)).astype(np.float32)
    return Transition(obs, obs, rng.normal(0.0, scale, 6).astype(np.float32), next_obs, np.ones(6, np.float32))


def test_rewards_are_divided_by_the_deviation_of_the_returns_clipped_and_not_shifted():
    algorithm, batch = showing(box(2), clip_reward=2.0), drawn_batch(5)
    returns = np.float32([3.0, 9.0, 15.0, 9.0, 3.0, 15.0])
    shown = algorithm.update(after_seeing(algorithm, batch.obs, returns=returns), batch, CLOCK)[1]
    expected = np.clip(np.float64(batch.reward) / np.std(np.float64(returns)), -2.0, 2.0)
    assert np.abs(expected).max() == 2.0
    assert np.abs(expected).min() < 2.0
    np.testing.assert_allclose(shown.reward, expected, rtol=1e-5)
    np.testing.assert_allclose(shown.next_obs, zscore(batch.next_obs, batch.obs), atol=1e-4)


def test_each_reward_of_an_n_step_return_is_clipped_by_itself():
    algorithm, batch = showing(box(2), clip_reward=2.0), drawn_batch(5)
    returns = np.float32([3.0, 9.0, 15.0, 9.0, 3.0, 15.0])
    steps = np.random.default_rng(6).normal(0.0, 20.0, (6, 3)).astype(np.float32)
    batch = batch._replace(reward=steps @ np.float32([1.0, GAMMA, GAMMA**2]), rewards=steps * GAMMA ** np.arange(3))
    batch = batch._replace(rewards=batch.rewards.astype(np.float32))
    shown = algorithm.update(after_seeing(algorithm, batch.obs, returns=returns), batch, CLOCK)[1]
    each = np.clip(np.float64(steps) / np.std(np.float64(returns)), -2.0, 2.0)
    assert (np.abs(each) == 2.0).any()
    np.testing.assert_allclose(shown.reward, each @ np.array([1.0, GAMMA, GAMMA**2]), rtol=1e-5)
    assert np.abs(shown.reward).max() > 2.0
    assert shown.rewards is None
    unseen = algorithm.update(algorithm.init(jax.random.PRNGKey(0)), batch, CLOCK)[1]
    np.testing.assert_allclose(unseen.reward, batch.reward, rtol=1e-5)


@pytest.mark.parametrize("hindsight", [False, True], ids=["plain", "hindsight"])
def test_batches_hold_each_reward_where_it_is_to_be_clipped(hindsight):
    def batch_of(**settings):
        more = {"replay_buffer_class": "HerReplayBuffer"} if hindsight else {}
        agent = small_sac(Reach() if hindsight else Counter((5,)), learning_starts=99, **more, **settings).learn(30)
        return agent.replay_buffer.sample(np.random.default_rng(0), (2, 40))

    batch = batch_of(normalize=True, n_steps=3)
    assert batch.rewards.shape == (2, 40, 3)
    np.testing.assert_allclose(batch.rewards.sum(axis=-1), batch.reward, rtol=1e-5)
    assert batch_of(normalize=True).rewards is None
    assert batch_of(normalize={"norm_reward": False}, n_steps=3).rewards is None
    assert batch_of(n_steps=3).rewards is None


@pytest.mark.parametrize("off", ["norm_obs", "norm_reward"])
def test_either_half_can_be_switched_off(off):
    algorithm, batch = showing(box(2), **{off: False}), drawn_batch(6)
    returns = np.float32([3.0, 9.0, 15.0, 9.0, 3.0, 15.0])
    shown = algorithm.update(after_seeing(algorithm, batch.obs, returns=returns), batch, CLOCK)[1]
    assert np.array_equal(shown.obs, batch.obs) == (off == "norm_obs")
    assert np.array_equal(shown.reward, batch.reward) == (off == "norm_reward")


def rollout_of(seed, loc, n_steps=4, n_envs=3):
    """A rollout in which the last step of the last environment does not exist, and holds nonsense."""
    rng = np.random.default_rng(seed)
    obs, next_obs = rng.normal(loc, 2.0, (2, n_steps, n_envs, 2)).astype(np.float32)
    reward, returns = rng.normal(loc, 4.0, (2, n_steps, n_envs)).astype(np.float32)
    valid = np.ones((n_steps, n_envs), bool)
    valid[-1, -1] = False
    obs[-1, -1] = returns[-1, -1] = 1e4
    ended = np.zeros((n_steps, n_envs), bool)
    return Rollout(obs, reward, reward, next_obs, reward, ended, valid, returns, ended[0], ())


def test_a_rollout_is_learnt_from_with_the_statistics_before_it_save_the_first():
    algorithm = showing(box(2))
    first, second = rollout_of(7, loc=1.0), rollout_of(8, loc=-5.0)
    state, shown_first = algorithm.update(algorithm.init(jax.random.PRNGKey(0)), first, CLOCK)
    state, shown_second = algorithm.update(state, second, CLOCK)
    seen = [r.obs[r.valid] for r in (first, second)]
    np.testing.assert_allclose(shown_first.obs[0], zscore(first.obs[0], seen[0]), atol=1e-4)
    np.testing.assert_allclose(shown_first.next_obs, zscore(first.next_obs, seen[0]), atol=1e-4)
    np.testing.assert_allclose(shown_second.obs[0], zscore(second.obs[0], seen[0]), atol=1e-4)
    moments = state.statistics.obs[0]
    np.testing.assert_allclose(moments.mean, np.concatenate(seen).mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(moments.variance, np.concatenate(seen).var(axis=0), rtol=1e-5)
    returns = np.concatenate([r.running_return[r.valid] for r in (first, second)])  # of the present rollout as well
    np.testing.assert_allclose(shown_second.reward, second.reward / np.std(np.float64(returns)), rtol=1e-5)
    assert float(state.statistics.returns.n_seen) == len(returns) == 22


@pytest.mark.parametrize(
    ("value", "error", "message"),
    [
        (3, TypeError, "must be True, False or a dict"),
        ({"norm_observations": True}, TypeError, "did you mean norm_obs"),
        ({"norm_obs": 1}, TypeError, "norm_obs=1 must be True or False"),
        ({"clip_obs": 0.0}, ValueError, "clip_obs=0.0 must be"),
        ({"epsilon": True}, ValueError, "epsilon=True must be"),
    ],
)
def test_a_bad_setting_is_refused(value, error, message):
    for algorithm in (rejeu.SAC, rejeu.PPO):
        with pytest.raises(error, match=message):
            algorithm("MlpPolicy", Counter(), normalize=value)


# In the loops.


class Noted(Counter):
    """A counter of episodes of 3, 5 and 2 steps that keeps what it showed; its rewards are drawn in advance."""

    def __init__(self, seed=0):
        super().__init__((3, 5, 2), "terminated")
        self.rewards = np.random.default_rng(seed).normal(2.0, 5.0, 400)
        self.shown, self.ends_of_episodes, self.taken = [], [], 0

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        self.shown.append(("reset", obs))
        return obs, info

    def step(self, action):
        obs, _, terminated, truncated, info = super().step(action)
        reward = self.rewards[self.taken]
        self.taken += 1
        self.ends_of_episodes.append(terminated)
        self.shown.append(("end" if terminated else "step", obs))
        return obs, float(reward), terminated, truncated, info

    def running_returns(self, gamma):
        total, result = 0.0, []
        for reward, ended in zip(self.rewards, self.ends_of_episodes, strict=False):
            total = gamma * total + reward
            result.append(total)
            total = 0.0 if ended else total
        return result


OFF = {"policy_kwargs": {"net_arch": [4]}, "batch_size": 4, "learning_starts": 4, "gamma": 0.9, "seed": 0}
ON = {"policy_kwargs": {"net_arch": [4]}, "n_steps": 6, "gamma": 0.9, "seed": 0}


def assert_moments(moments, values):
    values = np.float64(values)
    assert float(moments.n_seen) == len(values)
    np.testing.assert_allclose(moments.mean, values.mean(axis=0), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(moments.variance, values.var(axis=0), rtol=1e-3, atol=1e-4)


def test_off_policy_statistics_are_those_of_what_came():
    """Every step brings the observation that is acted on next; the returns run on until their episode ends."""
    envs = [Noted(1), Noted(2)]
    agent = rejeu.SAC("MlpPolicy", InProcess(envs), normalize=True, **OFF).learn(40)
    statistics = agent.state.statistics
    assert_moments(statistics.returns, np.concatenate([env.running_returns(0.9) for env in envs]))
    assert_moments(statistics.obs[0], [obs for env in envs for kind, obs in env.shown[1:] if kind != "end"])


@pytest.mark.parametrize("name", only(["A2C"], ["A2C", "PPO"]))
def test_on_policy_statistics_are_those_of_what_was_acted_on(name):
    envs = [Noted(1), Noted(2)]
    agent = rejeu.AGENTS[name]("MlpPolicy", InProcess(envs), normalize=True, **ON).learn(36)
    statistics = agent.state.statistics
    assert_moments(statistics.returns, np.concatenate([env.running_returns(0.9) for env in envs]))
    acted_on = [[obs for kind, obs in env.shown if kind != "end"][:18] for env in envs]
    assert_moments(statistics.obs[0], np.concatenate(acted_on))


def test_the_policy_of_a_rollout_keeps_its_statistics_until_it_has_been_learnt_from():
    seen = []
    agent = rejeu.A2C("MlpPolicy", env := Noted(), normalize=True, **ON)
    agent.learn(18, lambda agent, _: seen.append(float(agent.state.statistics.obs[0].n_seen)) and None)
    assert seen == [0.0] * 5 + [6.0] * 6 + [12.0] * 6 + [18.0]
    sums = [env.rewards[a:b].sum() for a, b in ((0, 3), (3, 8), (8, 10), (10, 13), (13, 18))]
    assert [e.episode_return for e in agent.history.episodes] == pytest.approx(sums, rel=1e-5)  # the environment's own


class Allowing(Discretely):
    """A discrete probe that allows every action."""

    def action_masks(self):
        return np.ones(3, bool)


def discrete_probe():
    return Allowing(Later())


SETTINGS = {name: ON if entry.kind == "rollout" else OFF for name, entry in CATALOG.items()}
ENVIRONMENT = dict.fromkeys(("DQN", "QRDQN", "IQN", "PQN", "MaskablePPO"), discrete_probe)


def normalising(name, **settings):
    """A small agent of the algorithm that normalises, and has learnt a little."""
    env = ENVIRONMENT.get(name, Noted)()
    settings = {**SETTINGS[name], **settings}
    if name == "RecurrentPPO":
        settings["policy_kwargs"] = {"net_arch": [4], "lstm_hidden_size": 4}
        settings["n_epochs"] = 2
    return rejeu.AGENTS[name]("MlpPolicy", env, normalize=True, **settings).learn(24)


def finite(agent):
    return all(np.isfinite(array).all() for array in agent.get_parameters().values())


@pytest.mark.parametrize("name", only(["SAC", "PPO"], [name for name in rejeu.AGENTS if name != "ARS"]))  # see test_ars
def test_every_algorithm_learns_on_scaled_numbers_and_keeps_them_in_its_file(name, tmp_path):
    agent = normalising(name)
    assert finite(agent)
    assert agent.n_updates > 0
    assert agent.state.statistics.obs[0].n_seen == 24
    parameters = agent.get_parameters()
    assert sum("statistics" in key for key in parameters) == 6  # mean, variance and number of observations and returns
    obs = np.random.default_rng(0).uniform(-1.0, 1.0, (5, *agent.observation_space.shape)).astype(np.float32)
    before, _ = agent.predict(obs, deterministic=True)
    for deterministic in (True, False):
        agent.predict(obs, deterministic=deterministic)
        agent.evaluate(2, deterministic=deterministic)
    assert all(np.array_equal(value, parameters[key]) for key, value in agent.get_parameters().items())
    loaded = rejeu.load(agent.save(tmp_path / "model"))
    assert_same_parameters(agent, loaded)
    assert np.array_equal(loaded.predict(obs, deterministic=True)[0], before)


@pytest.mark.parametrize("name", only(["PPO", "DQN"], ["TD3", "PPO", "DQN"]))
def test_predict_takes_raw_observations(name):
    agent = normalising(name)
    moments = agent.state.statistics.obs[0]
    mean, variance = np.float64(moments.mean), np.float64(moments.variance)
    raw = np.random.default_rng(1).normal(mean, 2.0 * np.sqrt(variance), (6, len(mean))).astype(np.float32)
    scaled = np.clip((raw - mean) / np.sqrt(variance + 1e-8), -10.0, 10.0).astype(np.float32)
    inner = agent.algorithm.make(agent.config, agent.observation_space, agent.action_space)
    expected = np.asarray(inner.exploit(inner.actor(agent.state.learner), scaled))
    given = agent.predict(raw, deterministic=True)[0]
    np.testing.assert_allclose(given, scale_action(agent.action_space, expected), atol=1e-4)
    if name != "DQN":
        unscaled = np.asarray(inner.exploit(inner.actor(agent.state.learner), raw))
        assert not np.allclose(given, scale_action(agent.action_space, unscaled), atol=1e-3)


def test_an_agent_with_statistics_does_not_take_a_file_without_them(tmp_path):
    plain = rejeu.SAC("MlpPolicy", Noted(), **OFF)
    path = plain.save(tmp_path / "plain")
    with pytest.raises(CheckpointError):
        normalising("SAC").set_parameters(path)
    with pytest.raises(CheckpointError):
        rejeu.load(path, normalize=True)


def test_the_best_weights_come_back_with_their_statistics():
    agent = normalising("SAC")
    kept = agent.get_parameters()
    agent.remember_best(1.0)
    agent.learn(20)
    assert float(agent.state.statistics.returns.n_seen) == 44.0
    agent.restore_best()
    assert all(np.array_equal(value, kept[key]) for key, value in agent.get_parameters().items())


# Exploration.


def test_noise_on_parameters_leaves_the_statistics_that_scale_as_they_are():
    """With noise of 100 on every number that it may touch, the observation is still scaled by what was seen."""
    inner = Algorithm(
        init=lambda key: {"weight": jnp.zeros((1, 2), jnp.float32)},
        actor=lambda state: state,
        explore=lambda actor, obs, key, clock: obs,
        exploit=lambda actor, obs: obs + actor["weight"],
        update=lambda state, batch, clock: (state, {}),
    )
    explorer = exploration.make(inner, ParameterNoise(initial_sigma=100.0))
    algorithm = normalized(inner, explorer, leaves(box(2)), NormalizationConfig())
    obs = np.random.default_rng(0).normal(3.0, 2.0, (5, 2)).astype(np.float32)
    actor = algorithm.actor(after_seeing(algorithm, obs))
    carry, begun = algorithm.explorer.init(actor, 5), np.ones(5, bool)
    action, carry = algorithm.explorer.act(carry, actor, obs, begun, jax.random.PRNGKey(0), CLOCK)
    assert max(float(np.abs(z).max()) for z in carry.perturbation) > 50.0
    np.testing.assert_allclose(action, zscore(obs, obs), atol=1e-4)


# Goals.


def reaching(n_steps):
    return rejeu.SAC(
        "MultiInputPolicy",
        InProcess([Reach() for _ in range(4)], seed=0),
        replay_buffer_class=rejeu.HerReplayBuffer,
        normalize={"norm_reward": False},
        gamma=0.8,
        learning_rate=3e-3,
        tau=0.05,
        batch_size=64,
        buffer_size=5000,
        learning_starts=200,
        policy_kwargs={"net_arch": [32, 32]},
        seed=0,
    ).learn(n_steps)


@exhaustive
def test_hindsight_learns_on_scaled_goals():
    assert reaching(1600).evaluate(40, env=InProcess([Reach() for _ in range(4)], seed=1)).success_rate >= 0.9


def test_hindsight_relabels_raw_goals():
    """A scaled goal would give another reward: the deviation of the goals is not 1, nor their mean exactly 0."""
    agent = reaching(240)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (1, 500), 1.0)
    next_obs = jax.tree.map(lambda x: np.asarray(x)[0], batch.next_obs)
    reward = Reach().compute_reward(next_obs["achieved_goal"], next_obs["desired_goal"], {})
    assert np.array_equal(np.asarray(batch.reward)[0], reward)
    assert np.std(next_obs["desired_goal"]) > 1.05 or abs(np.mean(next_obs["desired_goal"])) > 0.05
    goals = agent.state.statistics.obs
    assert len(goals) == 2
    assert float(goals[0].n_seen) == 2 * float(goals[1].n_seen) == 2 * 240


def test_statistics_are_taken_of_copies_that_the_next_step_cannot_overwrite():
    """The device reads a large array when it gets to it, in warm-up after the environments have stepped again."""
    env = InProcess([Counter() for _ in range(2)], seed=0)
    agent = rejeu.SAC("MlpPolicy", env, normalize=True, **{**OFF, "learning_starts": 20})
    observe, shared = agent.learner.observe, []

    def observing(state, obs, returns):
        shared.append(np.shares_memory(obs, env._obs))
        return observe(state, obs, returns)

    agent.learner.observe = observing
    agent.learn(40)
    assert shared == [False] * 20
