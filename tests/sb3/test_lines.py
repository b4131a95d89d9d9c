"""What scripts for Stable-Baselines3 do, line by line, and the tests that show each of them."""

import io
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import optax
import pytest
from gymnasium import spaces

from rejeu import sb3
from rejeu.algorithms import a2c, optimizers
from rejeu.sb3.common import (
    atari_wrappers,
    base_class,
    envs,
    logger as loggers,
    torch_layers,
    utils,
)
from rejeu.sb3.common.buffers import HerReplayBuffer
from rejeu.sb3.common.callbacks import LogEveryNTimesteps
from rejeu.sb3.common.env_util import make_atari_env, make_vec_env
from rejeu.sb3.common.monitor import ResultsWriter, load_results
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize, VecTransposeImage, is_vecenv_wrapped
from rejeu.sb3.common.vec_env.base_vec_env import VecEnvWrapper
from tests.sb3.test_original import Features
from tests.tiers import crossed, exhaustive

pytestmark = pytest.mark.usefixtures("learners_are_shared")

SMALL = {"policy_kwargs": {"net_arch": [8]}}


class Weighing(envs.BitFlippingEnv):
    """Its rewards depend on the info of the step too."""

    def __init__(self) -> None:
        super().__init__(n_bits=4, continuous=True)

    def reset(self, **kwargs):
        self.count = 0
        return super().reset(**kwargs)

    def step(self, action):
        obs, _, terminated, truncated, info = super().step(action)
        self.count += 1
        info["weight"] = float(self.count)
        reward = self.compute_reward(obs["achieved_goal"], obs["desired_goal"], info)
        return obs, float(reward), terminated, truncated, info

    def compute_reward(self, achieved_goal, desired_goal, info):
        weight = info["weight"] if info else 1.0
        return weight * (super().compute_reward(achieved_goal, desired_goal, info) - 0.5)


@pytest.mark.parametrize(("n_steps", "n_envs"), crossed([1, 2], [1, 2]))
def test_rewards_of_new_goals_are_computed_from_the_infos_of_their_steps(n_steps, n_envs, tmp_path):
    model = sb3.SAC(
        "MultiInputPolicy",
        make_vec_env(Weighing, n_envs=n_envs),
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"copy_info_dict": True, "n_sampled_goal": 4},
        learning_starts=100,
        n_steps=n_steps,
        gamma=1.0,
        seed=0,
        **SMALL,
    ).learn(60)
    batch = model.run.replay.draw(np.random.default_rng(0), (64,))[0]
    weights = np.asarray(batch.reward) * -2  # -1.5 times the weight where a goal was missed, else -0.5 times
    if n_steps == 1:
        reached = (batch.next_obs["achieved_goal"] == batch.next_obs["desired_goal"]).all(axis=1)
        weights = np.where(reached, weights, weights / 3)
        assert {*weights.tolist()} <= {1.0, 2.0, 3.0, 4.0}
        assert len({*weights.tolist()}) > 2
    assert (weights > 0).all()
    loaded = sb3.SAC.load(model.save(tmp_path / "model"))
    assert loaded.config.replay_buffer_kwargs.copy_info_dict


def test_the_default_optimizer_of_a2c_is_the_rmsprop_of_pytorch():
    made = [sb3.A2C("MlpPolicy", "CartPole-v1", **SMALL, **settings) for settings in ({}, {"use_rms_prop": False})]
    rule = a2c.optimizer_of(made[0].config)
    gradient = np.array([0.3, -2.0], np.float32)
    direction, state = rule.update(gradient, rule.init(gradient))
    square = 0.01 * gradient**2
    np.testing.assert_allclose(direction, gradient / (np.sqrt(square) + 1e-5), rtol=1e-5)
    square = 0.99 * square + 0.01 * gradient**2
    np.testing.assert_allclose(rule.update(gradient, state)[0], gradient / (np.sqrt(square) + 1e-5), rtol=1e-5)
    assert isinstance(a2c.optimizer_of(made[1].config).init(gradient), optax.ScaleByAdamState)

    class RMSpropTFLike:
        """Stands for the original's class of that name."""

    settings = {**SMALL["policy_kwargs"], "optimizer_class": RMSpropTFLike}
    settings["optimizer_kwargs"] = {"eps": 1e-5, "alpha": 0.9}
    like = optimizers.make(sb3.A2C("MlpPolicy", "CartPole-v1", policy_kwargs=settings).config.optimizer)
    direction, _ = like.update(gradient, like.init(gradient))
    np.testing.assert_allclose(direction, gradient / np.sqrt(0.9 + 0.1 * gradient**2 + 1e-5), rtol=1e-5)


def test_nothing_is_learned_without_gradient_steps():
    settings = {"learning_starts": 4, "batch_size": 4, "seed": 0, **SMALL}
    still = sb3.SAC("MlpPolicy", "Pendulum-v1", gradient_steps=0, **settings)
    before = still.policy.state_dict()
    assert still.learn(12)._n_updates == 0
    assert all((array == before[name]).all() for name, array in still.policy.state_dict().items())


@exhaustive
def test_targets_stay_with_a_tau_of_zero():
    fixed = sb3.SAC("MlpPolicy", "Pendulum-v1", learning_starts=4, batch_size=4, tau=0, seed=0, **SMALL)
    before = fixed.policy.state_dict()
    after = fixed.learn(12).policy.state_dict()
    same = {name for name in before if (before[name] == after[name]).all()}
    assert {name for name in before if name.startswith("target_critics")} <= same
    assert not any(name.startswith("critics.") and name.endswith("weight") for name in same)


def test_files_leave_out_and_contain_what_save_is_told(tmp_path):
    model = sb3.A2C("MlpPolicy", "CartPole-v1", verbose=2, gamma=0.5, ent_coef=0.1, **SMALL)
    model.note = {"trained by": "me", "scores": [1, 2.5]}
    file = io.BytesIO()
    model.save(file, exclude=["gamma", "verbose", "policy_kwargs", "unknown"], include=["note"])
    loaded = sb3.A2C.load(file)
    assert (loaded.gamma, loaded.ent_coef, loaded.verbose, loaded.note) == (0.99, 0.1, 0, model.note)
    model.save(tmp_path / "model", exclude=["verbose"], include=["verbose"])
    assert sb3.A2C.load(tmp_path / "model").verbose == 2
    assert sb3.A2C.load(tmp_path / "model", verbose=0).verbose == 0
    with pytest.raises(TypeError):
        model.save(tmp_path / "other", include=["rollout_buffer"])
    assert not (tmp_path / "other.zip").exists()


def test_the_environments_of_an_agent_show_images_with_the_channels_first():
    model = sb3.A2C("CnnPolicy", envs.FakeImageEnv(screen_height=36, screen_width=40), n_steps=8).learn(8)
    env = model.get_env()
    assert is_vecenv_wrapped(env, VecTransposeImage)
    obs = env.reset()
    assert obs.shape == (1, 1, 36, 40)
    actions = [model.predict(one, deterministic=True)[0] for one in (obs, np.moveaxis(obs, 1, -1))]
    assert actions[0] == actions[1]
    model.set_env(env)
    assert model.learn(8).num_timesteps == 8


def test_a_refused_setting_is_an_assertion_error_and_a_value_error():
    with pytest.raises(AssertionError, match="clip_range_vf"):
        sb3.PPO("MlpPolicy", "CartPole-v1", clip_range_vf=-0.2)
    with pytest.raises(ValueError, match="DQN"):
        sb3.DQN("MlpPolicy", "Pendulum-v1")


class Named(VecEnvWrapper):
    """A wrapper with an attribute."""

    level = "inner"

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        return self.venv.step_wait()


def test_an_attribute_of_two_inner_wrappers_is_ambiguous():
    inner = Named(DummyVecEnv([lambda: gym.make("CartPole-v1")]))
    assert VecNormalize(inner).level == "inner"
    with pytest.raises(AttributeError, match="ambiguous: Named and Named"):
        _ = VecNormalize(Named(inner)).level


def test_actor_and_critic_share_their_extractor_or_not():
    shape = {"features_extractor_class": Features, "net_arch": [5]}
    for shares, n_extractors in ((True, 1), (False, 2)):
        model = sb3.A2C("MlpPolicy", "CartPole-v1", policy_kwargs={**shape, "share_features_extractor": shares})
        assert sum(array.shape == (3, 4) for array in model.policy.parameters()) == n_extractors
    with pytest.warns(UserWarning, match="share_features_extractor"):
        sb3.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={**SMALL["policy_kwargs"], "share_features_extractor": True})


def test_squashed_actions_stay_in_their_bounds():
    shape = {"squash_output": True, "net_arch": [8], "log_std_init": 3.0}
    model = sb3.A2C("MlpPolicy", "Pendulum-v1", use_sde=True, policy_kwargs=shape, seed=0)
    actions = model.policy.get_distribution(np.ones((256, 3), np.float32)).sample()
    assert 1.9 < np.abs(actions).max() <= 2.0  # of Pendulum


@exhaustive
def test_tqc_explores_by_state_dependent_noise_as_in_the_original():
    model = sb3.TQC("MlpPolicy", "Pendulum-v1", use_sde=True, sde_sample_freq=4, learning_starts=8, seed=0, **SMALL)
    model.learn(16)
    assert any(name.endswith("log_std") for name in model.policy.state_dict())


def test_a_row_is_logged_every_so_many_steps(tmp_path):
    model = sb3.SAC("MlpPolicy", "Pendulum-v1", learning_starts=8, **SMALL)
    model.set_logger(loggers.configure(str(tmp_path), ["csv", "json"]))
    model.learn(40, callback=LogEveryNTimesteps(10), log_interval=None)
    rows = loggers.read_csv(tmp_path / "progress.csv")
    assert [int(row["time/total_timesteps"]) for row in rows] == [10, 20, 30, 40]
    assert float(rows[-1]["time/fps"]) > 0
    assert model.logger.output_formats[1].names == ("json",)
    model.logger.close()


class Kept(loggers.Logger):
    """A logger that keeps the values of the last row."""

    def dump(self, step=0):
        pass


def test_a_logger_that_keeps_values_gets_those_of_the_last_row():
    model = sb3.DQN("MlpPolicy", envs.IdentityEnv(2, ep_length=5), learning_starts=100, **SMALL)
    logger = Kept(None, [])
    model.set_logger(logger)
    model.learn(40, log_interval=1)
    assert logger.name_to_value["time/total_timesteps"] == 40
    sac = sb3.SAC("MlpPolicy", "Pendulum-v1", learning_starts=8, batch_size=4, **SMALL)
    assert sac.learn(12).logger.name_to_value["train/n_updates"] == 4


@pytest.mark.parametrize("algorithm", [sb3.DQN, sb3.A2C])
def test_a_callback_reads_the_losses_of_the_latest_update(algorithm):
    env = envs.IdentityEnv(2, ep_length=5)
    settings = {"learning_starts": 5, "batch_size": 4} if algorithm is sb3.DQN else {}
    before, after = [], []

    def look(locals_, globals_):
        logger = locals_["self"].logger
        (after if locals_["self"]._n_updates else before).append(dict(logger.name_to_value))
        logger.record("mine/x", 1.0)
        return True

    model = algorithm("MlpPolicy", env, **settings, **SMALL).learn(30, callback=look)
    name = "train/loss" if algorithm is sb3.DQN else "train/value_loss"
    assert name not in before[0]
    assert np.isfinite(after[-1][name])
    assert after[-1]["mine/x"] == 1.0
    assert model.logger.name_to_value["train/n_updates"] == model._n_updates
    assert model.logger.name_to_value["unknown"] == 0.0


class Console(gym.Env):
    """Has what Atari wrappers ask a game: lives, the meanings of actions, frames."""

    action_space = spaces.Discrete(3)
    observation_space = spaces.Box(0, 255, (210, 160, 3), np.uint8)

    class ale:  # noqa: N801
        left = 3

        @classmethod
        def lives(cls):
            return cls.left

    def get_action_meanings(self):
        return ["NOOP", "FIRE", "RIGHT"]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.ale.left = 0, 3
        return np.zeros((210, 160, 3), np.uint8), {}

    def step(self, action):
        self.t += 1
        self.ale.left = 3 - self.t // 50
        return np.full((210, 160, 3), 200 - self.t, np.uint8), 7.0, self.ale.left == 0, False, {}


def test_atari_wrappers_by_a_game_that_is_none():
    pytest.importorskip("cv2")
    env = atari_wrappers.AtariWrapper(Console(), noop_max=3, screen_size=42)
    obs, _ = env.reset(seed=0)
    assert obs.shape == (42, 42, 1)
    assert env.unwrapped.t in range(
        4 * 2 + 1, 4 * 2 + 4
    )  # one to three steps of nothing, then two actions of four frames
    before = env.unwrapped.t
    obs, reward, terminated, _, _ = env.step(2)
    assert (env.unwrapped.t - before, reward, terminated) == (4, 1.0, False)
    assert obs.max() == 201 - env.unwrapped.t  # the brighter of the last two frames
    while not terminated:
        terminated = env.step(2)[2]
    assert env.unwrapped.ale.lives() == 2  # an episode ends with a life
    vector = make_atari_env(Console, n_envs=2, wrapper_kwargs={"screen_size": 42})
    assert vector.reset().shape == (2, 42, 42, 1)


class Game(gym.Env):
    """Plays a script of lives, one a step; the game is over some steps after the last life. Keeps the actions."""

    action_space, observation_space = spaces.Discrete(4), spaces.Box(0, 255, (2,), np.uint8)

    def __init__(self, lives=(3,) * 99, over=99):
        self.script, self.over, self.ale, self.played = lives, over, SimpleNamespace(lives=self.lives), []

    def lives(self):
        return self.script[self.t]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.played.append("reset")
        return np.zeros(2, np.uint8), {}

    def step(self, action):
        self.t += 1
        self.played.append(action)
        return np.array([self.t, 100 - self.t], np.uint8), float(self.t), self.t == self.over, False, {}


def test_an_episode_of_atari_is_a_life_and_the_game_goes_on():
    game = Game(lives=(3, 3, 2, 2, 0, 0, 0), over=6)
    env = atari_wrappers.EpisodicLifeEnv(game)
    env.reset()
    assert [env.step(1)[2] for _ in range(2)] == [False, True]  # a life
    assert env.reset()[0][0] == 3  # a step without action, no reset
    assert [env.step(2)[2] for _ in range(3)] == [False, False, True]  # no lives are left before the game is over
    env.reset()
    assert game.played == ["reset", 1, 1, 0, 2, 2, 2, "reset"]
    env.step(3)
    assert env.reset()[0][0] == 2  # no life was lost
    game.over = 3
    assert (env.reset()[0][0], env.lives) == (0, 3)  # the game ended in the step without action


def test_the_wrappers_of_atari_one_by_one():
    game = Game(over=5)
    skips = atari_wrappers.MaxAndSkipEnv(game, skip=3)
    skips.reset()
    obs, reward, terminated, _, _ = skips.step(2)
    assert (obs.tolist(), reward, terminated) == ([3, 98], 6.0, False)  # the maxima of the last two of three frames
    obs, reward, terminated, _, _ = skips.step(1)
    assert (obs.tolist(), reward, terminated) == ([5, 96], 9.0, True)  # only two were left
    assert game.played == ["reset", 2, 2, 2, 1, 1]

    begun = {
        len((env := atari_wrappers.NoopResetEnv(Game(), 3)).reset(seed=seed) and env.unwrapped.played) - 1
        for seed in range(20)
    }
    assert begun == {1, 2, 3}
    env = atari_wrappers.NoopResetEnv(Game(over=2))
    env.override_num_noops = 3
    assert (env.reset()[0][0], env.unwrapped.played) == (1, ["reset", 0, 0, "reset", 0])
    env = atari_wrappers.FireResetEnv(Game())
    assert (env.reset()[0][0], env.unwrapped.played) == (2, ["reset", 1, 2])
    env = atari_wrappers.FireResetEnv(Game(over=1))
    assert (env.reset()[0][0], env.unwrapped.played) == (0, ["reset", 1, "reset", 2, "reset"])

    for probability, expected in ((0.0, [3, 1, 2]), (1.0, [0, 0, 0])):
        env = atari_wrappers.StickyActionEnv(Game(), probability)
        env.reset(seed=0)
        for action in (3, 1, 2):
            env.step(action)
        assert env.unwrapped.played[1:] == expected
    env.action_repeat_probability = 0.0
    env.step(3)
    env.action_repeat_probability = 1.0
    env.step(1)
    env.reset()
    env.step(1)
    assert env.unwrapped.played[-4:] == [3, 3, "reset", 0]  # what is repeated is of the same episode
    assert [atari_wrappers.ClipRewardEnv(Game()).reward(x) for x in (-7.0, 0.0, 0.5)] == [-1.0, 0.0, 1.0]


def test_random_actions_of_dqn_follow_the_seed_and_steps_can_be_set():
    obs, actions = np.zeros(4, np.float32), []
    for _ in range(2):
        model = sb3.DQN("MlpPolicy", "CartPole-v1", seed=3, **SMALL)
        model.exploration_rate = 0.9
        actions.append([int(model.predict(obs)[0]) for _ in range(30)])
    assert actions[0] == actions[1]
    assert {*actions[0]} == {0, 1}
    model.num_timesteps = 500
    assert model.learn(4, reset_num_timesteps=False).num_timesteps == 504


def test_small_functions(tmp_path):
    assert base_class.maybe_make_env("CartPole-v1").spec.id == "CartPole-v1"
    assert torch_layers.get_actor_critic_arch([8, 4]) == ([8, 4], [8, 4])
    assert torch_layers.get_actor_critic_arch({"pi": [8], "qf": [4]}) == ([8], [4])
    row = loggers.filter_excluded_keys({"a": 1, "b": 2}, {"a": ("csv",)}, "csv")
    assert row == {"b": 2}
    writer = ResultsWriter(tmp_path / "x", {"t_start": 0.0, "env_id": "E"}, ("won",))
    writer.write_row({"r": 1.0, "l": 2, "t": 0.5, "won": 1})
    writer.close()
    assert load_results(tmp_path)["won"].tolist() == [1]
    logger = utils.configure_logger(1, tmp_path, "run")
    assert (Path(logger.dir).name, type(logger.output_formats[0])) == ("run_1", loggers.HumanOutputFormat)
    logger.close()
    for name in ("run_2", "run_10", "run_11_old", "rerun_12", "run_", "run_x"):
        (tmp_path / name).mkdir()
    assert utils.get_latest_run_id(tmp_path, "run") == 10
    assert utils.get_latest_run_id(tmp_path, "other") == 0
    for is_new, name in ((False, "run_10"), (True, "run_11"), (False, "other_0")):  # what continues keeps its folder
        kind = name.partition("_")[0]
        assert Path(utils.configure_logger(0, tmp_path, kind, reset_num_timesteps=is_new).dir).name == name
    assert utils.configure_logger(0).output_formats == []


def test_a_row_is_written_without_what_tensorboard_cannot_show(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    formats = ["stdout", "log", "csv", "json", "tensorboard"]
    logger = loggers.configure(str(tmp_path), formats)
    unusual = {"none": None, "dict": {"a": 1}, "ragged": [[1], [1, 2]], "list": [np.zeros(2)], "words": np.array(["a"])}
    unusual |= {
        "objects": np.array([None]),
        "empty": np.zeros(0),
        "nan": np.full(2, np.nan),
        "complex": np.complex64(1),
    }
    for name, value in unusual.items():
        logger.record(name, value, exclude="json" if name in ("complex", "ragged") else None)
    logger.record("some", np.array([1.0, np.nan]))
    logger.record("flag", np.bool_(True))
    logger.dump(1)
    logger.close()
    row = loggers.read_json(tmp_path / "progress.json")[0]
    assert (row["none"], row["dict"], row["list"]) == (None, {"a": 1}, [[0.0, 0.0]])
    seen = accumulator.EventAccumulator(str(tmp_path)).Reload()
    assert (seen.Tags()["scalars"], seen.Tags()["histograms"]) == (["flag"], ["some"])


def test_what_tensorboard_shows(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    from matplotlib import pyplot
    from PIL import Image
    from tensorboard.plugins.hparams import metadata, plugin_data_pb2

    logger = loggers.Logger(str(tmp_path), [loggers.TensorBoardOutputFormat(tmp_path)])
    logger.record("number", np.float64(0.5))
    values = np.array([[0.0, 1.0], [2.0, 30.0]])
    logger.record("values", values)
    pixels = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)  # rows, columns, colors
    logger.record("image", loggers.Image(pixels.transpose(2, 0, 1), "CHW"))
    logger.record("shares", loggers.Image(np.array([[[0.0], [0.5], [2.0]]]), "HWC"))
    frames = np.zeros((1, 3, 3, 4, 5), np.uint8)
    frames[0, 1] = 255
    logger.record("video", loggers.Video(frames, fps=4))
    logger.record("left out", 1.0, exclude="tensorboard")
    logger.record("hparams", loggers.HParam({"gamma": 0.5, "name": "A2C", "masks": True}, {"loss": 0.0}))
    figure = pyplot.figure()
    logger.record("figure", loggers.Figure(figure, close=True))
    logger.dump(7)
    logger.close()
    assert not pyplot.fignum_exists(figure.number)
    seen = accumulator.EventAccumulator(str(tmp_path), {"images": 0, "histograms": 0}).Reload()
    content = seen.SummaryMetadata(metadata.SESSION_START_INFO_TAG).plugin_data.content
    given = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info.hparams
    assert (given["gamma"].number_value, given["name"].string_value, given["masks"].bool_value) == (0.5, "A2C", True)
    assert "figure" in seen.Tags()["images"]
    assert seen.Tags()["scalars"] == ["number"]
    assert [(one.step, one.value) for one in seen.Scalars("number")] == [(7, 0.5)]
    (event,) = seen.Histograms("values")
    shown = event.histogram_value
    assert (shown.min, shown.max, shown.num, shown.sum, shown.sum_squares) == (0.0, 30.0, 4, 33.0, 905.0)
    assert shown.bucket_limit == pytest.approx(range(1, 31))  # the upper end of each
    assert {limit: n for limit, n in zip(range(1, 31), shown.bucket, strict=True) if n} == {1: 1, 2: 1, 3: 1, 30: 1}
    images = {tag: Image.open(io.BytesIO(seen.Images(tag)[0].encoded_image_string)) for tag in seen.Tags()["images"]}
    np.testing.assert_array_equal(np.asarray(images["image"]), pixels)
    assert np.asarray(images["shares"]).tolist() == [[0, 127, 255]]
    video = images["video"]
    assert (video.n_frames, video.size, video.info["duration"], video.info["loop"]) == (3, (5, 4), 250, 0)
