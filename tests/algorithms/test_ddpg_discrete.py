"""DDPG on Discrete actions against float64 NumPy: expectations over actions, and whole updates."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import ddpg
from rejeu.algorithms.ddpg import discrete as ddpg_discrete
from rejeu.core import TD_ERROR
from tests.algorithms.batches import CLOCK, DISCRETE as ACTION_SPACE, OBS_SPACE, discrete_batch
from tests.environments import Sampled
from tests.numpy_networks import Adam, assert_equal_layers, follow, forward, layers, softmax

BATCH = 8
RATE, TAU, ENTROPY_COEFFICIENT = 1e-2, 0.25, 0.01
ROWS = np.arange(BATCH)

td_target, critic_loss, actor_loss = map(
    jax.jit, (ddpg_discrete.td_target, ddpg_discrete.critic_loss, ddpg_discrete.actor_loss)
)


def make(**settings):
    config = ddpg.Config(policy_kwargs={"net_arch": [5, 4]}, learning_rate=RATE, tau=TAU, **settings)
    return ddpg.make(config, OBS_SPACE, ACTION_SPACE)


@pytest.fixture(scope="module")
def learner():
    """The compiled update and the state that it starts from, its targets drawn apart from its networks."""
    algorithm = make()
    init = jax.jit(algorithm.init)
    state, other = init(jax.random.PRNGKey(1)), init(jax.random.PRNGKey(2))
    apart = {"target_actor": other.actor, "target_critic": other.critic}
    fields = {name: apart.get(name, getattr(state, name)) for name in state.__dataclass_fields__}
    return jax.jit(algorithm.update), ddpg_discrete.State(**fields)


def random_batch(seed=0):
    return discrete_batch(seed, BATCH)


# An independent version in float64.


def numpy_target(target_actor, target_critic, batch):
    probabilities, values = softmax(forward(target_actor, batch.next_obs)), forward(target_critic, batch.next_obs)
    expected = [sum(p * q for p, q in zip(*row, strict=True)) for row in zip(probabilities, values, strict=True)]
    return batch.reward + batch.discount * expected


def numpy_entropy(probabilities):
    return -(probabilities * np.log(probabilities)).sum(axis=1)


def numpy_actor_loss(actor, critic, obs):
    probabilities = softmax(forward(actor, obs))
    value = (probabilities * forward(critic, obs)).sum(axis=1)
    return -np.mean(value) - ENTROPY_COEFFICIENT * np.mean(numpy_entropy(probabilities))


class ByHand:
    """The algorithm as its docstring has it: critic, actor by the new critic, targets towards both."""

    def __init__(self, state):
        self.actor, self.critic = layers(state.actor), layers(state.critic)
        self.target_actor, self.target_critic = layers(state.target_actor), layers(state.target_critic)
        self.actor_adam, self.critic_adam = Adam(self.actor, RATE), Adam(self.critic, RATE)

    def update(self, batch):
        target = numpy_target(self.target_actor, self.target_critic, batch)
        self.critic_adam.descend(lambda: np.mean((forward(self.critic, batch.obs)[ROWS, batch.action] - target) ** 2))
        self.actor_adam.descend(lambda: numpy_actor_loss(self.actor, self.critic, batch.obs))
        follow(self.target_actor, self.actor, TAU)
        follow(self.target_critic, self.critic, TAU)


# Targets and losses.


@pytest.mark.usefixtures("strict_dtypes")
def test_the_target_bootstraps_from_the_expectation_under_the_target_policy(learner):
    _, state = learner
    batch = random_batch()
    given = td_target(state.target_actor, state.target_critic, batch)
    expected = numpy_target(layers(state.target_actor), layers(state.target_critic), batch)
    np.testing.assert_allclose(given, expected, atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_target_is_the_reward_where_the_mdp_terminated(learner):
    _, state = learner
    batch = random_batch()._replace(discount=np.zeros(BATCH, np.float32))
    np.testing.assert_array_equal(td_target(state.target_actor, state.target_critic, batch), batch.reward)


@pytest.mark.parametrize("weights", [None, np.linspace(0.1, 1.0, BATCH, dtype=np.float32)])
@pytest.mark.usefixtures("strict_dtypes")
def test_the_critics_loss_is_of_the_actions_taken_times_importance_weights(learner, weights):
    _, state = learner
    batch, target = random_batch()._replace(weight=weights), np.linspace(-2.0, 2.0, BATCH, dtype=np.float32)
    loss, values = critic_loss(state.critic, batch, target)
    expected = np.array([forward(layers(state.critic), batch.obs)[i, batch.action[i]] for i in range(BATCH)])
    np.testing.assert_allclose(values, expected, atol=1e-5)
    squares = (expected - target) ** 2 * (1.0 if weights is None else weights)
    assert float(loss) == pytest.approx(sum(squares) / BATCH, abs=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_actors_loss_is_minus_its_expected_value_and_a_hundredth_of_its_entropy(learner):
    _, state = learner
    batch = random_batch()
    values = forward(layers(state.critic), batch.obs)
    loss, entropy = actor_loss(state.actor, jnp.asarray(values, jnp.float32), batch.obs)
    expected = numpy_actor_loss(layers(state.actor), layers(state.critic), batch.obs)
    assert float(loss) == pytest.approx(expected, abs=1e-5)
    probabilities = softmax(forward(layers(state.actor), batch.obs))
    assert float(entropy) == pytest.approx(np.mean(numpy_entropy(probabilities)), abs=1e-5)


# Whole updates.


def test_three_updates_equal_numpy(learner):
    update, state = learner
    by_hand = ByHand(state)
    for k in range(3):
        state, _ = update(state, random_batch(k), CLOCK)
        by_hand.update(random_batch(k))
        for name in ("critic", "actor", "target_critic", "target_actor"):
            assert_equal_layers(layers(getattr(state, name)), getattr(by_hand, name), f"{name} after {k + 1}")
        for name in ("critic", "actor"):
            moments, adam = getattr(state, f"{name}_optimizer"), getattr(by_hand, f"{name}_adam")
            assert_equal_layers(layers(moments.mu), adam.first, f"first moment of {name}", atol=1e-6, rtol=1e-4)
    assert int(state.n_updates) == 3


def test_both_targets_move_by_tau_at_every_target_update_interval_th_update_and_only_then():
    algorithm = make(target_update_interval=3)
    update, state = jax.jit(algorithm.update), jax.jit(algorithm.init)(jax.random.PRNGKey(1))
    for k in range(1, 7):
        before, (state, _) = state, update(state, random_batch(k), CLOCK)
        for target, online in (("target_actor", "actor"), ("target_critic", "critic")):
            expected = layers(getattr(before, target))
            if k % 3 == 0:
                follow(expected, layers(getattr(state, online)), TAU)
            assert_equal_layers(layers(getattr(state, target)), expected, f"{target} after {k}", atol=1e-7)


def test_the_metrics_name_losses_values_entropy_and_errors(learner):
    """The actor's loss is by the critic after its step, the rest by the networks before."""
    update, state = learner
    batch = random_batch()
    after, metrics = update(state, batch, CLOCK)
    values = forward(layers(state.critic), batch.obs)[ROWS, batch.action]
    errors = values - numpy_target(layers(state.target_actor), layers(state.target_critic), batch)
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(errors), atol=1e-5)
    assert float(metrics["critic_loss"]) == pytest.approx(np.mean(errors**2), abs=1e-5)
    assert float(metrics["q_value"]) == pytest.approx(values.mean(), abs=1e-5)
    by_new, by_old = (
        numpy_actor_loss(layers(state.actor), layers(critic), batch.obs) for critic in (after.critic, state.critic)
    )
    assert abs(by_new - by_old) > 1e-3
    assert float(metrics["actor_loss"]) == pytest.approx(by_new, abs=1e-5)
    entropy = numpy_entropy(softmax(forward(layers(state.actor), batch.obs)))
    assert float(metrics["entropy"]) == pytest.approx(entropy.mean(), abs=1e-5)


# What is refused.


def test_noise_on_actions_is_refused_with_what_to_use():
    with pytest.raises(
        ValueError, match=r"NormalActionNoise adds to continuous .* use action_noise=ParameterNoise"
    ) as e:
        rejeu.DDPG("MlpPolicy", Sampled(OBS_SPACE, ACTION_SPACE), action_noise=rejeu.NormalActionNoise([0.0], [0.1]))
    assert "\n" not in str(e.value)
