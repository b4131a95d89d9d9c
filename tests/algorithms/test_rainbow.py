"""The parts of Rainbow and its successors: C51, Munchausen, noise and IQN, against loops in float64, together and learned."""

import functools
import itertools
import shutil
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import dqn, iqn, qrdqn
from rejeu.algorithms.quantile_loss import quantile_huber_loss
from rejeu.core.algorithm import TD_ERROR, Masked
from rejeu.export import c_file
from tests.algorithms.test_categorical import by_loops
from tests.algorithms.test_dqn import (
    ACTION_SPACE,
    BATCH,
    CLOCK,
    N_ACTIONS,
    OBS_SPACE,
    Chain,
    affine,
    dueling_parts,
    forward,
    learn_chain,
    random_batch,
)
from tests.tiers import exhaustive, only_tuples

pytestmark = pytest.mark.usefixtures("learners_are_shared")

ATOMS = np.linspace(-3.0, 5.0, 9)
C51 = {"distribution": "categorical", "v_min": -3.0, "v_max": 5.0, "n_atoms": 9}
IQN = {"n_quantiles": 5, "n_target_quantiles": 6, "n_policy_quantiles": 7, "n_cosines": 4}
EVERY = {"double_q": True, "dueling": True, "noisy": True, "munchausen_alpha": 0.9}
SMALL = {"policy_kwargs": {"net_arch": [5, 4]}}


def make(module: Any = dqn, seed: int = 1, **settings: Any):
    return made(module, seed, tuple(settings.items()))


@functools.cache
def made(module: Any, seed: int, settings: tuple[tuple[str, Any], ...]):
    algorithm = module.make(module.Config(**{**SMALL, **dict(settings)}), OBS_SPACE, ACTION_SPACE)
    return algorithm._replace(update=jax.jit(algorithm.update)), algorithm.init(jax.random.PRNGKey(seed))


def softmax(x: np.ndarray) -> np.ndarray:
    exponential = np.exp(np.float64(x) - np.max(x, axis=-1, keepdims=True))
    return exponential / exponential.sum(axis=-1, keepdims=True)


# C51.


def test_the_target_of_c51_is_the_projection_of_the_best_actions_distribution():
    _, state = make(**C51)
    batch = random_batch()
    returns = dqn.Config(**C51).returns
    given = dqn.td_target(state.network, state.target_network, batch, False, returns)
    probabilities = softmax(forward(state.network.outputs, batch.next_obs).reshape(BATCH, N_ACTIONS, 9))
    best = (probabilities @ ATOMS).argmax(axis=1)
    for i in range(BATCH):
        expected = by_loops(batch.reward[i] + batch.discount[i] * ATOMS, probabilities[i, best[i]])
        np.testing.assert_allclose(given[i], expected, atol=1e-5)


def test_the_loss_of_c51_is_the_cross_entropy_and_its_error_the_divergence():
    algorithm, state = make(**C51)
    batch = random_batch(weighted=True)
    target = softmax(np.random.default_rng(3).normal(size=(BATCH, 9))).astype(np.float32)
    loss, (error, value) = dqn.td_loss(state.network, batch, jnp.asarray(target), dqn.Config(**C51).returns)
    predicted = softmax(forward(state.network.outputs, batch.obs).reshape(BATCH, N_ACTIONS, 9))
    predicted = predicted[np.arange(BATCH), batch.action]
    crossed = -(target * np.log(predicted)).sum(axis=1)
    assert float(loss) == pytest.approx(np.mean(batch.weight * crossed), rel=1e-5)
    np.testing.assert_allclose(error, (target * np.log(target / predicted)).sum(axis=1), atol=1e-5)
    np.testing.assert_allclose(value, predicted @ ATOMS, atol=1e-5)
    values = algorithm.action_values(state, jnp.asarray(batch.obs), None)[0]
    np.testing.assert_allclose(np.asarray(values)[np.arange(BATCH), batch.action], predicted @ ATOMS, atol=1e-5)


def test_the_streams_of_a_distribution_are_joined_for_each_atom():
    _, state = make(dueling=True, **C51)
    obs = random_batch().obs
    value, advantage = dueling_parts(state.network.outputs, np.float64(obs))
    advantage = advantage.reshape(BATCH, N_ACTIONS, 9)
    expected = value[:, None] + advantage - advantage.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(state.network(obs), expected, atol=1e-5)


# Munchausen.


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("double_q", [False, True])
def test_the_munchausen_target_equals_loops(double_q, masked):
    settings = {"munchausen_alpha": 0.7, "munchausen_temperature": 0.3, "munchausen_clip": -0.4}
    (_, state), (_, other) = make(seed=1, double_q=double_q), make(seed=2)
    network, target_network, batch = state.network, other.network, random_batch()
    mask = np.random.default_rng(5).random((2, BATCH, N_ACTIONS)) < 0.6
    mask[0, np.arange(BATCH), batch.action] = mask[1, :, 0] = True
    mask = mask if masked else np.ones_like(mask)
    shown = batch._replace(obs=Masked(batch.obs, mask[0]), next_obs=Masked(batch.next_obs, mask[1]))
    returns = dqn.MEAN._replace(munchausen=dqn.Config(**settings).munchausen)
    given = dqn.td_target(network, target_network, shown if masked else batch, double_q, returns)
    policy_of = network if double_q else target_network
    own, chooser = forward(policy_of, batch.obs), forward(policy_of, batch.next_obs)
    theirs = forward(target_network, batch.next_obs)
    clipped = 0
    for i in range(BATCH):
        allowed = np.flatnonzero(mask[1, i])
        policy = softmax(chooser[i, allowed] / 0.3)
        soft = sum(p * (theirs[i, a] - 0.3 * np.log(p)) for p, a in zip(policy, allowed, strict=True))
        acted = softmax(own[i][mask[0, i]] / 0.3)[mask[0, i, : batch.action[i]].sum()]
        clipped += 0.3 * np.log(acted) < -0.4
        bonus = 0.7 * min(max(0.3 * np.log(acted), -0.4), 0.0)
        assert float(given[i]) == pytest.approx(batch.reward[i] + bonus + batch.discount[i] * soft, abs=1e-5)
    if not masked:
        assert 0 < clipped < BATCH


def test_munchausen_mixes_descriptions_of_the_return_by_the_policy():
    """Quantiles as M-IQN does: the mean over the policy of each, plus its entropy."""
    _, state = make(qrdqn, n_quantiles=3)
    batch = random_batch()
    settings = dqn.Munchausen(0.0, 0.5, -1.0)
    given = dqn.td_target(
        state.network, state.network, batch, False, qrdqn.quantile_returns(3)._replace(munchausen=settings)
    )
    quantiles = forward(state.network.outputs, batch.next_obs).reshape(BATCH, N_ACTIONS, 3)
    policy = softmax(quantiles.mean(axis=2) / 0.5)
    mixed = (policy[..., None] * (quantiles - 0.5 * np.log(policy)[..., None])).sum(axis=1)
    np.testing.assert_allclose(given, batch.reward[:, None] + batch.discount[:, None] * mixed, atol=1e-5)


@exhaustive
def test_munchausen_values_of_a_chain_are_those_of_its_own_iteration():
    """The fixed point of ``Q = r + alpha tau log pi + d sum pi (Q - tau log pi)``, ``pi = softmax(Q / tau)``, by iteration."""
    alpha, tau, chain = 0.5, 0.1, Chain()
    settings = {"munchausen_alpha": alpha, "munchausen_temperature": tau, "munchausen_clip": -10.0}
    config = dqn.Config(learning_rate=3e-3, target_update_interval=50, policy_kwargs={"net_arch": [32]}, **settings)
    state = learn_chain(dqn.make(config, chain.observation_space, chain.action_space), 4_000)
    values, (room, action, reward, following, discount, *_) = np.zeros((5, 2)), chain.transitions()
    for _ in range(500):
        log_policy = np.log(softmax(values / tau))
        soft = (np.exp(log_policy) * (values - tau * log_policy)).sum(axis=1)
        values[room, action] = reward + alpha * tau * log_policy[room, action] + discount * soft[following]
    np.testing.assert_allclose(state.network(np.arange(5, dtype=np.int32)), values, atol=0.02)


# IQN.


def implicit(network: Any, obs: np.ndarray, fractions: np.ndarray) -> np.ndarray:
    """The quantiles of one observation at some fractions, ``(n_actions, n)``, in float64."""
    features = np.float64(obs)
    for layer in network.torso.layers:
        features = np.maximum(affine(layer, features), 0.0)
    rows = []
    for tau in np.float64(fractions):
        cosines = np.cos(np.pi * np.arange(4) * tau)
        x = features * np.maximum(affine(network.embedding, cosines), 0.0)
        for layer in network.reader.torso.layers:
            x = np.maximum(affine(layer, x), 0.0)
        rows.append(affine(network.reader.head, x))
    return np.stack(rows, axis=1)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_network_of_iqn_equals_loops():
    algorithm, state = make(iqn, **IQN)
    obs, fractions = random_batch().obs, np.random.default_rng(0).random((BATCH, 6)).astype(np.float32)
    assert [layer.weight.shape for layer in state.network.reader.torso.layers] == [(5, 4)]
    given = state.network(jnp.asarray(obs), jnp.asarray(fractions))
    for i in range(BATCH):
        np.testing.assert_allclose(given[i], implicit(state.network, obs[i], fractions[i]), atol=1e-5)
    middle = (np.arange(7) + 0.5) / 7
    values = algorithm.action_values(state, jnp.asarray(obs), None)[0]
    for i in range(BATCH):
        np.testing.assert_allclose(values[i], implicit(state.network, obs[i], middle).mean(axis=1), atol=1e-5)


@pytest.mark.usefixtures("strict_dtypes")
def test_the_loss_at_any_fractions_equals_loops():
    rng = np.random.default_rng(0)
    current, target = rng.normal(size=(2, BATCH, 5)), 2.0 * rng.normal(size=(BATCH, 6))
    fractions = rng.random((BATCH, 5))
    f32 = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    expected, slope = np.zeros((2, BATCH)), np.zeros_like(current)
    for critic, i, j in itertools.product(range(2), range(BATCH), range(5)):
        for y in target[i]:
            u = y - current[critic, i, j]
            weight = abs(fractions[i, j] - (u < 0)) / 30
            expected[critic, i] += weight * (u * u / 2 if abs(u) <= 1 else abs(u) - 0.5)
            slope[critic, i, j] -= weight * np.clip(u, -1, 1)
    loss = lambda quantiles: quantile_huber_loss(quantiles, f32(target), fractions=f32(fractions))  # noqa: E731
    np.testing.assert_allclose(loss(f32(current)), expected, atol=1e-5)
    gradient = jax.grad(lambda quantiles: jnp.sum(loss(quantiles)))(f32(current))
    np.testing.assert_allclose(gradient, slope, atol=1e-5)


def test_a_target_of_iqn_has_the_quantiles_of_the_best_action():
    """At the fractions that its key determines; the best is that of the highest mean at fixed ones."""
    algorithm, state = make(iqn, **IQN)
    batch, key = random_batch(), jax.random.PRNGKey(7)
    returns = iqn.implicit_returns(5, 6, 7, 4)
    given = dqn.td_target(state.network, state.network, batch, False, returns, (None, key))
    fractions = np.asarray(jax.random.uniform(key, (BATCH, 6)))
    best = np.asarray(algorithm.action_values(state, jnp.asarray(batch.next_obs), None)[0]).argmax(axis=1)
    assert given.shape == (BATCH, 6)
    for i in range(BATCH):
        quantiles = implicit(state.network, batch.next_obs[i], fractions[i])[best[i]]
        np.testing.assert_allclose(given[i], batch.reward[i] + batch.discount[i] * quantiles, atol=1e-5)


def test_the_loss_of_iqn_is_at_the_fractions_of_its_predictions():
    _, state = make(iqn, **IQN)
    batch, key = random_batch(), jax.random.PRNGKey(3)
    target = np.random.default_rng(0).normal(size=(BATCH, 6))
    loss, _ = dqn.td_loss(state.network, batch, jnp.asarray(target, jnp.float32), iqn.implicit_returns(5, 6, 7, 4), key)
    fractions, expected = np.asarray(jax.random.uniform(key, (BATCH, 5))), 0.0
    for i in range(BATCH):
        current = implicit(state.network, batch.obs[i], fractions[i])[batch.action[i]]
        u = target[i][None] - current[:, None]
        huber = np.where(np.abs(u) <= 1, u * u / 2, np.abs(u) - 0.5)
        expected += (np.abs(fractions[i][:, None] - (u < 0)) * huber).mean(axis=1).sum() / BATCH
    assert float(loss) == pytest.approx(expected, rel=1e-5)


def test_iqn_draws_other_fractions_in_every_update():
    algorithm, state = make(iqn, **IQN)
    errors = [
        algorithm.update(state.__class__(**{**vars(state), "n_updates": jnp.int32(n)}), random_batch(), CLOCK)[1][
            TD_ERROR
        ]
        for n in (0, 0, 1)
    ]
    np.testing.assert_array_equal(errors[0], errors[1])
    assert (np.abs(errors[0] - errors[2]) > 1e-4).any()


# Noise.


def test_noise_acts_in_training_and_not_in_evaluation():
    algorithm, state = make(noisy=True)
    obs = jnp.zeros((1, 3))
    values = lambda key: dqn.with_noise(dqn.MEAN).values(state.network, obs, key)  # noqa: E731
    assert not np.allclose(values(jax.random.PRNGKey(0)), values(jax.random.PRNGKey(1)))
    np.testing.assert_allclose(algorithm.action_values(state, obs, None)[0], forward(state.network, obs), atol=1e-5)
    keys = jax.random.split(jax.random.PRNGKey(2), 200)
    explore = jax.jit(algorithm.explore)
    actions = {int(explore(state.network, obs, key, CLOCK)[0]) for key in keys}
    assert len(actions) > 1
    assert int(algorithm.exploit(state.network, obs)[0]) == int(forward(state.network, obs).argmax())
    assert dqn.Config(noisy=True).epsilon(0.0) == 0.0


def test_an_update_draws_noise_for_the_network_the_target_and_the_choice():
    """With the keys that the state and the number of updates determine."""
    algorithm, state = make(noisy=True, double_q=True)
    other = make(seed=2, noisy=True)[1].network
    state = state.__class__(**{**vars(state), "target_network": other})
    batch = random_batch()
    _, metrics = jax.jit(algorithm.update)(state, batch, CLOCK)
    key, chooser_key, target_key = jax.random.split(jax.random.fold_in(state.key, 0), 3)
    shown = lambda network, key, obs: forward(dqn.drawn(network, key), obs)  # noqa: E731
    best = shown(state.network, chooser_key, batch.next_obs).argmax(axis=1)
    theirs = shown(other, target_key, batch.next_obs)[np.arange(BATCH), best]
    value = shown(state.network, key, batch.obs)[np.arange(BATCH), batch.action]
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(value - batch.reward - batch.discount * theirs), atol=1e-4)


def test_noise_on_weights_of_two_kinds_is_refused():
    with pytest.raises(ValueError, match="noisy=True and action_noise"):
        dqn.Config(noisy=True, action_noise=rejeu.ParameterNoise())


# Together.

KINDS = {"DQN": (dqn, {}), "C51": (dqn, C51), "QRDQN": (qrdqn, {"n_quantiles": 5}), "IQN": (iqn, IQN)}


PARTS = [{}, {"noisy": True}, {"dueling": True, "double_q": True}]


@pytest.mark.parametrize(
    ("kind", "settings"),
    only_tuples([("C51", PARTS[2])], [(kind, part) for kind in KINDS for part in PARTS]),
)
def test_values_of_a_chain_are_learnt_by_every_kind(kind, settings):
    module, own = KINDS[kind]
    own = {**own, "v_min": -0.5, "v_max": 1.5, "n_atoms": 21} if kind == "C51" else own
    widths = [32]
    if kind == "IQN":  # whose hidden layers read features and fractions apart
        own, widths = {"n_quantiles": 16, "n_target_quantiles": 16, "n_cosines": 16}, [32, 32]
    config = module.Config(
        learning_rate=3e-3, target_update_interval=50, policy_kwargs={"net_arch": widths}, **own, **settings
    )
    algorithm = module.make(config, Chain.observation_space, Chain.action_space)
    state = learn_chain(algorithm, 2_000)
    values = algorithm.action_values(state, jnp.arange(5, dtype=jnp.int32), None)[0]
    np.testing.assert_allclose(values, Chain().values(), atol=0.1 if settings.get("noisy") else 0.04)


AGENTS = {"DQN": {}, "C51": C51, "QRDQN": {"n_quantiles": 5}, "IQN": IQN}
MEMORY = {"lstm_hidden_size": 4, "sequence_length": 4, "burn_in": 2}
PLACES = {
    "host": ("CartPole-v1", {"priorities": {}, "n_steps": 3}),
    "device": ("jax/CartPole-v1", {"priorities": {}, "n_steps": 3}),
    "memory": ("CartPole-v1", {"policy_kwargs": {"net_arch": [8], **MEMORY}, "n_steps": 2}),
}


@exhaustive
@pytest.mark.parametrize(
    ("kind", "place"),
    only_tuples([("C51", "host")], [(kind, place) for kind in AGENTS for place in PLACES]),
)
def test_all_parts_together_learn_save_and_load(kind, place, tmp_path):
    env, settings = PLACES[place]
    run = {"learning_starts": 20, "batch_size": 8, "train_freq": 2, "target_update_interval": 10, "seed": 0}
    cls = getattr(rejeu, "DQN" if kind == "C51" else kind)
    agent = cls("MlpPolicy", env, **{**run, "policy_kwargs": {"net_arch": [8]}, **AGENTS[kind], **EVERY, **settings})
    agent.learn(60)
    agent.save(tmp_path / "model")
    obs = np.random.default_rng(0).normal(size=(30, 4)).astype(np.float32)
    np.testing.assert_array_equal(rejeu.load(tmp_path / "model").predict(obs)[0], agent.predict(obs)[0])
    assert agent.evaluate(2).mean_return >= 8.0


@exhaustive
@pytest.mark.parametrize(
    ("kind", "suffix"),
    only_tuples([("IQN", "onnx")], [("C51", "onnx"), ("IQN", "onnx"), ("IQN", "c"), ("C51", "stablehlo")]),
)
def test_an_exported_policy_acts_as_predict(kind, suffix, tmp_path):
    if suffix == "c" and not any(map(shutil.which, c_file.COMPILERS)):
        pytest.skip("there is no C compiler")
    cls = rejeu.IQN if kind == "IQN" else rejeu.DQN
    settings = {"policy_kwargs": {"net_arch": [8]}, "seed": 0, **AGENTS[kind], **EVERY}
    agent = cls("MlpPolicy", "CartPole-v1", **settings)
    assert agent.export(tmp_path / f"policy.{suffix}").check.difference == 0
    obs = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    policy = rejeu.load_policy(agent.save(tmp_path / "model"))
    np.testing.assert_array_equal(policy.predict(obs)[0], agent.predict(obs, deterministic=True)[0])


def test_a_range_of_returns_is_not_empty():
    with pytest.raises(ValueError, match=r"v_min=1.0 must be below v_max=1.0"):
        rejeu.DQN("MlpPolicy", "CartPole-v1", v_min=1.0, v_max=1.0)
