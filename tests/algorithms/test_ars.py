"""ARS: which parameters each episode is played with, the step against NumPy, and what it refuses."""

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import ars
from rejeu.core.algorithm import Clock, Rollout
from tests.environments import Timed

pytestmark = pytest.mark.usefixtures("learners_are_shared")

OBS, BOX = gym.spaces.Box(-5.0, 5.0, (3,), np.float32), gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
CLOCK = Clock(np.uint32(0), np.uint32(0), np.float32(0.25))


def make(space=BOX, **settings):
    config = ars.Config(**{"n_delta": 3, **settings})
    algorithm = ars.make(config, OBS, space)
    return config, algorithm, jax.jit(algorithm.init)(jax.random.PRNGKey(0))


def parameters(network):
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(network)])


def rollout_of(rewards):
    """A rollout of whole episodes: ``rewards[j][e]`` are those of the j-th episode of environment e."""
    n_envs = len(rewards[0])
    lengths = [sum(len(episodes[e]) for episodes in rewards) for e in range(n_envs)]
    shape = (max(lengths) + 1, n_envs)  # the last step exists in no environment
    reward, valid, ended = np.full(shape, 77.0, np.float32), np.zeros(shape, bool), np.zeros(shape, bool)
    for e in range(n_envs):
        flat = np.concatenate([episodes[e] for episodes in rewards])
        reward[: len(flat), e], valid[: len(flat), e] = flat, True
        ended[np.cumsum([len(episodes[e]) for episodes in rewards]) - 1, e] = True
    obs = np.zeros((*shape, 3), np.float32)
    zero = np.zeros(shape, np.float32)
    return Rollout(obs, zero, reward, obs, zero, ended, valid, zero, np.ones(n_envs, bool), ())


def test_the_step_goes_along_the_best_directions_by_their_returns():
    """Six candidates (three directions, forward and backward) played by two environments in three episodes each."""
    _, algorithm, state = make(n_top=2, learning_rate=rejeu.Linear(0.4, 0.0), zero_policy=False, delta_std=0.1)
    returns = np.array([3.0, -1.0, 8.0, 2.0, 5.0, -4.0])
    parts = [[1.0, r - 1.0] if i % 2 else [r] for i, r in enumerate(returns)]
    rewards = [[parts[2 * j], parts[2 * j + 1]] for j in range(3)]
    after, metrics = jax.jit(algorithm.update)(state, rollout_of(rewards), CLOCK)
    plus, minus = returns[:3], returns[3:]
    best = [2, 1]  # maxima 3, 5 and 8
    sigma = np.std([*plus[best], *minus[best]])
    expected = parameters(state.actor.network).astype(np.float64)
    for k in best:
        delta = parameters(ars.direction(state.actor, jnp.int32(k)))
        expected += 0.3 / (2 * sigma) * (plus[k] - minus[k]) * delta
    np.testing.assert_allclose(parameters(after.actor.network), expected, rtol=1e-4, atol=1e-5)
    assert float(metrics["return_mean"]) == pytest.approx(returns.mean())
    assert float(metrics["return_std"]) == pytest.approx(sigma, rel=1e-5)
    assert int(after.n_updates) == int(after.actor.n_rollouts) == 1
    again = parameters(ars.direction(after.actor, jnp.int32(0)))
    assert not np.allclose(again, parameters(ars.direction(state.actor, jnp.int32(0))))


def test_returns_leave_out_padding_and_add_the_offset_of_every_step():
    """As in sb3-contrib: the return plus offset times length, so that -1 cancels an alive bonus of 1."""
    rollout = rollout_of([[[1.0, 2.0, 3.0], [4.0]], [[5.0], [6.0, 7.0]]])
    np.testing.assert_allclose(ars.episode_returns(rollout, 2, 0.5), [6.0 + 1.5, 4.0 + 0.5, 5.0 + 0.5, 13.0 + 1.0])
    np.testing.assert_allclose(ars.episode_returns(rollout_of([[[1.0] * 5]]), 1, -1.0), [0.0])


class Lasting(Timed):
    """Rewards -1 at every step; no time limit is declared. Truncates itself after ``length`` steps, None for never."""

    observation_space, action_space = OBS, BOX

    def __init__(self, length):
        self.length = length

    def reward(self, action):
        return -1.0


@pytest.fixture
def found(monkeypatch):
    """The returns that each update would go by; nothing is learned."""
    found = []

    def noted(run, learner, config, clock):
        n_episodes = config.episodes(run.env.n_envs)
        found.append(np.asarray(ars.episode_returns(run.replay.rollout(), n_episodes, 0.0)).tolist())

    monkeypatch.setattr("rejeu.training.on_policy.update", noted)
    return found


@pytest.mark.parametrize(("length", "counted"), [(None, 50), (80, 50), (30, 30)])
def test_without_a_time_limit_every_episode_counts_as_many_steps(length, counted, found):
    """``n_steps`` at most, whatever the other episodes of the iteration took."""
    agent = rejeu.ARS("MlpPolicy", Lasting(length), n_delta=2, n_steps=50, seed=0)
    agent.learn(4 * counted)
    assert found == [[-counted] * 4]
    assert len(agent.history.episodes) == (4 if length == counted else 0)  # what was cut is no episode


def test_learning_ends_with_an_iteration_and_cuts_no_episode(found):
    """Two environments with episodes of 10 steps, of which an iteration has 4."""
    env = rejeu.make_vector(lambda: Lasting(10), 2, "gymnasium")
    agent = rejeu.ARS("MlpPolicy", env, n_delta=2, n_steps=50, seed=0)
    agent.learn(15)
    assert found == [[-10.0] * 4]
    assert agent.num_timesteps == 40


def test_an_iteration_that_begins_again_begins_with_the_first_direction():
    """After an evaluation in the environments of training the numbers of episodes start again with the rollout."""
    env = Lasting(10)
    agent = rejeu.ARS("MlpPolicy", env, n_delta=2, n_steps=50, seed=0)
    agent.learn(25, lambda agent, turn: turn.step < 25)
    assert agent.run.carry.episode.tolist() == [3]
    agent.evaluate(episodes=1, env=env)
    agent.learn(5, lambda agent, turn: turn.step < 30, reset_num_timesteps=False)
    assert agent.run.carry.episode.tolist() == [1]


def test_forward_and_backward_are_opposite_and_directions_are_standard_normals():
    _, _, state = make(zero_policy=False)
    base = parameters(state.actor.network)
    for k in range(3):
        forward, backward = (parameters(ars.perturbed(state.actor, jnp.int32(c), 0.1, 3)) for c in (k, k + 3))
        np.testing.assert_allclose(forward + backward, 2 * base, atol=1e-6)
        np.testing.assert_allclose(
            forward - base, 0.1 * parameters(ars.direction(state.actor, jnp.int32(k))), atol=1e-6
        )
        np.testing.assert_allclose(forward, parameters(ars.perturbed(state.actor, jnp.int32(k + 6), 0.1, 3)))
    many = np.concatenate([parameters(ars.direction(state.actor, jnp.int32(k))) for k in range(300)])
    assert abs(many.mean()) < 0.06
    assert many.std() == pytest.approx(1.0, abs=0.05)


def test_each_episode_is_played_with_its_own_parameters():
    """Two environments: the first begins its second episode at the third step, and a new iteration begins at the fourth."""
    _, algorithm, state = make(zero_policy=False)
    actor = state.actor
    carry = algorithm.explorer.init(actor, 2)
    obs, key = np.ones((2, 3), np.float32), jax.random.key(0)

    def expected(actor, candidates):
        networks = [ars.perturbed(actor, jnp.int32(c), 0.05, 3) for c in candidates]
        return np.clip(np.concatenate([network(obs[:1]) for network in networks]), -1.0, 1.0)

    for ended, candidates in (([True, True], [0, 1]), ([False, False], [0, 1]), ([True, False], [2, 1])):
        action, carry = algorithm.explorer.act(carry, actor, obs, np.array(ended), key, CLOCK)
        np.testing.assert_allclose(action, expected(actor, candidates), atol=1e-6)
    later = jax.tree.map(jnp.copy, actor)
    later = ars.Perturbation(later.network, later.key, jnp.int32(1))
    action, _ = algorithm.explorer.act(carry, later, obs, np.array([True, True]), key, CLOCK)
    np.testing.assert_allclose(action, expected(later, [0, 1]), atol=1e-6)


@pytest.mark.slow
def test_cart_pole_is_solved():
    settings = {"learning_rate": 0.05, "delta_std": 0.1, "normalize": {"norm_reward": False}}
    agent = rejeu.ARS("MlpPolicy", rejeu.make_vector("CartPole-v1", 4), seed=3, **settings).learn(60_000)
    assert agent.evaluate(episodes=30).mean_return > 450


def test_no_more_directions_can_be_the_best_than_there_are():
    with pytest.raises(ValueError, match="n_top"):
        ars.Config(n_top=9)


def test_environments_that_cannot_share_the_episodes_are_refused_before_the_first_step():
    with pytest.raises(ValueError, match="16 episodes, which 3 environments"):
        rejeu.ARS("MlpPolicy", rejeu.make_vector("CartPole-v1", 3, "gymnasium"))


def test_other_actions_and_settings_without_meaning_are_refused():
    with pytest.raises(ValueError, match="Box or Discrete"):
        ars.make(ars.Config(), OBS, gym.spaces.MultiBinary(2))
    with pytest.raises(TypeError, match="n_episodes"):
        rejeu.ARS("MlpPolicy", "CartPole-v1", n_episodes=2)
