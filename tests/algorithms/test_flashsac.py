"""FlashSAC and XQC: whole updates against float64 NumPy, and what agents of them can do."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

import rejeu
from rejeu.algorithms import flashsac, xqc
from rejeu.core.algorithm import TD_ERROR
from rejeu.core.normalization import NormalizationConfig, normalizer_of
from rejeu.networks.layers import RMSNorm
from rejeu.networks.projected import UnitLinear
from tests.algorithms.batches import BOX, CLOCK, DISCRETE, OBS_SPACE, box_batch, noise_of
from tests.environments import Reach, Timed
from tests.networks.test_projected import numpy_torso
from tests.tiers import exhaustive, only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

BATCH, N_BINS, LIMIT = 8, 11, 2.0
SMALL = {"policy_kwargs": {"net_arch": [4, 4]}, "n_bins": N_BINS, "value_limit": LIMIT, "learning_rate": 1e-2}
MODULES = {"FlashSAC": flashsac, "XQC": xqc}
VALUES = np.linspace(-LIMIT, LIMIT, N_BINS)
one_of = lambda critics, index: jax.tree.map(lambda leaf: leaf[index], critics)  # noqa: E731


class Made(NamedTuple):
    """An algorithm with its configuration and a state."""

    config: Any
    algorithm: Any
    state: Any


def made(name, **settings) -> Made:
    module = MODULES[name]
    config = module.Config(**{**SMALL, **settings})
    algorithm = module.make(config, OBS_SPACE, BOX)
    state, other = (jax.jit(algorithm.init)(jax.random.PRNGKey(seed)) for seed in (1, 2))
    return Made(config, algorithm, state.__class__(**{**vars(state), "target_critics": other.critics}))


# The two algorithms in float64.


def outputs(network, x, train):
    hidden = numpy_torso(network.torso, x, train)
    return hidden @ np.float64(network.head.weight) + np.float64(network.head.bias)


def sample(name, out, noise):
    mean, raw = np.split(out, 2, axis=1)
    log_std = -10 + 6 * (1 + np.tanh(raw)) if name == "FlashSAC" else np.clip(raw, -10, 2)
    action = np.tanh(mean + np.exp(log_std) * noise)
    density = -0.5 * noise**2 - log_std - 0.5 * np.log(2 * np.pi) - np.log(1 - action**2)
    return action, density.sum(axis=1)


def rows_of(batch, next_action):
    now, then = np.hstack([batch.obs, batch.action]), np.hstack([batch.next_obs, next_action])
    return np.vstack([now, then])


def softmax(x):
    return special.softmax(x, axis=-1)


def numpy_target(critics, batch, next_action, cost):
    logits = np.array([outputs(one_of(critics, i), rows_of(batch, next_action), True)[BATCH:] for i in (0, 1)])
    least = (softmax(logits) @ VALUES).argmin(axis=0)
    found, width = np.zeros((BATCH, N_BINS)), VALUES[1] - VALUES[0]
    for b in range(BATCH):
        for p, z in zip(softmax(logits)[least[b], b], VALUES, strict=True):
            y = np.clip(batch.reward[b] + batch.discount[b] * (z - cost[b]), -LIMIT, LIMIT)
            found[b] += p * np.maximum(0.0, 1 - np.abs(VALUES - y) / width)
    return found, set(least.tolist())


@pytest.mark.parametrize("name", MODULES)
def test_an_update_uses_the_equations_in_the_documented_order(name):
    config, algorithm, state = made(name, policy_delay=1, ent_coef="auto_0.3")
    batch = box_batch(3, BATCH)._replace(weight=np.linspace(0.1, 1, BATCH, dtype=np.float32))
    target_key, actor_key = jax.random.split(jax.random.fold_in(state.key, 0))
    after, metrics = jax.jit(algorithm.update)(state, batch, CLOCK)
    next_action, next_log_prob = sample(name, outputs(state.actor, batch.next_obs, False), noise_of(target_key, BATCH))
    target, chosen = numpy_target(state.target_critics, batch, next_action, 0.3 * next_log_prob)
    rows = rows_of(batch, next_action)
    logits = np.array([outputs(one_of(state.critics, i), rows, True)[:BATCH] for i in (0, 1)])
    values = softmax(logits) @ VALUES
    loss = np.mean(batch.weight * -(target * np.log(softmax(logits))).sum(axis=-1), axis=1).sum()
    assert float(metrics["critic_loss"]) == pytest.approx(loss, abs=2e-4)
    assert float(metrics["q_value"]) == pytest.approx(values.mean(), abs=1e-4)
    np.testing.assert_allclose(metrics[TD_ERROR], np.abs(values - target @ VALUES).mean(axis=0), atol=2e-4)
    seen = np.vstack([batch.obs, batch.next_obs]) if name == "FlashSAC" else batch.obs
    action, log_prob = sample(name, outputs(state.actor, seen, True)[:BATCH], noise_of(actor_key, BATCH))
    pairs = np.hstack([batch.obs, action])
    judged = np.array([softmax(outputs(one_of(after.critics, i), pairs, False)) @ VALUES for i in (0, 1)])
    assert float(metrics["actor_loss"]) == pytest.approx(np.mean(0.3 * log_prob - judged.min(axis=0)), abs=2e-4)
    assert float(metrics["entropy"]) == pytest.approx(-log_prob.mean(), abs=1e-4)
    wanted = BOX.shape[0] * (0.5 * np.log(2 * np.pi * np.e * 0.15**2) if name == "FlashSAC" else -0.5)
    assert float(metrics["ent_coef_loss"]) == pytest.approx(np.log(0.3) * (-log_prob.mean() - wanted), abs=2e-3)
    assert chosen == {0, 1}, "one of the targets is the smaller everywhere"
    mean = np.float64(state.critics.head.bias), np.float64(after.critics.head.bias)
    old = np.float64(state.target_critics.head.bias)
    np.testing.assert_allclose(after.target_critics.head.bias, old + config.tau * (mean[1] - old), atol=1e-6)


def test_the_critics_loss_is_the_sum_of_that_of_each():
    critics, batch = made("XQC").state.critics, box_batch(2, BATCH)
    target = jnp.float32(np.random.default_rng(0).dirichlet(np.ones(N_BINS), BATCH))
    loss = jax.jit(lambda critics: flashsac.critics_loss(critics, batch, batch.action, target)[0])
    each = [float(loss(jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], critics))) for i in (0, 1)]
    assert float(loss(critics)) == pytest.approx(sum(each), rel=1e-5)


@exhaustive
@pytest.mark.parametrize("name", only(["XQC"], MODULES))
def test_the_target_has_no_gradient_and_the_critics_follow_theirs(name):
    """Finite differences of the cross-entropy in the head's bias and in one weight before a normalization."""
    _, _, state = made(name)
    batch, module = box_batch(1, BATCH), MODULES[name]
    next_action = np.tanh(np.random.default_rng(0).normal(size=(BATCH, 2))).astype(np.float32)
    target = softmax(np.random.default_rng(1).normal(size=(BATCH, N_BINS)))
    gradient, _ = jax.grad(flashsac.critics_loss, has_aux=True)(state.critics, batch, next_action, jnp.float32(target))
    critic = jax.tree.map(np.float64, one_of(state.critics, 1))
    layer = (critic.torso.layers[1] if name == "XQC" else critic.torso.blocks[0].expand).weight
    slopes = gradient.torso.layers[1].weight if name == "XQC" else gradient.torso.blocks[0].expand.weight

    def loss():
        logits = outputs(critic, rows_of(batch, next_action), True)[:BATCH]
        return np.mean(-(target * np.log(softmax(logits))).sum(axis=-1))

    for array, given in ((critic.head.bias, gradient.head.bias), (layer, slopes)):
        for place in list(np.ndindex(array.shape))[:6]:
            kept, ends = array[place], []
            for step in (1e-5, -1e-5):
                array[place] = kept + step
                ends.append(loss())
            array[place] = kept
            assert float(given[1][place]) == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=2e-4)
    assert module.make is flashsac.make


@pytest.mark.parametrize("name", only(["XQC"], MODULES))
def test_weights_keep_their_norm_and_the_actor_waits_for_its_turn(name):
    _, algorithm, state = made(name, policy_delay=3)
    update, moved = jax.jit(algorithm.update), []
    for seed in range(6):
        before, (state, _) = state, update(state, box_batch(seed, BATCH), CLOCK)
        moved.append(bool((before.actor.head.weight != state.actor.head.weight).any()))
        assert (before.critics.head.weight != state.critics.head.weight).any()
    assert moved == [False, False, True] * 2
    is_part = lambda node: isinstance(node, UnitLinear | RMSNorm)  # noqa: E731
    for node in jax.tree.leaves((state.actor, state.critics), is_leaf=is_part):
        if isinstance(node, UnitLinear):
            np.testing.assert_allclose(np.linalg.norm(node.weight, axis=-2), 1.0, atol=1e-4)
        if isinstance(node, RMSNorm):
            np.testing.assert_allclose(np.linalg.norm(node.scale, axis=-1), np.sqrt(node.scale.shape[-1]), rtol=1e-4)
    gains = state.critics.torso.norm.scale if name == "FlashSAC" else state.critics.torso.norms[0].scale
    offsets = state.critics.torso.norm.offset if name == "FlashSAC" else state.critics.torso.norms[0].offset
    sizes = np.sqrt((np.square(gains) + np.square(offsets)).sum(axis=-1) / gains.shape[-1])
    assert np.allclose(sizes, 1.0, atol=1e-4) == (name == "FlashSAC")


AGENT = {
    "policy_kwargs": {"net_arch": [8, 8]},
    "learning_rate": 3e-4,
    "learning_starts": 20,
    "batch_size": 16,
    "seed": 0,
    "n_bins": 11,
}


@exhaustive
@pytest.mark.parametrize("kind", [rejeu.FlashSAC, rejeu.XQC])
def test_it_learns_from_hindsight_from_priorities_and_on_the_device(kind):
    her = kind("MultiInputPolicy", Reach(), replay_buffer_class="HerReplayBuffer", **AGENT).learn(60)
    first = kind("MlpPolicy", "Pendulum-v1", priorities={}, n_steps=3, **AGENT).learn(60)
    device = kind("MlpPolicy", "jax/Pendulum-v1", **AGENT).learn(60)
    for agent in (her, first, device):
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(agent.run.state))
        assert agent.run.n_updates == 40 * (2 if kind is rejeu.XQC else 1)


def test_what_it_has_not_is_refused():
    with pytest.raises(ValueError, match="FlashSAC has blocks of one width throughout"):
        flashsac.Config(policy_kwargs={"net_arch": [4, 8]})
    with pytest.raises(ValueError, match="XQC normalizes layers of its own"):
        xqc.Config(policy_kwargs={"layer_norm": True})
    with pytest.raises(ValueError, match="FlashSAC needs a Box action space"):
        flashsac.make(flashsac.Config(), OBS_SPACE, DISCRETE)
    assert xqc.Config(policy_kwargs={"net_arch": [4, 8]}).name == "XQC"


# Rewards that are scaled so that returns fit.


class Rewarding(Timed):
    """Rewards of 3, and in the last step of an episode of 40 one of -500."""

    length, ends = 40, "terminated"

    def reward(self, action):
        return -500.0 if self.time == 39 else 3.0


@pytest.mark.parametrize("kind", only([rejeu.PPO], [rejeu.FlashSAC, rejeu.PPO]))
def test_no_scaled_return_exceeds_its_limit(kind):
    limit = NormalizationConfig(norm_obs=False, max_return=5.0)
    settings = AGENT if kind is rejeu.FlashSAC else {"n_steps": 20, "batch_size": 20, "seed": 0}
    agent = kind("MlpPolicy", Rewarding(), **settings, normalize=limit).learn(60)
    returns, total = [], 0.0
    for t in range(60):
        total = 0.99 * total * (t % 40 != 0) + (-500.0 if t % 40 == 39 else 3.0)
        returns.append(total)
    statistics = agent.state.statistics
    assert float(statistics.largest) == pytest.approx(max(map(abs, returns)), rel=1e-5)
    divisor = max(map(abs, returns)) / 5.0
    assert divisor > np.std(returns)
    normalizer = normalizer_of((), limit)
    np.testing.assert_allclose(
        normalizer.reward(statistics, jnp.array([3.0, -500.0])), np.array([3, -500]) / divisor, rtol=1e-4
    )
    plain = normalizer_of((), NormalizationConfig(norm_obs=False))
    without = plain.reward(statistics._replace(largest=None), jnp.array([3.0]))
    np.testing.assert_allclose(without, 3.0 / np.std(returns), rtol=1e-4)
