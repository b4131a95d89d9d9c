"""DDPG's losses and whole updates against float64 NumPy, its settings and what it refuses."""

from __future__ import annotations

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import ddpg
from rejeu.core import TD_ERROR
from tests.algorithms.batches import BOX as ACTION_SPACE, CLOCK, OBS_SPACE, box_batch
from tests.environments import Sampled
from tests.numpy_networks import (
    Adam,
    action_value as value,
    assert_equal_layers,
    follow,
    forward,
    gradient,
    largest_difference,
    layers,
)

BATCH = 6
RATE, TAU = 1e-2, 0.25

td_target, critic_loss, actor_loss = map(jax.jit, (ddpg.td_target, ddpg.critic_loss, ddpg.actor_loss))


def make(**settings):
    config = ddpg.Config(**{"policy_kwargs": {"net_arch": [5, 4]}, "learning_rate": RATE, "tau": TAU, **settings})
    return ddpg.make(config, OBS_SPACE, ACTION_SPACE)


@pytest.fixture(scope="module")
def learner():
    """The compiled update of one DDPG and the state that it starts from, its targets drawn apart from its networks."""
    algorithm = make()
    init = jax.jit(algorithm.init)
    state, other = init(jax.random.PRNGKey(1)), init(jax.random.PRNGKey(2))
    apart = {"target_actor": other.actor, "target_critic": other.critic}
    fields = {name: apart.get(name, getattr(state, name)) for name in state.__dataclass_fields__}
    return jax.jit(algorithm.update), ddpg.State(**fields)


def random_batch(seed=0):
    return box_batch(seed, BATCH)


# An independent DDPG in float64.


def act(actor, obs):
    return np.tanh(forward(actor, obs))


def numpy_target(target_actor, target_critic, batch):
    return batch.reward + batch.discount * value(target_critic, batch.next_obs, act(target_actor, batch.next_obs))


class ByHand:
    """The algorithm as its docstring has it: critic, actor by the new critic, targets towards both."""

    def __init__(self, state):
        self.actor, self.critic = layers(state.actor), layers(state.critic)
        self.target_actor, self.target_critic = layers(state.target_actor), layers(state.target_critic)
        self.actor_adam, self.critic_adam = Adam(self.actor, RATE), Adam(self.critic, RATE)

    def update(self, batch):
        target = numpy_target(self.target_actor, self.target_critic, batch)
        self.critic_adam.descend(lambda: np.mean((value(self.critic, batch.obs, batch.action) - target) ** 2))
        self.actor_adam.descend(lambda: -np.mean(value(self.critic, batch.obs, act(self.actor, batch.obs))))
        follow(self.target_actor, self.actor, TAU)
        follow(self.target_critic, self.critic, TAU)


# Targets and losses.


@pytest.mark.usefixtures("strict_dtypes")
def test_the_target_bootstraps_from_the_target_networks_own_action(learner):
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
def test_the_critics_loss_is_the_mean_squared_error_times_importance_weights(learner, weights):
    _, state = learner
    batch, target = random_batch()._replace(weight=weights), np.linspace(-2.0, 2.0, BATCH, dtype=np.float32)
    loss, values = critic_loss(state.critic, batch, target)
    expected = value(layers(state.critic), batch.obs, batch.action)
    np.testing.assert_allclose(values, expected, atol=1e-5)
    squares = (expected - target) ** 2 * (1.0 if weights is None else weights)
    assert float(loss) == pytest.approx(sum(squares) / BATCH, abs=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_actors_loss_is_minus_the_value_of_its_own_actions(learner):
    _, state = learner
    batch = random_batch()
    own = value(layers(state.critic), batch.obs, act(layers(state.actor), batch.obs))
    assert float(actor_loss(state.actor, state.critic, batch.obs)) == pytest.approx(-sum(own) / BATCH, abs=1e-5)


def test_the_actors_gradient_flows_through_the_critic_and_equals_finite_differences(learner):
    _, state = learner
    batch, actor, critic = random_batch(), layers(state.actor), layers(state.critic)
    expected = gradient(actor, lambda: -np.mean(value(critic, batch.obs, act(actor, batch.obs))))
    given = jax.jit(jax.grad(ddpg.actor_loss))(state.actor, state.critic, batch.obs)
    assert_equal_layers(layers(given), expected, "gradient", atol=1e-6)
    assert max(np.abs(weight).max() for weight, _ in expected) > 1e-3


def test_training_and_deterministic_actions_are_those_of_the_actor(learner):
    """All exploration comes from noise, which the loop adds."""
    algorithm, obs = make(), random_batch().obs
    _, state = learner
    expected = act(layers(state.actor), obs)
    explored = algorithm.explore(algorithm.actor(state), obs, jax.random.PRNGKey(0), CLOCK)
    np.testing.assert_allclose(explored, expected, atol=1e-6)
    np.testing.assert_allclose(algorithm.exploit(algorithm.actor(state), obs), expected, atol=1e-6)


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
            assert_equal_layers(layers(moments.nu), adam.second, f"second moment of {name}", atol=1e-7, rtol=1e-3)
    assert int(state.n_updates) == 3


def test_the_actor_climbs_the_critic_as_it_is_after_its_step(learner):
    update, state = learner
    batch = random_batch()
    after, metrics = update(state, batch, CLOCK)
    own = act(layers(state.actor), batch.obs)
    by_new, by_old = (-value(layers(critic), batch.obs, own).mean() for critic in (after.critic, state.critic))
    assert abs(by_new - by_old) > 1e-3
    assert float(metrics["actor_loss"]) == pytest.approx(by_new, abs=1e-5)


def test_targets_move_by_tau_towards_the_new_networks(learner):
    update, state = learner
    after, _ = update(state, random_batch(), CLOCK)
    for name in ("actor", "critic"):
        target, old = layers(getattr(state, f"target_{name}")), layers(getattr(state, name))
        new = layers(getattr(after, name))
        assert largest_difference(old, new) > 1e-3
        follow(target, new, TAU)
        assert_equal_layers(layers(getattr(after, f"target_{name}")), target, name, atol=1e-6)


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


def test_the_metrics_are_of_the_networks_before_the_update(learner):
    update, state = learner
    batch = random_batch()
    _, metrics = update(state, batch, CLOCK)
    values = value(layers(state.critic), batch.obs, batch.action)
    errors = values - numpy_target(layers(state.target_actor), layers(state.target_critic), batch)
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(errors), atol=1e-5)
    assert float(metrics["critic_loss"]) == pytest.approx(np.mean(errors**2), abs=1e-5)
    assert float(metrics["q_value"]) == pytest.approx(values.mean(), abs=1e-5)


def test_importance_weights_reach_the_critic_and_not_the_actor(learner):
    """Of six transitions all but one weigh next to nothing: the critic's gradient is a sixth of that one's alone."""
    update, state = learner
    batch = random_batch()
    weight = np.float32([1e-12] * 5 + [1.0])
    after, _ = update(state, batch._replace(weight=weight), CLOCK)
    critic, actor = layers(state.critic), layers(state.actor)
    target = numpy_target(layers(state.target_actor), layers(state.target_critic), batch)
    last = lambda: (value(critic, batch.obs, batch.action)[5] - target[5]) ** 2 / BATCH  # noqa: E731
    tenth = [[0.1 * g for g in layer] for layer in gradient(critic, last)]
    assert_equal_layers(layers(after.critic_optimizer.mu), tenth, "critic", atol=1e-6)
    new = layers(after.critic)
    everyone = gradient(actor, lambda: -np.mean(value(new, batch.obs, act(actor, batch.obs))))
    tenth = [[0.1 * g for g in layer] for layer in everyone]
    assert_equal_layers(layers(after.actor_optimizer.mu), tenth, "actor", atol=1e-6)


def test_the_learning_rate_follows_its_schedule():
    """Adam's first step has the length of the rate: a quarter along a line to zero it is 3/4 of that at the start."""
    algorithm = make(learning_rate=rejeu.Linear(1e-2, 0.0))
    update, state = jax.jit(algorithm.update), jax.jit(algorithm.init)(jax.random.PRNGKey(1))
    steps = {"actor": [], "critic": []}
    for progress in (0.0, 0.25):
        after, _ = update(state, random_batch(), CLOCK._replace(progress=np.float32(progress)))
        for name, seen in steps.items():
            seen.append(np.asarray(getattr(after, name).head.bias - getattr(state, name).head.bias))
    for first, later in steps.values():
        np.testing.assert_allclose(np.abs(first), 1e-2, rtol=1e-3)
        np.testing.assert_allclose(later, 0.75 * first, rtol=1e-3)


# What is refused.


def test_an_observation_space_without_arrays_is_refused():
    with pytest.raises(TypeError, match="the observation space is Text"):
        ddpg.make(ddpg.Config(), gym.spaces.Text(3), ACTION_SPACE)


def test_noise_of_another_dimension_than_the_actions_is_refused():
    noise = rejeu.NormalActionNoise([0.0] * 3, [0.1] * 3)
    with pytest.raises(
        ValueError, match=r"action_noise has 3 dimensions and the actions have 2; try NormalActionNoise"
    ):
        rejeu.DDPG("MlpPolicy", Sampled(OBS_SPACE, ACTION_SPACE), action_noise=noise)
