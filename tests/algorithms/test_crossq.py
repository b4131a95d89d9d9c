"""CrossQ's losses against float64 NumPy, and when which network learns and which statistics move."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rejeu.algorithms import crossq
from rejeu.core.algorithm import TD_ERROR
from rejeu.demonstrations import with_targets
from rejeu.sb3.policy import BasePolicy
from tests.algorithms.batches import ACTION_DIM, BOX as ACTION_SPACE, CLOCK, OBS_SPACE, box_batch, noise_of
from tests.networks.test_batch_renorm import NumpyRenorm, numpy_torso
from tests.numpy_networks import squashed_sample
from tests.tiers import only

BATCH, N_CRITICS = 6, 2
SMALL = {"learning_rate": 1e-2, "policy_kwargs": {"net_arch": [5, 4]}}


@functools.cache
def make(**settings):
    algorithm = crossq.make(crossq.Config(**{**SMALL, **settings}), OBS_SPACE, ACTION_SPACE)
    return jax.jit(algorithm.update), jax.jit(algorithm.init)(jax.random.PRNGKey(1))


clipped = functools.partial(crossq.squashed, log_std=crossq.clipped)
actor_loss = jax.jit(functools.partial(crossq.actor_loss, policy=clipped))


def random_batch(seed=0):
    batch = box_batch(seed, BATCH)
    return batch._replace(next_obs=1 + batch.next_obs)


# An independent CrossQ in float64.


def numpy_output(network, x, method):
    """Of one network for inputs ``(batch, n)``; and its renormalisations, which training has moved."""
    norms = [NumpyRenorm(norm) for norm in network.torso.norms]
    hidden = numpy_torso(network.torso, norms, x, method)
    return hidden @ np.float64(network.head.weight) + np.float64(network.head.bias), norms


def one_of(critics, index):
    return jax.tree.map(lambda leaf: leaf[index], critics)


def numpy_action(outputs, key):
    return squashed_sample(outputs, noise_of(key, BATCH))


def numpy_joint_values(critics, batch, next_action):
    """One pass of 2 * batch rows through each critic: ``(n_critics, 2 * batch)``."""
    now = np.concatenate([batch.obs, batch.action], axis=1)
    then = np.concatenate([batch.next_obs, next_action], axis=1)
    rows = np.concatenate([now, then], axis=0)
    return np.stack([numpy_output(one_of(critics, i), rows, "train")[0][:, 0] for i in range(N_CRITICS)])


def numpy_critics_loss(critics, batch, next_action, cost):
    values = numpy_joint_values(critics, batch, next_action)
    now, then = values[:, :BATCH], values[:, BATCH:]
    target = batch.reward + batch.discount * (then.min(axis=0) - cost)
    return sum(0.5 * np.mean(batch.weight * (value - target) ** 2) for value in now), now, target


def given_next(seed=5):
    rng = np.random.default_rng(seed)
    return np.tanh(rng.normal(size=(BATCH, ACTION_DIM))).astype(np.float32), rng.normal(size=BATCH).astype(np.float32)


@pytest.mark.parametrize("which", only([1], range(N_CRITICS)))
def test_the_critics_gradient_equals_finite_differences_with_the_target_held(which):
    """Through the batch statistics of both halves, but not through the target, in the weights that reach them all."""
    _, state = make()
    batch, (next_action, cost) = random_batch(), given_next()
    differentiate = jax.jit(jax.grad(crossq.critics_loss, has_aux=True))
    gradient, ((values, error), _) = differentiate(state.critics, batch, next_action, cost)
    target = (values - error)[0]
    critic = jax.tree.map(np.float64, one_of(state.critics, which))
    weight = critic.torso.layers[0].weight

    def loss():
        rows = np.concatenate([np.hstack([batch.obs, batch.action]), np.hstack([batch.next_obs, next_action])])
        values = numpy_output(critic, rows, "train")[0][:BATCH, 0]
        return 0.5 * np.mean((values - np.float64(target)) ** 2)

    expected = np.zeros_like(weight)
    for index in np.ndindex(weight.shape):
        kept = weight[index]
        ends = []
        for step in (1e-6, -1e-6):
            weight[index] = kept + step
            ends.append(loss())
        weight[index] = kept
        expected[index] = (ends[0] - ends[1]) / 2e-6
    np.testing.assert_allclose(gradient.torso.layers[0].weight[which], expected, atol=1e-4)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_actor_goes_by_its_batch_and_the_critics_by_their_running_statistics():
    update, state = make(policy_delay=3)
    for seed in range(3):
        with jax.numpy_dtype_promotion("standard"):
            state, _ = update(state, random_batch(seed), CLOCK)
    batch, key = random_batch(9), jax.random.PRNGKey(7)
    loss, (log_prob, trained) = actor_loss(state.actor, state.critics, jnp.float32(0.3), batch.obs, key, batch.obs)
    outputs, norms = numpy_output(state.actor, batch.obs, "train")
    action, expected = numpy_action(outputs, key)
    rows = np.hstack([batch.obs, action])
    values = np.stack([numpy_output(one_of(state.critics, i), rows, "infer")[0][:, 0] for i in range(N_CRITICS)])
    np.testing.assert_allclose(log_prob, expected, atol=1e-4)
    assert float(loss) == pytest.approx(np.mean(0.3 * expected - values.min(axis=0)), abs=1e-4)
    for given, wanted in zip(trained.torso.norms, norms, strict=True):
        np.testing.assert_allclose(given.mean, wanted.mean, atol=1e-6)


def test_an_update_uses_the_mathematics_above_in_the_documented_order():
    """Metrics of the first update from the keys it derives; with policy_delay=1 the actor follows the critics' step."""
    update, state = make(policy_delay=1, ent_coef="auto_0.3")
    batch = random_batch()._replace(weight=np.linspace(0.1, 1.0, BATCH, dtype=np.float32))
    target_key, actor_key = jax.random.split(jax.random.fold_in(state.key, 0))
    after, metrics = update(state, batch, CLOCK)
    next_action, next_log_prob = numpy_action(numpy_output(state.actor, batch.next_obs, "infer")[0], target_key)
    cost = 0.3 * next_log_prob
    loss, values, target = numpy_critics_loss(state.critics, batch, next_action, cost)
    assert float(metrics["critic_loss"]) == pytest.approx(loss, abs=1e-4)
    assert float(metrics["q_value"]) == pytest.approx(values.mean(), abs=1e-4)
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(values - target).mean(axis=0), atol=1e-4)
    action, log_prob = numpy_action(numpy_output(state.actor, batch.obs, "train")[0], actor_key)
    rows = np.hstack([batch.obs, action])
    judged = [numpy_output(one_of(after.critics, i), rows, "infer")[0][:, 0] for i in range(N_CRITICS)]
    assert float(metrics["actor_loss"]) == pytest.approx(np.mean(0.3 * log_prob - np.min(judged, axis=0)), abs=1e-4)
    assert float(metrics["entropy"]) == pytest.approx(-log_prob.mean(), abs=1e-4)
    loss_of = lambda critics: crossq.critics_loss(critics, batch, jnp.float32(next_action), jnp.float32(cost))[0]  # noqa: E731
    np.testing.assert_allclose(
        after.critics_optimizer.mu.head.bias, 0.5 * jax.jit(jax.grad(loss_of))(state.critics).head.bias, atol=1e-5
    )
    # From 0, one batch moves the mean of the input to a hundredth of the batch's, whatever the learning rate.
    np.testing.assert_allclose(after.actor.torso.norms[0].mean, 0.01 * batch.obs.mean(axis=0), atol=1e-6)
    both = np.concatenate([np.hstack([batch.obs, batch.action]), np.hstack([batch.next_obs, next_action])])
    np.testing.assert_allclose(after.critics.torso.norms[0].mean, [0.01 * both.mean(axis=0)] * N_CRITICS, atol=1e-6)


def test_actor_and_temperature_learn_every_policy_delay_th_update_and_the_critics_at_each():
    update, state = make(policy_delay=3)
    moved = {"actor": [], "log_alpha": [], "critics": []}
    for seed in range(6):
        before, (state, _) = state, update(state, random_batch(seed), CLOCK)
        for name, parts in moved.items():
            old, new = getattr(before, name), getattr(state, name)
            weight = (lambda part: part) if name == "log_alpha" else (lambda part: part.head.weight)
            parts.append(bool((weight(old) != weight(new)).any()))
    assert moved["critics"] == [True] * 6
    assert moved["actor"] == moved["log_alpha"] == [False, False, True, False, False, True]
    assert int(state.n_updates) == 6


def test_running_statistics_move_only_with_the_loss_of_their_own_network():
    """Once per update for the critics and once per actor step for the actor, whoever else passes through them."""
    update, state = make(policy_delay=3)
    for seed in range(7):
        state, _ = update(state, random_batch(seed), CLOCK)
    for norm in state.critics.torso.norms:
        np.testing.assert_array_equal(norm.n_batches, [7.0] * N_CRITICS)
    for norm in state.actor.torso.norms:
        assert float(norm.n_batches) == 2.0


def test_a_skipped_actor_step_is_a_branch_that_is_not_taken():
    """All products of the actor's loss stand inside a cond, so that a scan does not compute them when they are not due."""
    algorithm = crossq.make(crossq.Config(**SMALL), OBS_SPACE, ACTION_SPACE)
    state = jax.eval_shape(algorithm.init, jax.random.PRNGKey(0))
    jaxpr = jax.make_jaxpr(algorithm.update)(state, random_batch(), CLOCK).jaxpr
    conds = [equation for equation in jaxpr.eqns if equation.primitive.name == "cond"]
    products = [[str(branch).count("dot_general") for branch in cond.params["branches"]] for cond in conds]
    assert len(products) == 1
    assert min(products[0]) == 0
    # forward and backward through the actor (2 layers and a head) and the critics
    assert max(products[0]) >= 2 * (3 + 3)


def test_a_policy_acts_on_each_observation_by_itself():
    _, state = make()
    algorithm = crossq.make(crossq.Config(**SMALL), OBS_SPACE, ACTION_SPACE)
    obs = random_batch().obs
    np.testing.assert_allclose(
        algorithm.exploit(state.actor, obs)[:1], algorithm.exploit(state.actor, obs[:1]), atol=1e-6
    )


def test_a_state_without_target_critics_stays_without():
    _, state = make()
    assert state.target_critics is None
    assert jax.tree.structure(with_targets(state)) == jax.tree.structure(state)
    learner, spaces = SimpleNamespace(shapes=state), {"observation_space": OBS_SPACE, "action_space": ACTION_SPACE}
    policy = BasePolicy.of(SimpleNamespace(learner=learner, **spaces))
    assert policy.critic is not None
    with pytest.raises(AttributeError, match="critic_target"):
        _ = policy.critic_target
