"""Whole updates of DDPG, TD3, TD3+BC, ReBRAC, IQL, SAC and TQC against float64 NumPy: losses, gradients, targets, metrics."""

from typing import Any, NamedTuple

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import ddpg, iql, rebrac, sac, td3, td3_bc, tqc
from rejeu.algorithms.ddpg import discrete as ddpg_discrete
from rejeu.algorithms.sac import discrete as sac_discrete
from rejeu.core.algorithm import TD_ERROR
from tests.algorithms import references
from tests.algorithms.batches import (
    BOX,
    CLOCK,
    DISCRETE,
    OBS_DIM,
    OBS_SPACE,
    box_batch,
    discrete_batch,
    with_next_action,
)
from tests.environments import Sampled
from tests.numpy_networks import assert_equal_layers, forward, layers
from tests.tiers import only

BATCH, RATE = 8, 1e-2
SETTINGS = {
    "policy_kwargs": {"net_arch": [5, 4]},
    "learning_rate": rejeu.Linear(2 * RATE, 0.0),  # the clock of the tests is halfway
    "tau": 0.25,
}
TEMPERATURE = {"ent_coef": "auto_0.3"}


class Case(NamedTuple):
    """An algorithm with some hyperparameters."""

    module: Any
    reference: type[references.Reference]
    settings: dict[str, Any]
    discrete: bool = False
    weighted: bool = False

    @property
    def action_space(self) -> gym.Space:
        return DISCRETE if self.discrete else BOX

    def make(self) -> Any:
        """Returns the algorithm and its configuration."""
        config = self.module.Config(**SETTINGS, **self.settings)
        return self.module.make(config, OBS_SPACE, self.action_space), config

    def batch(self, seed: int) -> Any:
        batch = (discrete_batch if self.discrete else box_batch)(seed, BATCH)
        if self.module is rebrac:
            batch = with_next_action(batch, seed)
        return batch._replace(weight=np.linspace(0.1, 1.0, BATCH, dtype=np.float32)) if self.weighted else batch


NOISY = {"target_policy_noise": 0.6, "target_noise_clip": 0.5, "n_critics": 3}


def td3_case(**settings: Any) -> Case:
    settings = {**NOISY, **settings}
    return Case(td3, references.TD3, settings, weighted=settings.get("policy_delay") == 3)


FIXED = {"ent_coef": 0.2, "target_update_interval": 2}
REDQ = {"n_critics": 5, "target_subset": 3, "policy_delay": 2}
ONE_OF_TWO = {"n_critics": 2, "target_subset": 1}
QUANTILES = {**TEMPERATURE, "n_quantiles": 5}
CASES = {
    "DDPG": Case(ddpg, references.DDPG, {}),
    "DDPG, weights and interval": Case(ddpg, references.DDPG, {"target_update_interval": 3}, weighted=True),
    "DDPG, Discrete": Case(ddpg, references.DiscreteDDPG, {}, discrete=True),
    "DDPG, Discrete, weights": Case(
        ddpg, references.DiscreteDDPG, {"target_update_interval": 3}, discrete=True, weighted=True
    ),
    "TD3": td3_case(),
    "TD3, every update": td3_case(policy_delay=1, target_policy_noise=0.0),
    "TD3, weights and a longer delay": td3_case(policy_delay=3),
    "TD3BC": Case(td3_bc, references.TD3BC, {**NOISY, "normalize": None, "alpha": 1.5}),
    "ReBRAC": Case(rebrac, references.ReBRAC, {**NOISY, "actor_bc": 0.3, "critic_bc": 0.4, "critic_layer_norm": False}),
    "IQL": Case(iql, references.IQL, {"n_critics": 3, "expectile": 0.8, "inverse_temperature": 30.0}),
    "SAC": Case(sac, references.SAC, {**TEMPERATURE, "n_critics": 3}),
    "SAC, fixed": Case(sac, references.SAC, {**FIXED, "n_critics": 3}, weighted=True),
    "SAC, target entropy": Case(sac, references.SAC, {**TEMPERATURE, "target_entropy": -0.5, "n_critics": 3}),
    "SAC, bounds": Case(sac, references.SAC, {**TEMPERATURE, "n_critics": 3, "v_min": -0.3, "v_max": 0.1}),
    "SAC, Discrete, bound": Case(sac, references.DiscreteSAC, {**TEMPERATURE, "v_max": 0.2}, discrete=True),
    "SAC, REDQ": Case(sac, references.SAC, {**TEMPERATURE, **REDQ}, weighted=True),
    "SAC, Discrete": Case(sac, references.DiscreteSAC, TEMPERATURE, discrete=True),
    "SAC, Discrete, REDQ": Case(
        sac, references.DiscreteSAC, {**TEMPERATURE, **REDQ, "n_critics": 3, "target_subset": 2}, discrete=True
    ),
    "SAC, Discrete, fixed": Case(sac, references.DiscreteSAC, FIXED, discrete=True, weighted=True),
    "SAC, Discrete, target entropy": Case(  # more than four actions can have
        sac, references.DiscreteSAC, {**TEMPERATURE, "target_entropy": 2.0}, discrete=True
    ),
    "TQC": Case(tqc, references.TQC, {**QUANTILES, "top_quantiles_to_drop_per_net": 1}),
    "TQC, nothing dropped": Case(tqc, references.TQC, {**QUANTILES, "top_quantiles_to_drop_per_net": 0}),
    "TQC, REDQ": Case(tqc, references.TQC, {**QUANTILES, **REDQ, **ONE_OF_TWO, "top_quantiles_to_drop_per_net": 1}),
    "TQC, fixed": Case(tqc, references.TQC, {**FIXED, "n_quantiles": 5}, weighted=True),
}


VARIANTS = ("TQC, nothing dropped", "TQC", "SAC, Discrete", "TD3, every update", "DDPG, Discrete")
"""Exhaustive: others have the same settings one by one."""


def state_of(algorithm):
    """A state whose targets are drawn apart from its networks.

    The target actor's last layer is ten times as large, so that its actions reach their bounds.
    """
    state, other = (jax.jit(algorithm.init)(jax.random.PRNGKey(seed)) for seed in (1, 2))
    for name in ("critic", "critics"):
        if hasattr(state, name):
            state = eqx.tree_at(lambda s, n=name: getattr(s, f"target_{n}"), state, getattr(other, name))
    if hasattr(state, "value"):  # on both sides of what the critics say
        head = state.value.head
        bold = 6.0 * head.weight, head.bias + 1.6
        state = eqx.tree_at(lambda s: (s.value.head.weight, s.value.head.bias), state, bold)
    if hasattr(state, "target_actor"):
        bold = eqx.tree_at(lambda actor: actor.head.weight, other.actor, 10.0 * other.actor.head.weight)
        state = eqx.tree_at(lambda s: s.target_actor, state, bold)
    return state


@pytest.mark.parametrize(
    "case", only([CASES[name] for name in CASES if name not in VARIANTS], CASES.values()), ids=CASES
)
def test_updates_equal_numpy(case):
    algorithm, config = case.make()
    update, state = jax.jit(algorithm.update), state_of(algorithm)
    reference = case.reference(state, config, RATE)
    for k in range(1, 5):
        batch = case.batch(k)
        (state, metrics), expected = update(state, batch, CLOCK), reference.update(batch)
        np.testing.assert_allclose(metrics.pop(TD_ERROR), expected.pop(TD_ERROR), atol=5e-5)
        assert {name: float(value) for name, value in metrics.items()} == pytest.approx(expected, rel=3e-5, abs=5e-5), k
        for name, networks in reference.networks().items():
            compare(references.members(getattr(state, name)), networks, f"{name} after {k}", atol=5e-5)
        for name, moments in reference.first_moments().items():
            given = references.members(getattr(state, name).mu)
            compare(given, moments, f"first moment of {name} after {k}", atol=1e-6, rtol=1e-3)
        if hasattr(state, "log_alpha"):
            assert float(state.log_alpha) == pytest.approx(float(reference.log_alphas[0][0]), abs=1e-5)
    assert int(getattr(state, "n_updates", 4)) == 4
    assert reference.branches <= reference.met


def compare(given, expected, what, **tolerance):
    for i, pair in enumerate(zip(given, expected, strict=True)):
        assert_equal_layers(*pair, f"{what}, {i}", **tolerance)


@pytest.mark.usefixtures("strict_dtypes")
@pytest.mark.parametrize("name", ["DDPG", "DDPG, Discrete", "TD3", "SAC", "SAC, Discrete", "TQC"])
def test_the_target_is_the_reward_where_the_mdp_terminated_and_dtypes_are_not_mixed(name):
    with jax.numpy_dtype_promotion("standard"):
        case = CASES[name]
        state, key, alpha = state_of(case.make()[0]), jax.random.PRNGKey(0), jnp.float32(0.3)
    batch = jax.tree.map(jnp.asarray, case.batch(0)._replace(discount=np.zeros(BATCH, np.float32)))
    calls = {
        "DDPG": lambda: ddpg.continuous.td_target(state.target_actor, state.target_critic, batch),
        "DDPG, Discrete": lambda: ddpg_discrete.td_target(state.target_actor, state.target_critic, batch),
        "TD3": lambda: td3.td_target(
            state.target_critics, batch, td3.smoothed_action(state.target_actor, batch.next_obs, key, 0.6, 0.5)
        ),
        "SAC": lambda: sac.continuous.td_target(state.actor, state.target_critics, alpha, batch, key),
        "SAC, Discrete": lambda: sac_discrete.td_target(state.actor, state.target_critics, alpha, batch),
        "TQC": lambda: tqc.td_target(state.actor, state.target_critics, alpha, batch, key, 4).T,
    }
    target = calls[name]()
    np.testing.assert_array_equal(target, np.broadcast_to(batch.reward, target.shape))
    target = batch.reward if name != "TQC" else jnp.tile(batch.reward[:, None], 4)
    losses = {
        "DDPG": lambda: (
            ddpg.continuous.critic_loss(state.critic, batch, target),
            ddpg.continuous.actor_loss(state.actor, state.critic, batch.obs),
        ),
        "DDPG, Discrete": lambda: (
            ddpg_discrete.critic_loss(state.critic, batch, target),
            ddpg_discrete.actor_loss(state.actor, state.critic, batch.obs),
        ),
        "TD3": lambda: td3.critics_loss(state.critics, batch, target),
        "SAC": lambda: (
            sac.continuous.critics_loss(state.critics, batch, target),
            sac.continuous.actor_loss(state.actor, state.critics, alpha, batch.obs, key),
        ),
        "SAC, Discrete": lambda: sac_discrete.critics_loss(state.critics, batch, target),
        "TQC": lambda: (
            tqc.critics_loss(state.critics, batch, target),
            sac.continuous.actor_loss(state.actor, state.critics, alpha, batch.obs, key, tqc.judge),
        ),
    }
    assert {leaf.dtype.name for leaf in jax.tree.leaves(losses[name]())} == {"float32"}


@pytest.mark.parametrize("name", ["DDPG", "TD3", "SAC", "TQC"])
def test_the_deterministic_action_is_the_squashed_mean(name):
    algorithm, _ = CASES[name].make()
    state, obs = state_of(algorithm), CASES[name].batch(0).obs
    expected = np.tanh(forward(layers(state.actor), obs)[:, : BOX.shape[0]])
    np.testing.assert_allclose(algorithm.exploit(algorithm.actor(state), obs), expected, atol=1e-6)
    if name in ("DDPG", "TD3"):  # all exploration comes from noise, which the loop adds
        explored = algorithm.explore(algorithm.actor(state), obs, jax.random.PRNGKey(0), CLOCK)
        np.testing.assert_allclose(explored, expected, atol=1e-6)


def test_a_certain_policy_has_finite_losses_and_gradients():
    """Logits 200 apart leave probabilities of 0 in float32, whose logarithm must not become NaN."""
    case = CASES["SAC, Discrete"]
    algorithm, _ = case.make()
    certain = eqx.tree_at(lambda s: s.actor.head.bias, state_of(algorithm), jnp.array([200.0, 0.0, 0.0, 0.0]))
    after, metrics = jax.jit(algorithm.update)(certain, case.batch(0), CLOCK)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves((after, metrics)))
    assert float(metrics["entropy"]) == pytest.approx(0.0, abs=1e-6)


def test_log_std_is_clipped_to_its_range():
    state = state_of(CASES["SAC"].make()[0])
    head, bias = state.actor.head, jnp.array([0.0, 0.0, 100.0, -100.0])
    actor = eqx.tree_at(lambda a: (a.head.weight, a.head.bias), state.actor, (head.weight * 0, bias))
    np.testing.assert_array_equal(sac.continuous.policy(actor, jnp.zeros((1, OBS_DIM))).log_std, [[2.0, -20.0]])


@pytest.mark.parametrize(("ent_coef", "alpha"), [("auto", 1.0), ("auto_0.1", 0.1), (0.25, 0.25)])
def test_temperature_starts_where_ent_coef_says(ent_coef, alpha):
    algorithm = sac.make(sac.Config(**SETTINGS, ent_coef=ent_coef), OBS_SPACE, BOX)
    assert float(jnp.exp(jax.jit(algorithm.init)(jax.random.PRNGKey(1)).log_alpha)) == pytest.approx(alpha)


# What is refused.


def test_noise_on_discrete_actions_is_refused_in_one_line():
    noise = rejeu.NormalActionNoise([0.0], [0.1])
    with pytest.raises(
        ValueError, match=r"^NormalActionNoise adds to continuous .* use action_noise=ParameterNoise.*$"
    ):
        rejeu.DDPG("MlpPolicy", Sampled(OBS_SPACE, DISCRETE), action_noise=noise)
