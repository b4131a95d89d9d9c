"""SAC's losses against float64 NumPy, and whole updates against recorded ones of Stable-Baselines3."""

from __future__ import annotations

import functools
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import sac
from rejeu.core import TD_ERROR, Transition
from rejeu.io.checkpoint import tree_to_arrays
from tests.algorithms.batches import ACTION_DIM, BOX as ACTION_SPACE, CLOCK, OBS_DIM, OBS_SPACE, box_batch, noise_of
from tests.environments import Sampled
from tests.numpy_networks import action_value, ensemble, forward, layers, squashed_sample

GOLDEN = Path(__file__).parents[1] / "golden" / "sac_sb3.npz"
BATCH = 8


@functools.cache
def make(**settings):
    config = sac.Config(**{"policy_kwargs": {"net_arch": [5, 4]}, **settings})
    algorithm = sac.make(config, OBS_SPACE, ACTION_SPACE)
    return algorithm, algorithm.init(jax.random.PRNGKey(1))


def random_batch(seed=0):
    return box_batch(seed, BATCH)


# An independent SAC in float64, from plain arrays.


def numpy_sample(actor, obs, noise):
    return squashed_sample(forward(layers(actor), obs), noise)


def numpy_values(critics, obs, action):
    return np.stack([action_value(critic, obs, action) for critic in ensemble(critics)])


def numpy_target(state, batch, alpha, key):
    action, log_prob = numpy_sample(state.actor, batch.next_obs, noise_of(key, BATCH))
    value = numpy_values(state.target_critics, batch.next_obs, action).min(axis=0)
    return batch.reward + batch.discount * (value - alpha * log_prob)


@pytest.mark.usefixtures("strict_dtypes")
def test_td_target_equals_numpy():
    _, state = make()
    batch, key = random_batch(), jax.random.PRNGKey(7)
    given = sac.td_target(state.actor, state.target_critics, jnp.float32(0.3), batch, key)
    np.testing.assert_allclose(given, numpy_target(state, batch, 0.3, key), atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_td_target_is_the_reward_where_the_mdp_terminated():
    _, state = make()
    batch = random_batch()._replace(discount=np.zeros(BATCH, np.float32))
    given = sac.td_target(state.actor, state.target_critics, jnp.float32(0.3), batch, jax.random.PRNGKey(0))
    np.testing.assert_array_equal(given, batch.reward)


@pytest.mark.usefixtures("strict_dtypes")
def test_critics_loss_equals_numpy():
    _, state = make()
    batch, target = random_batch(), np.linspace(-2.0, 2.0, BATCH, dtype=np.float32)
    loss, values = sac.critics_loss(state.critics, batch, jnp.array(target))
    expected = numpy_values(state.critics, batch.obs, batch.action)
    np.testing.assert_allclose(values, expected, atol=1e-5)
    halves = [0.5 * np.mean((value - target) ** 2) for value in expected]
    assert float(loss) == pytest.approx(sum(halves), abs=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_importance_weights_multiply_each_squared_error():
    _, state = make()
    target, weight = np.linspace(-2.0, 2.0, BATCH, dtype=np.float32), np.linspace(0.1, 1.0, BATCH, dtype=np.float32)
    batch = random_batch()._replace(weight=weight)
    loss, _ = sac.critics_loss(state.critics, batch, jnp.array(target))
    values = numpy_values(state.critics, batch.obs, batch.action)
    assert float(loss) == pytest.approx((0.5 * weight * (values - target) ** 2).mean(axis=1).sum(), abs=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_actor_loss_equals_numpy():
    _, state = make()
    batch, key = random_batch(), jax.random.PRNGKey(7)
    loss, log_prob = sac.actor_loss(state.actor, state.critics, jnp.float32(0.3), batch.obs, key)
    action, expected_log_prob = numpy_sample(state.actor, batch.obs, noise_of(key, BATCH))
    value = numpy_values(state.critics, batch.obs, action).min(axis=0)
    np.testing.assert_allclose(log_prob, expected_log_prob, atol=1e-5)
    assert float(loss) == pytest.approx(np.mean(0.3 * expected_log_prob - value), abs=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_temperature_loss_equals_its_formula():
    log_prob = np.array([-1.0, 0.5, 3.0], np.float32)
    loss = sac.temperature_loss(jnp.float32(-0.7), jnp.array(log_prob), -2.0)
    # -(-0.7) * mean(-3, -1.5, 1) = 0.7 * (-3.5 / 3)
    assert float(loss) == pytest.approx(0.7 * -3.5 / 3, abs=1e-6)


@pytest.mark.parametrize(("log_prob", "direction"), [(5.0, 1.0), (-5.0, -1.0)])
def test_temperature_rises_exactly_while_entropy_is_below_its_target(log_prob, direction):
    """Entropy is -log_prob; with the target -2, log_prob 5 is too little of it and -5 too much."""
    gradient = jax.grad(sac.temperature_loss)(jnp.float32(0.0), jnp.full(4, log_prob, jnp.float32), -2.0)
    assert np.sign(-float(gradient)) == direction


def test_actor_gradient_equals_finite_differences():
    """Central differences of the float64 NumPy loss, for every number of the actor."""
    _, state = make()
    batch, key, alpha, eps = random_batch(), jax.random.PRNGKey(7), 0.3, 1e-6
    noise = noise_of(key, BATCH)
    gradient = jax.grad(sac.actor_loss, has_aux=True)(state.actor, state.critics, jnp.float32(alpha), batch.obs, key)[0]
    flat, tree = jax.tree.flatten(jax.tree.map(np.float64, state.actor))

    def loss(leaves):
        actor = jax.tree.unflatten(tree, leaves)
        action, log_prob = numpy_sample(actor, batch.obs, noise)
        return np.mean(alpha * log_prob - numpy_values(state.critics, batch.obs, action).min(axis=0))

    for position, given in enumerate(jax.tree.leaves(gradient)):
        expected = np.zeros_like(flat[position])
        for index in np.ndindex(expected.shape):
            ends = []
            for sign in (1, -1):
                moved = [leaf.copy() for leaf in flat]
                moved[position][index] += sign * eps
                ends.append(loss(moved))
            expected[index] = (ends[0] - ends[1]) / (2 * eps)
        np.testing.assert_allclose(given, expected, atol=1e-5)


def test_an_update_uses_the_mathematics_above_in_the_documented_order():
    """Metrics of one update, from the keys that it derives: the target precedes the critics' step, the policy follows."""
    algorithm, state = make(learning_rate=1e-2, gamma=0.9, ent_coef="auto_0.3")
    batch = random_batch()
    target_key, actor_key = jax.random.split(jax.random.fold_in(state.key, 0))
    after, metrics = algorithm.update(state, batch, CLOCK)
    values = numpy_values(state.critics, batch.obs, batch.action)
    target = numpy_target(state, batch, 0.3, target_key)
    action, log_prob = numpy_sample(state.actor, batch.obs, noise_of(actor_key, BATCH))
    value = numpy_values(after.critics, batch.obs, action).min(axis=0)
    expected = {
        "critic_loss": 0.5 * ((values - target) ** 2).mean(axis=1).sum(),
        "actor_loss": np.mean(0.3 * log_prob - value),
        "ent_coef": 0.3,
        "ent_coef_loss": -(np.log(0.3) * (log_prob - ACTION_DIM)).mean(),
        "entropy": -log_prob.mean(),
        "q_value": values.mean(),
    }
    np.testing.assert_allclose(metrics.pop(TD_ERROR), np.abs(values - target).mean(axis=0), atol=1e-5)
    assert {key: float(value) for key, value in metrics.items()} == pytest.approx(expected, abs=1e-5)


# Whole updates, against Stable-Baselines3 (tests/golden/record_sac.py).


def from_sb3(record, prefix):
    """A recorded set of torch parameters under our names: weights transposed, critics stacked, mean and log_std joined.

    With ``prefix`` "exp_avg." and the like it takes Adam's moments, which have the same names.
    """
    found = {}
    for i, torch_name in enumerate(["latent_pi.0", "latent_pi.2"]):
        found[f"actor.torso.layers.{i}.weight"] = record[f"{prefix}actor.{torch_name}.weight"].T
        found[f"actor.torso.layers.{i}.bias"] = record[f"{prefix}actor.{torch_name}.bias"]
    for kind in ("weight", "bias"):
        both = [record[f"{prefix}actor.{head}.{kind}"] for head in ("mu", "log_std")]
        found[f"actor.head.{kind}"] = np.concatenate(both).T
    for ours, theirs in (("critics", "critic"), ("target_critics", "critic_target")):
        if f"{prefix}{theirs}.qf0.0.weight" in record:
            for name, torch_index in (("torso.layers.0", 0), ("torso.layers.1", 2), ("head", 4)):
                for kind in ("weight", "bias"):
                    pair = [record[f"{prefix}{theirs}.qf{i}.{torch_index}.{kind}"].T for i in (0, 1)]
                    found[f"{ours}.{name}.{kind}"] = np.stack(pair)
    found["log_alpha"] = record[f"{prefix}log_ent_coef"][0]
    return found


def moments_from_sb3(record, prefix):
    found = {}
    for ours, theirs in (("mu", "exp_avg"), ("nu", "exp_avg_sq")):
        for name, value in from_sb3(record, f"{prefix}{theirs}.").items():
            part, _, rest = name.partition(".")
            found[f"alpha_optimizer.{ours}" if part == "log_alpha" else f"{part}_optimizer.{ours}.{rest}"] = value
    return found


@pytest.fixture(scope="module")
def record():
    with np.load(GOLDEN, allow_pickle=False) as file:
        return dict(file)


@pytest.fixture
def replayed(record, monkeypatch):
    """Our states and metrics after each recorded update, from the recorded parameters, batches and noise."""
    agent = rejeu.SAC(
        "MlpPolicy",
        Sampled(OBS_SPACE, ACTION_SPACE),
        learning_rate=1e-2,
        gamma=0.9,
        tau=0.1,
        ent_coef="auto_0.3",
        policy_kwargs={"net_arch": [5, 4]},
        seed=0,
    )
    agent.set_parameters(from_sb3(record, "before."), exact_match=False)
    algorithm = sac.make(agent.config, OBS_SPACE, ACTION_SPACE)
    states, metrics, state = [], [], agent.state
    for k in range(3):
        # The target is computed before the policy loss, hence the order; nothing is jitted, so each is called once.
        noises = iter([record[f"{k}.target_noise"], record[f"{k}.actor_noise"]])
        monkeypatch.setattr(jax.random, "normal", lambda key, shape, dtype, noises=noises: jnp.array(next(noises)))
        discount = np.where(record[f"{k}.terminated"], 0.0, 0.9).astype(np.float32)
        batch = Transition(*(record[f"{k}.{name}"] for name in ("obs", "action", "reward", "next_obs")), discount)
        state, metric = algorithm.update(state, batch, CLOCK)
        assert next(noises, None) is None
        states.append(state)
        metrics.append(metric)
    return states, metrics


def test_recorded_actions_are_not_saturated(record):
    """Stable-Baselines3 adds 1e-6 within its log(1 - a^2): less than 3e-6 a dimension where 1 - a^2 > 0.4."""
    parameters = from_sb3(record, "before.")
    weights = [
        (np.float64(parameters[f"actor.{name}.weight"]), np.float64(parameters[f"actor.{name}.bias"]))
        for name in ("torso.layers.0", "torso.layers.1", "head")
    ]
    mean, log_std = np.split(forward(weights, record["0.obs"]), 2, axis=1)
    assert (np.tanh(mean + np.exp(log_std) * record["0.actor_noise"]) ** 2 < 0.6).all()


@pytest.mark.parametrize("k", [0, 2])
def test_parameters_after_an_update_equal_stable_baselines3(record, replayed, k):
    given, expected = tree_to_arrays(replayed[0][k]), from_sb3(record, f"{k}.after.")
    assert {name for name in given if "optimizer" not in name} == {*expected, "key", "n_updates"}
    for name, value in expected.items():
        np.testing.assert_allclose(given[name], value, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("k", [0, 2])
def test_adam_moments_after_an_update_equal_stable_baselines3(record, replayed, k):
    given, expected = tree_to_arrays(replayed[0][k]), moments_from_sb3(record, f"{k}.after.")
    assert {name for name in given if "optimizer" in name and not name.endswith("count")} == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(given[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


def test_updates_move_every_network_by_more_than_the_tolerance(record):
    """Guards the two tests above: an update that did nothing must not pass them."""
    before, after = from_sb3(record, "before."), from_sb3(record, "0.after.")
    for part in ("actor.", "critics.", "target_critics.", "log_alpha"):
        moved = max(np.abs(after[name] - before[name]).max() for name in before if name.startswith(part))
        assert moved > 1e-3, part


def test_losses_equal_stable_baselines3(record, replayed):
    for k, metrics in enumerate(replayed[1]):
        for name in ("critic_loss", "actor_loss", "ent_coef"):
            assert float(metrics[name]) == pytest.approx(float(record[f"{k}.{name}"]), abs=1e-5), (k, name)


# What an update must and must not touch.


def test_a_fixed_temperature_does_not_move():
    algorithm, state = make(ent_coef=0.2)
    after, metrics = algorithm.update(state, random_batch(), CLOCK)
    assert float(metrics["ent_coef"]) == pytest.approx(0.2)
    assert float(after.log_alpha) == float(state.log_alpha)


def test_targets_move_by_tau_towards_the_new_critics():
    algorithm, state = make(tau=0.25)
    after, _ = algorithm.update(state, random_batch(), CLOCK)
    expected = jax.tree.map(lambda t, c: 0.75 * t + 0.25 * c, state.target_critics, after.critics)
    jax.tree.map(lambda given, e: np.testing.assert_allclose(given, e, atol=1e-6), after.target_critics, expected)


def test_targets_move_only_every_target_update_interval():
    algorithm, state = make(target_update_interval=3, learning_rate=0.1)
    update = jax.jit(algorithm.update)
    moved = []
    for _ in range(6):
        before = state.target_critics.head.weight
        state, _ = update(state, random_batch(), CLOCK)
        moved.append(bool((state.target_critics.head.weight != before).any()))
    assert moved == [False, False, True, False, False, True]


def test_the_learning_rate_follows_its_schedule():
    """Adam's first step has the length of the rate: halfway along a line to zero it is half the step of the start."""
    algorithm, state = make(learning_rate=rejeu.Linear(1e-2, 0.0))
    steps = []
    for progress in (0.0, 0.5):
        after, _ = algorithm.update(state, random_batch(), CLOCK._replace(progress=np.float32(progress)))
        steps.append(np.asarray(after.critics.head.bias - state.critics.head.bias))
    np.testing.assert_allclose(steps[1], steps[0] / 2, rtol=1e-3)
    assert (np.abs(steps[0]) > 1e-3).all()


def test_each_update_draws_other_noise():
    algorithm, state = make(learning_rate=0.0)
    first, one = algorithm.update(state, random_batch(), CLOCK)
    _, two = algorithm.update(first, random_batch(), CLOCK)
    assert float(one["entropy"]) != float(two["entropy"])


def test_log_std_is_clipped_to_its_range():
    _, state = make()
    head = state.actor.head
    bias = jnp.array([0.0, 0.0, 100.0, -100.0])
    actor = eqx.tree_at(lambda a: (a.head.weight, a.head.bias), state.actor, (head.weight * 0, bias))
    np.testing.assert_array_equal(sac.policy(actor, jnp.zeros((1, OBS_DIM))).log_std, [[2.0, -20.0]])


@pytest.mark.parametrize(("ent_coef", "alpha"), [("auto", 1.0), ("auto_0.1", 0.1), (0.25, 0.25)])
def test_temperature_starts_where_ent_coef_says(ent_coef, alpha):
    assert float(jnp.exp(make(ent_coef=ent_coef)[1].log_alpha)) == pytest.approx(alpha)


@pytest.mark.parametrize(
    "ent_coef",
    ["automatic", "auto_x", "auto_-1", "auto_nan", "auto_inf", 0, -0.1, True, None, float("nan"), float("inf")],
)
def test_an_impossible_ent_coef_is_refused(ent_coef):
    with pytest.raises(ValueError, match=r"ent_coef=.*must be 'auto', 'auto_0.1' or a positive number"):
        sac.Config(ent_coef=ent_coef)


def test_target_entropy_is_minus_the_number_of_action_dimensions():
    """With the gradient of J_alpha = -mean(log_prob + target_entropy), Adam's first moment is a tenth of it."""
    algorithm, state = make()
    after, metrics = algorithm.update(state, random_batch(), CLOCK)
    expected = 0.1 * -(-float(metrics["entropy"]) - ACTION_DIM)
    assert float(after.alpha_optimizer.mu) == pytest.approx(expected, abs=1e-6)


def test_a_given_target_entropy_is_used():
    algorithm, state = make(target_entropy=-0.5)
    after, metrics = algorithm.update(state, random_batch(), CLOCK)
    assert float(after.alpha_optimizer.mu) == pytest.approx(0.1 * (float(metrics["entropy"]) + 0.5), abs=1e-6)
