"""REDQ, and SAC with a subset of its critics as target and with dropout in them (DroQ)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import sac
from rejeu.core.algorithm import TD_ERROR
from rejeu.networks import action_values, with_dropout
from tests.algorithms.batches import BOX, CLOCK, OBS_SPACE, box_batch, noise_of
from tests.numpy_networks import squashed_sample
from tests.tiers import exhaustive, only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

BATCH, RATE = 8, 0.4
DROQ = {
    "policy_kwargs": {"net_arch": [7, 6], "dropout": RATE, "layer_norm": True},
    "n_critics": 3,
    "target_subset": 2,
    "ent_coef": 0.2,
}


def numpy_values(critics, obs, action):
    """The critics' values in float64: linear, dropout by the keys that the layers hold, layer norm, relu."""
    found = []
    for c in range(critics.head.bias.shape[0]):
        x = np.concatenate([np.float64(obs), np.float64(action)], axis=1)
        for layer, norm, drop in zip(critics.torso.layers, critics.torso.norms, critics.torso.dropouts, strict=True):
            x = x @ np.float64(layer.weight[c]) + np.float64(layer.bias[c])
            if drop.key is not None:
                x = x * np.asarray(jax.random.bernoulli(drop.key[c], 1 - RATE, x.shape)) / (1 - RATE)
            x = (x - x.mean(axis=1, keepdims=True)) / np.sqrt(x.var(axis=1, keepdims=True) + 1e-5)
            x = np.maximum(x * np.float64(norm.scale[c]) + np.float64(norm.offset[c]), 0)
        found.append((x @ np.float64(critics.head.weight[c]) + np.float64(critics.head.bias[c]))[:, 0])
    return np.array(found)


def made(**settings):
    config = sac.Config(**{**DROQ, **settings})
    algorithm = sac.make(config, OBS_SPACE, BOX)
    return config, algorithm, algorithm.init(jax.random.PRNGKey(3))


def test_dropout_equals_numpy_and_each_critic_and_layer_has_its_own():
    _, _, state = made()
    batch = box_batch(0, BATCH)
    dropped = with_dropout(state.critics, jax.random.PRNGKey(5))
    values = jax.jit(action_values)(dropped, batch.obs, batch.action)
    np.testing.assert_allclose(values, numpy_values(dropped, batch.obs, batch.action), atol=1e-5)
    keys = np.concatenate([np.asarray(drop.key) for drop in dropped.torso.dropouts])
    assert len(np.unique(keys, axis=0)) == 2 * 3
    whole = jax.jit(action_values)(state.critics, batch.obs, batch.action)
    np.testing.assert_allclose(whole, numpy_values(state.critics, batch.obs, batch.action), atol=1e-5)
    assert with_dropout(state.critics, None) is state.critics


def test_the_mean_over_dropouts_of_a_linear_layer_is_the_layer_without():
    layer = rejeu.networks.layers.Dropout(jax.random.PRNGKey(0), RATE)
    found = layer(jnp.full((40_000,), 2.0))
    assert float(found.mean()) == pytest.approx(2.0, abs=0.03)
    assert sorted(set(np.asarray(found).tolist())) == pytest.approx([0.0, 2.0 / (1 - RATE)])


def test_every_pass_of_an_update_drops_units_of_the_critics():
    """Target, critics and what judges the actor, each with masks of its own, in float64 with the keys of the update."""
    config, algorithm, state = made()
    batch = box_batch(1, BATCH)
    after, metrics = jax.jit(algorithm.update)(state, batch, CLOCK)
    target_key, actor_key = jax.random.split(jax.random.fold_in(state.key, 0))
    outputs = lambda obs: np.float64(state.actor(jnp.asarray(obs)))  # noqa: E731
    action, log_prob = squashed_sample(outputs(batch.next_obs), noise_of(target_key, BATCH))
    targets = config.for_target(state.target_critics, target_key)
    least = numpy_values(targets, batch.next_obs, action)
    assert least.shape[0] == 2
    target = batch.reward + batch.discount * (least.min(axis=0) - 0.2 * log_prob)
    learning, judging = config.dropout_keys(actor_key)
    values = numpy_values(with_dropout(state.critics, learning), batch.obs, batch.action)
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(values - target).mean(axis=0), atol=1e-4)
    assert float(metrics["critic_loss"]) == pytest.approx(0.5 * ((values - target) ** 2).mean(axis=1).sum(), abs=1e-4)
    action, log_prob = squashed_sample(outputs(batch.obs), noise_of(actor_key, BATCH))
    judged = numpy_values(with_dropout(after.critics, judging), batch.obs, action).mean(axis=0)
    assert float(metrics["actor_loss"]) == pytest.approx(np.mean(0.2 * log_prob - judged), abs=1e-4)
    assert (
        len({tuple(np.asarray(key).tolist()) for key in (learning, judging, config.dropout_keys(target_key)[1])}) == 3
    )


@exhaustive
@pytest.mark.parametrize("agent", only([rejeu.SAC], [rejeu.SAC, rejeu.TQC]))
def test_droq_learns_resumes_equal_and_acts_without_dropout(agent, tmp_path):
    settings = {**DROQ, "gradient_steps": 4, "policy_delay": 4, "learning_starts": 10, "batch_size": 8, "seed": 0}
    whole = agent("MlpPolicy", "Pendulum-v1", **settings).learn(40)
    half = agent("MlpPolicy", "Pendulum-v1", **settings)
    half.learn(25, rejeu.callbacks.Checkpoint(tmp_path / "checkpoints", every=25))
    again = agent.resume(tmp_path / "checkpoints", "Pendulum-v1").learn(15, reset_num_timesteps=False)
    for one, two in zip(jax.tree.leaves(whole.run.state), jax.tree.leaves(again.run.state), strict=True):
        np.testing.assert_array_equal(one, two)
    path = whole.save(tmp_path / "droq")
    loaded = rejeu.load(path)
    obs, action = np.zeros((2, 3), np.float32), np.zeros((2, 1), np.float32)
    np.testing.assert_array_equal(whole.q_values(obs, action), loaded.q_values(obs, action))
    assert whole.q_values(obs, action).shape == (2,)


def test_settings_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="target_subset=3 is more than n_critics=2"):
        sac.Config(target_subset=3)
    with pytest.raises(ValueError, match="TD3 has no critics with dropout"):
        rejeu.TD3("MlpPolicy", "Pendulum-v1", policy_kwargs={"dropout": 0.1})
    with pytest.raises(ValueError, match="architecture='simba' conflicts with dropout"):
        sac.Config(policy_kwargs={"dropout": 0.1, "architecture": "simba"})


def test_redq_is_sac_with_many_critics_and_gradient_steps():
    settings = {"policy_kwargs": {"net_arch": [4]}, "learning_starts": 10, "seed": 0}
    often = {"n_critics": 10, "target_subset": 2, "gradient_steps": 20, "policy_delay": 20}
    one = rejeu.REDQ("MlpPolicy", "Pendulum-v1", **settings).learn(15)
    other = rejeu.SAC("MlpPolicy", "Pendulum-v1", **settings, **often).learn(15)
    assert rejeu.REDQ("MlpPolicy", "Pendulum-v1").config.learning_starts == 5000
    for key, array in other.get_parameters().items():
        np.testing.assert_array_equal(one.get_parameters()[key], array, err_msg=key)


def test_redq_takes_the_actions_of_sac():
    agent = rejeu.REDQ("MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [4]}, learning_starts=5).learn(8)
    assert agent.q_values(np.zeros(4), critics="all").shape == (10, 2)
