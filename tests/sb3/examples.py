"""What the pages of Stable-Baselines3's documentation do in their examples, in our own words, with the imports replaced.

Each function is one example of the page that :func:`example` names. Trainings are shorter. ``fails`` says why an example does
not run here; classes of PyTorch are replaced by those of ``equinox`` and ``jax``, which the page says.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from rejeu.sb3 import A2C, DDPG, DQN, PPO, SAC, TD3, HerReplayBuffer
from rejeu.sb3.common import callbacks as cb
from rejeu.sb3.common.env_checker import check_env
from rejeu.sb3.common.env_util import make_atari_env, make_vec_env
from rejeu.sb3.common.evaluation import evaluate_policy
from rejeu.sb3.common.logger import Figure, HParam, Image, TensorBoardOutputFormat, Video, configure
from rejeu.sb3.common.monitor import Monitor
from rejeu.sb3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from rejeu.sb3.common.policies import ActorCriticPolicy
from rejeu.sb3.common.results_plotter import load_results, plot_results, ts2xy
from rejeu.sb3.common.torch_layers import BaseFeaturesExtractor
from rejeu.sb3.common.utils import set_random_seed
from rejeu.sb3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecNormalize,
    VecVideoRecorder,
)
from tests.sb3.envs import BitFlippingEnv, FakeImageEnv, InvalidActionEnvDiscrete, SimpleMultiObsEnv


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


@example("guide/quickstart")
def train_in_one_line():
    assert A2C("MlpPolicy", "CartPole-v1").learn(60).num_timesteps == 60


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
def train_off_policy_in_several_environments():
    vec_env = make_vec_env("Pendulum-v1", n_envs=4, seed=0)
    model = SAC("MlpPolicy", vec_env, train_freq=1, gradient_steps=2, learning_starts=20)
    assert model.learn(total_timesteps=40)._n_updates > 0


@example("guide/examples")
def train_on_dict_observations():
    env = SimpleMultiObsEnv(random_start=False)
    assert PPO("MultiInputPolicy", env, n_steps=16, batch_size=16).learn(total_timesteps=16)._n_updates > 0


class SaveOnBestTrainingReward(cb.BaseCallback):
    def __init__(self, check_freq, log_dir, verbose=1):
        super().__init__(verbose)
        self.check_freq, self.log_dir = check_freq, log_dir
        self.save_path = os.path.join(log_dir, "best_model")
        self.best_mean_reward = -np.inf

    def _init_callback(self):
        os.makedirs(self.save_path, exist_ok=True)

    def _on_step(self):
        if self.n_calls % self.check_freq == 0:
            x, y = ts2xy(load_results(self.log_dir), "timesteps")
            if len(x) > 0 and np.mean(y[-100:]) > self.best_mean_reward:
                self.best_mean_reward = np.mean(y[-100:])
                self.model.save(self.save_path + "/model")
        return True


@example("guide/examples")
def save_the_best_model_by_the_monitor_and_plot():
    os.makedirs("log", exist_ok=True)
    env = Monitor(gym.make("CartPole-v1"), "log/")
    PPO("MlpPolicy", env, n_steps=32, batch_size=32).learn(200, callback=SaveOnBestTrainingReward(50, "log/"))
    assert os.path.isfile("log/best_model/model.zip")
    plot_results(["log/"], 200, "timesteps", "CartPole")


@example("guide/examples", needs="ale_py")
def train_on_atari():
    vec_env = VecFrameStack(make_atari_env("PongNoFrameskip-v4", n_envs=2, seed=0), n_stack=4)
    A2C("CnnPolicy", vec_env).learn(total_timesteps=20)


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
def linear_learning_rate():
    def linear_schedule(initial_value):
        return lambda progress_remaining: progress_remaining * initial_value

    model = PPO("MlpPolicy", "CartPole-v1", learning_rate=linear_schedule(0.001), verbose=0, n_steps=32)
    model.learn(total_timesteps=64)
    model.learn(total_timesteps=32, reset_num_timesteps=True)
    assert model.lr_schedule(0.5) == 0.0005


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


@example("guide/examples")
def record_a_video():
    vec_env = DummyVecEnv([lambda: gym.make("CartPole-v1", render_mode="rgb_array")])
    vec_env = VecVideoRecorder(vec_env, "videos", record_video_trigger=lambda x: x == 0, video_length=5)
    vec_env.reset()
    for _ in range(6):
        vec_env.step([vec_env.action_space.sample()])
    vec_env.close()
    assert os.listdir("videos")


@example("guide/examples")
def make_images_for_a_gif():
    model = A2C("MlpPolicy", "CartPole-v1").learn(20)
    images = []
    obs = model.env.reset()
    img = model.env.render(mode="rgb_array")
    for _ in range(3):
        images.append(img)
        action, _ = model.predict(obs)
        obs, _, _, _ = model.env.step(action)
        img = model.env.render(mode="rgb_array")
    assert [image.ndim for image in images] == [3, 3, 3]


@example("guide/examples", fails="the original's environments for its own tests are not included")
def the_environments_for_tests():
    import importlib

    importlib.import_module("rejeu.sb3.common.envs")


@example("guide/vec_envs")
def attributes_methods_and_reset_infos():
    vec_env = make_vec_env("CartPole-v1", n_envs=2)
    vec_env.set_attr("gravity", 5.0)
    assert vec_env.get_attr("gravity") == [5.0, 5.0]
    vec_env.seed(3)
    vec_env.set_options({"low": -0.01, "high": 0.01})
    assert np.abs(vec_env.reset()).max() <= 0.01
    assert len(vec_env.reset_infos) == 2


@example("guide/vec_envs")
def a_wrapper_of_ones_own():
    from rejeu.sb3.common.vec_env.base_vec_env import VecEnvWrapper

    class VecExtract(VecEnvWrapper):
        def __init__(self, venv, key):
            self.key = key
            super().__init__(venv=venv, observation_space=venv.observation_space.spaces[key])

        def reset(self):
            return self.venv.reset()[self.key]

        def step_wait(self):
            obs, reward, done, infos = self.venv.step_wait()
            for info in infos:
                if "terminal_observation" in info:
                    info["terminal_observation"] = info["terminal_observation"][self.key]
            return obs[self.key], reward, done, infos

    env = VecExtract(DummyVecEnv([SimpleMultiObsEnv]), key="vec")
    assert PPO("MlpPolicy", env, n_steps=16, batch_size=16).learn(16)._n_updates > 0


class Corridor(gym.Env):
    metadata = {"render_modes": ["console"]}

    def __init__(self, size=5, render_mode="console"):
        super().__init__()
        self.render_mode, self.size, self.place = render_mode, size, size
        self.action_space = spaces.Discrete(2)
        self.observation_space = spaces.Box(low=0, high=size, shape=(1,), dtype=np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed, options=options)
        self.place = self.size
        return np.array([self.place], np.float32), {}

    def step(self, action):
        self.place = int(np.clip(self.place + (1 if action == 1 else -1), 0, self.size))
        return np.array([self.place], np.float32), float(self.place == 0), self.place == 0, False, {}

    def render(self):
        print(self.place)

    def close(self):
        pass


@example("guide/custom_env")
def check_an_environment():
    check_env(Corridor(), warn=True)


@example("guide/custom_env")
def train_in_an_environment_of_ones_own():
    vec_env = make_vec_env(Corridor, n_envs=1, env_kwargs={"size": 4})
    A2C("MlpPolicy", vec_env).learn(60)


@example("guide/custom_env")
def train_in_a_registered_environment():
    gym.register("CorridorOfExamples-v0", entry_point=Corridor, max_episode_steps=20)
    A2C("MlpPolicy", "CorridorOfExamples-v0").learn(20)


@example("guide/custom_policy")
def activation_and_layers():
    kwargs = {"activation_fn": jax.nn.relu, "net_arch": {"pi": [32, 32], "vf": [32, 32]}}
    model = PPO("MlpPolicy", "CartPole-v1", policy_kwargs=kwargs, n_steps=16, batch_size=16)
    model.learn(16)
    model.save("ppo_cartpole")
    PPO.load("ppo_cartpole", env=gym.make("CartPole-v1"))


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


@example("guide/custom_policy")
def layers_of_actor_and_critic():
    SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": {"pi": [16], "qf": [32, 32]}}, learning_starts=20).learn(
        30
    )


class Custom(cb.BaseCallback):
    def __init__(self, verbose=0):
        super().__init__(verbose)
        self.calls = []

    def _on_training_start(self):
        self.calls.append("start")

    def _on_rollout_start(self):
        self.calls.append("rollout")

    def _on_step(self):
        assert self.training_env.num_envs == 1
        self.logger.record("random/value", 0.5)
        return True

    def _on_rollout_end(self):
        self.calls.append("end of rollout")

    def _on_training_end(self):
        self.calls.append("end")


def short(callback, algorithm=PPO, steps=64, **settings):
    env_id = "Pendulum-v1" if algorithm in (SAC, TD3, DDPG) else "CartPole-v1"
    settings = settings if algorithm is not PPO else {"n_steps": 32, "batch_size": 32, **settings}
    return algorithm("MlpPolicy", env_id, **settings).learn(steps, callback=callback)


@example("guide/callbacks")
def a_callback_of_ones_own():
    callback = Custom()
    short(callback)
    assert callback.calls[0] == "start"
    assert callback.calls[-1] == "end"


@example("guide/callbacks")
def checkpoints():
    callback = cb.CheckpointCallback(
        save_freq=30, save_path="./logs/", name_prefix="rl_model", save_replay_buffer=True, save_vecnormalize=True
    )
    short(callback, SAC, learning_starts=20)
    assert "rl_model_30_steps.zip" in os.listdir("logs")


@example("guide/callbacks")
def evaluations():
    callback = cb.EvalCallback(
        gym.make("CartPole-v1"), best_model_save_path="./logs/", log_path="./logs/", eval_freq=30, deterministic=True
    )
    short(callback)
    assert {"best_model.zip", "evaluations.npz"} <= {*os.listdir("logs")}


@example("guide/callbacks")
def several_callbacks():
    both = [cb.CheckpointCallback(30, "./logs/"), cb.EvalCallback(gym.make("CartPole-v1"), eval_freq=30)]
    short(cb.CallbackList(both))
    short(both)


@example("guide/callbacks", needs="tqdm")
def a_progress_bar():
    short(cb.ProgressBarCallback())


@example("guide/callbacks")
def stop_at_a_reward():
    stop = cb.StopTrainingOnRewardThreshold(reward_threshold=5, verbose=1)
    model = short(cb.EvalCallback(gym.make("CartPole-v1"), callback_on_new_best=stop, eval_freq=20, verbose=1))
    assert model.num_timesteps == 20


@example("guide/callbacks")
def every_n_steps():
    event = cb.EveryNTimesteps(n_steps=20, callback=cb.CheckpointCallback(save_freq=1, save_path="./logs/"))
    short(event)
    assert len(os.listdir("logs")) == 3


@example("guide/callbacks")
def log_every_n_steps():
    short(cb.LogEveryNTimesteps(n_steps=20))


@example("guide/callbacks")
def stop_after_episodes():
    model = short(cb.StopTrainingOnMaxEpisodes(max_episodes=2, verbose=1), A2C, steps=100_000)
    assert model.num_timesteps < 1000


@example("guide/callbacks")
def stop_without_improvement():
    stop = cb.StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=1, verbose=1)
    callback = cb.EvalCallback(gym.make("Pendulum-v1"), eval_freq=10, callback_after_eval=stop, n_eval_episodes=1)
    assert short(callback, SAC, steps=1000, learning_starts=2000).num_timesteps < 1000


@example("guide/callbacks")
def a_function_as_callback():
    assert short(lambda locals_, globals_: locals_["self"].num_timesteps < 10).num_timesteps == 10


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


@example("guide/tensorboard", needs="tensorboard")
def log_images():
    def record(callback):
        image = callback.training_env.render(mode="rgb_array")
        callback.logger.record("image", Image(image, "HWC"), exclude=("stdout", "log", "json", "csv"))

    logged(record)


@example("guide/tensorboard", needs="tensorboard")
def log_figures():
    from matplotlib import pyplot

    figure = pyplot.figure()
    figure.add_subplot().plot([0.5])
    logged(lambda callback: callback.logger.record("figure", Figure(figure, close=True), exclude=("stdout", "csv")))


@example("guide/tensorboard", needs="tensorboard")
def log_videos():
    def record(callback):
        screens, env = [], make_vec_env("CartPole-v1")

        def grab(_locals, _globals):
            screens.append(env.render(mode="rgb_array").transpose(2, 0, 1))

        evaluate_policy(callback.model, env, callback=grab, n_eval_episodes=1)
        frames = np.stack(screens)[None, :3]
        callback.logger.record("video", Video(frames, fps=40), exclude=("stdout", "csv"))

    logged(record)


@example("guide/tensorboard", needs="tensorboard")
def log_hyperparameters():
    settings, metrics = {"algorithm": "A2C", "gamma": 0.99}, {"rollout/ep_len_mean": 0, "train/value_loss": 0.0}
    logged(lambda callback: callback.logger.record("hparams", HParam(settings, metrics), exclude=("stdout", "csv")))


@example(
    "guide/tensorboard", fails="the writer is not PyTorch's SummaryWriter; record values instead", needs="tensorboard"
)
def use_the_writer():
    def write(callback):
        formats = callback.logger.output_formats
        own = next(one for one in formats if isinstance(one, TensorBoardOutputFormat))
        own.writer.add_text("direct access", "this is a value", callback.num_timesteps)

    logged(write)


@example("guide/plotting")
def plot_a_monitor():
    env = make_vec_env("CartPole-v1", n_envs=2, monitor_dir="plots")
    PPO("MlpPolicy", env, n_steps=32, batch_size=32).learn(200)
    assert len(load_results("plots")) > 0
    plot_results(["plots"], None, "timesteps", "CartPole")


class NotFinite(gym.Env):
    observation_space = action_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)

    def reset(self, seed=None, options=None):
        return np.zeros(1), {}

    def step(self, action):
        return np.array([np.nan if action > 0 else np.inf]), 0.0, False, False, {}


@example("guide/checking_nan")
def find_nan():
    env = VecCheckNan(DummyVecEnv([NotFinite]), raise_exception=True)
    env.reset()
    try:
        env.step(np.array([[1.0]]))
    except ValueError:
        return
    raise AssertionError("NaN was not found")


@example("guide/rl_tips")
def an_environment_for_the_checklist():
    env = Corridor()
    check_env(env)
    obs, _ = env.reset()
    for _ in range(10):
        obs, _reward, terminated, truncated, _info = env.step(env.action_space.sample())
        if terminated or truncated:
            obs, _ = env.reset()
    assert env.observation_space.contains(obs)


@example("guide/save_format")
def parameters_as_arrays():
    model = A2C("MlpPolicy", "CartPole-v1")
    before = model.get_parameters()
    model.set_parameters(before, exact_match=True)
    after = model.get_parameters()
    assert all(np.array_equal(after[part][name], value) for part in before for name, value in before[part].items())


@example("guide/export", fails="torch.onnx exports PyTorch modules; agent.export(path) writes ONNX here")
def export_by_pytorch():
    import importlib

    importlib.import_module("torch.onnx").export(PPO("MlpPolicy", "CartPole-v1").policy, (np.zeros((1, 4)),), "m.onnx")


def trains(kind, env_id, **settings):
    vec_env = make_vec_env(env_id, n_envs=2)
    model = kind("MlpPolicy", vec_env, verbose=0, **settings)
    model.learn(total_timesteps=64, log_interval=4)
    model.save("model")
    del model
    model = kind.load("model")
    obs = vec_env.reset()
    action, _states = model.predict(obs)
    vec_env.step(action)


@example("modules/a2c")
def a2c():
    trains(A2C, "CartPole-v1")


@example("modules/ppo")
def ppo():
    trains(PPO, "CartPole-v1", n_steps=32)


@example("modules/dqn")
def dqn():
    trains(DQN, "CartPole-v1", learning_starts=20)


@example("modules/sac")
def sac():
    trains(SAC, "Pendulum-v1", learning_starts=20)


@example("modules/td3")
def td3():
    trains(TD3, "Pendulum-v1", learning_starts=20, action_noise=NormalActionNoise(np.zeros(1), 0.1 * np.ones(1)))


@example("modules/ddpg")
def ddpg():
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.1 * np.ones(1))
    trains(DDPG, "Pendulum-v1", learning_starts=20, action_noise=noise)


@example("modules/her")
def her():
    hindsight(DQN).learn(40)


@example("common/logger")
def a_logger():
    model = A2C("MlpPolicy", "CartPole-v1", verbose=1)
    model.set_logger(configure("logs", ["stdout", "csv", "json", "log"]))
    model.learn(600)
    assert {"progress.csv", "progress.json", "log.txt"} <= {*os.listdir("logs")}


@example("common/atari_wrappers", needs="ale_py")
def atari_wrappers():
    from rejeu.sb3.common.atari_wrappers import AtariWrapper

    AtariWrapper(gym.make("PongNoFrameskip-v4")).reset()


def contrib(name, env_id, policy="MlpPolicy", **settings):
    import rejeu.sb3_contrib

    trains_with = getattr(rejeu.sb3_contrib, name)
    model = trains_with(policy, env_id, **settings).learn(64)
    model.save(name)
    trains_with.load(name)


@example("sb3-contrib")
def ars():
    contrib("ARS", "CartPole-v1", "LinearPolicy", n_delta=1)


@example("sb3-contrib")
def crossq():
    contrib("CrossQ", "Pendulum-v1", learning_starts=20)


@example("sb3-contrib")
def qrdqn():
    contrib("QRDQN", "CartPole-v1", policy_kwargs={"n_quantiles": 20}, learning_starts=20)


@example("sb3-contrib")
def tqc():
    contrib("TQC", "Pendulum-v1", top_quantiles_to_drop_per_net=2, policy_kwargs={"n_critics": 2}, learning_starts=20)


@example("sb3-contrib")
def trpo():
    contrib("TRPO", "CartPole-v1", n_steps=32, batch_size=32)


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
