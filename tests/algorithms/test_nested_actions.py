"""Dict and Tuple actions: one joint distribution of independent parts, from the network to the environment and back."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces
from scipy import stats

import rejeu
from rejeu.algorithms.actor_critic.network import ActorCritic, action_kind
from rejeu.algorithms.actor_critic.steps import entropy_of
from rejeu.algorithms.sac import mixed
from rejeu.core.algorithm import Clock, Transition
from rejeu.core.distributions import Bernoulli, Categorical, Joint, MultiCategorical, Normal, TanhNormal
from rejeu.core.spaces import action_width, random_action, rows, scale_action
from rejeu.envs.functional import FunctionalEnv
from tests.environments import Timed
from tests.helpers import assert_same_parameters
from tests.tiers import exhaustive, only, only_tuples

pytestmark = pytest.mark.usefixtures("learners_are_shared")

NESTED = spaces.Dict(
    {
        "steer": spaces.Box(np.float32([-1.0, 0.0]), np.float32([1.0, 4.0])),
        "gear": spaces.Discrete(3, start=1),
        "arm": spaces.Tuple([spaces.MultiBinary(2), spaces.MultiDiscrete([2, 3]), spaces.Box(-2.0, 2.0, (1, 1))]),
    }
)
SPACES = {"nested": NESTED, "tuple": spaces.Tuple([spaces.Discrete(4), spaces.Box(-1.0, 1.0, (2,))])}
ON = {"policy_kwargs": {"net_arch": [8]}, "n_steps": 16, "seed": 0}
CONFIG = rejeu.SAC.algorithm.Config(policy_kwargs={"net_arch": [8]})
MANY = spaces.Dict({"bits": spaces.MultiBinary(12)})
KINDS = {
    "SAC": functools.partial(
        rejeu.SAC, policy_kwargs={"net_arch": [8]}, learning_starts=20, batch_size=8, buffer_size=200, n_steps=2, seed=0
    ),
    "PPO": functools.partial(rejeu.PPO, **ON, batch_size=16),
    "A2C": functools.partial(rejeu.A2C, **ON),
    "TRPO": functools.partial(rejeu.TRPO, **ON),
    "RecurrentPPO": functools.partial(
        rejeu.RecurrentPPO, **{**ON, "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4}}
    ),
}


class Strict(Timed):
    """Takes only what is in its space, and rewards the choice 2 of a Discrete part."""

    observation_space = spaces.Box(-1.0, 1.0, (2,))
    length = 8

    def __init__(self, kind="nested"):
        self.action_space, self.taken = SPACES[kind], []

    def reward(self, action):
        assert self.action_space.contains(action), action
        self.taken.append(action)
        chosen = action["gear"] if isinstance(action, dict) else action[0]
        return float(chosen == 2)


@pytest.mark.parametrize(
    ("name", "space"),
    only_tuples([("SAC", "nested"), ("PPO", "tuple")], [(name, space) for name in KINDS for space in SPACES]),
)
def test_the_environment_is_given_actions_of_its_space(name, space, tmp_path):
    env = Strict(space)
    agent = KINDS[name]("MlpPolicy", env).learn(48)
    assert len(env.taken) == 48
    assert len(agent.evaluate(4, env=Strict(space)).returns) == 4
    one, _ = agent.predict(np.zeros(2, np.float32))
    assert env.action_space.contains(one)
    batch, _ = agent.predict(np.zeros((5, 2), np.float32), deterministic=True)
    assert all(len(part) == 5 for part in jax.tree.leaves(batch))
    loaded = rejeu.load(agent.save(tmp_path / "model"), env=Strict(space))
    assert_same_parameters(agent, loaded)
    jax.tree.map(
        np.testing.assert_array_equal, loaded.predict(np.zeros((5, 2), np.float32), deterministic=True)[0], batch
    )
    loaded.learn(16)


@exhaustive
@pytest.mark.parametrize("backend", only(["gymnasium-async"], ["gymnasium", "gymnasium-async"]))
def test_on_every_backend(backend):
    vector = rejeu.make_vector(functools.partial(Strict, "nested"), 2, backend, seed=0)
    try:
        agent = rejeu.PPO("MlpPolicy", vector, n_episodes=1, **{**ON, "n_steps": 8}).learn(32)
        assert agent.num_timesteps == 32
        action = scale_action(NESTED, random_action(NESTED, 2, np.random.default_rng(0)))
        vector.reset()
        step = vector.step(action, np.array([True, False]))
        assert step.reward[1] == 0.0
    finally:
        vector.close()


class Functional(FunctionalEnv):
    """Pays for the gear 2, and for steering to the right."""

    max_episode_steps: int | None = 8

    @property
    def observation_space(self):
        return spaces.Box(-1.0, 1.0, (2,))

    @property
    def action_space(self):
        return NESTED

    def reset(self, key):
        return jnp.int32(0), jnp.zeros(2)

    def step(self, key, state, action):
        reward = (action["gear"] == 2).astype(jnp.float32) + 0.1 * action["steer"][0] + 0.1 * action["arm"][2][0, 0]
        return state + 1, jnp.zeros(2), reward, jnp.bool(False), state + 1 >= 8


@exhaustive
def test_the_device_trains_as_the_host_does():
    agents = []
    for on_device in (True, False):
        agent = KINDS["PPO"]("MlpPolicy", rejeu.make_vector(Functional(), 2, seed=0))
        agent.on_device = on_device
        agents.append(agent.learn(64))
    np.testing.assert_allclose(*(agent.history["return"] for agent in agents), rtol=1e-4, atol=1e-5)
    for one, other in zip(*(agent.get_parameters().values() for agent in agents), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)


@exhaustive
def test_it_learns():
    env = rejeu.make_vector(Functional(), 8, seed=0)
    agent = rejeu.PPO("MlpPolicy", env, **{**ON, "learning_rate": 0.01}).learn(4096)
    assert agent.evaluate(8, seed=1).mean_return > 0.85 * 8 * 1.3


def test_numbers_go_to_the_parts_in_the_order_of_sorted_keys():
    assert action_width(NESTED) == 8
    action = scale_action(NESTED, np.float32([[1, 0, 1, 2, 0.5, 2, -1.0, 0.5]]))
    assert list(action) == ["arm", "gear", "steer"]
    bits, choices, box = action["arm"]
    assert bits.tolist() == [[1, 0]]
    assert choices.tolist() == [[1, 2]]
    assert box.tolist() == [[[1.0]]]
    assert action["gear"].tolist() == [3]
    assert action["steer"].tolist() == [[-1.0, 3.0]]
    many = scale_action(NESTED, random_action(NESTED, 50, np.random.default_rng(0)))
    assert all(map(NESTED.contains, rows(many)))


def test_log_probability_and_entropy_are_sums_over_the_parts():
    rng = np.random.default_rng(0)
    draw = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    bits, one, two, choice, mean, std = draw(3, 2), draw(3, 2), draw(3, 3), draw(3, 4), draw(3, 2), draw(1, 2)
    box = Normal(jnp.array(mean), jnp.array(std))
    choices = MultiCategorical((Categorical(jnp.array(one)), Categorical(jnp.array(two))))
    joint = Joint((Joint((Bernoulli(jnp.array(bits)), choices)), Categorical(jnp.array(choice)), box))
    value = np.asarray(joint.sample(jax.random.PRNGKey(0)))
    assert value.dtype == np.float32
    assert value.shape == (3, 7)
    p = 1 / (1 + np.exp(-bits.astype(np.float64)))
    log_softmax = lambda x: x - np.log(np.exp(x.astype(np.float64)).sum(axis=-1, keepdims=True))  # noqa: E731
    pick = lambda x, i: np.take_along_axis(log_softmax(x), i.astype(int)[:, None], axis=1)[:, 0]  # noqa: E731
    expected = np.where(value[:, :2] > 0, np.log(p), np.log(1 - p)).sum(axis=1)
    expected += pick(one, value[:, 2]) + pick(two, value[:, 3]) + pick(choice, value[:, 4])
    expected += stats.norm.logpdf(value[:, 5:], mean, np.exp(std)).sum(axis=1)
    np.testing.assert_allclose(joint.log_prob(jnp.array(value)), expected, rtol=1e-4)
    entropy = -(p * np.log(p) + (1 - p) * np.log(1 - p)).sum(axis=1) + stats.norm.entropy(0, np.exp(std)).sum(axis=1)
    entropy -= sum((np.exp(log_softmax(x)) * log_softmax(x)).sum(axis=1) for x in (one, two, choice))
    np.testing.assert_allclose(joint.entropy(), entropy, rtol=1e-4)
    np.testing.assert_allclose(joint.kl_divergence(joint), 0.0, atol=1e-6)
    mode = np.asarray(joint.mode())
    np.testing.assert_allclose(mode[:, 4:], np.column_stack([choice.argmax(axis=1), mean]), rtol=1e-6)
    squashed = Joint((Categorical(jnp.array(choice)), TanhNormal(jnp.array(mean), jnp.array(std))))
    np.testing.assert_allclose(entropy_of(squashed, jnp.float32([1.0, 2.0, 3.0])), [-1.0, -2.0, -3.0])


@pytest.mark.parametrize(
    "settings",
    only(
        [{"squash_output": True}], [{}, {"state_dependent_std": True}, {"squash_output": True}, {"share_layers": True}]
    ),
)
def test_the_network_gives_every_part_its_outputs(settings):
    config = rejeu.PPO.algorithm.Config(policy_kwargs={"net_arch": [4], "log_std_init": -1.0, **settings})
    leaf = rejeu.core.spaces.leaves(Strict.observation_space)
    network = ActorCritic(jax.random.PRNGKey(0), leaf, action_kind(NESTED), config.policy_kwargs)
    joint = network.policy(jnp.zeros((5, 2)))
    (bits, choices, last), gear, steer = joint.parts[0].parts, *joint.parts[1:]
    assert bits.logits.shape == (5, 2)
    assert [part.logits.shape for part in choices.parts] == [(5, 2), (5, 3)]
    assert gear.logits.shape == (5, 3)
    assert (last.mean.shape, steer.mean.shape) == ((5, 1), (5, 2))
    np.testing.assert_allclose(steer.log_std, -1.0, atol=0.1)
    assert isinstance(steer, TanhNormal if "squash_output" in settings else Normal)
    action, log_prob = joint.sample(jax.random.PRNGKey(1)), None
    log_prob = joint.log_prob(action)
    assert action.shape == (5, 8)
    assert np.isfinite(log_prob).all()


REFUSED = {
    "use_sde=True needs Box actions": [(rejeu.SAC, {"use_sde": True}), (rejeu.PPO, {"use_sde": True})],
    "masks need Discrete": [(rejeu.SAC, {"action_masks": True}), (rejeu.PPO, {"action_masks": True})],
    "lstm_hidden_size is not available": [(rejeu.SAC, {"policy_kwargs": {"lstm_hidden_size": 8}})],
    "TD3 needs a Box action space, got Dict": [(rejeu.TD3, {})],
    "DQN needs a Discrete action space, got Dict": [(rejeu.DQN, {})],
    "ARS needs Box or Discrete actions, got Dict": [(rejeu.ARS, {})],
}


@pytest.mark.parametrize(
    ("kind", "settings", "message"), [(*one, words) for words, all_ in REFUSED.items() for one in all_]
)
def test_what_does_not_take_them_says_so(kind, settings, message):
    with pytest.raises(ValueError, match=message):
        kind("MlpPolicy", Strict(), **settings)


def test_what_is_not_possible_with_them_says_so():
    with pytest.raises(ValueError, match=r"SAC\.q_values has no critics"):
        rejeu.SAC("MlpPolicy", Strict()).q_values(np.zeros(2))
    with pytest.raises(ValueError, match="at most 1,024 combinations of choices, got 4,096"):
        mixed.make(CONFIG, Strict.observation_space, MANY)
    with pytest.raises(ValueError, match="Dict or Tuple actions cannot be exported"):
        rejeu.PPO("MlpPolicy", Strict(), **ON).export("policy.onnx")


# SAC


def batch_of(rng, n=16):
    action = random_action(NESTED, n, rng)
    obs, next_obs = rng.normal(size=(2, n, 2)).astype(np.float32)
    return Transition(obs, action, rng.normal(size=n).astype(np.float32), next_obs, rng.random(n).astype(np.float32))


def soft(actor, critics, alpha, obs, key, n):
    """V and the two mean log-probabilities, by loops over observations and combinations."""
    outputs = np.asarray(actor(obs), np.float64)
    _, normal = mixed.policy(actor, obs, n)
    sample = np.asarray(normal.sample(key))
    log_c = np.asarray(normal.log_prob(sample), np.float64)
    values = np.asarray(jax.vmap(lambda critic: critic(obs, sample))(critics)).min(axis=0)
    found, entropies = [], []
    for row in range(len(obs)):
        p = np.exp(outputs[row, :n]) / np.exp(outputs[row, :n]).sum()
        found.append(sum(p[d] * (values[row, d] - alpha[0] * np.log(p[d])) for d in range(n)) - alpha[1] * log_c[row])
        entropies.append(-(p * np.log(p)).sum())
    return np.array(found), np.array(entropies), log_c


def test_the_equations_of_sac_with_choices_and_components():
    rng, n = np.random.default_rng(0), 3 * 2 * 2 * 2 * 3
    algorithm = mixed.make(CONFIG, Strict.observation_space, NESTED)
    state, batch = algorithm.init(jax.random.PRNGKey(0)), batch_of(rng)
    alpha, key = np.float32([0.5, 0.2]), jax.random.PRNGKey(1)
    value, _, _ = soft(state.actor, state.target_critics, alpha, batch.next_obs, key, n)
    target = mixed.td_target(state.actor, state.target_critics, jnp.array(alpha), batch, key, n)
    np.testing.assert_allclose(target, batch.reward + batch.discount * value, rtol=1e-4, atol=1e-4)
    value, entropy, log_c = soft(state.actor, state.critics, alpha, batch.obs, key, n)
    loss, log_prob = mixed.actor_loss(state.actor, state.critics, jnp.array(alpha), batch.obs, key, n)
    np.testing.assert_allclose(loss, -value.mean(), rtol=1e-4)
    np.testing.assert_allclose(log_prob, np.column_stack([-entropy, log_c]), rtol=1e-3, atol=1e-3)
    after, metrics = jax.jit(algorithm.update)(state, batch, Clock(np.uint32(0), np.uint32(0), np.float32(0)))
    targets = np.array([0.3 * np.log(n), -3.0])
    entropies = np.array([metrics["entropy"], metrics["entropy_box"]])
    np.testing.assert_allclose(np.sign(after.log_alpha), np.sign(targets - entropies))
    np.testing.assert_allclose(np.abs(after.log_alpha), 3e-4, rtol=1e-3)  # Adam's first step, from log 1


def test_the_critic_learns_the_value_of_the_combination_that_was_taken():
    rng = np.random.default_rng(1)
    algorithm = mixed.make(CONFIG, Strict.observation_space, NESTED)
    state, batch = algorithm.init(jax.random.PRNGKey(0)), batch_of(rng)
    # columns: two bits, choices of 2 and 3, a component, a gear of 3, two components
    index = np.ravel_multi_index(batch.action[:, [0, 1, 2, 3, 5]].astype(int).T, (2, 2, 2, 3, 3))
    box, rows_ = batch.action[:, [4, 6, 7]], np.arange(16)
    values = np.asarray(jax.vmap(lambda critic: critic(batch.obs, box))(state.critics))[:, rows_, index]
    _, metrics = jax.jit(algorithm.update)(state, batch, Clock(np.uint32(0), np.uint32(0), np.float32(0)))
    np.testing.assert_allclose(metrics["q_value"], values.mean(), rtol=1e-4)
    action = np.asarray(algorithm.explore(state.actor, np.zeros((400, 2), np.float32), jax.random.PRNGKey(0), None))
    for column, size in {0: 2, 1: 2, 2: 2, 3: 3, 5: 3}.items():
        assert set(action[:, column].tolist()) == {*map(float, range(size))}
    assert (np.abs(action[:, [4, 6, 7]]) <= 1).all()


@exhaustive
@pytest.mark.parametrize("on_device", [True, False])
def test_sac_learns_choices_and_components(on_device):
    agent = rejeu.SAC(
        "MlpPolicy",
        rejeu.make_vector(Functional(), 1, seed=0),
        **{**KINDS["SAC"].keywords, "learning_rate": 0.01, "batch_size": 64, "buffer_size": 2000, "gamma": 0.5},
    )
    agent.on_device = on_device
    agent.learn(700)
    assert agent.evaluate(8, seed=1).mean_return > 0.8 * 8 * 1.3


@exhaustive
@pytest.mark.parametrize("space", [spaces.Dict({"a": spaces.Box(-1.0, 1.0, (2,))}), spaces.Tuple([spaces.Discrete(3)])])
def test_sac_takes_a_dict_of_one_kind(space):
    algorithm = mixed.make(CONFIG, Strict.observation_space, space)
    state, rng = algorithm.init(jax.random.PRNGKey(0)), np.random.default_rng(0)
    batch = batch_of(rng)._replace(action=random_action(space, 16, rng))
    after, _ = jax.jit(algorithm.update)(state, batch, Clock(np.uint32(0), np.uint32(0), np.float32(0)))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after) if leaf.dtype.kind == "f")
