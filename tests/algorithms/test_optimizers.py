"""The setting ``optimizer``: names, Optax optimizers of the user's own, and files that mention them."""

import os
import subprocess
import sys
from functools import partial

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from rejeu.algorithms import a2c, crossq, optimizers, sac
from rejeu.algorithms.config import rebuild, to_json
from rejeu.core.algorithm import descend
from rejeu.core.errors import CheckpointError
from tests.tiers import exhaustive

OWN = [optax.lamb, partial(optax.adamw, weight_decay=1e-2), optax.chain(optax.clip(1.0), optax.adabelief(1.0))]


def stepped(optimizer, rate, params, gradients, n=3):
    state = optimizer.init(params)
    for _ in range(n):
        params, state = descend(params, gradients, state, optimizer, rate)
    return params


@pytest.mark.parametrize(
    ("name", "reference"),
    [
        ("adam", optax.adam),
        ("adamw", optax.adamw),
        ("nadam", optax.nadam),
        ("radam", optax.radam),
        ("amsgrad", optax.amsgrad),
        ("lion", partial(optax.lion, weight_decay=0.0)),
        ("rmsprop", partial(optax.rmsprop, decay=0.99)),
        ("sgd", optax.sgd),
    ],
)
def test_a_name_gives_optaxs_optimizer(name, reference):
    params, gradients = {"w": jnp.array([1.0, -2.0])}, {"w": jnp.array([0.5, 0.25])}
    given = stepped(optimizers.make(optimizers.parse("optimizer", name)), 0.1, params, gradients)
    optimizer = reference(0.1)
    state, expected = optimizer.init(params), params
    for _ in range(3):
        change, state = optimizer.update(gradients, state, expected)
        expected = optax.apply_updates(expected, change)
    np.testing.assert_allclose(given["w"], expected["w"], rtol=1e-6)


@pytest.mark.parametrize("name", list(optimizers.OPTIMIZERS))
def test_a_dict_of_a_name_alone_gives_what_the_name_gives(name):
    params, gradients = {"w": jnp.array([1.0, -2.0])}, {"w": jnp.array([0.5, 0.25])}
    for extra in ({}, {"momentum": 0.0}):
        both = [optimizers.parse("optimizer", given) for given in (name, {"name": name, **extra})]
        one, other = (stepped(optimizers.make(given), 0.1, params, gradients) for given in both)
        np.testing.assert_allclose(one["w"], other["w"], rtol=1e-6)


def test_an_optimizer_of_the_users_own_is_scaled_by_the_learning_rate():
    params, gradients = jnp.array([1.0]), jnp.array([2.0])
    for own in (optax.sgd, optax.sgd(1.0)):
        assert float(stepped(optimizers.make(own), 0.25, params, gradients, n=1)[0]) == 0.5


@pytest.mark.parametrize(("given", "error"), [("adamm", ValueError), (3, TypeError), (lambda rate: rate, TypeError)])
def test_what_is_not_an_optimizer_is_refused(given, error):
    with pytest.raises(error, match="optimizer="):
        sac.Config(optimizer=given)


def test_algorithms_keep_their_own_settings_of_adam():
    assert optimizers.make(crossq.Config().optimizer, b1=0.5).init(jnp.zeros(1)).mu.shape == (1,)
    assert isinstance(a2c.optimizer_of(a2c.Config()).init(jnp.zeros(1)), optax.ScaleByRmsState)
    assert isinstance(a2c.optimizer_of(a2c.Config(use_rms_prop=False)).init(jnp.zeros(1)), optax.ScaleByAdamState)
    assert isinstance(a2c.optimizer_of(a2c.Config(optimizer="adam")).init(jnp.zeros(1)), optax.ScaleByAdamState)


@pytest.mark.parametrize("optimizer", OWN)
def test_a_file_mentions_an_optimizer_of_the_users_own(optimizer):
    config = sac.Config(optimizer=optimizer)
    saved = to_json(config)
    assert saved["optimizer"] == {"own": optimizers.name(optimizer)}
    with pytest.raises(CheckpointError, match="its optimizer is your own"):
        rebuild(sac.Config, saved, {})
    assert rebuild(sac.Config, saved, {"optimizer": optimizer}) == config


SCRIPT = """
import sys
import jax, numpy as np, optax, rejeu

kind, optimizer = sys.argv[1:]
settings = {"DQN": {"learning_starts": 10, "train_freq": 1}, "A2C": {},
            "PPO": {"n_steps": 32, "batch_size": 16, "n_epochs": 1}}[kind]
optimizer = {"lamb": optax.lamb, "clip": optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1.0)),
             "adafactor": optax.adafactor}[optimizer]
agent = getattr(rejeu, kind)("MlpPolicy", "CartPole-v1", optimizer=optimizer, learning_rate=1e-3, seed=0, **settings)
before = agent.get_parameters()
after = agent.learn(40).get_parameters()
assert any((before[name] != after[name]).any() for name in before), kind
assert all(np.isfinite(array).all() for array in after.values()), kind
"""


@exhaustive
@pytest.mark.parametrize("kind", ["DQN", "A2C", "PPO"])
@pytest.mark.parametrize("optimizer", ["lamb", "clip", "adafactor"])
def test_optimizers_that_look_at_all_gradients_work_in_the_programs_that_users_compile(kind, optimizer):
    """The tests compile with other options, under which the kernels of these optimizers are never made."""
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, kind, optimizer], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
