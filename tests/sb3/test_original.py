"""What scripts for Stable-Baselines3 do: one test for each kind of call."""

import io
import json
import warnings

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from rejeu import sb3
from rejeu.algorithms.actor_critic.network import sde_std
from rejeu.core.distributions import Normal, TanhNormal
from rejeu.sb3.common import env_checker, envs, logger as loggers, torch_layers
from rejeu.sb3.common.buffers import HerReplayBuffer
from rejeu.sb3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from rejeu.sb3.common.torch_layers import BaseFeaturesExtractor
from rejeu.sb3.common.utils import get_parameters_by_name
from rejeu.sb3.common.vec_env import DummyVecEnv, VecCheckNan, VecNormalize
from rejeu.sb3.policy import ActorCriticPolicy, Distribution, half_widths
from tests.tiers import exhaustive, only

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [8]}}


class Features(BaseFeaturesExtractor):
    linear: eqx.nn.Linear

    def __init__(self, observation_space, features_dim=3, *, key):
        super().__init__(observation_space, features_dim)
        self.linear = eqx.nn.Linear(observation_space.shape[0], features_dim, key=key)

    def forward(self, observations):
        return jax.nn.relu(self.linear(observations))


class AdamW:
    """Stands for PyTorch's class of that name."""


class Wide(ActorCriticPolicy):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs, net_arch={"pi": [5], "vf": [6]})


def ppo(**settings):
    return sb3.PPO("MlpPolicy", gym.make("CartPole-v1"), n_steps=16, batch_size=16, n_epochs=1, seed=0, **settings)


def sac(**settings):
    return sb3.SAC(
        "MlpPolicy", gym.make("Pendulum-v1"), learning_starts=8, seed=0, **{"batch_size": 8, **SMALL, **settings}
    )


def test_policy_kwargs_of_the_original_are_translated():
    config = sac(
        policy_kwargs={"net_arch": [8], "n_critics": 3, "optimizer_class": AdamW, "share_features_extractor": False}
    ).config
    assert (config.n_critics, config.optimizer.name) == (3, "adamw")
    kwargs = {
        "optimizer_class": AdamW,
        "optimizer_kwargs": {"weight_decay": 0.5, "betas": (0.8, 0.9)},
        "net_arch": {"pi": [4]},
    }
    config = ppo(policy_kwargs=kwargs).config
    assert dict(config.optimizer.settings) == {"weight_decay": 0.5, "b1": 0.8, "b2": 0.9}
    assert (config.policy_kwargs.pi, config.policy_kwargs.vf) == ((4,), ())


def test_a_features_extractor_is_used_saved_and_loaded(tmp_path):
    kwargs = {"features_extractor_class": Features, "features_extractor_kwargs": {"features_dim": 7}, "net_arch": [8]}
    model = ppo(policy_kwargs=kwargs).learn(16)
    assert model.state.network.torso.layers[0].weight.shape == (7, 8)
    model.save(tmp_path / "model")
    obs = np.ones(4, np.float32)
    assert sb3.PPO.load(tmp_path / "model").predict(obs, deterministic=True) == model.predict(obs, deterministic=True)
    with pytest.raises(TypeError, match="equinox"):
        ppo(policy_kwargs={"features_extractor_class": AdamW})


@pytest.mark.parametrize(
    ("settings", "is_known"),
    [
        ({"features_dim": 7, "widths": [8, 8], "kind": "relu", "extra": None}, True),
        ({"features_dim": 10**9}, False),
        ({"weights": "../secret.npy"}, False),
        ({"widths": [[8]]}, False),
    ],
)
def test_a_file_gives_a_features_extractor_numbers_and_words_only(settings, is_known):
    name = f"{torch_layers.PREFIX}Features {json.dumps([settings, True])}"
    torch_layers.register_again(name)
    assert (torch_layers.ENCODERS.pop(name, None) is not None) == is_known


def test_the_width_of_convolutions_and_images_that_are_scaled_already():
    image = envs.FakeImageEnv(screen_height=36, screen_width=36, channel_first=True)
    env = VecNormalize(DummyVecEnv([lambda: image]))
    shape = {"features_extractor_kwargs": {"features_dim": 16}, "normalize_images": False}
    model = sb3.A2C("CnnPolicy", env, policy_kwargs=shape)
    assert model.state.network.encoder.n_features == 16
    assert model.state.network.encoder.images[0].scale == 1.0
    with pytest.raises(AssertionError, match="uint8"):
        sb3.A2C("CnnPolicy", env)


def test_a_policy_class_of_ones_own_sets_the_layers():
    model = sb3.PPO(Wide, "CartPole-v1", n_steps=16, batch_size=16)
    assert isinstance(model.policy, Wide)
    assert (model.config.policy_kwargs.pi, model.config.policy_kwargs.vf) == ((5,), (6,))


def test_sac_explores_by_state_dependent_noise(tmp_path):
    model = sac(use_sde=True, sde_sample_freq=4)
    assert model.state.actor.log_std.shape == (8, 1)
    model.save(tmp_path / "sde.zip")
    obs = np.ones((2, 3), np.float32)
    np.testing.assert_array_equal(
        sb3.SAC.load(tmp_path / "sde").predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0]
    )
    with pytest.raises(TypeError, match="use_sde"):
        sb3.TD3("MlpPolicy", "Pendulum-v1", use_sde=True)
    with pytest.warns(UserWarning, match="explores by itself"):
        assert sac(use_sde=True, action_noise=0.1).config.action_noise is None


def test_expln_continues_the_exponential_smoothly():
    x = np.array([-1.0, 0.0, 2.0], np.float32)
    np.testing.assert_allclose(sde_std(x, True), [np.exp(-1), 1, np.log(3) + 1], rtol=1e-6)
    assert float(jax.grad(lambda v: sde_std(v, True))(1e-6)) == pytest.approx(1.0, rel=1e-4)


def test_policy_parts_agree_with_the_agent():
    model = ppo(**SMALL)
    assert model.policy.train(mode=False) is model.policy.eval() is model.policy.to(device="cpu") is model.policy
    biases = get_parameters_by_name(model.policy, ["bias"])
    assert 0 < len(biases) < len([*model.policy.parameters()])
    assert {array.ndim for array in biases} == {1}
    obs = np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32)
    values, log_prob, entropy = model.policy.evaluate_actions(obs, np.array([0, 1, 0, 1, 1]))
    np.testing.assert_allclose(values[:, 0], model.value(obs), rtol=1e-6)
    distribution = model.policy.get_distribution(obs)
    p = jax.nn.softmax(distribution.distribution.logits)
    np.testing.assert_allclose(np.exp(log_prob.numpy()), p[np.arange(5), [0, 1, 0, 1, 1]], rtol=1e-5)
    np.testing.assert_allclose(entropy, -(p * np.log(p)).sum(axis=1), rtol=1e-5)
    agent = sac()
    np.testing.assert_allclose(2 * agent.actor(obs[:, :3]), agent.predict(obs[:, :3], deterministic=True)[0], rtol=1e-5)
    assert [q.shape for q in agent.critic(obs[:, :3], np.zeros((5, 1)))] == [(5, 1)] * 2
    state = {name: array + 1 for name, array in agent.policy.state_dict().items()}
    agent.policy.load_state_dict(state)
    vector = agent.policy.parameters_to_vector()
    np.testing.assert_array_equal(vector, np.concatenate([a.ravel() for a in state.values()]))
    name, array = next(iter(state.items()))
    for given in ({name: array + 1}, {other: value for other, value in state.items() if other != name}, {}):
        with pytest.raises(RuntimeError, match="missing"):
            agent.policy.load_state_dict(given)
    np.testing.assert_array_equal(agent.policy.parameters_to_vector(), vector)
    agent.policy.load_state_dict({name: array + 1}, strict=False)
    found = agent.policy.state_dict()
    np.testing.assert_array_equal(found.pop(name), array + 1)
    assert all(np.array_equal(value, state[other]) for other, value in found.items())
    agent.policy.load_from_vector(vector - 2)
    np.testing.assert_array_equal(agent.policy.parameters_to_vector(), vector - 2)


def test_box_distributions_are_in_the_environments_units():
    model = sb3.A2C("MlpPolicy", gym.make("Pendulum-v1"), seed=0)
    _, log_prob, entropy = model.policy.evaluate_actions(
        np.zeros((1, 3), np.float32), model.policy.get_distribution(np.zeros(3)).mode()
    )
    assert float(log_prob[0]) == pytest.approx(-0.5 * np.log(2 * np.pi) - np.log(2), rel=1e-5)  # sigma is 2 there
    assert float(entropy[0]) == pytest.approx(0.5 * np.log(2 * np.pi * np.e) + np.log(2), rel=1e-5)
    widths = half_widths(spaces.Box(np.array([0, -1], np.float32), np.array([4, 9], np.float32)))
    asymmetric = Distribution(Normal(jnp.array([0.5, -1.0]), jnp.log(jnp.array([1e-6, 0.5]))), widths)
    assert asymmetric.mode().tolist() == [3.0, -1.0]
    assert asymmetric.sample()[0] == pytest.approx(3.0, abs=1e-4)
    sigma = np.array([2e-6, 2.5])
    density = -0.5 * np.square([0.0, 0.8]) - np.log(sigma * np.sqrt(2 * np.pi))
    assert float(asymmetric.log_prob(np.array([3.0, 1.0]))) == pytest.approx(density.sum(), rel=1e-5)
    assert float(asymmetric.entropy()) == pytest.approx(np.log(sigma * np.sqrt(2 * np.pi * np.e)).sum(), rel=1e-5)
    assert Distribution(TanhNormal(jnp.zeros(1), jnp.zeros(1)), None).entropy() is None


def test_hyperparameters_are_attributes_that_can_be_set():
    model = ppo(**SMALL, learning_rate=lambda remaining: 1e-3 if remaining > 0.5 else 1e-4, clip_range=0.3)
    assert (model.gamma, model.batch_size, model.clip_range(0.1)) == (0.99, 16, 0.3)
    assert (model.lr_schedule(0.9), model.lr_schedule(0.1)) == (1e-3, 1e-4)
    model.gamma = 0.5
    assert model.config.gamma == 0.5
    assert model.learn(16)._n_updates == 1
    with pytest.raises(AttributeError):
        _ = model.no_such_thing


def test_neutral_arguments_are_accepted_and_those_not_followed_warn():
    ppo(**SMALL, use_sde=False, rollout_buffer_class=None, _init_setup_model=True)
    noise = VectorizedActionNoise(NormalActionNoise(np.zeros(1), np.ones(1)), 2)
    assert noise().shape == (2, 1)
    steady = OrnsteinUhlenbeckActionNoise(np.ones(1), np.zeros(1), theta=0.5, dt=1.0)
    each = VectorizedActionNoise(steady, 3)
    assert [each()[:, 0].tolist() for _ in range(2)] == [[0.5] * 3, [0.75] * 3]
    each.reset([1])
    assert each()[:, 0].tolist() == [0.875, 0.5, 0.875]
    each.reset()
    assert each()[:, 0].tolist() == [0.5] * 3 == [float(steady()[0])] * 3  # the process given has not moved
    model = sac(
        optimize_memory_usage=True, use_sde=False, sde_sample_freq=-1, action_noise=noise, train_freq=(1, "step")
    )
    assert model.config.action_noise == noise.base_noise
    env = sb3.common.env_util.make_vec_env("Pendulum-v1")
    for make, given in (
        (sac, {"use_sde_at_warmup": True}),
        (ppo, {"rollout_buffer_class": sb3.common.buffers.RolloutBuffer}),
        (ppo, {"rollout_buffer_kwargs": {"gamma": 0.5}}),
    ):
        with pytest.warns(UserWarning, match=f"{next(iter(given))}=.* has no effect") as caught:
            make(**given)
        assert len(caught) == 1
    with pytest.warns(UserWarning, match="handle_timeout_termination"):
        sb3.SAC("MlpPolicy", env, replay_buffer_kwargs={"handle_timeout_termination": False}, **SMALL)
    with pytest.raises(TypeError, match="no_such_argument"):
        sac(no_such_argument=1)


@exhaustive
def test_a_batch_may_be_larger_than_the_buffer():
    assert sac(batch_size=64, buffer_size=16).learn(20)._n_updates > 0


def test_files_have_exactly_the_given_name_or_are_file_objects(tmp_path):
    model = sac().learn(12)
    model.save(tmp_path / "a")
    model.save(tmp_path / "b.any")
    model.save_replay_buffer(tmp_path / "replay")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "b.any", "replay.pkl"]
    file = io.BytesIO()
    model.save(file)
    assert sb3.SAC.load(file, custom_objects={"learning_rate": 1e-5, "other": 2}).learning_rate == 1e-5
    model.load_replay_buffer(tmp_path / "replay")
    assert model.replay_buffer.size() == 12


def test_the_rollout_of_an_agent_has_its_values_and_advantages_also_right_after_an_update():
    sizes = []

    def look(known, names):
        sizes.append(known["self"].rollout_buffer.size())
        return True

    agent = sb3.A2C("MlpPolicy", gym.make("CartPole-v1"), n_steps=8, gae_lambda=0.5, learning_rate=0.0, seed=0, **SMALL)
    agent.learn(16, callback=look)
    shown = agent.rollout_buffer
    assert (sizes[7:9], shown.full, shown.episode_starts[0, 0]) == ([8, 1], True, False)
    values = agent.policy.predict_values(shown.observations[:, 0])[:, 0]
    np.testing.assert_allclose(shown.values[:, 0], values, rtol=1e-5)
    assert not shown.episode_starts[1:].any()
    last = shown.returns[-1] - shown.rewards[-1]  # the discounted value of what followed
    error = shown.rewards[:-1] + 0.99 * shown.values[1:] - shown.values[:-1]
    expected = [shown.rewards[-1] + last - shown.values[-1]]
    for one in error[::-1]:
        expected.append(one + 0.99 * 0.5 * expected[-1])
    np.testing.assert_allclose(shown.advantages, expected[::-1], rtol=1e-4)
    np.testing.assert_allclose(shown.returns, shown.advantages + shown.values, rtol=1e-5)
    log_prob = agent.policy.evaluate_actions(shown.observations[:, 0], shown.actions[:, 0, 0])[1]
    np.testing.assert_allclose(shown.log_probs[:, 0], log_prob, rtol=1e-5)


@exhaustive
def test_the_rollout_of_a_recurrent_agent_has_no_values():
    assert not hasattr(sb3.RecurrentPPO("MlpLstmPolicy", "CartPole-v1", **SMALL).rollout_buffer, "values")


PARTS = {
    sb3.PPO: {"policy", "policy.optimizer"},
    sb3.DQN: {"policy", "policy.optimizer"},
    sb3.DDPG: {"policy", "actor.optimizer", "critic.optimizer"},
    sb3.SAC: {"policy", "actor.optimizer", "critic.optimizer", "ent_coef_optimizer"},
}


@pytest.mark.parametrize("kind", only([sb3.PPO, sb3.SAC], PARTS))
def test_parameters_are_got_and_set_by_network_and_optimizer(kind):
    parts = PARTS[kind]
    env = "CartPole-v1" if kind in (sb3.PPO, sb3.DQN) else "Pendulum-v1"
    one, two = (kind("MlpPolicy", env, seed=seed, **SMALL) for seed in (0, 1))
    given = one.get_parameters()
    assert given.keys() == parts
    assert given["policy"].keys() == one.policy.state_dict().keys()
    two.set_parameters(given)
    found = two.get_parameters()
    assert all(np.array_equal(found[part][name], value) for part in given for name, value in given[part].items())
    name, array = given["policy"].popitem()
    for exact, wrong in (
        (False, {"nobody": {}}),
        (True, {"policy": {**given["policy"], name: array}}),
        (True, given),
        (False, {"policy": {name: array[..., None]}}),
    ):
        with pytest.raises(ValueError, match="set_parameters") as caught:
            two.set_parameters(wrong, exact_match=exact)
        assert isinstance(caught.value, RuntimeError)
    two.set_parameters({"policy": {name: array + 1}}, exact_match=False)
    np.testing.assert_array_equal(two.policy.state_dict()[name], array + 1)
    two.set_parameters(
        super(sb3.algorithms.Original, one).get_parameters()
    )  # by name alone, as rejeu's agents have them
    np.testing.assert_array_equal(two.policy.state_dict()[name], array)


def test_extractors_are_shown_as_parts_of_the_networks():
    shape = {"features_extractor_class": Features, "net_arch": [4]}
    agent = sb3.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs=shape, seed=0)
    obs = np.ones((5, 3), np.float32)
    for network in (agent.actor, agent.critic, agent.critic_target):
        extractor = network.features_extractor
        weight, bias = (array[0] if "critic" in name else array for name, array in extractor.named_parameters())
        expected = np.maximum(obs @ weight.T + bias, 0)
        np.testing.assert_allclose(network.extract_features(obs), expected, rtol=1e-5)
        assert extractor.features_dim == 3
    agent.actor.features_extractor.load_state_dict(
        {name: np.zeros_like(array) for name, array in agent.actor.features_extractor.state_dict().items()}
    )
    assert not agent.actor.features_extractor(obs).any()
    assert agent.critic.features_extractor(obs).any()


def test_a_policy_class_whose_methods_are_not_called_warns():
    class Own(ActorCriticPolicy):
        def forward(self, obs, deterministic=False):
            return super().forward(obs, deterministic)

    with pytest.warns(UserWarning, match=r"Own.forward='your own' is called neither in training nor by model.predict"):
        sb3.A2C(Own, "CartPole-v1", policy_kwargs={"net_arch": [4]})


@exhaustive
def test_compute_reward_may_return_an_array_of_one_for_one_goal():
    class OfOne(envs.BitFlippingEnv):
        def compute_reward(self, achieved_goal, desired_goal, _info):
            reward = super().compute_reward(achieved_goal, desired_goal, None)
            return reward if _info is None else np.atleast_1d(reward)  # step gives None

    kwargs = {"replay_buffer_class": sb3.HerReplayBuffer, "learning_starts": 8, "batch_size": 8, **SMALL}
    assert sb3.DQN("MultiInputPolicy", OfOne(4), **kwargs).learn(20)._n_updates > 0


def test_logger_formats(tmp_path, capsys):
    logger = loggers.configure(str(tmp_path), ["stdout", "csv", "json", "log"])
    logger.record("a/b", 1.5)
    logger.record("a/text", "words", exclude="csv")
    logger.dump(3)
    logger.record("c", 2)
    logger.dump(4)
    assert "|    b    | 1.5" in capsys.readouterr().out
    assert loggers.read_csv(tmp_path / "progress.csv") == [{"a/b": "1.5", "c": ""}, {"a/b": "", "c": "2"}]
    assert loggers.read_json(tmp_path / "progress.json") == [{"a/b": 1.5, "a/text": "words"}, {"c": 2}]
    logger.record("figure", loggers.Figure(None, False))
    with pytest.raises(loggers.FormatUnsupportedError, match="exclude"):
        logger.dump()
    logger.close()
    model = ppo(**SMALL)
    model.set_logger(loggers.Logger(None, []))
    model.logger.dump = lambda step=0: None
    model.learn(64, log_interval=1)
    assert model.logger.name_to_value["time/fps"] > 0


@pytest.mark.parametrize(
    "kind", [envs.IdentityEnv, envs.IdentityEnvBox, envs.FakeImageEnv, envs.BitFlippingEnv, envs.SimpleMultiObsEnv]
)
def test_environments_pass_the_checker_without_warnings(kind):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env_checker.check_env(kind())


def test_the_checker_states_the_difference():
    env = envs.IdentityEnvBox()
    env.step = lambda action: (np.full(1, 3.0, np.float32), 0.0, False, False, {})
    with pytest.raises(AssertionError, match=r"3\.0 at index 0, outside of the declared bounds \[-1\.0, 1\.0\]"):
        env_checker.check_env(env)


def test_the_checker_refuses_actions_without_bounds_and_warns_of_others_than_those_of_the_policy():
    env = envs.IdentityEnvBox()
    env.action_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    with pytest.raises(AssertionError, match="must have finite bounds"):
        env_checker.check_env(env)
    env.action_space = env.observation_space = spaces.Box(0, 2, (1,), np.float32)
    with pytest.warns(UserWarning, match="bounds of -1 and 1 are recommended"):
        env_checker.check_env(env)


def test_the_checker_renders_if_it_is_asked_to():
    env, rendered = envs.IdentityEnvBox(), []
    env.render_mode, env.render = "rgb_array", lambda: rendered.append(1)
    for skips in (True, False):
        env_checker.check_env(env, skip_render_check=skips)
    assert rendered == [1]


def test_contrib_modules_and_masks():
    from rejeu.sb3_contrib import MaskablePPO
    from rejeu.sb3_contrib.common.envs import InvalidActionEnvDiscrete
    from rejeu.sb3_contrib.common.maskable.evaluation import evaluate_policy
    from rejeu.sb3_contrib.common.maskable.utils import get_action_masks
    from rejeu.sb3_contrib.common.wrappers import ActionMasker, TimeFeatureWrapper
    from rejeu.sb3_contrib.ppo_recurrent import MlpLstmPolicy  # noqa: F401

    env = InvalidActionEnvDiscrete(dim=6, n_invalid_actions=5)
    model = MaskablePPO("MlpPolicy", env, n_steps=8, batch_size=8, **SMALL)
    assert evaluate_policy(model, env, n_eval_episodes=2)[0] == 100.0  # only the right action is left
    assert get_action_masks(ActionMasker(env, lambda inner: np.ones(6))).tolist() == [True] * 6
    timed = TimeFeatureWrapper(gym.make("Pendulum-v1"))
    assert timed.reset()[0][-1] == 1.0
    assert [timed.step(np.zeros(1))[0][-1] for _ in range(2)] == pytest.approx([1 - 1 / 200, 1 - 2 / 200])
    assert timed.reset()[0][-1] == 1.0
    shown = TimeFeatureWrapper(gym.make("Pendulum-v1"), test_mode=True)
    assert (shown.reset()[0][-1], shown.step(np.zeros(1))[0][-1]) == (1.0, 1.0)
    goals = TimeFeatureWrapper(Reach(), max_steps=4)  # which has no limit of its own
    goals.reset()
    obs = goals.step(np.zeros(1))[0]
    assert (obs["observation"].tolist(), obs["achieved_goal"].tolist()) == ([100.0, 0.75], [100.0])
    assert goals.observation_space.contains(obs)
    assert goals.observation_space["observation"].low.tolist() == [-200.0, 0.0]


def test_stacks_of_observations_by_hand():
    from rejeu.sb3.common.vec_env.stacked_observations import StackedObservations

    space = spaces.Box(0, 255, (3, 4, 5), np.uint8)
    assert StackedObservations.compute_stacking(2, space) == (True, 1, (6, 4, 5), 0)
    stack = StackedObservations(2, 3, spaces.Box(-1, 1, (2,)))
    stack.reset(np.ones((2, 2)))
    obs, infos = stack.update(
        np.full((2, 2), 2), np.array([False, True]), [{}, {"terminal_observation": np.full(2, 3)}]
    )
    assert obs.tolist() == [[0, 0, 1, 1, 2, 2], [0, 0, 0, 0, 2, 2]]
    assert infos[1]["terminal_observation"].tolist() == [0, 0, 1, 1, 3, 3]
    with pytest.raises(TypeError, match="one value"):
        StackedObservations(2, 3, spaces.Box(-1, 1, (2,)), {"a": "first"})


def test_a_vector_environment_need_not_call_its_base_and_extra_actions_warn():
    class Bare(DummyVecEnv):
        def __init__(self):
            super().__init__([lambda: gym.make("Pendulum-v1")])
            del self.reset_infos

    assert VecCheckNan(Bare()).reset_infos == [{}]
    env = VecCheckNan(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), raise_exception=True)
    env.reset()
    with pytest.raises(ValueError, match="nan"):
        env.step(np.array([[np.nan]]))
    with pytest.warns(UserWarning, match="takes the first"):
        env.step(np.zeros((2, 1)))


@exhaustive
def test_trust_regions_and_random_search_are_at_their_paths():
    from rejeu.sb3_contrib import ARS, TRPO
    from rejeu.sb3_contrib.ars import LinearPolicy
    from rejeu.sb3_contrib.trpo import MlpPolicy

    assert TRPO(MlpPolicy, "CartPole-v1", n_steps=32, batch_size=32, seed=0).learn(64).num_timesteps == 64
    linear = ARS(LinearPolicy, "CartPole-v1", n_delta=1, seed=0).learn(100)
    assert {array.shape for array in linear.policy.parameters() if array.ndim == 2} == {(4, 2)}
    hidden = ARS("MlpPolicy", "CartPole-v1", n_delta=1, seed=0)
    assert {array.shape for array in hidden.policy.parameters() if array.ndim == 2} == {
        (4, 64),
        (64, 64),
        (64, 2),
    }


class Reach(gym.Env):
    """A point that moves on a line, and a place that it must reach, far from 0; five steps an episode."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)
    observation_space = spaces.Dict(
        {key: spaces.Box(-200, 200, (1,), np.float32) for key in ("observation", "achieved_goal", "desired_goal")}
    )

    def _obs(self):
        place = np.full(1, self.place, np.float32)
        return {"observation": place, "achieved_goal": place, "desired_goal": np.full(1, self.goal, np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.t, self.goal = 100.0, 0, self.np_random.integers(97, 104)
        return self._obs(), {}

    def step(self, action):
        self.place, self.t = float(np.float32(self.place + np.round(action[0]))), self.t + 1
        obs = self._obs()
        return obs, self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {}), False, self.t >= 5, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return np.where(np.any(achieved_goal != desired_goal, axis=-1), -1.0, 0.0)


@pytest.mark.parametrize("her", only([True], [False, True]))
def test_a_replay_buffer_behind_vec_normalize_keeps_original_values_and_draws_scaled_ones(her):
    from rejeu.sb3.common.env_util import make_vec_env

    env = VecNormalize(make_vec_env(Reach, n_envs=2))
    kwargs = {"replay_buffer_class": HerReplayBuffer} if her else {}
    model = sb3.SAC("MultiInputPolicy", env, learning_starts=10, batch_size=8, seed=0, **SMALL, **kwargs).learn(44)
    shown = model.replay_buffer
    places = shown.observations["observation"]
    assert np.array_equal(places, np.round(places))
    assert places.min() > 90
    ended = shown.dones.astype(bool)
    assert np.abs(shown.next_observations["observation"][ended] - places[ended]).max() <= 1
    batch = model.run.replay.draw(np.random.default_rng(0), (32,))[0]
    reached, goal = (env.unnormalize_obs(batch.next_obs)[key] for key in ("achieved_goal", "desired_goal"))
    expected = env.normalize_reward(np.where(np.round(reached[:, 0]) == np.round(goal[:, 0]), 0.0, -1.0))
    np.testing.assert_allclose(batch.reward, expected, rtol=1e-5)
    model.set_env(VecNormalize(make_vec_env(Reach, n_envs=2), training=False))
    model.learn(10)


def test_time_limits_are_terminal_without_handle_timeout_termination():
    kwargs = {"replay_buffer_kwargs": {"handle_timeout_termination": False}, "learning_starts": 20, **SMALL}
    shown = sb3.SAC("MultiInputPolicy", Reach(), **kwargs).learn(12).replay_buffer
    assert (shown.dones.sum(), shown.timeouts.sum()) == (2, 0)
    assert sb3.SAC("MultiInputPolicy", Reach(), learning_starts=20, **SMALL).learn(12).replay_buffer.timeouts.sum() == 2


@exhaustive
def test_noise_of_one_component_is_that_of_every_action():
    env, noise = envs.IdentityEnvBox(), NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    env.action_space = spaces.Box(-1, 1, (3,), np.float32)
    assert sb3.TD3("MlpPolicy", env, action_noise=noise, **SMALL).config.action_noise.sigma == (0.1, 0.1, 0.1)
