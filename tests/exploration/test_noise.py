"""Action noise: its exact statistics, the repulsive boundary, resets, and its settings' forms."""

import math
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from gymnasium import spaces

import rejeu
from rejeu.algorithms import config as configs
from rejeu.core.algorithm import Algorithm, Clock
from rejeu.exploration import explorer
from rejeu.exploration.noise import (
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    ParameterNoise,
    barrier,
    barrier_slope,
    check_fits,
    for_actions,
    parse,
    to_json,
)
from tests.environments import Counter
from tests.helpers import small_sac
from tests.tiers import only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0))


def course(noise, n_steps: int, n_envs: int = 1, policy=0.0, seed: int = 0, clip: bool = True) -> np.ndarray:
    """Returns the actions ``(n_steps, n_envs, dim)`` of a policy whose output is always ``policy``."""
    state = noise.init(n_envs)
    output = jnp.full((n_envs, len(noise.mean)), policy, jnp.float32)

    def step(state, key):
        state, action = noise.perturb(state, output, key)
        return state, jnp.clip(action, -1, 1) if clip else action

    return np.asarray(jax.lax.scan(step, state, jax.random.split(jax.random.PRNGKey(seed), n_steps))[1])


def constant(output: float, dim: int) -> Algorithm:
    """Returns an algorithm whose policy is constant."""
    act = lambda actor, obs, *_: jnp.full((obs.shape[0], dim), output, jnp.float32)  # noqa: E731
    return Algorithm(None, None, act, act, None)


def test_normal_noise_has_its_mean_and_deviation():
    noise = NormalActionNoise(mean=[0.1, -0.2], sigma=[0.2, 0.05])
    drawn = course(noise, 1, n_envs=40_000, clip=False)[0]
    error = np.array([0.2, 0.05]) / np.sqrt(40_000)
    assert (np.abs(drawn.mean(0) - [0.1, -0.2]) < 4 * error).all()
    assert (np.abs(drawn.std(0) - [0.2, 0.05]) < 4 * error / np.sqrt(2)).all()
    assert abs(np.corrcoef(drawn.T)[0, 1]) < 4 / np.sqrt(40_000)


def test_ornstein_uhlenbeck_follows_its_recursion_exactly():
    noise = OrnsteinUhlenbeckActionNoise([0.3, -0.1], [0.2, 0.4], theta=0.5, dt=0.04, initial_noise=[0.7, 0.0])
    key = jax.random.PRNGKey(1)
    state, action = noise.perturb(noise.init(1), jnp.full((1, 2), 0.25), key)
    normal = np.asarray(jax.random.normal(key, (1, 2)), np.float64)
    start, mean, sigma = np.array([[0.7, 0.0]]), np.array([[0.3, -0.1]]), np.array([[0.2, 0.4]])
    expected = start + 0.5 * (mean - start) * 0.04 + sigma * np.sqrt(0.04) * normal
    np.testing.assert_allclose(state, expected, rtol=1e-6)
    np.testing.assert_allclose(action, 0.25 + expected, rtol=1e-6)


def test_ornstein_uhlenbeck_is_stationary_with_the_closed_form_variance_and_autocorrelation():
    """With a = 1 - theta dt it is x' = a x + (1 - a) mean + s N(0, 1), s^2 = sigma^2 dt.

    Hence the stationary variance s^2 / (1 - a^2) and the autocorrelation a^k at lag k. The values of 20,000 independent
    processes after 200 steps (a^200 = 2e-9) are as many independent draws of the stationary law.
    """
    theta, dt, sigma, n = 1.0, 0.1, 0.3, 20_000
    noise = OrnsteinUhlenbeckActionNoise([0.2], [sigma], theta=theta, dt=dt)
    x = course(noise, 206, n_envs=n, clip=False)[200:, :, 0].astype(np.float64)
    a = 1 - theta * dt
    variance = sigma**2 * dt / (1 - a**2)
    assert abs(x[0].mean() - 0.2) < 4 * np.sqrt(variance / n)
    assert x[0].var() == pytest.approx(variance, rel=4 * np.sqrt(2 / n))
    for lag in (1, 2, 5):
        assert np.corrcoef(x[0], x[lag])[0, 1] == pytest.approx(a**lag, abs=4 * (1 - a ** (2 * lag)) / np.sqrt(n))


def test_drift_moves_the_resting_point_by_drift_over_theta():
    noise = OrnsteinUhlenbeckActionNoise([0.1], [0.0], theta=2.0, dt=0.1, drift=0.5)
    x = course(noise, 300, clip=False)[:, 0, 0]
    assert x[0] == pytest.approx(0.2 * 0.1)  # the drift comes after the value is used
    # used = x + theta (mean - x) dt at rest, with x = used + drift dt:
    assert x[-1] == pytest.approx(0.1 + (1 - 0.2) * 0.5 * 0.1 / 0.2)


def test_barrier_slope_is_the_derivative_of_the_barrier():
    u = np.linspace(-1.5, 1.5, 13)
    np.testing.assert_allclose(barrier(u), (np.pi * u / 2) ** 6, rtol=1e-12)
    expected = (barrier(u + 1e-5) - barrier(u - 1e-5)) / 2e-5
    np.testing.assert_allclose(barrier_slope(jnp.asarray(u, jnp.float32)), expected, rtol=1e-4, atol=1e-6)


def test_repulsion_gives_the_course_of_the_document_once_its_units_are_converted():
    """The document's explorer in its own units, in float64, over [low, high] = [-2, 2]: the half width is 2.

    There, z = (x - low) / (high - low) pi - pi / 2, the gradient is 6 z^5 pi / (high - low), and 1e-4 times it is taken
    from the action and from the process.
    """
    low, high, std, theta, dt, strength, policy = -2.0, 2.0, 0.8, 0.15, 1e-2, 1e-4, 1.7
    half = (high - low) / 2
    noise = OrnsteinUhlenbeckActionNoise(
        [0.0] * 3, std / half, theta=theta, dt=dt, repulsive=4 * strength / (high - low) ** 2
    )
    keys = jax.random.split(jax.random.PRNGKey(5), 400)
    process, expected = np.zeros(3), []
    for key in keys:
        normal = np.asarray(jax.random.normal(key, (1, 3)), np.float64)[0]
        process = process - theta * process * dt + std * np.sqrt(dt) * normal
        action = policy + process
        gradient = ((action - low) / (high - low) * np.pi - np.pi / 2) ** 5 * 6 / (high - low) * np.pi
        action = action - gradient * strength
        process = process - gradient * strength
        expected.append(np.clip(action, low, high))
    found = half * course(noise, 400, policy=policy / half, seed=5)[:, 0]
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_strong_repulsion_pushes_no_further_than_to_the_middle():
    noise = OrnsteinUhlenbeckActionNoise([0.0], 0.0, initial_noise=3.0, repulsive=1.0)
    state, action = noise.perturb(noise.init(1), jnp.ones((1, 1)), jax.random.PRNGKey(0))
    assert float(action[0, 0]) == 0.0
    assert float(state[0, 0]) == pytest.approx(-1.0)
    assert np.isfinite(course(noise, 1_000, policy=1.0)).all()


def test_processes_start_anew_where_an_episode_ended_and_only_there():
    noise = OrnsteinUhlenbeckActionNoise([0.0], 0.0, theta=1.0, dt=0.5, initial_noise=0.8)
    exploring = explorer.make(constant(0.0, 1), noise)
    obs, carry = jnp.zeros((2, 1)), exploring.init(None, 2)
    found = []
    for t in range(3):
        ended = jnp.array([t == 2, False])
        action, carry = exploring.act(carry, None, obs, ended, jax.random.PRNGKey(t), CLOCK)
        found.append(np.asarray(action)[:, 0])
    np.testing.assert_allclose(found, [[0.4, 0.4], [0.2, 0.2], [0.4, 0.1]], rtol=1e-6)


def test_each_environment_has_a_process_of_its_own():
    x = course(OrnsteinUhlenbeckActionNoise([0.0], 0.3), 2_000, n_envs=8, clip=False)[:, :, 0]
    kicks = np.diff(x, axis=0)
    correlation = np.corrcoef(kicks.T) - np.eye(8)
    assert np.abs(correlation).max() < 5 / np.sqrt(2_000)


def test_arguments_are_those_of_stable_baselines3_in_its_order():
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(2), np.full(2, 0.1), 0.2, 0.02, np.ones(2), np.float64)
    assert noise == OrnsteinUhlenbeckActionNoise(
        mean=np.zeros(2), sigma=0.1 * np.ones(2), theta=0.2, dt=0.02, initial_noise=[1, 1], dtype=np.float32
    )
    assert noise.initial_noise == (1.0, 1.0)
    assert OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2), initial_noise=None).initial_noise == (0.0, 0.0)
    assert NormalActionNoise(np.zeros(2), 0.1 * np.ones(2), np.float32).sigma == (0.1, 0.1)


@pytest.mark.parametrize(
    "noise",
    [
        NormalActionNoise([0.0, 0.1], 0.2),
        OrnsteinUhlenbeckActionNoise([0.0, 0.1], 0.2, drift=0.1, repulsive=[1e-4, 0.0], initial_noise=[0.1, 0.2]),
        ParameterNoise(0.2, 0.3, 1.05, 10),
    ],
)
def test_settings_survive_json(noise):
    import json

    assert parse(json.loads(json.dumps(to_json(noise)))) == noise
    assert hash(noise) == hash(parse(to_json(noise)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: NormalActionNoise([0, 0], [0.1, 0.1, 0.1]), "mean has 2, sigma has 3"),
        (lambda: NormalActionNoise([0], [-0.1]), "must not be negative"),
        (lambda: NormalActionNoise([0], [0.1], np.int32), "floating dtype"),
        (lambda: OrnsteinUhlenbeckActionNoise([0], [0.1], theta=-1), "theta=-1"),
        (lambda: OrnsteinUhlenbeckActionNoise([0], [0.1], dt=0), "dt=0"),
        (lambda: OrnsteinUhlenbeckActionNoise([0], [0.1], repulsive=-1), "repulsive"),
        (lambda: ParameterNoise(adaptation=0.9), "adaptation=0.9"),
        (lambda: ParameterNoise(adaptation_interval=0), "adaptation_interval=0"),
    ],
)
def test_settings_out_of_range_are_refused_by_name(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_action_noise_is_refused_where_it_does_not_fit_the_actions():
    box = spaces.Box(-1, 1, (3,))
    check_fits(None, box)
    check_fits(ParameterNoise(), spaces.Discrete(4))
    check_fits(NormalActionNoise([0] * 3, 0.1), box)
    with pytest.raises(ValueError, match="1 dimensions and the actions have 3"):
        check_fits(NormalActionNoise([0], 0.1), box)
    with pytest.raises(ValueError, match=r"use action_noise=ParameterNoise\(\)"):
        check_fits(NormalActionNoise([0], 0.1), spaces.Discrete(4))


# By hand.


def test_noise_called_by_hand_runs_the_process_of_one_environment():
    noise = OrnsteinUhlenbeckActionNoise([0.3], [0.0], theta=1.0, dt=0.5, initial_noise=[0.7])
    found = [float(noise()[0]) for _ in range(3)]
    np.testing.assert_allclose(found, [0.5, 0.4, 0.35], rtol=1e-6)  # half way to the mean in each step
    noise.reset()
    assert noise().tolist() == pytest.approx([0.5], rel=1e-6)


def test_a_seed_repeats_what_is_drawn_by_hand_and_reset_alone_lets_the_random_numbers_continue():
    noise = NormalActionNoise([0.0], 1.0)
    noise.reset(seed=3)
    first = [noise().item(), noise().item()]
    noise.reset()
    assert noise().item() not in first
    noise.reset(seed=3)
    assert [noise().item(), noise().item()] == first


def test_the_repulsive_boundary_answers_the_action_that_is_given_by_hand():
    """At u = 1 the slope is 3 pi (pi / 2)^5 = 90.13; no kicks, so that the push is all there is."""
    noise = OrnsteinUhlenbeckActionNoise([0.0], 0.0, theta=0.0, repulsive=1e-3)
    assert noise(1.0).item() == pytest.approx(-1e-3 * 3 * np.pi * (np.pi / 2) ** 5, rel=1e-5)
    noise.reset()
    assert noise().item() == 0.0


# It belongs to training: nothing that predicts adds it.

NOISES = {
    "normal": NormalActionNoise([0.9], 0.5),
    "Ornstein-Uhlenbeck": OrnsteinUhlenbeckActionNoise([0.9], 0.5, initial_noise=[0.9]),
    "parameters": ParameterNoise(1.0),
}


@pytest.mark.parametrize("noise", only(["parameters"], NOISES))
def test_a_deterministic_policy_predicts_the_same_action_whatever_the_noise_of_its_training(noise):
    settings = {"policy_kwargs": {"net_arch": [8]}, "learning_starts": 0, "batch_size": 4, "seed": 0}
    settings |= {"action_noise": NOISES[noise], "normalize": noise == "parameters"}
    agent = rejeu.TD3("MlpPolicy", Counter((5,)), **settings).learn(6)
    obs = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    expected, _ = agent.predict(obs, deterministic=True)
    for _ in range(2):
        np.testing.assert_allclose(agent.predict(obs)[0], expected, atol=1e-6)
    assert np.abs(expected).max() < 1.0
    env = Counter((5,))
    agent.evaluate(2, env=env, deterministic=False)
    last_seen = np.float32([1, 4, env.drawn])  # of the second episode, before its last step
    np.testing.assert_allclose(env.actions[-1], agent.predict(last_seen, deterministic=True)[0], atol=1e-6)


@pytest.mark.parametrize("noise", only(["normal", "parameters"], NOISES))
def test_a_stochastic_policy_predicts_samples_without_the_noise_of_its_training(noise):
    """Two agents of one seed have the same weights and draw the same numbers."""
    plain, noisy = small_sac(Counter((5,))), small_sac(Counter((5,)), action_noise=NOISES[noise])
    obs = np.random.default_rng(0).normal(size=(20, 3)).astype(np.float32)
    first, second = plain.predict(obs)[0], plain.predict(obs)[0]
    assert (first != second).any()
    np.testing.assert_allclose(noisy.predict(obs)[0], first, atol=1e-6)
    np.testing.assert_allclose(noisy.predict(obs)[0], second, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (0.1, NormalActionNoise([0.0, 0.0], [0.1, 0.1])),
        (1, NormalActionNoise([0.0, 0.0], [1.0, 1.0])),
        ("normal(0.3)", NormalActionNoise([0.0, 0.0], [0.3, 0.3])),
        ("OU(0.2)", OrnsteinUhlenbeckActionNoise([0.0, 0.0], [0.2, 0.2])),
        ("ou(0.2, theta=0.3, dt = 1)", OrnsteinUhlenbeckActionNoise([0.0, 0.0], [0.2, 0.2], theta=0.3, dt=1.0)),
        ("parameter(0.4)", ParameterNoise(0.4)),
    ],
)
def test_noise_may_be_given_as_a_number_or_a_text(given, expected):
    """Pendulum has one action, so the two dimensions show that the noise is fitted to the actions."""
    config = rejeu.TD3.algorithm.Config(action_noise=given)
    assert for_actions(config.action_noise, spaces.Box(-1, 1, (2,))) == expected
    assert rejeu.TD3.algorithm.Config(**configs.to_json(config)) == config  # as a file has it


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("ou", "must be None, a standard deviation"),
        ("uniform(1)", "must be one of normal"),
        ("ou(x)", "'x' is not a number"),
        ("ou(0.2, 0.3)", "takes no '0.3'"),
        ("normal(0, random=0.3, random=0.9)", "takes no 'random=0.9'; normal takes sigma, random, each once"),
        ("ou(0.2, sigma=0.3)", "takes no 'sigma=0.3'"),
        ("ou(0.2, omega=1)", "takes no 'omega=1'; ou takes sigma, theta"),
        (-0.1, "must not be negative"),
        (True, "must be None"),
        (float("nan"), "must be finite"),
    ],
)
def test_noise_that_is_written_wrongly_is_refused(given, message):
    with pytest.raises((TypeError, ValueError), match=message):
        rejeu.DDPG.algorithm.Config(action_noise=given)


@pytest.mark.parametrize("agent", only([rejeu.DDPG], [rejeu.DDPG, rejeu.TD3]))
def test_a_deterministic_policy_without_noise_is_warned_of_once(agent):
    small = {"policy_kwargs": {"net_arch": [4]}, "batch_size": 4, "learning_starts": 5, "buffer_size": 100, "seed": 0}
    without = agent("MlpPolicy", "Pendulum-v1", **small)
    with pytest.warns(UserWarning, match=f"{agent.__name__} trains without exploration noise") as seen:
        without.learn(2)
    assert len(seen) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        without.learn(2, reset_num_timesteps=False)
        for noise in (0.1, ParameterNoise()):
            agent("MlpPolicy", "Pendulum-v1", action_noise=noise, **small).learn(1)


class Alternating:
    """Noise of the user's own, which changes its sign from step to step."""

    def init(self, n_envs):
        return jnp.ones(n_envs)

    def perturb(self, state, action, key):
        return -state, action + 0.1 * state[:, None]


def test_noise_of_the_users_own_is_added_and_mentioned_in_files(tmp_path):
    noise = Alternating()
    agent = rejeu.DDPG("MlpPolicy", "Pendulum-v1", action_noise=noise, learning_starts=0, batch_size=4, seed=0).learn(9)
    path = agent.save(tmp_path / "model")
    with pytest.raises(rejeu.CheckpointError, match="its action_noise is your own, 'Alternating'"):
        rejeu.load(path)
    assert rejeu.load(path, action_noise=noise).config.action_noise is noise
    with pytest.raises(TypeError, match="init and perturb"):
        rejeu.DDPG("MlpPolicy", "Pendulum-v1", action_noise=object())


def test_the_share_random_of_actions_is_uniform_and_the_others_are_noisy():
    """``random=0.3``, for 20,000 environments: a binomial share, uniform values, and rows replaced as a whole."""
    n, key = 20_000, jax.random.PRNGKey(3)
    plain, noise = NormalActionNoise([0.0] * 2, 0.01), NormalActionNoise([0.0] * 2, 0.01, random=0.3)
    action = jnp.full((n, 2), 0.9)
    _, expected = plain.perturb(plain.init(n), action, key)
    _, taken = noise.perturb(noise.init(n), action, key)
    kept = np.isclose(taken, expected).all(axis=1)
    replaced = np.asarray(taken)[~kept]
    assert 1 - kept.mean() == pytest.approx(0.3, abs=4 * math.sqrt(0.3 * 0.7 / n))
    assert not np.isclose(replaced, np.asarray(expected)[~kept]).all(axis=1).any()
    assert scipy.stats.kstest(replaced.ravel(), "uniform", (-1, 2)).pvalue > 1e-3
    assert np.corrcoef(replaced.T)[0, 1] == pytest.approx(0.0, abs=0.06)


def test_the_share_random_is_read_from_a_string_and_saved():
    noise = for_actions(parse("normal(0.2, random=0.3)"), spaces.Box(-1, 1, (2,)))
    assert noise == NormalActionNoise([0.0] * 2, 0.2, random=0.3)
    assert parse(to_json(noise)) == noise
    with pytest.raises(ValueError, match=r"random=1\.5"):
        NormalActionNoise([0.0], 0.1, random=1.5)
