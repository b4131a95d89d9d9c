"""Examples of the pages of Stable-Baselines3's documentation that no other test shows, in our own words.

Each function is one example of the page that :func:`example` names. Trainings are shorter. ``fails`` says why an example does
not run here; classes of PyTorch are replaced by those of ``equinox`` and ``jax``, which the page says.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np

from rejeu.sb3 import A2C, DQN, PPO, SAC, HerReplayBuffer
from rejeu.sb3.common import callbacks as cb
from rejeu.sb3.common.env_util import make_vec_env
from rejeu.sb3.common.envs import BitFlippingEnv, FakeImageEnv, SimpleMultiObsEnv
from rejeu.sb3.common.evaluation import evaluate_policy
from rejeu.sb3.common.logger import TensorBoardOutputFormat
from rejeu.sb3.common.policies import ActorCriticPolicy
from rejeu.sb3.common.torch_layers import BaseFeaturesExtractor
from rejeu.sb3.common.utils import set_random_seed
from rejeu.sb3.common.vec_env import (
    SubprocVecEnv,
    VecNormalize,
)
from rejeu.sb3_contrib.common.envs import InvalidActionEnvDiscrete


@dataclass(frozen=True)
class Example:
    """An example of a page; ``needs`` is a package that may not be installed."""

    page: str
    run: Callable[[], None]
    fails: str | None
    needs: str | None


EXAMPLES: list[Example] = []


def example(page: str, fails: str | None = None, needs: str | None = None) -> Callable[[Any], Any]:
    """Adds a function to the examples."""

    def add(function: Callable[[], None]) -> Callable[[], None]:
        EXAMPLES.append(Example(page, function, fails, needs))
        return function

    return add


@example("guide/quickstart")
def train_and_step_its_environment():
    env = gym.make("CartPole-v1", render_mode="rgb_array")
    model = A2C("MlpPolicy", env, verbose=0)
    model.learn(total_timesteps=60)
    vec_env = model.get_env()
    obs = vec_env.reset()
    for _ in range(5):
        action, _states = model.predict(obs, deterministic=True)
        obs, _reward, _done, _info = vec_env.step(action)
    assert vec_env.render("rgb_array").ndim == 3


@example("guide/examples")
def train_save_load_and_evaluate():
    env = gym.make("CartPole-v1", render_mode="rgb_array")
    model = DQN("MlpPolicy", env, verbose=1, learning_starts=20)
    model.learn(total_timesteps=60, progress_bar=False)
    model.save("dqn_cartpole")
    del model
    model = DQN.load("dqn_cartpole", env=env)
    mean_reward, _ = evaluate_policy(model, model.get_env(), n_eval_episodes=2)
    assert mean_reward > 0


def of_rank(env_id, rank, seed=0):
    def _init():
        env = gym.make(env_id)
        env.reset(seed=seed + rank)
        return env

    set_random_seed(seed)
    return _init


@example("guide/examples")
def train_in_processes():
    vec_env = SubprocVecEnv([of_rank("CartPole-v1", i) for i in range(2)])
    model = PPO("MlpPolicy", vec_env, n_steps=16, batch_size=16).learn(total_timesteps=32)
    assert model.predict(vec_env.reset())[0].shape == (2,)
    vec_env.close()


@example("guide/examples")
def train_on_dict_observations():
    env = SimpleMultiObsEnv(random_start=False)
    assert PPO("MultiInputPolicy", env, n_steps=16, batch_size=16).learn(total_timesteps=16)._n_updates > 0


@example("guide/examples")
def normalize_save_the_statistics_and_load_them():
    vec_env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=1), norm_obs=True, norm_reward=True, clip_obs=10.0)
    model = PPO("MlpPolicy", vec_env, n_steps=32, batch_size=32)
    model.learn(total_timesteps=64)
    model.save("ppo_pendulum")
    vec_env.save("vec_normalize.pkl")
    del model, vec_env
    vec_env = VecNormalize.load("vec_normalize.pkl", make_vec_env("Pendulum-v1", n_envs=1))
    vec_env.training, vec_env.norm_reward = False, False
    model = PPO.load("ppo_pendulum", env=vec_env)
    assert model.predict(vec_env.reset())[0].shape == (1, 1)


def hindsight(kind, **settings):
    env = BitFlippingEnv(n_bits=4, continuous=kind is not DQN, max_steps=4)
    replay = {"n_sampled_goal": 4, "goal_selection_strategy": "future"}
    return kind(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs=replay,
        learning_starts=20,
        **settings,
    )


@example("guide/examples")
def hindsight_with_save_and_load():
    model = hindsight(SAC, buffer_size=1000, tau=0.05, policy_kwargs={"net_arch": [64, 64]}).learn(40)
    model.save("her_model")
    env = BitFlippingEnv(n_bits=4, continuous=True, max_steps=4)
    model = SAC.load("her_model", env=env)
    obs, _info = env.reset()
    assert env.action_space.contains(model.predict(obs, deterministic=True)[0])


@example("guide/examples")
def save_and_load_replay_buffer_and_policy():
    from rejeu.sb3.sac.policies import MlpPolicy

    model = SAC("MlpPolicy", "Pendulum-v1", verbose=0, learning_rate=1e-3, learning_starts=20)
    model.learn(total_timesteps=60)
    model.save("sac_pendulum")
    model.save_replay_buffer("sac_replay_buffer")
    loaded_model = SAC.load("sac_pendulum")
    assert loaded_model.replay_buffer.size() == 0
    loaded_model.load_replay_buffer("sac_replay_buffer")
    assert loaded_model.replay_buffer.size() == 60
    model.policy.save("sac_policy_pendulum")
    saved_policy = MlpPolicy.load("sac_policy_pendulum")
    obs = np.zeros((1, 3), np.float32)
    first, again = (one.predict(obs, deterministic=True)[0] for one in (model, saved_policy))
    assert np.array_equal(first, again)


@example("guide/examples")
def change_parameters_by_random_search():
    model = A2C("MlpPolicy", "CartPole-v1", ent_coef=0.0, policy_kwargs={"net_arch": [32]}).learn(60)
    mean = dict(model.policy.state_dict())
    candidate = {name: value + 0.1 * np.random.randn(*value.shape) for name, value in mean.items()}  # noqa: NPY002
    model.policy.load_state_dict({name: np.float32(value) for name, value in candidate.items()}, strict=False)
    env = model.get_env()
    assert evaluate_policy(model, env, n_eval_episodes=2, warn=False)[0] > 0


@example("guide/examples", fails="the original's environments for its own tests are not included")
def the_environments_for_tests():
    import importlib

    importlib.import_module("rejeu.sb3.common.envs")


class Convolutions(BaseFeaturesExtractor):
    conv: eqx.nn.Conv2d
    linear: eqx.nn.Linear

    def __init__(self, observation_space, features_dim=16, *, key):
        super().__init__(observation_space, features_dim)
        self.conv = eqx.nn.Conv2d(observation_space.shape[0], 4, kernel_size=8, stride=4, key=key)
        side = (observation_space.shape[1] - 8) // 4 + 1
        self.linear = eqx.nn.Linear(4 * side * side, features_dim, key=key)

    def forward(self, observations):
        return jax.nn.relu(self.linear(jnp.ravel(jax.nn.relu(self.conv(observations)))))


@example("guide/custom_policy")
def a_features_extractor_for_images():
    kwargs = {"features_extractor_class": Convolutions, "features_extractor_kwargs": {"features_dim": 8}}
    env = FakeImageEnv(screen_height=36, screen_width=36)
    PPO("CnnPolicy", env, policy_kwargs=kwargs, n_steps=16, batch_size=16).learn(16)


class Combined(BaseFeaturesExtractor):
    linear: eqx.nn.Linear

    def __init__(self, observation_space, *, key):
        super().__init__(observation_space, 9)
        self.linear = eqx.nn.Linear(observation_space.spaces["vec"].shape[0], 8, key=key)

    def forward(self, observations):
        mean = jnp.mean(observations["img"])[None]
        return jnp.concatenate([self.linear(observations["vec"]), mean])


@example("guide/custom_policy")
def a_features_extractor_for_dicts():
    kwargs = {"features_extractor_class": Combined}
    PPO("MultiInputPolicy", SimpleMultiObsEnv(), policy_kwargs=kwargs, n_steps=16, batch_size=16).learn(16)


@example(
    "guide/custom_policy", fails="policies are views of an agent; the layers between extractor and heads are net_arch"
)
def a_network_of_ones_own():
    class Own(ActorCriticPolicy):
        def _build_mlp_extractor(self):
            self.mlp_extractor = None

    model = PPO(Own, "CartPole-v1", n_steps=16, batch_size=16)
    assert model.policy.mlp_extractor is None


def logged(record, algorithm=A2C):
    class Values(cb.BaseCallback):
        def _on_step(self):
            if self.n_calls == 10:
                record(self)
                self.logger.dump(self.num_timesteps)
            return True

    model = algorithm("MlpPolicy", "CartPole-v1", tensorboard_log="./board/")
    model.learn(20, callback=Values(), tb_log_name="first")
    assert os.listdir("board") == ["first_1"]
    model.learn(20, tb_log_name="first", reset_num_timesteps=False)


@example("guide/tensorboard", needs="tensorboard")
def log_values():
    logged(lambda callback: callback.logger.record("random_value", np.float64(0.5)))


@example(
    "guide/tensorboard", fails="the writer is not PyTorch's SummaryWriter; record values instead", needs="tensorboard"
)
def use_the_writer():
    def write(callback):
        formats = callback.logger.output_formats
        own = next(one for one in formats if isinstance(one, TensorBoardOutputFormat))
        own.writer.add_text("direct access", "this is a value", callback.num_timesteps)

    logged(write)


@example("guide/export", fails="torch.onnx exports PyTorch modules; agent.export(path) writes ONNX here")
def export_by_pytorch():
    import importlib

    importlib.import_module("torch.onnx").export(PPO("MlpPolicy", "CartPole-v1").policy, (np.zeros((1, 4)),), "m.onnx")


@example("sb3-contrib")
def masks():
    from rejeu.sb3_contrib import MaskablePPO
    from rejeu.sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_by_masks
    from rejeu.sb3_contrib.common.maskable.utils import get_action_masks
    from rejeu.sb3_contrib.common.wrappers import ActionMasker

    env = InvalidActionEnvDiscrete(dim=8, n_invalid_actions=4)
    model = MaskablePPO("MlpPolicy", env, gamma=0.4, seed=32, n_steps=32, batch_size=32).learn(64)
    evaluate_by_masks(model, env, n_eval_episodes=2, warn=False)
    obs, _ = env.reset()
    model.predict(obs, action_masks=get_action_masks(env))
    wrapped = ActionMasker(env, lambda inner: inner.action_masks())
    MaskablePPO("MlpPolicy", wrapped, n_steps=32, batch_size=32).learn(32)


@example("sb3-contrib")
def recurrent():
    from rejeu.sb3_contrib import RecurrentPPO

    model = RecurrentPPO("MlpLstmPolicy", "CartPole-v1", n_steps=32, batch_size=32).learn(32)
    vec_env = model.get_env()
    obs, lstm_states, starts = vec_env.reset(), None, np.ones((1,), dtype=bool)
    for _ in range(5):
        action, lstm_states = model.predict(obs, state=lstm_states, episode_start=starts, deterministic=True)
        obs, _rewards, starts, _info = vec_env.step(action)
