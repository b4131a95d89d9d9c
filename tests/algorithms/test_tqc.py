"""TQC's losses against float64 NumPy: quantile Huber loss, truncation, target, and one whole update."""

from __future__ import annotations

import functools

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import tqc
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.core import TD_ERROR
from tests.algorithms.batches import ACTION_DIM, BOX as ACTION_SPACE, CLOCK, OBS_SPACE, box_batch, noise_of
from tests.numpy_networks import ensemble, forward, layers, squashed_sample
from tests.tiers import exhaustive

BATCH, N_CRITICS, N_QUANTILES = 6, 2, 5


@functools.cache
def make(**settings):
    settings = {"n_quantiles": N_QUANTILES, "policy_kwargs": {"net_arch": [5, 4]}, **settings}
    algorithm = tqc.make(tqc.Config(**settings), OBS_SPACE, ACTION_SPACE)
    return jax.jit(algorithm.update), jax.jit(algorithm.init)(jax.random.PRNGKey(1))


td_target, critics_loss, actor_loss = (
    jax.jit(tqc.td_target, static_argnums=5),
    jax.jit(tqc.critics_loss),
    jax.jit(tqc.actor_loss),
)


def random_batch(seed=0):
    return box_batch(seed, BATCH)


# An independent TQC in float64 and loops.


def brute_force_loss(quantiles, samples, kappa=1.0):
    """One transition: the mean over all pairs of |fraction - 1[u < 0]| Huber(u), u = sample - quantile."""
    total = 0.0
    for i, quantile in enumerate(quantiles):
        fraction = (i + 0.5) / len(quantiles)
        for sample in samples:
            u = sample - quantile
            huber = 0.5 * u * u if abs(u) <= kappa else kappa * (abs(u) - 0.5 * kappa)
            total += (1.0 - fraction if u < 0 else fraction) * huber
    return total / (len(quantiles) * len(samples))


def numpy_quantiles(critics, obs, action):
    x = np.concatenate([np.float64(obs), np.float64(action)], axis=1)
    return np.stack([forward(critic, x) for critic in ensemble(critics)])


def numpy_sample(actor, obs, key):
    return squashed_sample(forward(layers(actor), obs), noise_of(key, BATCH))


def numpy_target(state, batch, alpha, key, dropped):
    action, log_prob = numpy_sample(state.actor, batch.next_obs, key)
    quantiles = numpy_quantiles(state.target_critics, batch.next_obs, action)
    rows = []
    for b in range(BATCH):
        pooled = sorted(quantiles[n, b, i] for n in range(N_CRITICS) for i in range(N_QUANTILES))
        kept = pooled[: N_CRITICS * (N_QUANTILES - dropped)]
        rows.append([batch.reward[b] + batch.discount[b] * (z - alpha * log_prob[b]) for z in kept])
    return np.array(rows)


@pytest.mark.parametrize("kappa", [0.1, 1.0, 5.0])
@pytest.mark.usefixtures("strict_dtypes")
def test_quantile_huber_loss_equals_loops_over_all_pairs(kappa):
    rng = np.random.default_rng(0)
    quantiles, targets = 2 * rng.normal(size=(N_CRITICS, BATCH, 5)), 2 * rng.normal(size=(BATCH, 7))
    given = quantile_huber_loss(jnp.array(quantiles, jnp.float32), jnp.array(targets, jnp.float32), kappa)
    expected = [[brute_force_loss(quantiles[n, b], targets[b], kappa) for b in range(BATCH)] for n in range(N_CRITICS)]
    np.testing.assert_allclose(given, expected, atol=1e-5)


def test_quantile_huber_loss_needs_no_axis_of_critics():
    quantiles, targets = jnp.array([[0.0, 1.0], [2.0, 0.5]]), jnp.array([[0.3, -4.0, 1.0], [0.0, 0.0, 9.0]])
    expected = [brute_force_loss(*pair) for pair in zip(quantiles.tolist(), targets.tolist(), strict=True)]
    np.testing.assert_allclose(quantile_huber_loss(quantiles, targets), expected, atol=1e-6)


def test_the_gradient_of_the_quantile_huber_loss_equals_finite_differences_and_the_targets_get_none():
    rng = np.random.default_rng(1)
    quantiles, targets = 2 * rng.normal(size=(1, 4)), 2 * rng.normal(size=(1, 6))
    loss = lambda q, t: jnp.sum(quantile_huber_loss(q, t))  # noqa: E731
    by_quantiles, by_targets = jax.grad(loss, argnums=(0, 1))(jnp.array(quantiles), jnp.array(targets))
    eps = 1e-6 * np.eye(4)
    expected = [
        (brute_force_loss(quantiles[0] + e, targets[0]) - brute_force_loss(quantiles[0] - e, targets[0])) / 2e-6
        for e in eps
    ]
    np.testing.assert_allclose(by_quantiles[0], expected, atol=1e-5)
    np.testing.assert_array_equal(by_targets, 0.0)


def test_the_table_of_all_pairs_is_never_in_memory():
    loss = lambda q, t: jnp.sum(quantile_huber_loss(q, t))  # noqa: E731
    compiled = jax.jit(jax.value_and_grad(loss)).lower(jnp.zeros((8, 30)), jnp.zeros((8, 40))).compile()
    needed = compiled.memory_analysis().temp_size_in_bytes
    assert needed < 8 * 30 * 40 * 4, needed


def test_the_quantile_huber_loss_is_least_at_the_quantiles_of_the_samples():
    """Two quantiles, at 1/4 and 3/4, of the numbers 0 to 100, with a kappa too small to matter: 25 and 75."""
    samples = jnp.arange(101.0)[None]
    grid = jnp.arange(0.0, 101.0, 5.0)
    lower = [float(quantile_huber_loss(jnp.array([[q, 75.0]]), samples, 1e-3)[0]) for q in grid]
    upper = [float(quantile_huber_loss(jnp.array([[25.0, q]]), samples, 1e-3)[0]) for q in grid]
    assert (float(grid[np.argmin(lower)]), float(grid[np.argmin(upper)])) == (25.0, 75.0)


@pytest.mark.parametrize("dropped", [0, 1, 3])
@pytest.mark.usefixtures("strict_dtypes")
def test_td_target_equals_numpy(dropped):
    _, state = make()
    batch, key = random_batch(), jax.random.PRNGKey(7)
    n_kept = N_CRITICS * (N_QUANTILES - dropped)
    given = td_target(state.actor, state.target_critics, jnp.float32(0.3), batch, key, n_kept)
    assert given.shape == (BATCH, n_kept)
    np.testing.assert_allclose(np.sort(given, axis=1), numpy_target(state, batch, 0.3, key, dropped), atol=1e-5)


def test_truncation_is_of_all_quantiles_together_not_of_each_critic():
    """The second critic says nothing below 10: one quantile dropped per critic, and both of its own go."""
    quantiles = jnp.array([[[3.0, 1.0]], [[20.0, 10.0]]])
    np.testing.assert_array_equal(tqc.truncate(quantiles, 2), [[1.0, 3.0]])


def test_td_target_is_the_reward_where_the_mdp_terminated():
    _, state = make()
    batch = random_batch()._replace(discount=np.zeros(BATCH, np.float32))
    given = td_target(state.actor, state.target_critics, jnp.float32(0.3), batch, jax.random.PRNGKey(0), 4)
    np.testing.assert_array_equal(given, np.repeat(batch.reward[:, None], 4, axis=1))


@pytest.mark.parametrize("weights", [None, np.linspace(0.1, 1.0, BATCH, dtype=np.float32)])
@pytest.mark.usefixtures("strict_dtypes")
def test_critics_loss_equals_numpy_with_and_without_importance_weights(weights):
    _, state = make()
    batch = random_batch()._replace(weight=weights)
    target = np.random.default_rng(3).normal(size=(BATCH, 8)).astype(np.float32)
    loss, quantiles = critics_loss(state.critics, batch, target)
    expected = numpy_quantiles(state.critics, batch.obs, batch.action)
    np.testing.assert_allclose(quantiles, expected, atol=1e-5)
    each = np.array([[brute_force_loss(expected[n, b], target[b]) for b in range(BATCH)] for n in range(N_CRITICS)])
    weighted = each if weights is None else each * weights
    assert float(loss) == pytest.approx(weighted.mean(axis=1).sum(), abs=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_actor_goes_by_the_mean_of_all_quantiles_of_all_critics():
    _, state = make()
    batch, key = random_batch(), jax.random.PRNGKey(7)
    loss, log_prob = actor_loss(state.actor, state.critics, jnp.float32(0.3), batch.obs, key)
    action, expected = numpy_sample(state.actor, batch.obs, key)
    value = numpy_quantiles(state.critics, batch.obs, action).mean(axis=(0, 2))
    np.testing.assert_allclose(log_prob, expected, atol=1e-5)
    assert float(loss) == pytest.approx(np.mean(0.3 * expected - value), abs=1e-5)


def test_an_update_uses_the_mathematics_above_in_the_documented_order():
    """Metrics of one update from the keys it derives: the target precedes, the policy loss follows the critics' step."""
    update, state = make(learning_rate=1e-2, ent_coef="auto_0.3", top_quantiles_to_drop_per_net=1)
    batch = random_batch()
    target_key, actor_key = jax.random.split(jax.random.fold_in(state.key, 0))
    after, metrics = update(state, batch, CLOCK)
    target = numpy_target(state, batch, 0.3, target_key, 1)
    quantiles = numpy_quantiles(state.critics, batch.obs, batch.action)
    each = [[brute_force_loss(quantiles[n, b], target[b]) for b in range(BATCH)] for n in range(N_CRITICS)]
    action, log_prob = numpy_sample(state.actor, batch.obs, actor_key)
    value = numpy_quantiles(after.critics, batch.obs, action).mean(axis=(0, 2))
    assert float(metrics["critic_loss"]) == pytest.approx(np.mean(each, axis=1).sum(), abs=1e-5)
    assert float(metrics["actor_loss"]) == pytest.approx(np.mean(0.3 * log_prob - value), abs=1e-5)
    assert float(metrics["entropy"]) == pytest.approx(-log_prob.mean(), abs=1e-5)
    assert float(metrics["q_value"]) == pytest.approx(quantiles.mean(), abs=1e-5)
    errors = np.abs(quantiles.mean(axis=2) - target.mean(axis=1)).mean(axis=0)
    np.testing.assert_allclose(metrics[TD_ERROR], errors, atol=1e-5)
    assert int(after.n_updates) == 1
    # Adam's first step against the gradient of J_alpha, minus (mean log_prob + target_entropy), has the rate's length.
    direction = np.sign(log_prob.mean() - ACTION_DIM)
    assert float(after.log_alpha - state.log_alpha) == pytest.approx(1e-2 * direction, rel=1e-3)


def test_targets_move_by_tau_towards_the_new_critics_every_target_update_interval():
    update, state = make(tau=0.25, target_update_interval=2)
    first, _ = update(state, random_batch(), CLOCK)
    second, _ = update(first, random_batch(), CLOCK)
    np.testing.assert_array_equal(first.target_critics.head.weight, state.target_critics.head.weight)
    expected = 0.75 * first.target_critics.head.weight + 0.25 * second.critics.head.weight
    np.testing.assert_allclose(second.target_critics.head.weight, expected, atol=1e-6)


@exhaustive
def test_a_fixed_temperature_stays():
    update, state = make(ent_coef=0.2)
    after, metrics = update(state, random_batch(), CLOCK)
    assert float(metrics["ent_coef"]) == pytest.approx(0.2)
    assert float(after.log_alpha) == float(state.log_alpha)


class Halfway(gym.Env):
    """Probe: two steps, the observation says which. The first gives nothing, the second 1 - 4 (a - 1/2)^2."""

    observation_space = gym.spaces.Box(0.0, 1.0, (1,), np.float32)
    action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.time += 1
        reward = 1.0 - 4 * (float(action[0]) - 0.5) ** 2 if self.time == 2 else 0.0
        return np.full(1, self.time % 2, np.float32), reward, self.time == 2, False, {}


def test_it_finds_the_best_action_of_a_probe_and_its_values_before_and_at_the_end():
    """At the end the best action is 1/2 and worth 1; a step earlier everything is worth gamma times that."""
    agent = rejeu.TQC(
        "MlpPolicy",
        Halfway(),
        seed=0,
        learning_rate=1e-2,
        learning_starts=100,
        batch_size=64,
        gamma=0.8,
        tau=0.05,
        ent_coef=0.001,
        policy_kwargs={"net_arch": [32, 32]},
    ).learn(700)
    action, _ = agent.predict(np.ones((1, 1), np.float32), deterministic=True)
    assert abs(float(action[0, 0]) - 0.5) < 0.15
    values = tqc.action_quantiles(agent.state.critics, jnp.array([[0.0], [1.0]]), jnp.array([[0.0], [0.5]]))
    np.testing.assert_allclose(np.mean(values, axis=(0, 2)), [0.8, 1.0], atol=0.1)


@pytest.mark.slow
def test_it_learns_pendulum_in_5_000_steps():
    """A random policy gets about -1,200; swinging up and holding about -150."""
    agent = rejeu.TQC(
        "MlpPolicy", "Pendulum-v1", seed=0, learning_rate=1e-3, batch_size=64, policy_kwargs={"net_arch": [64, 64]}
    ).learn(5_000)
    assert agent.evaluate(20, seed=1).mean_return > -250
