"""State-dependent exploration: its variance and noise against NumPy, how long it stays, and where it is refused."""

import functools

import equinox as eqx
import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import ppo, sac
from rejeu.algorithms.actor_critic.config import ActorCriticConfig
from rejeu.algorithms.actor_critic.network import ActorCritic, action_kind, explorer_of, sde_explorer
from rejeu.algorithms.sac.continuous import SdeActor
from rejeu.core.algorithm import Clock
from rejeu.core.spaces import leaves
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import ByAction, BySightAndAction, Discretely
from tests.environments import Counter
from tests.helpers import assert_same_parameters
from tests.tiers import only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.0))
OBS_SPACE = gym.spaces.Box(-5.0, 5.0, (3,), np.float32)
ACTION_SPACE = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
WIDTH, N = 6, 3


@functools.cache
def network(squash=False):
    shape = ActorCriticConfig(net_arch=(WIDTH,), log_std_init=-0.7, squash_output=squash)
    made = ActorCritic(jax.random.PRNGKey(0), leaves(OBS_SPACE), action_kind(ACTION_SPACE), shape, use_sde=True)
    rng = np.random.default_rng(0)
    spread = rng.normal(-0.7, 0.5, (WIDTH, 2)).astype(np.float32)
    return eqx.tree_at(lambda n: n.log_std, made, spread)


def hidden(net, obs):
    layer = net.torso.layers[0]
    return np.tanh(np.float64(obs) @ np.float64(layer.weight) + np.float64(layer.bias))


def mean(net, obs):
    return hidden(net, obs) @ np.float64(net.head.weight) + np.float64(net.head.bias)


OBS = np.random.default_rng(1).normal(size=(N, 3)).astype(np.float32)


def test_the_deviation_is_that_of_the_noise():
    """Var(sum_i h_i E_ij) = sum_i h_i^2 sigma_ij^2, the entries of E being independent."""
    net = network()
    variance = hidden(net, OBS) ** 2 @ np.exp(2.0 * np.float64(net.log_std))
    distribution = net.policy(OBS)
    np.testing.assert_allclose(np.exp(2.0 * np.float64(distribution.log_std)), variance + 1e-6, rtol=1e-4)
    np.testing.assert_allclose(distribution.mean, mean(net, OBS), atol=1e-5)


def test_the_noise_that_is_drawn_has_that_deviation():
    net, explorer = network(), sde_explorer(-1)
    act = jax.jit(lambda key: explorer.act(explorer.init(net, N), net, OBS, np.ones(N, bool), key, CLOCK)[0])
    drawn = np.float64(jax.vmap(act)(jax.random.split(jax.random.PRNGKey(0), 4000))) - mean(net, OBS)
    variance = hidden(net, OBS) ** 2 @ np.exp(2.0 * np.float64(net.log_std))
    np.testing.assert_allclose(drawn.mean(axis=0), 0.0, atol=4 * np.sqrt(variance.max() / 4000))
    np.testing.assert_allclose(drawn.var(axis=0), variance, rtol=0.12)  # five deviations, sqrt(2 / 4000) each


def test_the_deviation_of_sac_trains_the_hidden_layer():
    """d log(sqrt(v)) / dh_i = h_i sigma_ij^2 / v_j with v_j = sum_i h_i^2 sigma_ij^2, summed over j; as in the original."""
    config = sac.Config(use_sde=True, policy_kwargs={"net_arch": [WIDTH]})
    actor = SdeActor(jax.random.PRNGKey(0), (leaves(OBS_SPACE), config.policy_kwargs), 2, config)
    h, squares = np.random.default_rng(0).normal(size=(N, WIDTH)), np.exp(2.0 * np.float64(actor.log_std))
    slope = jax.grad(lambda h: actor.distribution(h).log_std.sum())(h.astype(np.float32))
    np.testing.assert_allclose(slope, h * ((1.0 / (h**2 @ squares + 1e-6)) @ squares.T), rtol=1e-3)


@pytest.mark.parametrize("squash", [False, True])
def test_the_noise_is_a_matrix_times_the_hidden_layer(squash):
    """Least squares finds the matrix from actions at more observations than it has rows."""
    net, explorer = network(squash), sde_explorer(-1)
    carry, rng = explorer.init(net, N), np.random.default_rng(2)
    begun, rows, noise = np.ones(N, bool), [], []
    for t in range(20):
        obs = rng.normal(size=(N, 3)).astype(np.float32)
        action, carry = explorer.act(carry, net, obs, begun, jax.random.PRNGKey(t), CLOCK)
        action = np.arctanh(np.float64(action)) if squash else np.float64(action)
        rows.append(hidden(net, obs))
        noise.append(action - mean(net, obs))
        begun = np.zeros(N, bool)
    for e in range(N):
        h, y = np.array(rows)[:, e], np.array(noise)[:, e]
        matrix, *_ = np.linalg.lstsq(h, y, rcond=None)
        np.testing.assert_allclose(h @ matrix, y, atol=1e-3)
        np.testing.assert_allclose(matrix, carry[0][e], atol=2e-2)
    assert len({np.asarray(one).tobytes() for one in carry[0]}) == N  # each environment has its own


def matrices(explorer, ends):
    """The matrices ``(steps, N, ...)`` where episodes begin at these (step, environment)."""
    net = network()
    carry, result = explorer.init(net, N), []
    for t in range(12):
        begun = np.array([t == 0 or (t, e) in ends for e in range(N)])
        _, carry = explorer.act(carry, net, OBS, begun, jax.random.PRNGKey(t), CLOCK)
        result.append(np.asarray(carry[0]))
    return np.array(result)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"sde_sample_freq": -1, "n_steps": 4}, ([0, 4, 8], [0, 4, 5, 8], [0, 4, 8])),
        ({"sde_sample_freq": -1, "n_episodes": 2}, ([0], [0, 5], [0])),
        ({"sde_sample_freq": 4}, ([0, 4, 8], [0, 4, 5, 9], [0, 4, 8])),
        ({"sde_sample_freq": 1}, ([*range(12)],) * 3),
    ],
)
def test_the_noise_stays_for_a_rollout_or_so_many_steps_and_is_drawn_anew_with_each_episode(settings, expected):
    explorer = explorer_of(ppo.Config(use_sde=True, **settings), action_kind(ACTION_SPACE))
    drawn = matrices(explorer, {(5, 1)})
    for e in range(N):
        fresh = [t for t in range(12) if t == 0 or not np.array_equal(drawn[t, e], drawn[t - 1, e])]
        assert fresh == expected[e]


def test_no_gradient_reaches_the_hidden_layer_through_the_deviation():
    slope = jax.grad(lambda net: net.policy(OBS).log_std.sum())(network())
    assert np.abs(slope.torso.layers[0].weight).max() == 0.0
    assert np.abs(slope.log_std).min() > 0.0


SMALL = {"policy_kwargs": {"net_arch": [8]}, "use_sde": True, "n_steps": 32, "gamma": 0.5, "seed": 0}


@pytest.mark.parametrize("algorithm", only([rejeu.A2C], [rejeu.PPO, rejeu.A2C]))
def test_a_file_keeps_it_and_goes_on(algorithm, tmp_path):
    agent = algorithm("MlpPolicy", Counter((5,)), sde_sample_freq=4, **SMALL).learn(64)
    assert agent.state.network.log_std.shape == (8, 1)
    loaded = rejeu.load(agent.save(tmp_path / "model"), env=Counter((5,)))
    assert loaded.config == agent.config
    assert_same_parameters(agent, loaded)
    obs = np.zeros((4, 3), np.float32)
    assert np.array_equal(agent.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    loaded.learn(32)
    assert not np.array_equal(loaded.state.network.log_std, agent.state.network.log_std)


def test_prediction_draws_noise_of_its_own():
    agent = rejeu.PPO("MlpPolicy", Counter((5,)), **SMALL)
    obs = np.ones((3, 3), np.float32)
    one, other = agent.predict(obs)[0], agent.predict(obs)[0]
    assert not np.array_equal(one, other)
    assert len(np.unique(one)) == 3
    assert np.array_equal(agent.predict(obs, deterministic=True)[0], agent.predict(obs, deterministic=True)[0])


def test_predictions_have_the_deviation_of_the_noise():
    agent = rejeu.PPO("MlpPolicy", Counter((5,), low=-3.0, high=3.0), **SMALL)
    obs = np.float32([1.0, -0.5, 0.2])
    drawn = agent.predict(np.tile(obs, (4000, 1)))[0][:, 0] / 3.0
    distribution = agent.state.network.policy(obs[None])
    deviation, middle = float(np.exp(distribution.log_std[0, 0])), float(distribution.mean[0, 0])
    bounded = np.clip(middle + deviation * np.random.default_rng(0).normal(size=10**6), -1.0, 1.0)
    np.testing.assert_allclose([drawn.mean(), drawn.std()], [bounded.mean(), bounded.std()], atol=0.05)


def test_it_finds_the_best_action():
    """Of two sights, neither of them 0: there the hidden layer would be 0 at first, and with it the noise."""
    env = InProcess([BySightAndAction() for _ in range(4)], seed=0)
    agent = rejeu.PPO(
        "MlpPolicy", env, **{**SMALL, "policy_kwargs": {"net_arch": [16], "log_std_init": -1.0}}, learning_rate=1e-2
    ).learn(4000)
    action, _ = agent.predict(np.float32([[-1.0], [1.0]]), deterministic=True)
    assert action[:, 0] == pytest.approx([0.5, 1.5], abs=0.15)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"sde_sample_freq": 0}, ValueError, "use 1 or more, or -1"),
        ({"sde_sample_freq": -2}, ValueError, "sde_sample_freq=-2"),
        ({"use_sde": 1}, TypeError, "use_sde=1 must be True or False"),
        ({"policy_kwargs": {"learn_std": False}}, ValueError, "leave state_dependent_std and learn_std out"),
        ({"policy_kwargs": {"state_dependent_std": True}}, ValueError, "leave state_dependent_std and learn_std out"),
    ],
)
def test_a_bad_setting_is_refused(settings, error, message):
    with pytest.raises(error, match=message):
        rejeu.PPO("MlpPolicy", Counter(), **{**SMALL, **settings})


def test_choices_get_no_noise():
    with pytest.raises(ValueError, match="use_sde=True needs Box actions"):
        rejeu.PPO("MlpPolicy", Discretely(ByAction()), **SMALL)
