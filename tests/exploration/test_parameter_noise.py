"""Adaptive parameter-space noise: who acts, when it changes, how its size is steered, and that it is plain arrays."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from rejeu.algorithms import ddpg, dqn
from rejeu.core import algorithm as core, checkpoint
from rejeu.core.algorithm import Clock
from rejeu.exploration import explorer, parameter_space
from rejeu.exploration.parameter_space import ParameterNoise

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(1))
OBS_SPACE = spaces.Box(-1, 1, (3,), np.float32)
NETS = {"net_arch": [16], "layer_norm": True}


@cache
def compiled(module):
    """Returns an algorithm, its exploiting policy and an actor; DQN without its epsilon."""
    actions = spaces.Discrete(5) if module is dqn else spaces.Box(-1, 1, (2,), np.float32)
    settings = {"exploration_final_eps": 0.0} if module is dqn else {}
    algorithm = module.make(module.Config(policy_kwargs=NETS, **settings), OBS_SPACE, actions)
    actor = jax.jit(lambda key: algorithm.actor(algorithm.init(key)))(jax.random.PRNGKey(0))
    return algorithm, jax.jit(algorithm.exploit), actor


@cache
def made(module=ddpg, noise: ParameterNoise = ParameterNoise(), n_envs: int = 4):  # noqa: B008 - frozen
    """Returns an algorithm's exploiting policy, its explorer's ``act``, a carry and an actor."""
    algorithm, exploit, actor = compiled(module)
    exploring = explorer.make(algorithm, noise)
    return exploit, jax.jit(exploring.act), exploring.init(actor, n_envs), actor


def of_sigma(carry: parameter_space.State, sigma: float) -> parameter_space.State:
    """Returns the carry as it would be had ``sigma`` been adapted to this value."""
    return parameter_space.State(carry.perturbation, jnp.float32(sigma), carry.distance, carry.count)


def observations(n: int, seed: int = 0) -> jax.Array:
    return jax.random.uniform(jax.random.PRNGKey(seed), (n, 3), minval=-1, maxval=1)


def play(act, carry, actor, n_steps: int, length: int, n_envs: int = 4, seed: int = 0):
    """Explores ``n_steps`` steps in episodes of ``length``; returns the carry, all sigmas and the perturbations."""
    key, sigmas, perturbations = jax.random.PRNGKey(seed), [], []
    for t in range(n_steps):
        ended = np.full(n_envs, t % length == 0)
        _, carry = act(carry, actor, observations(n_envs, t), ended, jax.random.fold_in(key, t), CLOCK)
        sigmas.append(float(carry.sigma))
        perturbations.append([np.asarray(leaf) for leaf in carry.perturbation])
    return carry, sigmas, perturbations


@pytest.mark.parametrize("module", [ddpg, dqn])
def test_the_perturbed_actor_acts_in_each_environment(module):
    exploit, act, carry, actor = made(module)
    obs = observations(4)
    action, carry = act(of_sigma(carry, 0.5), actor, obs, np.ones(4, bool), jax.random.PRNGKey(1), CLOCK)
    for env in range(4):
        perturbed = parameter_space.perturb(actor, [leaf[env] for leaf in carry.perturbation])
        np.testing.assert_allclose(action[env], exploit(perturbed, obs[env : env + 1])[0], atol=1e-6)
    ended = np.array([False, True, False, False])  # who ended draws anew
    _, after = act(carry, actor, obs, ended, jax.random.PRNGKey(2), CLOCK)
    for old, new in zip(carry.perturbation, after.perturbation, strict=True):
        np.testing.assert_array_equal((np.asarray(old) != new).any(axis=tuple(range(1, old.ndim))), ended)
    np.testing.assert_array_equal(after.count, [2, 1, 2, 2])


def test_perturbations_differ_between_environments_and_change_at_episode_starts_only():
    _, act, carry, actor = made()
    _, _, perturbations = play(act, carry, actor, n_steps=10, length=5)
    weights = [perturbation[0] for perturbation in perturbations]
    assert len({row.tobytes() for row in weights[0]}) == 4
    for t in range(1, 10):
        assert np.array_equal(weights[t], weights[t - 1]) == (t % 5 != 0)


def test_noise_is_drawn_at_the_first_step_also_in_the_middle_of_an_episode():
    """The first steps of a run are random, so that exploration may begin long after an episode did."""
    _, act, carry, actor = made()
    _, carry = act(carry, actor, observations(4), np.zeros(4, bool), jax.random.PRNGKey(0), CLOCK)
    assert all((np.asarray(leaf) != 0).all() for leaf in carry.perturbation)
    assert float(carry.sigma) == pytest.approx(0.1)


def test_noise_has_the_standard_deviation_sigma_in_every_perturbed_leaf_and_spares_layer_norm():
    _, act, carry, actor = made(noise=ParameterNoise(initial_sigma=0.3), n_envs=500)
    _, carry = act(carry, actor, observations(500), np.ones(500, bool), jax.random.PRNGKey(0), CLOCK)
    names = core.names(actor)
    spared = [name for i, name in enumerate(names) if i not in parameter_space.perturbed_leaves(actor)]
    assert spared == ["torso.norms.0.scale", "torso.norms.0.offset"]
    assert len(carry.perturbation) == 4  # weight and bias of the hidden layer and the head
    for leaf in carry.perturbation:
        assert float(jnp.std(leaf)) == pytest.approx(0.3, rel=4 / np.sqrt(2 * leaf.size))


@pytest.mark.parametrize("module", [ddpg, dqn])
def test_sigma_rises_while_policies_are_too_alike_and_falls_while_they_differ_too_much(module):
    """Four environments end together after 3 steps: each adapts once, so that sigma moves by 1.1^4 at every end."""
    for target, factor in ((0.9, 1.1**4), (1e-6, 1.1**-4)):
        noise = ParameterNoise(0.02, target_distance=target, adaptation=1.1, adaptation_interval=4)
        _, act, carry, actor = made(module, noise)
        _, sigmas, _ = play(act, carry, actor, n_steps=10, length=3)
        expected = 0.02 * factor ** np.array([0, 0, 0, 1, 1, 1, 2, 2, 2, 3])
        np.testing.assert_allclose(sigmas, expected, rtol=1e-5)


def test_long_episodes_adapt_once_per_interval():
    noise = ParameterNoise(0.02, target_distance=0.9, adaptation=1.1, adaptation_interval=4)
    _, act, carry, actor = made(ddpg, noise)
    _, sigmas, _ = play(act, carry, actor, n_steps=11, length=10)
    assert sigmas[-1] == pytest.approx(0.02 * 1.1 ** (4 * 10 / 4), rel=1e-5)


def test_sigma_settles_where_the_actions_differ_by_the_target():
    """At the end the root mean square difference of actions over many states is near the target distance."""
    noise = ParameterNoise(initial_sigma=1.0, target_distance=0.1, adaptation=1.05)
    exploit, act, carry, actor = made(noise=noise)
    carry, _, _ = play(act, carry, actor, n_steps=400, length=4)
    differences = []
    for env in range(4):
        perturbed = parameter_space.perturb(actor, [leaf[env] for leaf in carry.perturbation])
        obs = observations(100, env)
        differences.append(np.mean((exploit(perturbed, obs) - exploit(actor, obs)) ** 2))
    assert 0.05 < np.sqrt(np.mean(differences)) < 0.2


def test_distance_is_measured_over_the_states_of_the_episode():
    exploit, act, carry, actor = made()
    carry, expected = of_sigma(carry, 0.5), np.zeros(4)
    for t in range(3):
        obs = observations(4, t)
        _, carry = act(carry, actor, obs, np.full(4, t == 0), jax.random.PRNGKey(t), CLOCK)
        plain = np.asarray(exploit(actor, obs), np.float64)
        for env in range(4):
            perturbed = parameter_space.perturb(actor, [leaf[env] for leaf in carry.perturbation])
            varied = np.asarray(exploit(perturbed, obs[env : env + 1]), np.float64)[0]
            expected[env] += np.mean((varied - plain[env]) ** 2)
    np.testing.assert_allclose(carry.distance, expected, rtol=1e-4)
    np.testing.assert_array_equal(carry.count, [3] * 4)


def test_divergence_is_that_of_the_softmax_policies():
    rng = np.random.default_rng(0)
    plain, varied = rng.normal(size=(2, 7, 4)) * 3
    softmax = lambda q: np.exp(q) / np.exp(q).sum(axis=1, keepdims=True)  # noqa: E731
    p, q = softmax(plain), softmax(varied)
    found = parameter_space.divergence(jnp.asarray(plain, jnp.float32), jnp.asarray(varied, jnp.float32))
    np.testing.assert_allclose(found, (p * np.log(p / q)).sum(axis=1), rtol=1e-5)


def test_target_divergence_is_that_of_epsilon_greedy_from_greedy():
    """KL(greedy || epsilon-greedy) = 1 log(1 / P(greedy action)), which has probability 1 - eps + eps / n."""
    greedy, epsilon_greedy = np.array([1.0, 0, 0, 0]), np.array([0.85, 0.05, 0.05, 0.05])
    expected = float(greedy[0] * np.log(greedy[0] / epsilon_greedy[0]))
    assert parameter_space.divergence_target(0.2, 4) == pytest.approx(expected)
    with pytest.raises(ValueError, match=r"target_distance=1\.0 must be below 1"):
        parameter_space.divergence_target(1.0, 4)


def test_what_it_remembers_is_named_arrays_that_survive_a_file(tmp_path):
    _, act, carry, actor = made()
    carry, _, _ = play(act, carry, actor, n_steps=4, length=3)
    path = checkpoint.write(tmp_path / "carry", "agent", checkpoint.tree_to_arrays(carry), {})
    shapes = jax.eval_shape(lambda: carry)
    _, arrays = checkpoint.read(path, "agent")
    restored = checkpoint.arrays_to_tree(shapes, arrays, path)
    ended, key = np.array([True, False, False, True]), jax.random.PRNGKey(9)
    one, two = (act(c, actor, observations(4), ended, key, CLOCK) for c in (carry, restored))
    jax.tree.map(np.testing.assert_array_equal, one, two)
