"""SAC on Discrete actions against float64 NumPy: expectations over actions, temperature, and updates."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms import sac
from rejeu.algorithms.sac import discrete as sac_discrete
from rejeu.core import TD_ERROR
from tests.algorithms.batches import CLOCK, DISCRETE as ACTION_SPACE, N_ACTIONS, OBS_SPACE, discrete_batch
from tests.numpy_networks import Adam, assert_equal_layers, ensemble, follow, forward, layers, softmax

BATCH = 8
RATE, TAU, ALPHA = 1e-2, 0.25, 0.3
ROWS = np.arange(BATCH)

td_target, critics_loss, actor_loss = map(
    jax.jit, (sac_discrete.td_target, sac_discrete.critics_loss, sac_discrete.actor_loss)
)


def make(**settings):
    settings = {"learning_rate": RATE, "tau": TAU, "ent_coef": f"auto_{ALPHA}", **settings}
    config = sac.Config(policy_kwargs={"net_arch": [5, 4]}, **settings)
    return sac.make(config, OBS_SPACE, ACTION_SPACE)


@pytest.fixture(scope="module")
def learner():
    """The compiled update and the state that it starts from, its targets drawn apart from its critics."""
    algorithm = make()
    init = jax.jit(algorithm.init)
    state, other = init(jax.random.PRNGKey(1)), init(jax.random.PRNGKey(2))
    return jax.jit(algorithm.update), eqx.tree_at(lambda s: s.target_critics, state, other.critics)


def random_batch(seed=0):
    return discrete_batch(seed, BATCH)


# An independent version in float64.


def least(critics, obs):
    return np.min([forward(critic, obs) for critic in critics], axis=0)


def numpy_target(actor, target_critics, alpha, batch):
    probabilities, values = softmax(forward(actor, batch.next_obs)), least(target_critics, batch.next_obs)
    soft = [
        sum(p * (q - alpha * np.log(p)) for p, q in zip(*row, strict=True))
        for row in zip(probabilities, values, strict=True)
    ]
    return batch.reward + batch.discount * soft


def numpy_entropy(actor, obs):
    probabilities = softmax(forward(actor, obs))
    return -(probabilities * np.log(probabilities)).sum(axis=1)


def numpy_actor_loss(actor, values, alpha, obs):
    probabilities = softmax(forward(actor, obs))
    return np.mean((probabilities * (alpha * np.log(probabilities) - values)).sum(axis=1))


class ByHand:
    """The algorithm as its docstring has it: critics, actor by the new critics, temperature, targets."""

    target_entropy = 0.3 * np.log(N_ACTIONS)

    def __init__(self, state):
        self.actor, self.critics = layers(state.actor), ensemble(state.critics)
        self.target_critics = ensemble(state.target_critics)
        self.log_alpha = [[np.array(np.log(ALPHA))]]
        self.actor_adam, self.alpha_adam = Adam(self.actor, RATE), Adam(self.log_alpha, RATE)
        self.critic_adams = [Adam(critic, RATE) for critic in self.critics]

    def update(self, batch):
        alpha, entropy = np.exp(self.log_alpha[0][0]), numpy_entropy(self.actor, batch.obs).mean()
        target = numpy_target(self.actor, self.target_critics, alpha, batch)
        for critic, adam in zip(self.critics, self.critic_adams, strict=True):
            adam.descend(
                lambda critic=critic: 0.5 * np.mean((forward(critic, batch.obs)[ROWS, batch.action] - target) ** 2)
            )
        values = least(self.critics, batch.obs)
        self.actor_adam.descend(lambda: numpy_actor_loss(self.actor, values, alpha, batch.obs))
        self.alpha_adam.descend(lambda: float(self.log_alpha[0][0]) * (entropy - self.target_entropy))
        for target_critic, critic in zip(self.target_critics, self.critics, strict=True):
            follow(target_critic, critic, TAU)


# Targets and losses.


@pytest.mark.usefixtures("strict_dtypes")
def test_the_target_is_the_soft_expectation_of_the_smaller_critic(learner):
    _, state = learner
    batch, targets = random_batch(), ensemble(state.target_critics)
    smaller = np.argmin([forward(critic, batch.next_obs) for critic in targets], axis=0)
    assert 0 < smaller.sum() < smaller.size, "neither critic is the smaller everywhere"
    given = td_target(state.actor, state.target_critics, jnp.float32(ALPHA), batch)
    np.testing.assert_allclose(given, numpy_target(layers(state.actor), targets, ALPHA, batch), atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_target_is_the_reward_where_the_mdp_terminated(learner):
    _, state = learner
    batch = random_batch()._replace(discount=np.zeros(BATCH, np.float32))
    given = td_target(state.actor, state.target_critics, jnp.float32(ALPHA), batch)
    np.testing.assert_array_equal(given, batch.reward)


@pytest.mark.parametrize("weights", [None, np.linspace(0.1, 1.0, BATCH, dtype=np.float32)])
@pytest.mark.usefixtures("strict_dtypes")
def test_the_critics_losses_are_half_squares_of_the_actions_taken_times_importance_weights(learner, weights):
    _, state = learner
    batch, target = random_batch()._replace(weight=weights), np.linspace(-2.0, 2.0, BATCH, dtype=np.float32)
    loss, values = critics_loss(state.critics, batch, target)
    all_values = [forward(critic, batch.obs) for critic in ensemble(state.critics)]
    expected = np.array([[v[i, batch.action[i]] for i in range(BATCH)] for v in all_values])
    np.testing.assert_allclose(values, expected, atol=1e-5)
    squares = (expected - target) ** 2 * (1.0 if weights is None else weights)
    assert float(loss) == pytest.approx(sum(0.5 * row.mean() for row in squares), abs=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_actors_loss_is_the_expectation_under_its_probabilities(learner):
    _, state = learner
    batch, actor = random_batch(), layers(state.actor)
    values = np.random.default_rng(3).normal(size=(BATCH, N_ACTIONS)).astype(np.float32)
    loss, entropy = actor_loss(state.actor, values, jnp.float32(ALPHA), batch.obs)
    assert float(loss) == pytest.approx(numpy_actor_loss(actor, values, ALPHA, batch.obs), abs=1e-5)
    np.testing.assert_allclose(entropy, numpy_entropy(actor, batch.obs), atol=1e-5)


# Whole updates.


def test_three_updates_equal_numpy(learner):
    update, state = learner
    by_hand = ByHand(state)
    for k in range(3):
        state, _ = update(state, random_batch(k), CLOCK)
        by_hand.update(random_batch(k))
        assert_equal_layers(layers(state.actor), by_hand.actor, f"actor after {k + 1}")
        for name in ("critics", "target_critics"):
            for i, (given, expected) in enumerate(
                zip(ensemble(getattr(state, name)), getattr(by_hand, name), strict=True)
            ):
                assert_equal_layers(given, expected, f"{name}[{i}] after {k + 1}")
        pairs = [(layers(state.actor_optimizer.mu), by_hand.actor_adam)]
        pairs += zip(ensemble(state.critics_optimizer.mu), by_hand.critic_adams, strict=True)
        for given, adam in pairs:
            assert_equal_layers(given, adam.first, f"first moments after {k + 1}", atol=1e-6, rtol=1e-4)
        assert float(state.log_alpha) == pytest.approx(float(by_hand.log_alpha[0][0]), abs=1e-5)
        assert float(state.alpha_optimizer.mu) == pytest.approx(float(by_hand.alpha_adam.first[0][0]), abs=1e-6)
    assert int(state.n_updates) == 3


def test_the_metrics_name_losses_values_entropy_temperature_and_errors(learner):
    """The actor's loss is by the critics after their step, the rest by the networks before."""
    update, state = learner
    batch, actor = random_batch(), layers(state.actor)
    after, metrics = update(state, batch, CLOCK)
    target = numpy_target(actor, ensemble(state.target_critics), ALPHA, batch)
    values = np.array([forward(critic, batch.obs)[ROWS, batch.action] for critic in ensemble(state.critics)])
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(values - target).mean(axis=0), atol=1e-5)
    expected = 0.5 * np.mean((values - target) ** 2, axis=1).sum()
    assert float(metrics["critic_loss"]) == pytest.approx(expected, abs=1e-5)
    assert float(metrics["q_value"]) == pytest.approx(values.mean(), abs=1e-5)
    by_new, by_old = (
        numpy_actor_loss(actor, least(ensemble(critics), batch.obs), ALPHA, batch.obs)
        for critics in (after.critics, state.critics)
    )
    assert abs(by_new - by_old) > 1e-3
    assert float(metrics["actor_loss"]) == pytest.approx(by_new, abs=1e-5)
    assert float(metrics["entropy"]) == pytest.approx(numpy_entropy(actor, batch.obs).mean(), abs=1e-5)
    assert float(metrics["ent_coef"]) == pytest.approx(ALPHA, abs=1e-6)


def test_the_temperature_goes_against_the_entropys_distance_from_a_given_target():
    """The gradient of log_alpha (H - target) is H - target, and Adam's first moment a tenth of it.

    The most entropy that four actions can have is log 4 = 1.39, so a target of 2 must raise the temperature.
    """
    algorithm = make(target_entropy=2.0)
    state = jax.jit(algorithm.init)(jax.random.PRNGKey(1))
    after, _ = jax.jit(algorithm.update)(state, random_batch(), CLOCK)
    entropy = numpy_entropy(layers(state.actor), random_batch().obs).mean()
    assert float(after.alpha_optimizer.mu) == pytest.approx(0.1 * (entropy - 2.0), abs=1e-6)
    assert float(after.log_alpha - state.log_alpha) == pytest.approx(RATE, rel=1e-3)


def test_a_fixed_temperature_stays_and_targets_move_only_every_target_update_interval():
    algorithm = make(ent_coef=0.2, target_update_interval=2)
    update, state = jax.jit(algorithm.update), jax.jit(algorithm.init)(jax.random.PRNGKey(1))
    first, metrics = update(state, random_batch(0), CLOCK)
    second, _ = update(first, random_batch(1), CLOCK)
    assert float(metrics["ent_coef"]) == pytest.approx(0.2)
    assert float(second.log_alpha) == float(state.log_alpha) == pytest.approx(np.log(0.2))
    for i, target in enumerate(ensemble(state.target_critics)):
        assert_equal_layers(layers(first.target_critics, i), target, "target after 1", atol=0.0)
        follow(target, layers(second.critics, i), TAU)
        assert_equal_layers(layers(second.target_critics, i), target, "target after 2", atol=1e-6)


def test_a_certain_policy_has_finite_losses_and_gradients(learner):
    """Logits 200 apart leave probabilities of 0 in float32, whose logarithm must not become NaN."""
    update, state = learner
    bias = jnp.array([200.0, 0.0, 0.0, 0.0])
    certain = eqx.tree_at(lambda s: s.actor.head.bias, state, bias)
    after, metrics = update(certain, random_batch(), CLOCK)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves((after, metrics)))
    assert float(metrics["entropy"]) == pytest.approx(0.0, abs=1e-6)
