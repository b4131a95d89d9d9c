"""A2C's losses, gradients and whole updates against float64 NumPy, its settings and what it refuses."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import a2c
from rejeu.algorithms.actor_critic import Samples
from tests import numpy_actor_critic as by_hand
from tests.algorithms.test_ppo import (
    ACTIONS,
    CLOCK,
    LAST_STEP_MISSING,
    N_ENVS,
    N_STEPS,
    OBS_SPACE,
    begin,
    random_rollout,
)
from tests.numpy_networks import Adam, assert_equal_layers, gradient

RATE, EPSILON = 3e-2, 1e-3

SETTINGS = {
    "box": ("box", {}),
    "a choice, following schedules": ("choice", {"learning_rate": rejeu.Linear(4e-2, 0.0), "ent_coef": "lin_0.4"}),
    "choices, two optimizers": ("choices", {"critic_learning_rate": 1e-2, "max_grad_norm": 0.1}),
    "bits, Adam": ("bits", {"use_rms_prop": False, "normalize_advantage": True, "max_grad_norm": None}),
    "box, lambda": ("box", {"gae_lambda": 0.5, "vf_coef": 2.0}),
}


def make(actions, **settings):
    settings = {"learning_rate": RATE, "rms_prop_eps": EPSILON, "policy_kwargs": {"net_arch": [4]}, **settings}
    config = a2c.Config(**settings)
    return config, a2c.make(config, OBS_SPACE, ACTIONS[actions][0])


def optimizers(name):
    """Those of the settings: RMSprop for everything unless the name says otherwise."""
    rms = lambda layers, rate=RATE: by_hand.RMSprop(layers, rate, EPSILON)  # noqa: E731
    if "Adam" in name:
        return lambda network: [Adam(network.everything, RATE, eps=EPSILON)]
    if "two" in name:
        return lambda network: [rms(network.policy), rms(network.vf, 1e-2)]
    return lambda network: [rms(network.everything)]


@pytest.mark.parametrize("name", SETTINGS)
def test_three_updates_equal_numpy(name):
    """14 of 15 steps exist. At a quarter of the way from 0.04 to 0 the rate is 0.03."""
    actions, settings = SETTINGS[name]
    space, kind = ACTIONS[actions]
    config, algorithm = make(actions, **settings)
    state, update = begin(algorithm), jax.jit(algorithm.update)
    hand = by_hand.A2C(state.network, config, kind, optimizers(name))
    for k in range(3):
        rollout = random_rollout(space, seed=k, valid=LAST_STEP_MISSING)
        expected = hand.update(rollout, 0.3 if "schedules" in name else 0.0)
        state, metrics = update(state, rollout, CLOCK)
        given = by_hand.Network(state.network).everything
        assert_equal_layers(given, hand.network.everything, f"after rollout {k}", atol=1e-5)
        expected["entropy_loss"] = -expected["entropy"]
        for field in ("policy_loss", "value_loss", "entropy_loss"):
            assert float(metrics[field]) == pytest.approx(expected[field], rel=1e-4, abs=1e-5), field
        if kind == "box":
            assert float(metrics["std"]) == pytest.approx(np.exp(hand.network.log_std[0][0]).mean(), rel=1e-5)
    assert int(state.n_updates) == 3
    if "Adam" not in name:
        seconds = [layer for optimizer in hand.optimizers for layer in optimizer.second]
        kept = by_hand.Network(state.optimizer.nu)
        expected = kept.pi + kept.log_std + kept.vf if "two" in name else kept.everything
        assert_equal_layers(expected, seconds, "means of squares", atol=1e-5)


def test_the_first_step_of_rmsprop_is_that_of_a_mean_of_squares_which_began_at_1():
    """A gradient g moves a weight by rate g / sqrt(0.99 + 0.01 g^2 + eps): far less than from 0, by rate g / (0.1 |g|)."""
    config, algorithm = make("box", max_grad_norm=None)
    state, rollout = begin(algorithm), random_rollout(ACTIONS["box"][0])
    after, _ = jax.jit(algorithm.update)(state, rollout, CLOCK)
    hand = by_hand.A2C(state.network, config, "box", lambda network: [Kept(network.everything)])
    hand.update(rollout, 0.0)
    (kept,) = hand.optimizers
    expected = [[RATE * g / np.sqrt(0.99 + 0.01 * g**2 + EPSILON) for g in layer] for layer in kept.slopes]
    moved = zip(by_hand.Network(state.network).everything, by_hand.Network(after.network).everything, strict=True)
    given = [[a - b for a, b in zip(one, two, strict=True)] for one, two in moved]
    assert_equal_layers(given, expected, "first step", atol=1e-6)


class Kept:
    """An optimizer that only keeps the slopes."""

    def __init__(self, network):
        self.network = network

    def step(self, slopes):
        self.slopes = slopes


@pytest.mark.parametrize("actions", ACTIONS)
def test_the_gradient_of_the_loss_equals_finite_differences_in_float64(actions):
    space, kind = ACTIONS[actions]
    config, algorithm = make(actions, ent_coef=0.1, vf_coef=0.25)
    network = begin(algorithm).network
    hand, rng, rollout = by_hand.Network(network), np.random.default_rng(0), random_rollout(space)
    n = N_STEPS * N_ENVS
    obs, action = rollout.obs.reshape(n, -1), rollout.action.reshape(n, *rollout.action.shape[2:])
    advantage, target = rng.normal(size=(2, n)).astype(np.float32)
    valid = np.arange(n) % 4 > 0
    unused = np.zeros(n, np.float32)
    batch = Samples(obs, action, unused, unused, advantage, target, valid)
    (total, _), given = jax.jit(jax.value_and_grad(a2c.loss, has_aux=True), static_argnums=2)(
        network, batch, config, CLOCK
    )

    def expected():
        log_prob, entropy = by_hand.log_prob_and_entropy(hand, obs, action, kind)
        value_loss = np.mean((hand.value(obs)[valid] - target[valid]) ** 2)
        return -np.mean((log_prob * advantage)[valid]) + 0.25 * value_loss - 0.1 * np.mean(entropy[valid])

    assert float(total) == pytest.approx(expected(), rel=1e-4)
    slopes = gradient(hand.everything, expected)
    assert_equal_layers(by_hand.Network(given).everything, slopes, "gradient", atol=1e-5, rtol=1e-4)


def test_padding_leaks_into_no_update():
    _, algorithm = make("box", normalize_advantage=True)
    state, update = begin(algorithm), jax.jit(algorithm.update)
    rollout = random_rollout(ACTIONS["box"][0], valid=LAST_STEP_MISSING)
    spoil = lambda a: np.where(rollout.valid.reshape(*rollout.valid.shape, *[1] * (a.ndim - 2)), a, 50.0)  # noqa: E731
    names = ("obs", "action", "reward", "next_obs")
    spoilt = rollout._replace(**{name: spoil(getattr(rollout, name)).astype(np.float32) for name in names})
    for one, two in zip(*(jax.tree.leaves(update(state, r, CLOCK)) for r in (rollout, spoilt)), strict=True):
        np.testing.assert_array_equal(one, two)
