"""TRPO's step against the natural gradient in closed form, its line search, and its settings."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from scipy import special

from rejeu.algorithms import trpo
from rejeu.algorithms.actor_critic.steps import samples
from tests.algorithms.test_ppo import ACTIONS, CLOCK, LAST_STEP_MISSING, OBS_SPACE, begin, random_rollout

LINEAR = {"net_arch": [], "ortho_init": False}


def make(actions, **settings):
    config = trpo.Config(**{"policy_kwargs": LINEAR, "cg_max_steps": 40, **settings})
    return config, trpo.make(config, OBS_SPACE, ACTIONS[actions][0])


def natural_step(network, data, config, kind):
    """The direction of the step and ``x . (F + damping) x``, by a dense solve in float64.

    For a linear policy with outputs ``z = W'(s, 1)`` the Hessian of the KL divergence is the mean over states of
    ``(s, 1)(s, 1)' (x) H``, where H is the Fisher information of the outputs: ``1 / sigma^2`` for the mean of a normal,
    ``diag(p) - p p'`` for logits, ``p (1 - p)`` for bits; of a log standard deviation it is 2.
    """
    keep = np.asarray(data.valid)
    inputs = np.concatenate([np.asarray(data.obs, np.float64), np.ones((len(keep), 1))], axis=1)[keep]
    weights = np.concatenate([network.head.weight, network.head.bias[None]]).astype(np.float64)
    outputs, action = inputs @ weights, np.asarray(data.action)[keep]
    advantage = np.asarray(data.advantage, np.float64)[keep]
    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    n, width = outputs.shape
    extra = 0
    if kind == "box":
        sigma = np.exp(np.asarray(network.log_std, np.float64))
        z = (action - outputs) / sigma
        score, information, extra = z / sigma, np.broadcast_to(np.diag(sigma**-2), (n, width, width)), width
    elif kind == "binary":
        p = special.expit(outputs)
        score, information = action - p, (p * (1 - p))[:, :, None] * np.eye(width)
    else:
        p, score, information = [], [], np.zeros((n, width, width))
        ends = np.cumsum([0, *kind])
        for i, (first, last) in enumerate(itertools.pairwise(ends)):
            part = special.softmax(outputs[:, first:last], axis=1)
            chosen = action.reshape(n, -1)[:, i]
            score.append(np.eye(last - first)[chosen] - part)
            information[:, first:last, first:last] = part[:, :, None] * np.eye(last - first) - np.einsum(
                "ni,nj->nij", part, part
            )
        score = np.concatenate(score, axis=1)
    gradient = np.einsum("ni,nj,n->ij", inputs, score, advantage).ravel() / n
    hessian = np.einsum("ni,nj,nab->iajb", inputs, inputs, information).reshape(gradient.size, -1) / n
    if extra:
        gradient = np.concatenate([gradient, ((z**2 - 1) * advantage[:, None]).mean(axis=0)])
        full = np.zeros((gradient.size, gradient.size))
        full[: len(hessian), : len(hessian)], full[len(hessian) :, len(hessian) :] = hessian, 2 * np.eye(extra)
        hessian = full
    damped = hessian + config.cg_damping * np.eye(len(hessian))
    direction = np.linalg.solve(damped, gradient)
    return direction, direction @ damped @ direction


@pytest.mark.parametrize("actions", ACTIONS)
def test_the_step_is_the_natural_gradient_scaled_to_the_bound(actions):
    space, kind = ACTIONS[actions]
    config, algorithm = make(actions, target_kl=1e-4)
    state = begin(algorithm)
    data = samples(state.network, random_rollout(space, seed=3, valid=LAST_STEP_MISSING), config.gae_lambda)
    network, step = jax.jit(lambda n, d: trpo.policy_step(n, d, config))(state.network, data)
    assert float(step.accepted) == 1.0
    direction, curvature = natural_step(state.network, data, config, kind)
    longest = np.sqrt(2 * config.target_kl / curvature)
    parts = lambda n: [n.head.weight, n.head.bias] + ([n.log_std] if actions == "box" else [])  # noqa: E731
    moved = [np.ravel(np.float64(a) - np.float64(b)) for a, b in zip(parts(network), parts(state.network), strict=True)]
    moved = np.concatenate(moved)
    length = moved @ direction / (direction @ direction) / longest
    attempts = np.log(length) / np.log(config.line_search_shrinking_factor)
    assert attempts == pytest.approx(round(attempts), abs=0.02)
    np.testing.assert_allclose(moved, length * longest * direction, atol=2e-5)
    assert 0 < float(step.kl) < config.target_kl
    np.testing.assert_array_equal(network.value_head.weight, state.network.value_head.weight)


def test_the_step_is_within_the_bound_and_the_attempt_before_it_was_not():
    """The attempt before is a ninth longer. By the reversed divergence, or with a bound half as large again, it would do."""
    config, algorithm = make("box", target_kl=0.3, line_search_shrinking_factor=0.9, line_search_max_iter=40)
    state = begin(algorithm)
    data = samples(state.network, random_rollout(ACTIONS["box"][0], seed=2), config.gae_lambda)
    network, step = jax.jit(lambda n, d: trpo.policy_step(n, d, config))(state.network, data)

    def normal(scale):
        """Means and standard deviations after a multiple of the step that was taken."""
        old, new = ([n.head.weight, n.head.bias, n.log_std] for n in (state.network, network))
        weight, bias, log_std = (
            np.float64(o) + scale * (np.float64(n) - np.float64(o)) for o, n in zip(old, new, strict=True)
        )
        return np.float64(data.obs) @ weight + bias, np.exp(log_std)

    def divergence(one, two):
        (mean, std), (other, wider) = one, two
        return (np.log(wider / std) + (std**2 + (mean - other) ** 2) / (2 * wider**2) - 0.5).sum(axis=1).mean()

    assert float(step.kl) == pytest.approx(divergence(normal(0.0), normal(1.0)), rel=1e-4)
    assert float(step.kl) < 0.3 < divergence(normal(0.0), normal(1 / 0.9)) < 1.5 * 0.3
    assert divergence(normal(1 / 0.9), normal(0.0)) < 0.3


def test_a_step_that_does_not_improve_is_refused():
    """With one attempt whose step is far too long for the quadratic approximation, the policy stays; the value learns."""
    _, algorithm = make("choice", target_kl=50.0, cg_damping=0.0, line_search_max_iter=1, cg_max_steps=40)
    state = begin(algorithm)
    rollout = random_rollout(ACTIONS["choice"][0])
    after, metrics = jax.jit(algorithm.update)(state, rollout, CLOCK)
    assert float(metrics["is_line_search_success"]) == 0.0
    assert float(metrics["kl_divergence_loss"]) == 0.0
    np.testing.assert_array_equal(after.network.head.weight, state.network.head.weight)
    assert not np.array_equal(after.network.value_head.weight, state.network.value_head.weight)


def test_without_advantage_no_step_is_taken():
    config, algorithm = make("box", normalize_advantage=False)
    state = begin(algorithm)
    data = samples(state.network, random_rollout(ACTIONS["box"][0]), config.gae_lambda)
    data = data._replace(advantage=0.0 * data.advantage)
    network, step = jax.jit(lambda n, d: trpo.policy_step(n, d, config))(state.network, data)
    assert float(step.accepted) == 0.0
    for one, two in zip(jax.tree.leaves(network), jax.tree.leaves(state.network), strict=True):
        np.testing.assert_array_equal(one, two)


def test_every_so_many_steps_count_for_the_policy():
    config, algorithm = make("box")
    state = begin(algorithm)
    data = samples(state.network, random_rollout(ACTIONS["box"][0]), config.gae_lambda)
    half = jax.tree.map(lambda x: x[::2], data)
    one, _ = trpo.policy_step(state.network, data, dataclasses.replace(config, sub_sampling_factor=2))
    two, _ = trpo.policy_step(state.network, half, config)
    np.testing.assert_array_equal(one.head.weight, two.head.weight)


def test_the_update_counts_its_gradient_steps_and_fits_the_value():
    config, algorithm = make("box", batch_size=8, n_critic_updates=200, learning_rate=1e-2)
    state = begin(algorithm)
    rollout = random_rollout(ACTIONS["box"][0], valid=LAST_STEP_MISSING)
    data = samples(state.network, rollout, config.gae_lambda)
    after, metrics = jax.jit(algorithm.update)(state, rollout, CLOCK)
    assert int(after.n_updates) == float(metrics["gradient_steps"]) == 1 + 200 * 2 == config.gradient_steps(14)
    keep = np.asarray(data.valid)
    inputs = np.concatenate([np.asarray(data.obs), np.ones((len(keep), 1))], axis=1)[keep]
    target = np.asarray(data.target)[keep]
    best = np.linalg.lstsq(inputs, target, rcond=None)[0]
    fitted = np.asarray(after.network.value(data.obs))[keep]
    assert np.mean((fitted - target) ** 2) < 1.1 * np.mean((inputs @ best - target) ** 2) + 1e-3


def test_a_factor_that_leaves_environments_out_is_warned_of():
    with pytest.warns(UserWarning, match="takes 2 of 4 environments only"):
        trpo.warn_of_unused(2, 4)
    trpo.warn_of_unused(3, 4)
