"""DQN's losses against float64 NumPy, whole updates against recorded ones of Stable-Baselines3, and what it learns."""

import itertools
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import dqn
from rejeu.core.algorithm import TD_ERROR, Clock, Transition, clip
from rejeu.core.schedules import at
from tests.bit_flipping import BitFlipping
from tests.environments import Timed
from tests.tiers import only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

OBS_DIM, N_ACTIONS, BATCH = 3, 4, 8
OBS_SPACE = gym.spaces.Box(-5.0, 5.0, (OBS_DIM,), np.float32)
ACTION_SPACE = gym.spaces.Discrete(N_ACTIONS)
CLOCK = Clock(np.uint32(1), np.uint32(0), np.float32(0.5))


def make(**settings):
    config = dqn.Config(**{"policy_kwargs": {"net_arch": [5, 4]}, **settings})
    algorithm = dqn.make(config, OBS_SPACE, ACTION_SPACE)
    return algorithm, algorithm.init(jax.random.PRNGKey(1))


def random_batch(seed=0, weighted=False):
    rng = np.random.default_rng(seed)
    f32 = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    discount = np.where(np.arange(BATCH) % 3 == 0, 0.0, 0.9).astype(np.float32)
    action = rng.integers(N_ACTIONS, size=BATCH).astype(np.int32)
    weight = rng.uniform(0.1, 1.0, BATCH).astype(np.float32) if weighted else None
    return Transition(f32(BATCH, OBS_DIM), action, 2.0 * f32(BATCH), f32(BATCH, OBS_DIM), discount, weight)


def other_network(seed=2, **settings):
    algorithm, _ = make(**settings)
    return algorithm.init(jax.random.PRNGKey(seed)).network


# An independent network in float64. Layers are (weight, bias) pairs.


def affine(layer, x):
    return x @ np.float64(layer.weight) + np.float64(layer.bias)


def forward(network, x):
    x = np.float64(x)
    for layer in network.torso.layers:
        x = np.maximum(affine(layer, x), 0.0)
    return affine(network.head, x)


# Targets and losses.


@pytest.mark.usefixtures("strict_dtypes")
def test_td_target_bootstraps_from_the_targets_highest_value():
    network, target_network, batch = other_network(2), other_network(3), random_batch()
    given = dqn.td_target(network, target_network, batch, double_q=False)
    values = forward(target_network, batch.next_obs)
    expected = [batch.reward[i] + batch.discount[i] * max(values[i]) for i in range(BATCH)]
    np.testing.assert_allclose(given, expected, atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_double_q_takes_the_targets_value_of_the_networks_best_action():
    network, target_network, batch = other_network(2), other_network(3), random_batch()
    given = dqn.td_target(network, target_network, batch, double_q=True)
    chosen = forward(network, batch.next_obs).argmax(axis=1)
    values = forward(target_network, batch.next_obs)
    assert (chosen != values.argmax(axis=1)).any(), "otherwise the two targets are the same"
    expected = [batch.reward[i] + batch.discount[i] * values[i, chosen[i]] for i in range(BATCH)]
    np.testing.assert_allclose(given, expected, atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("name", ["huber", "squared"])
def test_td_loss_equals_numpy(name, weighted):
    network, batch = other_network(), random_batch(weighted=weighted)
    target = np.linspace(-3.0, 3.0, BATCH, dtype=np.float32)
    loss, (td_error, value) = dqn.td_loss(network, batch, jnp.array(target), dqn.LOSSES[name])
    if name == "squared":
        assert dqn.td_loss(network, batch, jnp.array(target), jnp.square)[0] == loss
    values = forward(network, batch.obs)
    errors = [values[i, batch.action[i]] - target[i] for i in range(BATCH)]
    assert min(map(abs, errors)) < 1 < max(map(abs, errors)), "both branches of Huber's function are met"
    np.testing.assert_allclose(td_error, errors, atol=1e-5)
    np.testing.assert_allclose(value, values[np.arange(BATCH), batch.action], atol=1e-5)
    penalty = {"huber": lambda e: e * e / 2 if abs(e) < 1 else abs(e) - 0.5, "squared": lambda e: e * e}[name]
    weights = batch.weight if weighted else np.ones(BATCH)
    assert float(loss) == pytest.approx(
        np.mean([w * penalty(e) for w, e in zip(weights, errors, strict=True)]), abs=1e-5
    )


def test_update_reports_td_errors_of_the_batch_it_learnt_from():
    algorithm, state = make(double_q=True)
    batch = random_batch()
    _, metrics = jax.jit(algorithm.update)(state, batch, CLOCK)
    values, following = forward(state.network, batch.obs), forward(state.network, batch.next_obs)
    target = batch.reward + batch.discount * following.max(axis=1)
    taken = values[np.arange(BATCH), batch.action]
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(taken - target), atol=1e-5)
    assert float(metrics["q_value"]) == pytest.approx(taken.mean(), abs=1e-5)


def test_gradients_are_clipped_by_value_first_and_then_by_norm():
    gradients = {"a": jnp.array([30.0, -400.0]), "b": jnp.array([[0.0]])}
    by_value = clip(gradients, 40.0, None)
    np.testing.assert_allclose(by_value["a"], [30.0, -40.0])
    both = clip(gradients, 40.0, 10.0)  # (30, -40) has the norm 50
    np.testing.assert_allclose(both["a"], [6.0, -8.0], rtol=1e-5)
    np.testing.assert_array_equal(clip({"a": jnp.zeros(2)}, None, 1.0)["a"], [0.0, 0.0])
    for limits in ((None, None), (400.0, 402.0)):
        np.testing.assert_array_equal(clip(gradients, *limits)["a"], gradients["a"])


# The dueling network.


def dueling_parts(network, x):
    """Value ``(batch, 1)`` and advantages ``(batch, n_actions)`` by hand, in float64."""
    for layer in network.torso.layers:
        x = np.maximum(affine(layer, x), 0.0)
    (value_layer,), (advantage_layer,) = network.value.layers, network.advantage.layers
    value = affine(network.value_head, np.maximum(affine(value_layer, x), 0.0))
    return value, affine(network.advantage_head, np.maximum(affine(advantage_layer, x), 0.0))


@pytest.mark.usefixtures("strict_dtypes")
def test_dueling_adds_the_value_to_advantages_without_their_mean():
    network, obs = other_network(dueling=True), random_batch().obs
    value, advantage = dueling_parts(network, np.float64(obs))
    expected = [[v + a - sum(row) / N_ACTIONS for a in row] for (v,), row in zip(value, advantage, strict=True)]
    np.testing.assert_allclose(network(obs), expected, atol=1e-5)


def test_dueling_streams_share_the_layers_before_the_last():
    network = other_network(dueling=True)
    assert [layer.weight.shape for layer in network.torso.layers] == [(OBS_DIM, 5)]
    assert [layer.weight.shape for layer in network.value.layers] == [(5, 4)]
    assert network.advantage_head.weight.shape == (4, N_ACTIONS)
    assert network.value_head.weight.shape == (4, 1)
    linear = other_network(dueling=True, policy_kwargs={"net_arch": []})
    assert linear.value_head.weight.shape == (OBS_DIM, 1)
    assert linear(random_batch().obs).shape == (BATCH, N_ACTIONS)


# Exploration.


def test_epsilon_greedy_draws_each_row_by_itself():
    """Of 30,000 rows, the share away from the best action is epsilon (n - 1) / n = 0.225, within 5 standard errors."""
    values = jnp.tile(jnp.array([[0.0, 3.0, 1.0, 2.0]]), (30_000, 1))
    action = np.asarray(dqn.epsilon_greedy(values, 0.3, jax.random.PRNGKey(0)))
    assert action.dtype == np.int32
    shares = np.bincount(action, minlength=4) / 30_000
    np.testing.assert_allclose(shares, [0.075, 0.775, 0.075, 0.075], atol=5 * np.sqrt(0.775 * 0.225 / 30_000))


def test_linear_epsilon_reaches_its_end_at_the_fraction():
    """From 0.9 by 0.8 over 0.2 of the run: a quarter of the way at 0.05, the end from 0.2 on."""
    settings = {"exploration_initial_eps": 0.9, "exploration_final_eps": 0.1, "exploration_fraction": 0.2}
    epsilon = dqn.Config(**settings).epsilon
    assert [at(epsilon, p) for p in (0.0, 0.05, 0.2, 1.0)] == pytest.approx([0.9, 0.7, 0.1, 0.1])


def test_exponential_epsilon_falls_by_one_factor_an_episode():
    """As the exercise has it: epsilon is multiplied by (end / start)^(1 / n) after each of n episodes."""
    settings = {"exploration_initial_eps": 0.9, "exploration_final_eps": 0.01, "exploration_fraction": 1.0}
    epsilon = dqn.Config(exploration_schedule="exponential", **settings).epsilon
    expected, n = 0.9, 450
    for episode in range(n):
        assert at(epsilon, episode / n) == pytest.approx(expected, rel=1e-6)
        expected *= (0.01 / 0.9) ** (1 / n)


# The target network.


@pytest.mark.parametrize(
    ("last", "step", "interval", "expected"),
    [(0, 599, 600, 0), (592, 608, 600, 1), (600, 616, 600, 0), (0, 1800, 600, 3), (7, 8, 1, 1), (5_000, 100, 10, 0)],
)
def test_moves_due_counts_the_multiples_in_between(last, step, interval, expected):
    counted = sum(1 for s in range(last + 1, step + 1) if s % interval == 0)
    assert counted == expected
    assert int(dqn.moves_due(jnp.uint32(last), np.uint32(step), interval)) == expected


def test_several_soft_moves_at_once_equal_as_many_in_turn():
    target, online = {"w": jnp.array([0.0, 8.0])}, {"w": jnp.array([8.0, 0.0])}
    moved = dqn.moved_target(target, online, jnp.int32(3), 0.5)["w"]  # 0 -> 4 -> 6 -> 7
    np.testing.assert_allclose(moved, [7.0, 1.0])
    np.testing.assert_array_equal(dqn.moved_target(target, online, jnp.int32(0), 0.5)["w"], target["w"])


def test_target_takes_the_network_from_before_the_gradient_step():
    algorithm, state = make(target_update_interval=10, learning_rate=0.1)
    update = jax.jit(algorithm.update)
    state, _ = update(state, random_batch(), CLOCK._replace(step=np.uint32(9)))
    after, _ = update(state, random_batch(1), CLOCK._replace(step=np.uint32(10)))
    jax.tree.map(np.testing.assert_array_equal, after.target_network, state.network)
    assert (after.network.head.weight != state.network.head.weight).any()


# What it learns.


class Chain:
    """Five rooms in a row: left and right, and going right from the last one pays 1 and ends. Discount 0.9.

    The shortest way to the end is best, so ``Q(s, right) = 0.9^(4 - s)``, and a step left costs that step and another one
    back: ``Q(s, left) = 0.9^2 Q(s, right)``, or ``0.9 Q(0, right)`` in the first room, where left stays.
    """

    n, gamma = 5, 0.9
    observation_space, action_space = gym.spaces.Discrete(n), gym.spaces.Discrete(2)

    def transitions(self):
        """Every room with every action."""
        room, action = (np.array(x, np.int32) for x in zip(*itertools.product(range(self.n), (0, 1)), strict=True))
        ends = (room == self.n - 1) & (action == 1)
        following = np.clip(room + 2 * action - 1, 0, self.n - 1).astype(np.int32)
        return Transition(room, action, ends.astype(np.float32), following, np.float32(self.gamma) * ~ends)

    def values(self):
        """The true values, ``(n, 2)``."""
        right = self.gamma ** np.arange(self.n - 1.0, -1.0, -1.0)
        left = self.gamma * np.concatenate([right[:1], right[:-1]])
        return np.stack([left, right], axis=1)


def learn_chain(algorithm, n_updates):
    """The state after so many updates on every transition of the chain, one environment step apart."""
    batch = jax.tree.map(jnp.asarray, Chain().transitions())

    def update(state: Any, step: Any):
        return algorithm.update(state, batch, Clock(step, jnp.uint32(0), jnp.float32(0.5)))[0], None

    steps = jnp.arange(1, n_updates + 1, dtype=jnp.uint32)
    return jax.jit(lambda state: jax.lax.scan(update, state, steps)[0])(algorithm.init(jax.random.PRNGKey(0)))


CHAINS = [{}, {"double_q": True}, {"dueling": True}, {"loss": "squared"}, {"tau": 0.05}]


@pytest.mark.parametrize("settings", only(CHAINS[:1] + CHAINS[4:], CHAINS))
def test_values_of_a_chain_are_learnt(settings):
    interval = 1 if "tau" in settings else 50
    config = dqn.Config(
        learning_rate=3e-3, target_update_interval=interval, policy_kwargs={"net_arch": [32]}, **settings
    )
    state = learn_chain(dqn.make(config, Chain.observation_space, Chain.action_space), 2_000)
    np.testing.assert_allclose(state.network(np.arange(5, dtype=np.int32)), Chain().values(), atol=0.02)


class Bandit(Timed):
    """One state, actions 5, 6 and 7; 6 pays 1, the others nothing. Ten steps an episode; refuses any other action."""

    action_space = gym.spaces.Discrete(3, start=5)

    def reward(self, action):
        assert self.action_space.contains(action), action
        return float(action == 6)


@pytest.mark.parametrize("n_envs", only([3], [1, 3, 8]))
def test_discrete_actions_of_any_start_are_learnt(n_envs):
    env = rejeu.make_vector(Bandit, n_envs)
    settings = {"gamma": 0.0, "learning_rate": 1e-2, "train_freq": 2, "learning_starts": 50}
    agent = rejeu.DQN("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [8]}, **settings).learn(400)
    assert agent.num_timesteps == -(-400 // n_envs) * n_envs
    action, _ = agent.predict(np.zeros(1, np.float32), deterministic=True)
    assert action == 6


BIT_FLIPPING = {
    "learning_rate": 1e-3,
    "batch_size": 256,
    "buffer_size": 10_000,
    "gamma": 0.95,
    "train_freq": 1,
    "target_update_interval": 50,
    "exploration_fraction": 0.3,
    "exploration_final_eps": 0.01,
    "policy_kwargs": {"net_arch": [256]},
}


def bit_flipping_success(seed, hindsight):
    """Share of the last 100 training episodes, of 1,500 steps in 2 environments, that ended at the goal."""
    replay = {"replay_buffer_class": "HerReplayBuffer"} if hindsight else {}
    env = rejeu.make_vector(BitFlipping, 2, seed=seed)
    agent = rejeu.DQN("MultiInputPolicy", env, seed=seed, **BIT_FLIPPING, **replay).learn(1_500)
    assert len(agent.ep_success_buffer) == 100
    return np.mean(agent.ep_success_buffer)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4])
def test_hindsight_makes_the_difference_for_every_seed(seed):
    assert bit_flipping_success(seed, hindsight=True) > 0.9
    assert bit_flipping_success(seed, hindsight=False) < 0.1
