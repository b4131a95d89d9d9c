"""Whole updates of SAC and DQN against recorded ones of Stable-Baselines3 (tests/golden/record_updates.py)."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.core.algorithm import Clock, Transition
from rejeu.core.checkpoint import tree_to_arrays
from tests.algorithms.batches import BOX, OBS_SPACE
from tests.algorithms.test_dqn import ACTION_SPACE as DISCRETE
from tests.environments import Sampled
from tests.numpy_networks import forward

GOLDEN = Path(__file__).parents[1] / "golden"
SMALL = {"learning_rate": 1e-2, "gamma": 0.9, "policy_kwargs": {"net_arch": [5, 4]}, "seed": 0}


def sac_from_sb3(record, prefix):
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


def dqn_from_sb3(record, prefix):
    """A recorded set of torch parameters under our names, weights transposed; a record of moments has no target."""
    layers = {"torso.layers.0": 0, "torso.layers.1": 2, "head": 4}
    return {
        f"{ours}.{name}.{kind}": record[f"{prefix}{theirs}.q_net.{index}.{kind}"].T
        for ours, theirs in (("network", "q_net"), ("target_network", "q_net_target"))
        if f"{prefix}{theirs}.q_net.0.weight" in record
        for name, index in layers.items()
        for kind in ("weight", "bias")
    }


class Recorded(NamedTuple):
    """An algorithm with its recording."""

    agent: Any
    settings: dict[str, Any]
    from_sb3: Any
    steps: tuple[int, ...]
    """Environment steps of the updates; DQN moved its target before the third only."""
    losses: dict[str, str]
    """Metrics by their names in the recording."""
    beside: set[str]
    """Leaves of the state that the recording does not have."""


RECORDED = {
    "sac": Recorded(
        rejeu.SAC,
        {"tau": 0.1, "ent_coef": "auto_0.3"},
        sac_from_sb3,
        (0, 0, 0),
        {name: name for name in ("critic_loss", "actor_loss", "ent_coef")},
        {"key", "n_updates"},
    ),
    "dqn": Recorded(
        rejeu.DQN,
        {"tau": 0.25, "target_update_interval": 2, "max_grad_norm": 0.1},
        dqn_from_sb3,
        (1, 1, 2),
        {"loss": "loss"},
        {"step", "n_updates"},
    ),
}


def moments_from_sb3(kind, record, prefix):
    found = {}
    for ours, theirs in (("mu", "exp_avg"), ("nu", "exp_avg_sq")):
        for name, value in kind.from_sb3(record, f"{prefix}{theirs}.").items():
            part, _, rest = name.partition(".")
            optimizer = {"log_alpha": "alpha_optimizer", "network": "optimizer"}.get(part, f"{part}_optimizer")
            found[f"{optimizer}.{ours}.{rest}".removesuffix(".")] = value
    return found


def read(name):
    with np.load(GOLDEN / f"{name}_sb3.npz", allow_pickle=False) as file:
        return dict(file)


@pytest.fixture(scope="module", params=RECORDED)
def replayed(request):
    """The recording, and our states and metrics after each of its updates, from its parameters, batches and noise."""
    kind, record = RECORDED[request.param], read(request.param)
    space = BOX if request.param == "sac" else DISCRETE
    agent = kind.agent("MlpPolicy", Sampled(OBS_SPACE, space), **SMALL, **kind.settings)
    agent.set_parameters(kind.from_sb3(record, "before."), exact_match=False)
    algorithm = agent.algorithm.make(agent.config, OBS_SPACE, space)
    states, metrics, state = [], [], agent.state
    for k in range(3):
        # The target is computed before the policy loss, hence the order; nothing is jitted, so each is called once.
        noises = iter([record[f"{k}.{name}"] for name in ("target_noise", "actor_noise") if f"{k}.{name}" in record])
        discount = np.where(record[f"{k}.terminated"], 0.0, 0.9).astype(np.float32)
        obs, action, reward, next_obs = (record[f"{k}.{name}"] for name in ("obs", "action", "reward", "next_obs"))
        action = action.astype(np.float32 if space is BOX else np.int32)
        clock = Clock(np.uint32(kind.steps[k]), np.uint32(0), np.float32(0.5))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(jax.random, "normal", lambda key, shape, dtype, noises=noises: jnp.array(next(noises)))
            state, metric = algorithm.update(state, Transition(obs, action, reward, next_obs, discount), clock)
        assert next(noises, None) is None
        states.append(state)
        metrics.append(metric)
    return kind, record, states, metrics


@pytest.mark.parametrize("k", [0, 2])
def test_parameters_and_moments_after_an_update_equal_stable_baselines3(replayed, k):
    kind, record, states, _ = replayed
    given = tree_to_arrays(states[k])
    parameters, moments = (f(record, f"{k}.after.") for f in (kind.from_sb3, lambda *a: moments_from_sb3(kind, *a)))
    assert {name for name in given if "optimizer" not in name} == {*parameters, *kind.beside}
    assert {name for name in given if "optimizer" in name and not name.endswith("count")} == set(moments)
    for name, value in parameters.items():
        np.testing.assert_allclose(given[name], value, atol=1e-5, err_msg=name)
    for name, value in moments.items():
        np.testing.assert_allclose(given[name], value, rtol=1e-4, atol=1e-6, err_msg=name)


def test_losses_equal_stable_baselines3(replayed):
    kind, record, _, metrics = replayed
    for k, metric in enumerate(metrics):
        for ours, theirs in kind.losses.items():
            assert float(metric[ours]) == pytest.approx(float(record[f"{k}.{theirs}"]), abs=1e-5), (k, ours)


@pytest.mark.parametrize("name", RECORDED)
def test_recorded_updates_move_every_network_by_more_than_the_tolerance(name):
    """Guards the tests above: updates that did nothing must not pass them."""
    kind, record = RECORDED[name], read(name)
    before, after = (kind.from_sb3(record, prefix) for prefix in ("before.", "2.after."))
    for part in {name.partition(".")[0] for name in before}:
        moved = max(np.abs(after[name] - before[name]).max() for name in before if name.partition(".")[0] == part)
        assert moved > 1e-3, part


def test_recorded_gradients_of_dqn_are_clipped():
    record = read("dqn")
    assert [float(record[f"{k}.grad_norm"]) for k in range(3)] == pytest.approx([0.1] * 3, rel=1e-3)


def test_recorded_actions_are_not_saturated():
    """Stable-Baselines3 adds 1e-6 within its log(1 - a^2): less than 3e-6 a dimension where 1 - a^2 > 0.4."""
    record = read("sac")
    parameters = sac_from_sb3(record, "before.")
    weights = [
        (np.float64(parameters[f"actor.{name}.weight"]), np.float64(parameters[f"actor.{name}.bias"]))
        for name in ("torso.layers.0", "torso.layers.1", "head")
    ]
    mean, log_std = np.split(forward(weights, record["0.obs"]), 2, axis=1)
    assert (np.tanh(mean + np.exp(log_std) * record["0.actor_noise"]) ** 2 < 0.6).all()
