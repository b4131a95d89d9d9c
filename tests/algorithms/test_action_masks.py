"""Action masks as a setting: what is forbidden is never done, never a maximum, and has no gradient, in every algorithm."""

import functools

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import rejeu
from rejeu.algorithms import dqn, qrdqn
from rejeu.algorithms.sac import discrete
from rejeu.core.algorithm import Masked, Transition
from rejeu.envs.functional.bit_flipping import BitFlipping
from rejeu.envs.make import InProcess
from rejeu.sb3 import DQN
from rejeu.sb3_contrib import MaskablePPO, MaskableRecurrentPPO
from tests.helpers import assert_same_parameters
from tests.jax_environments import Forbidden
from tests.tiers import exhaustive, only
from tests.worker_environments import Rules

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SHAPE = {"policy_kwargs": {"net_arch": [4]}, "seed": 0, "action_masks": True}
OFF = {**SHAPE, "learning_starts": 40, "batch_size": 8, "buffer_size": 300}
ON = {**SHAPE, "n_steps": 16}
Q = {**OFF, "exploration_fraction": 0.5, "exploration_final_eps": 0.5, "target_update_interval": 20}
KINDS = {
    "DQN": functools.partial(rejeu.DQN, **Q, train_freq=1),
    "DQN, double, n steps, priorities": functools.partial(rejeu.DQN, **Q, double_q=True, n_steps=3, priorities={}),
    "DQN, normalised, parameters": functools.partial(
        rejeu.DQN, **{**Q, "normalize": True, "action_noise": rejeu.ParameterNoise()}
    ),
    "QRDQN": functools.partial(rejeu.QRDQN, **Q, n_quantiles=5),
    "SAC": functools.partial(rejeu.SAC, **OFF),
    "PPO": functools.partial(rejeu.PPO, **ON, batch_size=16),
    "A2C": functools.partial(rejeu.A2C, **ON),
    "TRPO": functools.partial(rejeu.TRPO, **ON),
    "RecurrentPPO": functools.partial(
        rejeu.RecurrentPPO, **{**ON, "policy_kwargs": {"net_arch": [4], "lstm_hidden_size": 4}}
    ),
}
PLACES = [(name, on_device) for name in ("DQN", "QRDQN", "SAC", "RecurrentPPO") for on_device in (True, False)]


def vector(all_at_end=True, kind="discrete"):
    return InProcess([Rules(kind, all_at_end=all_at_end) for _ in range(2)], seed=0)


@pytest.mark.parametrize("name", only(["DQN, double, n steps, priorities", "SAC", "PPO"], KINDS))
def test_what_is_forbidden_is_never_done_and_nothing_becomes_infinite(name):
    env = vector(all_at_end=False)  # the environment raises at a forbidden action
    agent = KINDS[name]("MlpPolicy", env).learn(160)
    assert sum(one.taken for one in env.envs) == 160
    other = vector()
    for deterministic in (True, False):
        agent.evaluate(10, env=other, deterministic=deterministic)
    assert all(np.isfinite(value).all() for value in agent.get_parameters().values())
    floats = [value for value in agent.get_parameters().values() if value.dtype.kind == "f"]
    assert max(np.abs(value).max() for value in floats) < 1e6


class Lenient(Forbidden):
    """Allows everything."""

    def action_mask(self, state):
        return jnp.ones(3, bool)


@exhaustive
@pytest.mark.parametrize(("name", "on_device"), PLACES)
def test_masks_that_allow_everything_change_nothing(name, on_device):
    agents = []
    for masks in (True, False):
        kind = KINDS[name]
        settings = {**kind.keywords, "action_masks": masks}
        if name == "SAC":
            settings["target_entropy"] = 0.3
        agent = kind.func("MlpPolicy", rejeu.make_vector(Lenient(), 2, seed=0), **settings)
        agent.on_device = on_device
        agents.append(agent.learn(100))
    assert_same_parameters(*agents)


def batch_of(rng, n=6, n_actions=4):
    obs, next_obs = rng.normal(size=(2, n, 3)).astype(np.float32)
    mask, next_mask = rng.random((2, n, n_actions)) < 0.5
    mask[:, 0] = True
    next_mask[0], next_mask[1:, 1] = False, True
    action = np.zeros(n, np.int32)
    reward, discount = rng.normal(size=n).astype(np.float32), rng.random(n).astype(np.float32)
    return Transition(Masked(obs, mask), action, reward, Masked(next_obs, next_mask), discount), next_mask


def spaces_of(n_actions=4):
    return spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Discrete(n_actions)


def best(values, chooser, mask):
    """The value of the best allowed action, of all where none is allowed, row by row."""
    rows = []
    for row, choice, allowed in zip(values, chooser, mask, strict=True):
        among = np.flatnonzero(allowed) if allowed.any() else np.arange(len(allowed))
        rows.append(row[among[np.argmax(choice[among])]])
    return np.array(rows)


@pytest.mark.parametrize("double_q", [True, False])
def test_the_target_of_dqn_is_the_best_of_what_is_allowed(double_q):
    batch, mask = batch_of(np.random.default_rng(0))
    config = dqn.Config(double_q=double_q, policy_kwargs={"net_arch": [4]}, action_masks=True)
    algorithm = dqn.make(config, *spaces_of())
    network, target = (algorithm.init(jax.random.PRNGKey(seed)).network for seed in (0, 1))
    values = np.asarray(target(batch.next_obs.obs))
    chooser = np.asarray(network(batch.next_obs.obs)) if double_q else values
    expected = batch.reward + batch.discount * best(values, chooser, mask)
    np.testing.assert_allclose(dqn.td_target(network, target, batch, double_q), expected, rtol=1e-5, atol=1e-6)


def test_the_target_of_qr_dqn_is_the_distribution_of_the_best_allowed_action():
    batch, mask = batch_of(np.random.default_rng(1))
    config = qrdqn.Config(n_quantiles=3, policy_kwargs={"net_arch": [4]}, action_masks=True)
    network = qrdqn.make(config, *spaces_of()).init(jax.random.PRNGKey(0)).network
    quantiles = np.asarray(network(batch.next_obs.obs))
    expected = batch.reward[:, None] + batch.discount[:, None] * best(quantiles, quantiles.mean(axis=-1), mask)
    returns = qrdqn.quantile_returns(3)
    np.testing.assert_allclose(dqn.td_target(network, network, batch, False, returns), expected, rtol=1e-5, atol=1e-6)


def log_policy(logits, mask):
    """Log-probabilities among the allowed actions, minus infinity elsewhere; all are allowed where none is."""
    mask = mask | ~mask.any(axis=-1, keepdims=True)
    logits = np.where(mask, logits.astype(np.float64), -np.inf)
    return logits - np.log(np.exp(logits).sum(axis=-1, keepdims=True))


def expectation(log_p, values):
    p = np.exp(log_p)
    return np.where(p > 0, p * np.where(p > 0, values, 0.0), 0.0).sum(axis=-1)


def soft_actor_critic(target_entropy="auto"):
    settings = {"target_entropy": target_entropy, "ent_coef": "auto_0.3"}  # at a temperature of 1 its loss is always 0
    config = discrete.Config(policy_kwargs={"net_arch": [4]}, action_masks=True, **settings)
    algorithm = discrete.make(config, *spaces_of())
    return algorithm, algorithm.init(jax.random.PRNGKey(0))


def test_the_equations_of_discrete_sac_with_masks():
    batch, next_mask = batch_of(np.random.default_rng(2))
    _, state = soft_actor_critic()
    alpha = 0.5
    log_p = log_policy(np.asarray(state.actor(batch.next_obs.obs)), next_mask)
    values = np.asarray(discrete.all_values(state.target_critics, batch.next_obs.obs)).min(axis=0)
    expected = batch.reward + batch.discount * expectation(log_p, values - alpha * log_p)
    target = discrete.td_target(state.actor, state.target_critics, jnp.float32(alpha), batch)
    np.testing.assert_allclose(target, expected, rtol=1e-5, atol=1e-5)
    log_p = log_policy(np.asarray(state.actor(batch.obs.obs)), batch.obs.mask)
    loss, log_prob = discrete.actor_loss(state.actor, jnp.asarray(values), jnp.float32(alpha), batch.obs)
    np.testing.assert_allclose(loss, expectation(log_p, alpha * log_p - values).mean(), rtol=1e-5)
    np.testing.assert_allclose(log_prob, expectation(log_p, log_p), rtol=1e-5, atol=1e-6)


def test_forbidden_actions_have_no_gradient_in_discrete_sac():
    batch, _ = batch_of(np.random.default_rng(3))
    obs = Masked(batch.obs.obs, np.tile([True, False, True, False], (6, 1)))
    _, state = soft_actor_critic()
    values = jnp.arange(24.0).reshape(6, 4)
    gradient = eqx.filter_grad(lambda actor: discrete.actor_loss(actor, values, jnp.float32(0.2), obs)[0])(state.actor)
    bias = np.asarray(gradient.head.bias)
    assert (bias[[1, 3]] == 0).all()
    assert (np.abs(bias[[0, 2]]) > 1e-6).all()


def test_the_target_entropy_of_sac_is_a_share_of_that_of_the_allowed_actions():
    batch, _ = batch_of(np.random.default_rng(4))
    expected, of_next = (0.3 * np.log(obs.mask.sum(axis=-1).clip(1)).mean() for obs in (batch.obs, batch.next_obs))
    assert abs(expected - of_next) > 0.01, "otherwise the masks of the next observations give the same"
    one, state = soft_actor_critic()
    other, _ = soft_actor_critic(float(expected))
    clock = rejeu.Clock(np.uint32(0), np.uint32(0), np.float32(0))
    after, metrics = jax.jit(one.update)(state, batch, clock)
    found = float(metrics["ent_coef_loss"])
    assert abs(found) > 1e-3
    assert found == pytest.approx(float(jax.jit(other.update)(state, batch, clock)[1]["ent_coef_loss"]), rel=1e-5)
    assert jax.tree.all(jax.tree.map(lambda x: bool(jnp.isfinite(x).all()), after))


def test_random_actions_are_uniform_among_the_allowed_ones():
    mask = jnp.tile(jnp.array([[True, False, True, True]]), (3000, 1))
    action = dqn.epsilon_greedy(jnp.zeros((3000, 4)), 1.0, jax.random.PRNGKey(0), mask)
    share = np.bincount(action, minlength=4) / 3000
    assert share[1] == 0
    np.testing.assert_allclose(share[[0, 2, 3]], 1 / 3, atol=0.03)


@pytest.mark.parametrize("name", only(["DQN"], ["DQN", "SAC"]))
def test_the_replay_buffer_holds_the_masks_of_both_observations(name):
    env = InProcess([Rules()], seed=0)
    agent = KINDS[name]("MlpPolicy", env).learn(50)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (200,))
    assert batch.obs.mask.dtype == bool
    assert batch.obs.mask[np.arange(200), batch.action].all()
    seen = {mask.tobytes() for mask in env.envs[0].masks}
    assert {mask.tobytes() for mask in (*batch.obs.mask, *batch.next_obs.mask)} <= seen


@pytest.mark.parametrize("name", only(["DQN"], ["DQN", "QRDQN", "SAC"]))
def test_a_file_keeps_the_setting_and_the_masks(name, tmp_path):
    agent = KINDS[name]("MlpPolicy", vector()).learn(60)
    agent.save_replay_buffer(tmp_path / "buffer")
    loaded = rejeu.load(agent.save(tmp_path / "model"), env=vector())
    assert loaded.takes_masks
    loaded.load_replay_buffer(tmp_path / "buffer")
    for array, other in zip(agent.replay_buffer.ring.obs, loaded.replay_buffer.ring.obs, strict=True):
        assert np.array_equal(array, other)
    obs = np.random.default_rng(1).normal(size=(50, 2)).astype(np.float32)
    mask = np.tile([False, True, False, True, False], (50, 1))
    actions = [one.predict(obs, deterministic=True, action_masks=mask)[0] for one in (agent, loaded)]
    assert np.array_equal(*actions)
    assert set(actions[0].tolist()) <= {1, 3}
    assert agent.q_values({"observation": obs, "action_mask": mask}).shape == (50, 5)
    numpy_policy = rejeu.load_policy(tmp_path / "model")
    assert np.array_equal(numpy_policy.predict(obs, action_masks=mask)[0], actions[0])
    loaded.learn(20)


class Bits(BitFlipping):
    """Bit flipping that forbids to flip the first bit."""

    def action_mask(self, state):
        return jnp.arange(self.n_bits) > 0


@pytest.mark.parametrize("on_device", only([True], [True, False]))
def test_masks_and_hindsight_go_together(on_device):
    env = rejeu.make_vector(Bits(4), 2, seed=0)
    agent = rejeu.DQN("MultiInputPolicy", env, replay_buffer_class=rejeu.HerReplayBuffer, **Q)
    agent.on_device = on_device
    agent.learn(200)
    batch = agent.replay_buffer.sample(np.random.default_rng(0), (300,))
    assert (batch.action > 0).all()
    assert not batch.next_obs.mask[:, 0].any()
    np.testing.assert_array_equal(
        batch.reward, (batch.next_obs.obs["achieved_goal"] == batch.next_obs.obs["desired_goal"]).all(axis=1) - 1.0
    )


@exhaustive
def test_maskable_ppo_is_ppo_with_masks():
    agents = [
        kind("MlpPolicy", vector(kind="multi"), **{**ON, "batch_size": 16}).learn(64)
        for kind in (rejeu.PPO, rejeu.MaskablePPO, MaskablePPO)
    ]
    assert_same_parameters(agents[0], agents[1])
    assert_same_parameters(agents[0], agents[2])


@exhaustive
def test_maskable_recurrent_ppo_is_recurrent_ppo_with_masks(tmp_path):
    settings = {key: value for key, value in KINDS["RecurrentPPO"].keywords.items() if key != "action_masks"}
    agent = MaskableRecurrentPPO("MlpLstmPolicy", vector(), **settings).learn(64)
    assert_same_parameters(agent, KINDS["RecurrentPPO"]("MlpPolicy", vector()).learn(64))
    loaded = MaskableRecurrentPPO.load(agent.save(tmp_path / "model"))
    assert loaded.takes_masks
    obs, mask, memory = np.zeros((9, 2), np.float32), np.tile([False, True, True, False, False], (9, 1)), None
    for _ in range(3):
        action, memory = loaded.predict(obs, memory, action_masks=mask)
        assert set(action.tolist()) <= {1, 2}


def test_dqn_of_sb3_acts_at_random_among_the_allowed_actions():
    agent = DQN("MlpPolicy", vector(), **Q)
    agent.exploration_rate = 1.0
    obs, mask = np.zeros((200, 2), np.float32), np.tile([False, True, False, True, False], (200, 1))
    assert {int(a) for _ in range(20) for a in agent.predict(obs, action_masks=mask)[0]} == {1, 3}


@pytest.mark.parametrize("name", ["DDPG", "PQN"])
def test_algorithms_that_take_no_masks_say_which_do(name):
    with pytest.raises(ValueError, match=f"{name} takes no masks; use PPO"):
        rejeu.AGENTS[name]("MlpPolicy", Rules(), action_masks=True)


def test_where_masks_have_no_meaning_they_are_refused():
    with pytest.raises(ValueError, match="masks need Discrete"):
        rejeu.SAC("MlpPolicy", gym.make("Pendulum-v1"), action_masks=True)
