"""What scripts expect of an agent: its environments, seeds, files and evaluation."""

import random
from collections import deque

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.logs import evaluation as limits
from rejeu.sb3 import A2C, PPO, SAC
from rejeu.sb3.common.callbacks import BaseCallback
from rejeu.sb3.common.evaluation import evaluate_policy
from rejeu.sb3.common.monitor import Monitor
from rejeu.sb3.common.torch_layers import BaseFeaturesExtractor
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from tests.environments import Timed

pytestmark = pytest.mark.usefixtures("learners_are_shared")

TINY = {"policy_kwargs": {"net_arch": [4]}}


class Endless(Timed):
    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Discrete(2)
    length = None

    def reward(self, action):
        return 1.0


def test_the_environments_of_an_id_have_the_methods_of_the_original():
    model = A2C("MlpPolicy", "CartPole-v1", n_steps=8, **TINY)
    env = model.env
    assert env is model.get_env()
    assert (env.num_envs, env.render_mode, env.env_is_wrapped(Monitor)) == (1, "rgb_array", [True])
    assert env.seed(3) == [3]
    assert env.reset().shape == (1, 4)
    obs, rewards, dones, infos = env.step([0])
    assert (obs.shape, rewards.shape, dones.shape, len(infos)) == ((1, 4), (1,), (1,), 1)
    assert env.render(mode="rgb_array").ndim == 3
    assert env.get_attr("gravity") == [9.8]
    env.set_attr("gravity", 5.0)
    assert env.env_method("get_wrapper_attr", "gravity") == [5.0]
    with pytest.raises(AttributeError, match="use set_env"):
        model.env = env


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="there is a GPU")
def test_cuda_without_a_gpu_is_the_cpu():
    model = A2C("MlpPolicy", Endless(), n_steps=8, device="cuda", **TINY)
    assert (model.device, model.device.type) == ("cpu", "cpu")
    assert model.learn(8).num_timesteps == 8


def test_a_gymnasium_environment_gets_one_monitor():
    for env in (Endless(), Monitor(Endless())):
        model = A2C("MlpPolicy", env, n_steps=8, **TINY)
        assert model.env.env_is_wrapped(Monitor) == [True]
        assert isinstance(model.env.envs[0].env, Endless)


def test_the_recent_episodes_are_saved_and_forgotten_by_a_new_run(tmp_path):
    model = A2C("MlpPolicy", Endless(), n_steps=8, stats_window_size=2, **TINY)
    model.ep_info_buffer.extend([{"r": 1.5, "l": 3, "t": 0.25}] * 3)
    model.ep_success_buffer.append(1.0)
    model.save(tmp_path / "model")
    model.save(tmp_path / "without", exclude=["ep_info_buffer"])
    loaded = A2C.load(tmp_path / "model", Endless())
    assert (loaded.ep_info_buffer, loaded.ep_success_buffer) == (model.ep_info_buffer, model.ep_success_buffer)
    assert A2C.load(tmp_path / "without").ep_info_buffer == deque()
    lengths = [len(loaded.learn(1, reset_num_timesteps=reset).ep_info_buffer) for reset in (False, True)]
    assert lengths == [2, 0]


def test_callbacks_can_render_the_training_environments():
    class Renders(BaseCallback):
        def _on_step(self):
            self.frame = self.training_env.render(mode="rgb_array")
            return self.n_calls < 2

    callback = Renders()
    A2C("MlpPolicy", "CartPole-v1", n_steps=8, **TINY).learn(4, callback)
    assert callback.frame.dtype == np.uint8


def test_a_seed_seeds_the_global_generators_too(tmp_path):
    def drawn(make):
        made = make()
        return made, random.random(), np.random.random()  # noqa: NPY002

    env = gym.make("CartPole-v1")
    model, *first = drawn(lambda: A2C("MlpPolicy", env, seed=7, **TINY))
    model.save(tmp_path / "m")
    assert drawn(lambda: A2C("MlpPolicy", env, seed=7, **TINY))[1:] == tuple(first)
    assert drawn(lambda: A2C.load(tmp_path / "m", seed=7))[1:] == tuple(first)
    assert drawn(lambda: A2C("MlpPolicy", env, **TINY))[1:] != tuple(first)


@pytest.mark.parametrize("name", ["save", "snapshot"])
def test_files_keep_where_statistics_go(tmp_path, name):
    model = A2C("MlpPolicy", gym.make("CartPole-v1"), verbose=1, tensorboard_log=tmp_path / "board", **TINY)
    model.save(tmp_path / "m.zip") if name == "save" else model.snapshot(tmp_path / "m.zip")()
    loaded = A2C.load(tmp_path / "m")
    assert (loaded.verbose, loaded.tensorboard_log, loaded.log) == (1, str(tmp_path / "board"), ("tensorboard",))
    changed = A2C.load(tmp_path / "m", verbose=0, tensorboard_log=None)
    assert (changed.verbose, changed.tensorboard_log, changed.log) == (0, None, ())
    model.save(tmp_path / "n", exclude=["verbose", "tensorboard_log"])
    assert (A2C.load(tmp_path / "n").verbose, A2C.load(tmp_path / "n").log) == (0, ())


def test_an_endless_episode_of_an_evaluation_is_cut_off(monkeypatch):
    monkeypatch.setattr("rejeu.sb3.common.evaluation.MOST_STEPS", 5)
    monkeypatch.setattr(limits, "MOST_STEPS", 5)
    model = A2C("MlpPolicy", Endless(), **TINY)
    with pytest.warns(UserWarning, match="1 episode of an evaluation did not end in 5 steps and was cut off"):
        assert evaluate_policy(model, Endless(), 3, return_episode_rewards=True) == ([5.0], [5])


def test_an_evaluation_without_the_normalization_of_training_warns():
    model = A2C("MlpPolicy", VecNormalize(DummyVecEnv([lambda: gym.make("CartPole-v1")])), **TINY)
    with pytest.warns(UserWarning, match="learns in a VecNormalize, and is evaluated without"):
        evaluate_policy(model, gym.make("CartPole-v1"), 1)


@pytest.mark.parametrize("kind", [SAC, rejeu.SAC])
def test_an_empty_replay_buffer_does_not_replace_a_file(tmp_path, kind):
    model = kind("MlpPolicy", gym.make("Pendulum-v1"), learning_starts=100, buffer_size=50, **TINY)
    model.save(tmp_path / "m")
    model.learn(5).save_replay_buffer(tmp_path / "replay")
    for loaded in (kind.load(tmp_path / "m"), kind.load(tmp_path / "m", env=gym.make("Pendulum-v1"))):
        with pytest.warns(UserWarning, match=r"exists and is kept, .* call load_replay_buffer first"):
            path = loaded.save_replay_buffer(tmp_path / "replay")
        assert path.is_file()
    loaded.load_replay_buffer(tmp_path / "replay")
    assert loaded.replay_buffer.size() == 5


@pytest.mark.parametrize("kind", [PPO, rejeu.PPO])
def test_a_setting_of_the_networks_says_where_it_belongs(kind):
    with pytest.raises(
        TypeError, match=r"PPO takes log_std_init in policy_kwargs: policy_kwargs=\{'log_std_init': ...\}"
    ):
        kind("MlpPolicy", "Pendulum-v1", log_std_init=-1)


def test_a_missing_file_is_named_as_it_was_looked_for(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no file .*model\.zip"):
        A2C.load(tmp_path / "model")


def test_the_old_class_of_hindsight_says_what_replaced_it():
    from rejeu.sb3 import HER

    for call in (HER, HER.load):
        with pytest.raises(ImportError, match="replay_buffer_class=HerReplayBuffer"):
            call("path")


class TorchModule:
    """Stands for ``torch.nn.Module``: PyTorch is not installed where the tests run."""

    __module__ = "torch.nn.modules.module"


class WithLayersOfTorch(BaseFeaturesExtractor):
    def __init__(self, observation_space, features_dim=8):
        super().__init__(observation_space, features_dim)
        self.net = TorchModule()


def of_torch(name):
    return type(name, (TorchModule,), {"__module__": f"torch.{name.lower()}"})


@pytest.mark.parametrize(("setting", "value", "message"), [
    ("features_extractor_class", WithLayersOfTorch, "WithLayersOfTorch: .*'net'; .*equinox.*docs/coming-from-sb3.md shows"),
    ("features_extractor_class", of_torch("MyCNN"), "MyCNN.* not a PyTorch module; .*equinox.nn, as docs/coming-from-sb3.md"),
    ("optimizer_class", of_torch("Adagrad"), "optimizer_class=Adagrad is of PyTorch; use one of Adam, .*optimizer=optax"),
    ("activation_fn", of_torch("Mish"), "activation_fn='mish' must be one of relu, tanh"),
    ("activation_fn", of_torch("Mish")(), "activation_fn='mish' must be one of relu, tanh"),
])  # fmt: skip
def test_a_class_of_pytorch_is_named_with_what_to_do(setting, value, message):
    with pytest.raises((TypeError, ValueError), match=message) as caught:
        PPO("MlpPolicy", "CartPole-v1", policy_kwargs={setting: value})
    assert "\n" not in str(caught.value)
