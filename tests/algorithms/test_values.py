"""What the critics say, asked by hand: shapes, ranges of actions, several critics, scaling, memory."""

import numpy as np
import pytest

import rejeu
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import Probe
from tests.algorithms.test_every_algorithm import OBS
from tests.environments import Reach
from tests.every_agent import KINDS, env_of, every_kind, small
from tests.helpers import small_sac
from tests.numpy_networks import forward, layers
from tests.on_policy_agents import KINDS as ON_POLICY

N = len(OBS)


@every_kind
def test_the_values_of_a_batch_are_those_of_its_parts_and_the_least_is_the_default(kind):
    agent = small(kind, env_of(kind))
    actions = [agent.action_space.sample() for _ in range(N)]
    each = agent.q_values(OBS, np.stack(actions), critics="all")
    assert each.shape == (getattr(agent.config, "n_critics", 1), N)
    assert each.dtype == np.float32
    np.testing.assert_allclose(agent.q_values(OBS, actions), each.min(axis=0), rtol=1e-6)
    np.testing.assert_allclose(agent.q_values(OBS, actions, critics="mean"), each.mean(axis=0), rtol=1e-5)
    one = agent.q_values(OBS[2], actions[2], critics="all")
    assert one.shape == each.shape[:1]
    np.testing.assert_allclose(one, each[:, 2], rtol=1e-5, atol=1e-6)
    assert agent.q_values(OBS[2], actions[2]).shape == ()


@pytest.mark.parametrize("kind", [kind for kind in KINDS.values() if kind.discrete], ids=lambda kind: kind.name)
def test_of_discrete_actions_all_are_rated_at_once_in_the_order_of_the_space(kind):
    agent = small(kind, env_of(kind))
    space = agent.action_space
    rated = agent.q_values(OBS)
    assert rated.shape == (N, space.n)
    for i in range(space.n):
        np.testing.assert_array_equal(agent.q_values(OBS, [space.start + i] * N), rated[:, i])
    assert agent.q_values(OBS[0], critics="all").shape == (getattr(agent.config, "n_critics", 1), space.n)


def test_the_best_rated_action_of_dqn_is_the_one_it_takes():
    agent = small(KINDS["DQN"], env_of(KINDS["DQN"]))
    best = agent.action_space.start + agent.q_values(OBS).argmax(axis=1)
    np.testing.assert_array_equal(agent.predict(OBS, deterministic=True)[0], best)


def test_actions_are_in_the_environments_own_range():
    """Pendulum's are from -2 to 2: the critic, here in float64, is given a half of them."""
    agent = rejeu.TD3("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    rng = np.random.default_rng(0)
    obs, actions = rng.normal(size=(5, 3)).astype(np.float32), rng.uniform(-2, 2, (5, 1)).astype(np.float32)
    given = agent.q_values(obs, actions, critics="all")
    for i in range(2):
        expected = forward(layers(agent.state.critics, i), np.concatenate([obs, actions / 2], axis=1))[:, 0]
        np.testing.assert_allclose(given[i], expected, atol=1e-5)
    assert not np.allclose(given[0], given[1])


def test_observations_are_scaled_as_in_training():
    agent = small_sac(Probe(), normalize=True, learning_starts=8).learn(30)
    state = agent.state
    moments = state.statistics.obs[0]
    mean, variance = np.float64(moments.mean), np.float64(moments.variance)
    obs, actions = np.float32([[0.4], [-3.0]]), np.float32([[0.5], [2.0]])
    config = agent.config.normalize
    scaled = ((obs - mean) / np.sqrt(variance + config.epsilon)).clip(-config.clip_obs, config.clip_obs)
    inputs = np.concatenate([scaled, actions - 1.0], axis=1)  # the probe's actions are from 0 to 2
    expected = [forward(layers(state.learner.critics, i), inputs)[:, 0] for i in range(2)]
    np.testing.assert_allclose(agent.q_values(obs, actions, critics="all"), expected, rtol=1e-3, atol=1e-4)


def test_observations_may_be_dicts():
    agent = small_sac(InProcess([Reach()]))
    obs = {key: np.linspace(-1, 1, 4, dtype=np.float32)[:, None] for key in agent.observation_space}
    batch = agent.q_values(obs, np.zeros((4, 1)))
    single = agent.q_values({key: value[1] for key, value in obs.items()}, np.zeros(1))
    np.testing.assert_allclose(single, batch[1], rtol=1e-5)


def test_pqn_rates_all_actions_and_the_value_is_that_of_the_best():
    kind = ON_POLICY["PQN, Discrete"]
    agent = kind.small(kind.envs(Probe))
    rated, start = agent.q_values(OBS), agent.action_space.start
    assert rated.shape == (N, agent.action_space.n)
    np.testing.assert_array_equal(agent.q_values(OBS, start + rated.argmax(axis=1)), rated.max(axis=1))
    np.testing.assert_array_equal(agent.predict(OBS, deterministic=True)[0], start + rated.argmax(axis=1))
    np.testing.assert_allclose(agent.value(OBS), rated.max(axis=1), rtol=1e-6)
    assert agent.q_values(OBS[0], critics="all").shape == (1, agent.action_space.n)


@pytest.mark.parametrize("kind", [ON_POLICY["PPO, Box"], ON_POLICY["A2C, Discrete"]], ids=["PPO", "A2C"])
def test_the_value_of_an_observation_is_that_of_the_critic(kind):
    agent = kind.small(kind.envs(Probe))
    network = agent.state.network
    hidden = np.tanh(forward(layers_of(network.value_torso.layers), OBS))
    expected = hidden @ np.float64(network.value_head.weight) + np.float64(network.value_head.bias)
    np.testing.assert_allclose(agent.value(OBS), expected[:, 0], atol=1e-5)
    assert agent.value(OBS[3]).shape == ()
    np.testing.assert_allclose(agent.value(OBS[3]), expected[3, 0], atol=1e-5)


def layers_of(parts):
    return [[np.float64(part.weight), np.float64(part.bias)] for part in parts]


def test_the_value_of_a_policy_with_a_memory_depends_on_what_it_remembers():
    agent = rejeu.RecurrentPPO("MlpPolicy", Probe(), policy_kwargs={"lstm_hidden_size": 8, "net_arch": []}, seed=0)
    fresh = agent.value(OBS)
    _, memory = agent.predict(OBS, deterministic=True)
    later = agent.value(OBS, memory)
    assert not np.allclose(later, fresh)
    np.testing.assert_allclose(agent.value(OBS, memory, np.ones(N, bool)), fresh, rtol=1e-5)


def test_masks_in_observations_are_passed_over():
    agent = rejeu.MaskablePPO("MlpPolicy", ON_POLICY["PPO, Discrete"].wrapper(Probe()), seed=0)
    assert agent.value(OBS).shape == (N,)


def test_what_cannot_be_rated_is_refused_in_one_line():
    agent = small_sac(Probe())
    dqn = small(KINDS["DQN"], env_of(KINDS["DQN"]))
    for ask, message in (
        (lambda: agent.q_values(OBS), "q_values needs actions of Box"),
        (lambda: agent.q_values(OBS, np.zeros((2, 1))), r"shape \(2, 1\), expected \(7, 1\): one for each observation"),
        (lambda: agent.q_values(OBS[0], np.zeros((7, 1))), r"shape \(7, 1\), expected \(1,\)"),
        (lambda: agent.q_values(OBS, np.full((7, 1), np.nan)), "not finite"),
        (
            lambda: agent.q_values(OBS, np.zeros((7, 1)), critics="least"),
            "critics='least' must be one of min, mean, all",
        ),
        (lambda: dqn.q_values(OBS, [99] * N), "expected Discrete"),
        (lambda: agent.q_values(np.zeros((2, 5)), np.zeros((2, 1))), "the observation has shape"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            ask()
        assert "\n" not in str(caught.value)
