"""TD3's losses and whole updates against float64 NumPy, the delay of its actor, its settings and what it refuses."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms import td3
from rejeu.core import TD_ERROR
from tests.algorithms.batches import ACTION_DIM, BOX as ACTION_SPACE, CLOCK, OBS_SPACE, box_batch, noise_of
from tests.numpy_networks import (
    Adam,
    action_value as value,
    assert_equal_layers,
    ensemble,
    follow,
    forward,
    largest_difference,
    layers,
)

BATCH, N_CRITICS = 6, 3
RATE, TAU, DELAY, SIGMA, CLIP = 1e-2, 0.25, 2, 0.6, 0.5

smoothed_action = jax.jit(td3.smoothed_action, static_argnums=(3, 4))
td_target, critics_loss = jax.jit(td3.td_target), jax.jit(td3.critics_loss)


def make(**settings):
    settings = {
        "policy_kwargs": {"net_arch": [5, 4]},
        "learning_rate": RATE,
        "tau": TAU,
        "policy_delay": DELAY,
        "target_policy_noise": SIGMA,
        "target_noise_clip": CLIP,
        "n_critics": N_CRITICS,
        **settings,
    }
    return td3.make(td3.Config(**settings), OBS_SPACE, ACTION_SPACE)


@pytest.fixture(scope="module")
def learner():
    """The compiled update of one TD3 and the state that it starts from, its targets drawn apart from its networks.

    The target actor's last layer is ten times as large, so that its actions reach their bounds.
    """
    algorithm = make()
    init = jax.jit(algorithm.init)
    state, other = init(jax.random.PRNGKey(1)), init(jax.random.PRNGKey(2))
    bold = eqx.tree_at(lambda actor: actor.head.weight, other.actor, 10.0 * other.actor.head.weight)
    state = eqx.tree_at(lambda s: (s.target_actor, s.target_critics), state, (bold, other.critics))
    return jax.jit(algorithm.update), state


def random_batch(seed=0):
    return box_batch(seed, BATCH)


# An independent TD3 in float64.


def act(actor, obs):
    return np.tanh(forward(actor, obs))


def numpy_smoothed_action(target_actor, next_obs, noise):
    kick = np.minimum(np.maximum(SIGMA * noise, -CLIP), CLIP)
    return np.minimum(np.maximum(act(target_actor, next_obs) + kick, -1.0), 1.0)


def numpy_target(target_actor, target_critics, batch, noise):
    action = numpy_smoothed_action(target_actor, batch.next_obs, noise)
    values = [value(critic, batch.next_obs, action) for critic in target_critics]
    return [r + d * min(v) for r, d, v in zip(batch.reward, batch.discount, np.transpose(values), strict=True)]


class ByHand:
    """The algorithm as its docstring has it, counting its updates from 1."""

    def __init__(self, state):
        self.actor, self.critics = layers(state.actor), ensemble(state.critics)
        self.target_actor, self.target_critics = layers(state.target_actor), ensemble(state.target_critics)
        self.actor_adam, self.critic_adams = Adam(self.actor, RATE), [Adam(critic, RATE) for critic in self.critics]
        self.key, self.n = state.key, 0

    def update(self, batch):
        noise = noise_of(jax.random.fold_in(self.key, self.n), BATCH)
        target = numpy_target(self.target_actor, self.target_critics, batch, noise)
        for critic, adam in zip(self.critics, self.critic_adams, strict=True):
            adam.descend(lambda critic=critic: np.mean((value(critic, batch.obs, batch.action) - target) ** 2))
        self.n += 1
        if self.n % DELAY == 0:
            self.actor_adam.descend(lambda: -np.mean(value(self.critics[0], batch.obs, act(self.actor, batch.obs))))
            follow(self.target_actor, self.actor, TAU)
            for target_critic, critic in zip(self.target_critics, self.critics, strict=True):
                follow(target_critic, critic, TAU)


# Targets and losses.


@pytest.mark.usefixtures("strict_dtypes")
def test_the_targets_action_has_clipped_noise_and_is_clipped_itself(learner):
    _, state = learner
    batch, key = random_batch(), jax.random.PRNGKey(5)
    given = smoothed_action(state.target_actor, batch.next_obs, key, SIGMA, CLIP)
    noise, plain = noise_of(key, BATCH), act(layers(state.target_actor), batch.next_obs)
    assert (np.abs(SIGMA * noise) > CLIP).any(), "some noise is clipped"
    assert (np.abs(plain + np.clip(SIGMA * noise, -CLIP, CLIP)) > 1.0).any(), "some action is clipped"
    np.testing.assert_allclose(
        given, numpy_smoothed_action(layers(state.target_actor), batch.next_obs, noise), atol=1e-5
    )
    assert np.abs(given).max() == 1.0


def test_without_noise_the_targets_action_is_the_target_actors(learner):
    _, state = learner
    batch = random_batch()
    expected = act(layers(state.target_actor), batch.next_obs)
    for sigma, clip in ((0.0, CLIP), (SIGMA, 0.0)):
        given = smoothed_action(state.target_actor, batch.next_obs, jax.random.PRNGKey(5), sigma, clip)
        np.testing.assert_allclose(given, expected, atol=1e-6)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_target_bootstraps_from_the_smallest_critic(learner):
    _, state = learner
    batch = random_batch()
    action = np.tanh(np.random.default_rng(3).normal(size=(BATCH, ACTION_DIM))).astype(np.float32)
    values = np.array([value(critic, batch.next_obs, action) for critic in ensemble(state.target_critics)])
    assert len(set(values.argmin(axis=0))) > 1, "no critic is the smallest everywhere"
    expected = [batch.reward[i] + batch.discount[i] * min(values[:, i]) for i in range(BATCH)]
    np.testing.assert_allclose(td_target(state.target_critics, batch, action), expected, atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_target_is_the_reward_where_the_mdp_terminated(learner):
    _, state = learner
    batch = random_batch()._replace(discount=np.zeros(BATCH, np.float32))
    np.testing.assert_array_equal(td_target(state.target_critics, batch, batch.action), batch.reward)


@pytest.mark.parametrize("weights", [None, np.linspace(0.1, 1.0, BATCH, dtype=np.float32)])
@pytest.mark.usefixtures("strict_dtypes")
def test_the_critics_losses_are_summed_mean_squared_errors_times_importance_weights(learner, weights):
    _, state = learner
    batch, target = random_batch()._replace(weight=weights), np.linspace(-2.0, 2.0, BATCH, dtype=np.float32)
    loss, values = critics_loss(state.critics, batch, target)
    expected = np.array([value(critic, batch.obs, batch.action) for critic in ensemble(state.critics)])
    np.testing.assert_allclose(values, expected, atol=1e-5)
    squares = (expected - target) ** 2 * (1.0 if weights is None else weights)
    assert float(loss) == pytest.approx(sum(row.mean() for row in squares), abs=1e-5)


def test_training_and_deterministic_actions_are_those_of_the_actor(learner):
    _, state = learner
    algorithm, obs = make(), random_batch().obs
    expected = act(layers(state.actor), obs)
    explored = algorithm.explore(algorithm.actor(state), obs, jax.random.PRNGKey(0), CLOCK)
    np.testing.assert_allclose(explored, expected, atol=1e-6)
    np.testing.assert_allclose(algorithm.exploit(algorithm.actor(state), obs), expected, atol=1e-6)


# Whole updates.


def test_four_updates_equal_numpy(learner):
    update, state = learner
    by_hand = ByHand(state)
    for k in range(4):
        state, _ = update(state, random_batch(k), CLOCK)
        by_hand.update(random_batch(k))
        for name in ("actor", "target_actor"):
            assert_equal_layers(layers(getattr(state, name)), getattr(by_hand, name), f"{name} after {k + 1}")
        for name in ("critics", "target_critics"):
            for i, (given, expected) in enumerate(
                zip(ensemble(getattr(state, name)), getattr(by_hand, name), strict=True)
            ):
                assert_equal_layers(given, expected, f"{name}[{i}] after {k + 1}")
        pairs = [(layers(state.actor_optimizer.mu), by_hand.actor_adam)]
        pairs += zip(ensemble(state.critics_optimizer.mu), by_hand.critic_adams, strict=True)
        for given, adam in pairs:
            assert_equal_layers(given, adam.first, f"first moments after {k + 1}", atol=1e-6, rtol=1e-4)
    assert int(state.n_updates) == 4


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_the_actor_and_all_targets_change_exactly_at_every_policy_delay_th_update(delay, learner):
    """Stable-Baselines3 0.11.0 fixed an off-by-one here: nothing may move before the delay is over, all of it then."""
    update = learner[0] if delay == DELAY else jax.jit(make(policy_delay=delay).update)
    state = learner[1]
    moved = {name: [] for name in ("critics", "actor", "target_actor", "target_critics", "actor_optimizer")}
    for k in range(6):
        after, _ = update(state, random_batch(k), CLOCK)
        for name, seen in moved.items():
            before, now = (jax.tree.leaves(getattr(s, name)) for s in (state, after))
            seen.append(any((np.asarray(b) != np.asarray(n)).any() for b, n in zip(before, now, strict=True)))
        state = after
    assert moved.pop("critics") == [True] * 6
    expected = [n % delay == 0 for n in range(1, 7)]
    assert moved == dict.fromkeys(moved, expected)


def test_the_actor_climbs_the_first_critic_as_it_is_after_its_step(learner):
    update, state = learner
    before, _ = update(state, random_batch(0), CLOCK)
    batch = random_batch(1)
    after, metrics = update(before, batch, CLOCK)
    own = act(layers(before.actor), batch.obs)
    losses = [-value(critic, batch.obs, own).mean() for critic in ensemble(after.critics)]
    assert float(metrics["actor_loss"]) == pytest.approx(losses[0], abs=1e-5)
    old = -value(layers(before.critics, 0), batch.obs, own).mean()
    assert min(abs(losses[0] - other) for other in (*losses[1:], old, -np.min(losses))) > 1e-3


def test_the_actors_loss_is_reported_until_its_next_step(learner):
    update, state = learner
    reported = []
    for k in range(4):
        state, metrics = update(state, random_batch(k), CLOCK)
        reported.append(float(metrics["actor_loss"]))
    assert reported[0] == 0.0
    assert reported[1] == reported[2] != reported[3]


def test_targets_move_by_tau_towards_the_new_networks(learner):
    update, state = learner
    before, _ = update(state, random_batch(0), CLOCK)
    after, _ = update(before, random_batch(1), CLOCK)
    parts = [(layers(before.target_actor), layers(after.actor), layers(after.target_actor))]
    parts += zip(*map(ensemble, (before.target_critics, after.critics, after.target_critics)), strict=True)
    for target, new, given in parts:
        follow(target, new, TAU)
        assert_equal_layers(given, target, "target", atol=1e-6)
    assert largest_difference(layers(before.actor), layers(after.actor)) > 1e-3


def test_the_metrics_are_of_the_networks_before_the_update(learner):
    update, state = learner
    batch = random_batch()
    _, metrics = update(state, batch, CLOCK)
    noise = noise_of(jax.random.fold_in(state.key, 0), BATCH)
    target = numpy_target(layers(state.target_actor), ensemble(state.target_critics), batch, noise)
    values = np.array([value(critic, batch.obs, batch.action) for critic in ensemble(state.critics)])
    errors = values - target
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(errors).mean(axis=0), atol=1e-5)
    assert float(metrics["critic_loss"]) == pytest.approx(np.mean(errors**2, axis=1).sum(), abs=1e-5)
    assert float(metrics["q_value"]) == pytest.approx(values.mean(), abs=1e-5)


def test_each_update_draws_other_noise(learner):
    """The same batch and networks, a number of updates apart: nothing but the noise can change the target."""
    update, state = learner
    later = eqx.tree_at(lambda s: s.n_updates, state, jnp.int32(DELAY))
    losses = [float(update(s, random_batch(), CLOCK)[1]["critic_loss"]) for s in (state, later)]
    assert losses[0] != losses[1]
