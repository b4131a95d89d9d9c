"""A2C's losses, gradients and whole updates against float64 NumPy, its settings and what it refuses."""

import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import a2c
from tests import numpy_actor_critic as by_hand
from tests.algorithms.test_ppo import (
    ACTIONS,
    CLOCK,
    LAST_STEP_MISSING,
    OBS_SPACE,
    begin,
    random_rollout,
)
from tests.numpy_networks import Adam, assert_equal_layers

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
