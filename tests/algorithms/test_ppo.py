"""PPO's losses, gradients and whole updates against float64 NumPy, its networks, its settings and what it refuses."""

import functools

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import ppo
from rejeu.algorithms.actor_critic.config import ActorCriticConfig
from rejeu.algorithms.actor_critic.network import ActorCritic, action_kind, is_value
from rejeu.algorithms.actor_critic.steps import (
    Samples,
    explained_variance,
    flat,
    permuted,
    samples,
    shuffled,
    standardized,
)
from rejeu.core.algorithm import Clock, Rollout
from rejeu.core.prng import nth
from rejeu.core.spaces import leaves
from tests import numpy_actor_critic as by_hand
from tests.environments import Sampled
from tests.numpy_networks import assert_equal_layers, gradient
from tests.tiers import only, only_tuples

pytestmark = pytest.mark.usefixtures("learners_are_shared")

OBS_DIM, N_STEPS, N_ENVS = 3, 5, 3
OBS_SPACE = gym.spaces.Box(-5.0, 5.0, (OBS_DIM,), np.float32)
CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.25))
EVERYWHERE = np.ones((N_STEPS, N_ENVS), bool)

ACTIONS = {
    "box": (gym.spaces.Box(-1.0, 1.0, (2,), np.float32), "box"),
    "choice": (gym.spaces.Discrete(3), [3]),
    "choices": (gym.spaces.MultiDiscrete([2, 3]), [2, 3]),
    "bits": (gym.spaces.MultiBinary(3), "binary"),
}
"""Spaces, and what they are called in ``numpy_actor_critic``."""


def bold(network):
    """The network with a policy head a hundred times as large, so that actions depend on what is seen."""
    return eqx.tree_at(lambda n: n.head.weight, network, 100.0 * network.head.weight)


def random_rollout(space, seed=0, valid=EVERYWHERE):
    rng = np.random.default_rng(seed)
    shape = valid.shape
    obs, next_obs = rng.normal(size=(2, *shape, OBS_DIM)).astype(np.float32)
    if isinstance(space, gym.spaces.Box):
        action = np.tanh(rng.normal(size=(*shape, *space.shape))).astype(np.float32)
    else:
        high = {"Discrete": lambda: space.n, "MultiDiscrete": lambda: space.nvec, "MultiBinary": lambda: 2}
        action = rng.integers(high[type(space).__name__](), size=(*shape, *space.shape), dtype=np.int32)
    how = rng.integers(4, size=shape)
    return Rollout(
        obs=obs,
        action=action,
        reward=rng.normal(size=shape).astype(np.float32),
        next_obs=next_obs,
        discount=np.where(how == 1, 0.0, 0.9).astype(np.float32),
        ended=(how == 1) | (how == 2),
        valid=valid,
        running_return=np.zeros(shape, np.float32),
        started=np.ones(shape[1], bool),
        carry=(),
    )


# Parts of the loss; the whole of it is below, with its gradient.


def test_advantages_are_standardized_over_the_valid_entries_alone():
    rng = np.random.default_rng(0)
    values, valid = rng.normal(5.0, 3.0, 20).astype(np.float32), np.arange(20) < 13
    values[13:] = 1e5
    kept = np.float64(values[:13])
    expected = (kept - kept.mean()) / kept.std()
    np.testing.assert_allclose(standardized(jnp.array(values), jnp.array(valid))[:13], expected, rtol=1e-4)


def test_one_advantage_alone_is_left_as_it_is():
    """It has no deviation: subtracting its mean would leave nothing to learn from (Stable-Baselines3 1.6.1)."""
    values = jnp.array([3.5, 100.0])
    assert float(standardized(values, jnp.array([True, False]))[0]) == 3.5
    assert float(standardized(values[:1], jnp.array([True]))[0]) == 3.5


def test_explained_variance_is_1_for_exact_values_and_0_for_a_constant():
    target, valid = jnp.array([1.0, 2.0, 4.0, 1e6]), jnp.array([True, True, True, False])
    assert float(explained_variance(target + 7.0, target, valid)) == pytest.approx(1.0, abs=1e-6)
    assert float(explained_variance(jnp.zeros(4), target, valid)) == pytest.approx(0.0, abs=1e-6)
    halved = 1 - np.var([0.5, 1.0, 2.0]) / np.var([1.0, 2.0, 4.0])
    assert float(explained_variance(target / 2, target, valid)) == pytest.approx(halved, rel=1e-5)
    assert np.isnan(explained_variance(target, jnp.ones(4), valid))


# Gradients.

NETWORKS = {
    "box": ("box", "box", {}),
    "box, std by observation": ("box", "box", {"state_dependent_std": True, "log_std_init": -0.5}),
    "squashed": ("box", "squashed", {"squash_output": True}),
    "choice": ("choice", [3], {}),
    "choices": ("choices", [2, 3], {}),
    "bits": ("bits", "binary", {}),
}


@pytest.mark.parametrize("name", NETWORKS)
def test_the_gradient_of_the_loss_equals_finite_differences_in_float64(name):
    """With every part of the loss at work; half of the ratios lie beyond the clip."""
    actions, kind, shape = NETWORKS[name]
    space = ACTIONS[actions][0]
    config = ppo.Config(ent_coef=0.1, clip_range=0.1, clip_range_vf=0.5, policy_kwargs={"net_arch": [4], **shape})
    network = bold(draw(leaves(OBS_SPACE), action_kind(space), config.policy_kwargs))
    rng, rollout = np.random.default_rng(0), random_rollout(space)
    n = N_STEPS * N_ENVS
    obs, action = rollout.obs.reshape(n, -1), rollout.action.reshape(n, *rollout.action.shape[2:])
    hand = by_hand.Network(network)
    log_prob, _ = by_hand.log_prob_and_entropy(hand, obs, action, kind)
    old_log_prob = np.float32(log_prob + rng.choice([-0.3, -0.05, 0.05, 0.3], n))
    old_value = np.float32(hand.value(obs) + rng.choice([-0.7, -0.2, 0.2, 0.7], n))
    advantage, target = rng.normal(size=(2, n)).astype(np.float32)
    batch = Samples(obs, action, old_log_prob, old_value, advantage, target, np.ones(n, bool))
    (total, losses), given = jax.jit(ppo.gradient, static_argnums=2)(network, batch, config, CLOCK)

    def expected():
        scaled = by_hand.standard(np.float64(advantage))
        return by_hand.Losses(hand, obs, action, kind, old_log_prob, old_value, scaled, target, 0.1, 0.5, 0.5, 0.1)

    assert 0.2 < expected().clip_fraction < 0.8
    assert float(total) == pytest.approx(expected().total, rel=1e-4, abs=1e-5)
    for field, value in losses._asdict().items():
        assert float(value) == pytest.approx(vars(expected())[field], rel=1e-4, abs=1e-5), field
    slopes = gradient(hand.everything, lambda: expected().total)
    assert_equal_layers(by_hand.Network(given).everything, slopes, "gradient", atol=1e-5, rtol=1e-4)


def test_blocks_of_steps_change_neither_gradient_nor_values(monkeypatch):
    """Three blocks, the last of which has no step that counts, and the second some."""
    space = ACTIONS["choice"][0]
    config = ppo.Config(ent_coef=0.1, clip_range=0.1, policy_kwargs={"net_arch": [4]})
    network, rng = bold(draw(leaves(OBS_SPACE), action_kind(space), config.policy_kwargs)), np.random.default_rng(0)
    steps, n = random_rollout(space), N_STEPS * N_ENVS
    log_prob, value, advantage, target = rng.normal(0.0, 0.1, (4, n)).astype(np.float32)
    batch = Samples(*map(flat, (steps.obs, steps.action)), log_prob, value, advantage, target, np.arange(n) < n // 2)

    def evaluated():
        return ppo.gradient(network, batch, config, CLOCK), samples(network, steps, 0.9)

    whole = evaluated()
    monkeypatch.setattr("rejeu.algorithms.actor_critic.steps.BLOCK", n // 3)
    for together, by_blocks in zip(*map(jax.tree.leaves, (whole, evaluated())), strict=True):
        np.testing.assert_allclose(by_blocks, together, rtol=1e-4, atol=1e-6)


# Whole updates.

SETTINGS = {
    "box": ("box", {}),
    "a choice, everything following a schedule": (
        "choice",
        {
            "learning_rate": rejeu.Linear(4e-2, 0.0),
            "clip_range": rejeu.Linear(0.4, 0.0),
            "clip_range_vf": rejeu.Linear(0.04, 0.0),
            "ent_coef": rejeu.Linear(0.4, 0.0),
        },
    ),
    "choices, two optimizers": ("choices", {"critic_learning_rate": 1e-2, "max_grad_norm": 0.1}),
    "bits, nothing scaled": ("bits", {"max_grad_norm": None, "normalize_advantage": False, "batch_size": 100}),
    "box, stopping early": ("box", {"learning_rate": 5e-2, "target_kl": 0.05}),
}
LAST_STEP_MISSING = np.arange(N_STEPS * N_ENVS).reshape(N_STEPS, N_ENVS) != N_STEPS * N_ENVS - 1


def make(actions, **settings):
    settings = {
        "batch_size": 4,
        "n_epochs": 3,
        "gae_lambda": 0.8,
        "learning_rate": 3e-2,
        "policy_kwargs": {"net_arch": [4]},
        **settings,
    }
    config = ppo.Config(**settings)
    return config, ppo.make(config, OBS_SPACE, ACTIONS[actions][0])


def begin(algorithm, seed=0):
    state = jax.jit(algorithm.init)(jax.random.PRNGKey(seed))
    return eqx.tree_at(lambda s: s.network, state, bold(state.network))


def orders_of(state, rollout, config):
    valid = rollout.valid.ravel()
    size = min(config.batch_size, valid.size)
    orders = shuffled(nth(state.key, state.n_rollouts), valid, config.n_epochs, -valid.size % size)
    return np.asarray(orders)[:, : valid.sum()]


@pytest.mark.parametrize("name", SETTINGS)
def test_two_updates_equal_numpy(name):
    """14 of 15 steps exist, in minibatches of 4, 4, 4 and 2, in the orders that JAX draws."""
    actions, settings = SETTINGS[name]
    space, kind = ACTIONS[actions]
    config, algorithm = make(actions, **settings)
    state, update = begin(algorithm), jax.jit(algorithm.update)
    hand = by_hand.PPO(state.network, config, kind, two_rates="critic_learning_rate" in settings)
    scheduled = "schedule" in name
    rates = [3e-2, 1e-2] if "two" in name else [5e-2 if "early" in name else 3e-2]
    schedule = (0.3, 0.03, 0.3) if scheduled else (0.2, None, 0.0)  # of 0.4 to 0 at a quarter of the way
    for k in range(2):
        rollout = random_rollout(space, seed=k, valid=LAST_STEP_MISSING)
        expected = hand.update(rollout, orders_of(state, rollout, config), rates, *schedule)
        state, metrics = update(state, rollout, CLOCK)
        given, numbers = by_hand.Network(state.network), hand.network
        assert int(state.n_updates) == hand.n_updates
        assert_equal_layers(given.everything, numbers.everything, f"after rollout {k}", atol=3e-5)
        for field in ("value_loss", "approx_kl", "clip_fraction"):
            assert float(metrics[field]) == pytest.approx(expected[field], rel=1e-3, abs=1e-5), field
        assert float(metrics["policy_gradient_loss"]) == pytest.approx(expected["policy_loss"], rel=1e-3, abs=1e-5)
        assert float(metrics["entropy_loss"]) == pytest.approx(-expected["entropy"], rel=1e-3, abs=1e-5)
        assert float(metrics["clip_range"]) == pytest.approx(schedule[0])
        total = expected["policy_loss"] + config.vf_coef * expected["value_loss"] - schedule[2] * expected["entropy"]
        assert float(metrics["loss"]) == pytest.approx(total, rel=1e-3, abs=1e-4)
        assert float(metrics["learning_rate"]) == pytest.approx(rates[0])
        if kind == "box":
            assert float(metrics["std"]) == pytest.approx(np.exp(numbers.log_std[0][0]).mean(), rel=1e-4)
    assert int(state.n_rollouts) == 2  # by which the order is drawn
    full = 2 * 3 * (1 if settings.get("batch_size") == 100 else 4)
    assert 2 <= hand.n_updates < full if "early" in name else hand.n_updates == full


def test_updates_are_counted_as_they_were_taken_where_the_divergence_stops_them():
    """Stable-Baselines3 1.8.0 and 2.8.0 mended the count: a rollout of 8 steps would be worth 4 gradient steps."""
    settings = {**SMALL, "learning_rate": 0.3, "target_kl": 0.01}
    agent = rejeu.PPO("MlpPolicy", Noisy(), **settings).learn(32)
    assert 0 < agent.n_updates == int(agent.state.n_updates) < 4 * 4


@pytest.mark.parametrize(
    ("n", "n_valid"),
    only_tuples(
        [(12, 7), (2**14 + 1, 2**14), (2**14 + 1, 0)],
        [(1, 1), (12, 1), (12, 7), (12, 12), (2**14, 9000), (2**14 + 1, 2**14), (2**14 + 1, 0), (12, 0)],
    ),
    ids=str,
)
def test_an_order_holds_every_step_once_the_valid_ones_first(n, n_valid):
    """Few steps are sorted, more than 2^14 permuted by a network of rounds."""
    valid = np.random.default_rng(0).permutation(np.arange(n) < n_valid)
    orders = np.asarray(shuffled(nth(jax.random.PRNGKey(0), 3), jnp.array(valid), 5, 4))
    assert (orders.shape, orders.dtype) == ((5, n + 4), np.int32)
    for order in orders:
        assert sorted(order[:n]) == list(range(n))
        assert sorted(order[:n_valid]) == np.flatnonzero(valid).tolist()
    if n_valid > 1:
        assert len({tuple(order) for order in orders.tolist()}) == 5, "every epoch has its own"


def test_every_step_comes_first_equally_often():
    """1200 orders of 6 steps: each is expected first 200 times, with a deviation of 13."""
    orders = np.asarray(shuffled(nth(jax.random.PRNGKey(1), 0), jnp.ones(6, bool), 1200, 0))
    assert np.abs(np.bincount(orders[:, 0], minlength=6) - 200).max() < 5 * 13


@pytest.mark.parametrize("n", [81, 100, 121])
def test_permutations_that_are_not_sorted_are_uniform(n):
    """Chi-square over 20,000 orders: of the number at each place, of neighbors, and of the distance between neighbors."""
    n_orders = 20_000
    orders = np.asarray(jax.jit(permuted, static_argnums=(1, 3))(jax.random.PRNGKey(n), n, jnp.int32(n), n_orders))
    places = np.stack([np.bincount(column, minlength=n) for column in orders.T])
    first, second = orders[:, 0], orders[:, 1]
    pairs = np.bincount(first * n + second, minlength=n * n).reshape(n, n)[~np.eye(n, dtype=bool)]
    distances = np.bincount((second - first) % n, minlength=n)[1:]
    freedoms = ((n - 1) ** 2, pairs.size - 1, distances.size - 1)
    for counts, freedom in zip((places, pairs, distances), freedoms, strict=True):
        expected = counts.mean()
        statistic = ((counts - expected) ** 2 / expected).sum()
        assert abs(statistic - freedom) < 4 * np.sqrt(2 * freedom)
    fixed = (orders == np.arange(n)).sum(axis=1)  # of a random permutation: 1 on average, with a variance of 1
    assert abs(fixed.mean() - 1) < 5 / np.sqrt(n_orders)
    assert abs(fixed.var() - 1) < 0.1


def test_training_actions_are_drawn_and_the_deterministic_one_is_the_mode():
    _, algorithm = make("box")
    state, obs = begin(algorithm), jnp.zeros((5000, OBS_DIM)).at[:, 0].set(1.0)
    drawn = np.asarray(algorithm.explore(state.network, obs, jax.random.PRNGKey(0), CLOCK))
    mode = np.asarray(algorithm.exploit(state.network, obs))
    expected = by_hand.through(by_hand.Network(state.network).pi, np.eye(3)[:1])
    np.testing.assert_allclose(mode, np.repeat(expected, 5000, axis=0), atol=1e-5)
    np.testing.assert_allclose(drawn.mean(axis=0), expected[0], atol=5 / np.sqrt(5000))
    np.testing.assert_allclose(drawn.std(axis=0), 1.0, atol=5 / np.sqrt(10000))


# Networks.

IMAGES = gym.spaces.Box(0, 255, (8, 8, 3), np.uint8)


def build(space=OBS_SPACE, **shape):
    shape = ActorCriticConfig(**{"net_arch": [6, 4], **shape})
    return draw(leaves(space), action_kind(ACTIONS["box"][0]), shape)


@functools.cache
def draw(obs_leaves, kind, shape):
    return jax.jit(lambda key: ActorCritic(key, obs_leaves, kind, shape))(jax.random.PRNGKey(0))


def assert_orthogonal(layer, gain):
    """W^T W = gain^2 I for as many columns as rows or fewer, else W W^T; of a convolution, of its filters."""
    weight = np.float64(layer.weight).reshape(-1, layer.weight.shape[-1])
    product = weight.T @ weight if weight.shape[0] >= weight.shape[1] else weight @ weight.T
    np.testing.assert_allclose(product, gain**2 * np.eye(len(product)), atol=1e-5)
    np.testing.assert_array_equal(layer.bias, 0.0)


def test_weights_begin_orthogonal_with_a_gain_for_each_part():
    network = build()
    assert [layer.weight.shape for layer in (*network.torso.layers, network.head)] == [(3, 6), (6, 4), (4, 2)]
    for layer in (*network.torso.layers, *network.value_torso.layers):
        assert_orthogonal(layer, np.sqrt(2.0))
    assert_orthogonal(network.head, 0.01)
    assert_orthogonal(network.value_head, 1.0)
    apart = build(IMAGES, share_features_extractor=False)
    for encoder in (apart.encoder, apart.value_encoder):
        (cnn,) = encoder.images
        for layer in (*cnn.layers, cnn.linear):
            assert_orthogonal(layer, np.sqrt(2.0))
    flags = is_value(apart)  # of the value's own optimizer
    of = lambda part: set(jax.tree.leaves(getattr(flags, part)))  # noqa: E731
    assert of("value_encoder") == of("value_torso") == of("value_head") == {True}
    assert of("encoder") == of("torso") == of("head") == of("log_std") == {False}
    weights = [np.asarray(torso.layers[0].weight) for torso in (network.torso, network.value_torso)]
    assert (weights[0] != weights[1]).any(), "policy and value are drawn apart"
    np.testing.assert_array_equal(network.log_std, np.zeros(2))


def test_without_orthogonal_initialisation_weights_are_uniform():
    for layer in (*(network := build(ortho_init=False)).torso.layers, network.head, network.value_head):
        bound = 1.0 / np.sqrt(layer.weight.shape[0])
        assert 0.5 * bound < np.abs(layer.weight).max() <= bound
        assert (layer.bias != 0).all()


def test_policy_and_value_have_the_widths_asked_for():
    apart = build(net_arch={"pi": [5], "vf": [7, 6]})
    assert [layer.weight.shape for layer in apart.torso.layers] == [(3, 5)]
    assert [layer.weight.shape for layer in apart.value_torso.layers] == [(3, 7), (7, 6)]
    default = jax.eval_shape(lambda: build(net_arch=None))
    for torso in (default.torso, default.value_torso):
        assert [layer.weight.shape for layer in torso.layers] == [(3, 64), (64, 64)]
    assert default.torso.activation == "tanh"


OBS = np.random.default_rng(0).normal(size=(5, OBS_DIM)).astype(np.float32)
PIXELS = np.random.default_rng(0).integers(256, size=(5, 8, 8, 3), dtype=np.uint8)


SHARING = [{}, {"share_layers": True}, {"share_features_extractor": False}]


@pytest.mark.parametrize("shape", only(SHARING[1:2], SHARING))
def test_policy_and_value_at_once_are_what_each_is_alone(shape):
    network = bold(build(IMAGES, **shape))
    (policy, value), policy_alone, value_alone = jax.jit(lambda n: (n.both(PIXELS), n.policy(PIXELS), n.value(PIXELS)))(
        network
    )
    np.testing.assert_allclose(value, value_alone, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(policy.mean, policy_alone.mean, rtol=1e-5, atol=1e-6)


def moves(of, network):
    """Which parts of the network a change of what ``of`` computes goes through."""
    slopes = jax.jit(jax.grad(lambda n: jnp.sum(of(n))))(network)
    parts = ("encoder", "torso", "head", "value_encoder", "value_torso", "value_head")
    return {part for part in parts if any((np.asarray(x) != 0).any() for x in jax.tree.leaves(getattr(slopes, part)))}


@pytest.mark.parametrize(
    ("shape", "of_policy", "of_value"),
    [
        ({}, {"encoder", "torso", "head"}, {"encoder", "value_torso", "value_head"}),
        (
            {"share_features_extractor": False},
            {"encoder", "torso", "head"},
            {"value_encoder", "value_torso", "value_head"},
        ),
        ({"share_layers": True}, {"encoder", "torso", "head"}, {"encoder", "torso", "value_head"}),
    ],
)
def test_only_what_is_shared_is_moved_by_both(shape, of_policy, of_value):
    network = build(IMAGES, **shape)
    assert moves(lambda n: n.policy(PIXELS).mean, network) == of_policy
    assert moves(lambda n: n.value(PIXELS), network) == of_value


def test_a_standard_deviation_by_observation_begins_near_its_initial_value_and_is_bounded():
    network = build(state_dependent_std=True, log_std_init=-0.7)
    assert network.log_std is None
    assert network.head.weight.shape == (4, 4)
    np.testing.assert_allclose(network.policy(OBS).log_std, np.full((5, 2), -0.7), atol=0.05)
    bolder = bold(network).policy(OBS).log_std
    assert np.ptp(bolder[:, 0]) > 0.1, "it depends on what is seen"
    for factor, bound in ((1e6, 2.0), (-1e6, -20.0)):
        extreme = eqx.tree_at(lambda n: n.head.bias, network, factor * jnp.ones(4))
        np.testing.assert_array_equal(extreme.policy(OBS).log_std, np.full((5, 2), bound))


SMALL = {
    "n_steps": 8,
    "batch_size": 4,
    "n_epochs": 2,
    "learning_rate": 1e-2,
    "policy_kwargs": {"net_arch": [4]},
    "seed": 0,
}


def play(env, **settings):
    """An agent that has acted 8 times and learnt nothing yet."""
    agent = rejeu.PPO("MlpPolicy", env, **{**SMALL, "n_steps": 100, **settings})
    return agent.learn(100, callback=lambda agent, progress: progress.step < 8)


def test_a_standard_deviation_that_is_not_learnt_stays_exactly_where_it_began():
    """log 0.707 = -0.3466; with an entropy bonus, which pulls at nothing else."""
    shape = {"net_arch": [4], "log_std_init": -0.3466, "learn_std": False}

    def train(shape):
        settings = {**SMALL, "policy_kwargs": shape, "ent_coef": 10.0}
        return rejeu.PPO("MlpPolicy", Noisy(), **settings).learn(24)

    kept = train(shape)
    np.testing.assert_array_equal(kept.state.network.log_std, np.float32([-0.3466]))
    assert kept.statistics()["train/std"] == pytest.approx(0.7071, abs=1e-4)
    learnt = train({**shape, "learn_std": True})
    assert float(learnt.state.network.log_std[0]) > -0.3466 + 1e-3


class Noisy(Sampled):
    """Random rewards, and actions that must lie in the space as they are."""

    def __init__(self, action_space=None):
        super().__init__(OBS_SPACE, action_space)
        self.actions = []

    def reward(self, action):
        assert self.action_space.contains(action), (action, getattr(action, "dtype", None))
        self.actions.append(np.array(action))
        return float(self.np_random.normal())


SPACES = {
    "bounds of its own": gym.spaces.Box(np.float32([-1.0, 0.0]), np.float32([3.0, 0.5])),
    "no bounds": gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
    "one bound": gym.spaces.Box(np.float32([0.0, -np.inf]), np.float32([np.inf, 0.2])),
    "two axes": gym.spaces.Box(-2.0, 2.0, (2, 3), np.float64),
    "no axis": gym.spaces.Box(-2.0, 1.0, (), np.float32),
    "a choice from 3 on": gym.spaces.Discrete(4, start=3),
    "choices from 1 and -2 on": gym.spaces.MultiDiscrete([2, 3], start=[1, -2]),
    "choices of two axes": gym.spaces.MultiDiscrete([[2, 3], [4, 2]]),
    "bits": gym.spaces.MultiBinary(3),
    "bits of two axes": gym.spaces.MultiBinary([2, 3]),
}


@pytest.mark.filterwarnings(
    "ignore:.*Casting input x"
)  # Gymnasium of an action that is one number, as it passes them itself
@pytest.mark.parametrize("name", only(["bounds of its own", "choices of two axes"], SPACES))
def test_actions_have_the_spaces_range_shape_and_dtype_in_training_and_after(name):
    space = SPACES[name]
    agent = play(env := Noisy(space))
    assert len(env.actions) == 8
    assert len({action.tobytes() for action in env.actions}) > 1, "they are drawn"
    obs = np.random.default_rng(0).normal(size=(6, OBS_DIM)).astype(np.float32)
    for deterministic in (True, False):
        batch, state = agent.predict(obs, deterministic=deterministic)
        assert state is None
        assert (batch.shape, batch.dtype) == ((6, *space.shape), space.dtype)
        assert all(space.contains(one) for one in batch)
    single, _ = agent.predict(obs[0], deterministic=True)
    np.testing.assert_array_equal(single, agent.predict(obs, deterministic=True)[0][0])
    assert np.shape(single) == space.shape


def set_mean(agent, mean):
    head = {"weight": np.zeros((4, 2), np.float32), "bias": np.full(2, mean, np.float32)}
    agent.set_parameters({f"network.head.{name}": array for name, array in head.items()}, exact_match=False)


def test_without_bounds_the_mean_is_the_action():
    """With 3 as its bias the mean lies beyond [-1, 1]: it is neither scaled nor clipped, but for the bound there is."""
    for name, expected in (("no bounds", [3.0, 3.0]), ("one bound", [3.0, 0.2]), ("bounds of its own", [3.0, 0.5])):
        agent = play(Noisy(SPACES[name]))
        set_mean(agent, 3.0)
        np.testing.assert_allclose(agent.predict(np.zeros(OBS_DIM), deterministic=True)[0], expected, rtol=1e-6)


def test_squashed_actions_lie_within_the_bounds_without_being_clipped():
    space = SPACES["bounds of its own"]
    agent = play(env := Noisy(space), policy_kwargs={"net_arch": [4], "squash_output": True, "log_std_init": 0.5})
    actions = np.array(env.actions)
    assert ((actions > space.low) & (actions < space.high)).all(), "none lies at a bound, where clipped ones would"
    set_mean(agent, 0.5)
    expected = space.low + (np.tanh(0.5) + 1.0) / 2.0 * (space.high - space.low)
    np.testing.assert_allclose(agent.predict(np.zeros(OBS_DIM), deterministic=True)[0], expected, rtol=1e-5)


# Settings.


@pytest.mark.parametrize(
    "shape", [{"net_arch": {"pi": [8], "vf": [8]}}, {"pi": [8]}, {"net_arch": None, "actor_layers": [8]}]
)
def test_shared_layers_may_have_the_widths_of_both_or_of_the_policy(shape):
    network = build(OBS_SPACE, share_layers=True, **shape)
    assert network.head.weight.shape[0] == network.value_head.weight.shape[0] == 8


@pytest.mark.parametrize("algorithm", only([rejeu.A2C], [rejeu.PPO, rejeu.A2C]))
def test_a_rate_of_the_values_own_needs_convolutions_of_its_own(algorithm):
    """Shared ones would follow one of the two optimizers, and the gradients of both."""
    env = Sampled(IMAGES)
    with pytest.raises(ValueError, match=r"critic_learning_rate .*share_features_extractor=False") as caught:
        algorithm("CnnPolicy", env, critic_learning_rate=1e-3)
    assert "\n" not in str(caught.value)
    make, config = algorithm.algorithm.make, algorithm.algorithm.Config
    make(config(critic_learning_rate=1e-3, policy_kwargs={"share_features_extractor": False}), IMAGES, env.action_space)
    make(config(critic_learning_rate=1e-3), OBS_SPACE, env.action_space)
