"""Small functions of Stable-Baselines3's modules, by their definitions."""

import io
import math
from types import SimpleNamespace

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

from rejeu.sb3.common import envs, logger as loggers, preprocessing, utils
from rejeu.sb3.common.results_plotter import rolling_window
from rejeu.sb3.common.torch_layers import create_mlp
from rejeu.sb3.common.vec_env import DummyVecEnv, VecCheckNan, VecMonitor, VecTransposeImage
from tests.golden.vec_env_script import Walk

IMAGE = spaces.Box(0, 255, (36, 40, 3), np.uint8)
FIRST = spaces.Box(0, 255, (3, 36, 40), np.uint8)
BOX = spaces.Box(-1, 1, (3,), np.float32)


# utils


def test_numbers_of_arrays():
    assert utils.explained_variance(np.array([1.0, 1.0, 3.0]), np.array([1.0, 2.0, 3.0])) == pytest.approx(2 / 3)
    assert math.isnan(utils.explained_variance(np.array([1.0, 2.0]), np.ones(2)))
    assert utils.safe_mean([1, 2, 6]) == 3.0
    assert math.isnan(utils.safe_mean([]))
    target = [np.array([1.0, 2.0]), np.array([8.0])]
    utils.polyak_update([np.array([5.0, 2.0]), np.array([0.0])], target, 0.25)
    assert [array.tolist() for array in target] == [[2.0, 2.0], [6.0]]
    assert rolling_window(np.arange(4), 3).tolist() == [[0, 1, 2], [1, 2, 3]]
    x = utils.Tensor.of(np.arange(6.0).reshape(2, 3))
    assert (x.mean(dim=1).tolist(), x.sum(dim=0).tolist(), float(x.mean())) == ([1.0, 4.0], [3.0, 5.0, 7.0], 2.5)
    clone = x.clone()
    clone += 1
    assert (x[0, 0], type(clone), type(x.numpy())) == (0.0, utils.Tensor, np.ndarray)
    seen = utils.obs_as_tensor({"a": np.ones(2)})
    assert (type(seen["a"]), type(utils.obs_as_tensor(np.ones(2)))) == (utils.Tensor, utils.Tensor)


def test_collecting_goes_on_up_to_so_many_steps_or_episodes():
    for unit, n_steps, n_episodes in (("step", 3, 9), ("episode", 9, 3)):
        frequency = SimpleNamespace(frequency=4, unit=unit)
        assert utils.should_collect_more_steps(frequency, n_steps, n_episodes)
        assert not utils.should_collect_more_steps(frequency, n_steps + 1, n_episodes + 1)


def test_schedules_and_rates():
    assert utils.constant_fn(3.0)(0.1) == utils.FloatSchedule(utils.FloatSchedule(3))(0.9) == 3.0
    assert utils.get_schedule_fn(lambda remaining: np.float32(2 * remaining))(0.25) == 0.5
    line = utils.LinearSchedule(1.0, 0.2, 0.5)
    assert [line(remaining) for remaining in (1.0, 0.75, 0.5, 0.0)] == pytest.approx([1.0, 0.6, 0.2, 0.2])
    assert utils.of_remaining(utils.of_progress(line)) == line
    groups = [{"lr": 1.0}, {"lr": 2.0}]
    utils.update_learning_rate(SimpleNamespace(param_groups=groups), 0.5)
    assert groups == [{"lr": 0.5}, {"lr": 0.5}]


def test_spaces_are_compared():
    env = SimpleNamespace(observation_space=BOX, action_space=spaces.Discrete(2))
    utils.check_for_correct_spaces(env, BOX, spaces.Discrete(2))
    for given in ((IMAGE, spaces.Discrete(2)), (BOX, spaces.Discrete(3))):
        with pytest.raises(ValueError, match="do not match"):
            utils.check_for_correct_spaces(env, *given)


def test_batches_are_told_from_single_observations():
    choices, bits = spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3)
    for space, single in ((BOX, (3,)), (spaces.Discrete(4), ()), (choices, (2,)), (bits, (3,))):
        assert not utils.is_vectorized_observation(np.zeros(single), space)
        assert utils.is_vectorized_observation(np.zeros((5, *single)), space)
        with pytest.raises(ValueError, match="shape"):
            utils.is_vectorized_observation(np.zeros((2, 5, *single)), space)
    both = spaces.Dict(a=BOX, b=spaces.Discrete(4))
    assert utils.is_vectorized_observation({"a": np.zeros((1, 3)), "b": np.zeros(1)}, both)
    with pytest.raises(ValueError, match="batches"):
        utils.is_vectorized_observation({"a": np.zeros((1, 3)), "b": np.zeros(())}, both)


# preprocessing


def test_images_are_known_by_their_spaces_and_turned():
    assert preprocessing.is_image_space_channels_first(FIRST)
    assert not preprocessing.is_image_space_channels_first(IMAGE)
    with pytest.warns(UserWarning, match="last"):
        assert not preprocessing.is_image_space_channels_first(spaces.Box(0, 255, (36, 3, 40), np.uint8))
    five = spaces.Box(0, 255, (36, 36, 5), np.uint8)
    scaled = spaces.Box(0, 1, (36, 36, 3), np.float32)
    assert [preprocessing.is_image_space(space) for space in (five, scaled, BOX)] == [True, False, False]
    assert [preprocessing.is_image_space(space, check_channels=True) for space in (five, FIRST)] == [False, True]
    assert preprocessing.is_image_space(scaled, normalized_image=True)
    last = np.arange(36 * 40 * 3).reshape(36, 40, 3)
    turned = preprocessing.maybe_transpose(last, FIRST)
    np.testing.assert_array_equal(turned[2], last[..., 2])
    assert preprocessing.maybe_transpose(turned, FIRST) is turned
    assert preprocessing.maybe_transpose(last[None], FIRST).shape == (1, 3, 36, 40)
    assert preprocessing.maybe_transpose(last, IMAGE) is last


def test_observations_for_networks():
    white = np.full((2, *IMAGE.shape), 255, np.uint8)
    both = spaces.Dict(image=IMAGE, choice=spaces.Discrete(3))
    found = preprocessing.preprocess_obs({"image": white, "choice": np.array([2, 0])}, both)
    assert (float(found["image"].max()), found["choice"].tolist()) == (1.0, [[0, 0, 1], [1, 0, 0]])
    assert float(preprocessing.preprocess_obs(white, IMAGE, normalize_images=False).max()) == 255.0
    choices = preprocessing.preprocess_obs(np.array([[1, 2]]), spaces.MultiDiscrete([2, 3]))
    assert (choices.tolist(), choices.dtype) == ([[0, 1, 0, 0, 1]], jnp.float32)
    with pytest.raises(NotImplementedError):
        preprocessing.preprocess_obs(np.zeros(1), spaces.Text(3))
    for space, *sizes in (
        (spaces.Discrete(4), (1,), 4, 1),
        (spaces.MultiBinary(4), (4,), 4, 4),
        (spaces.MultiDiscrete([2, 5]), (2,), 7, 2),
        (IMAGE, IMAGE.shape, 4320, 4320),
    ):
        functions = preprocessing.get_obs_shape, preprocessing.get_flattened_obs_dim, preprocessing.get_action_dim
        assert [function(space) for function in functions] == sizes
    with pytest.raises(AssertionError):
        preprocessing.get_action_dim(spaces.MultiBinary([2, 3]))
    preprocessing.check_for_nested_spaces(both)
    for nested in (spaces.Dict(a=both), spaces.Tuple([both])):
        with pytest.raises(NotImplementedError):
            preprocessing.check_for_nested_spaces(nested)


# logger


def test_tables_of_a_logger():
    text = io.StringIO()
    table = loggers.HumanOutputFormat(text, max_length=10)
    table.write({"b/long name of it": 0.123456, "a": 3, "b/c": "a text that is long"}, {})
    assert [[cell.strip() for cell in line.strip("|").split("|")] for line in text.getvalue().splitlines()[1:-1]] == [
        ["a", "3"],
        ["b/", ""],
        ["c", "a text ..."],
        ["long...", "0.123"],
    ]
    with pytest.raises(ValueError, match="already exists"):
        table.write({"a much longer": 1, "a much longest": 2}, {})
    with pytest.warns(UserWarning, match="empty"):
        table.write({"a": 1}, {"a": "stdout"})


def test_levels_means_and_what_is_left_out(tmp_path):
    text = io.StringIO()
    logger = loggers.Logger(
        str(tmp_path), [loggers.HumanOutputFormat(text), loggers.make_output_format("json", tmp_path, "_x")]
    )
    logger.debug("quiet")
    logger.info("a", 1)
    logger.set_level(loggers.WARN)
    logger.info("quiet")
    logger.warn("b")
    logger.error("c")
    assert text.getvalue() == "a 1\nb\nc\n"
    for value in (1.0, None, 4.0):
        logger.record_mean("mean", value, exclude=("stdout", "log"))
    logger.record("array", np.arange(2), exclude="stdout")
    logger.record("kept", 1)
    logger.dump(1)
    logger.set_level(loggers.DISABLED)
    logger.record("kept", 2)
    logger.dump(2)
    logger.close()
    assert loggers.read_json(tmp_path / "progress_x.json") == [{"mean": 2.5, "array": [0, 1], "kept": 1}]
    assert "mean" not in text.getvalue()
    with pytest.raises(ValueError, match="Unknown format"):
        loggers.make_output_format("xml", tmp_path)


def test_the_environment_says_where_a_logger_writes(tmp_path, monkeypatch):
    monkeypatch.setenv("SB3_LOGDIR", str(tmp_path / "logs"))
    monkeypatch.setenv("SB3_LOG_FORMAT", "json,log")
    logger = loggers.configure()
    logger.record("a", 1)
    logger.dump()
    logger.close()
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["log.txt", "progress.json"]
    assert "| a | 1 |" in (tmp_path / "logs" / "log.txt").read_text()


# wrappers of vectors


def test_nan_is_looked_for_as_asked():
    step = np.array([np.inf])
    env = VecCheckNan(DummyVecEnv([Walk]), raise_exception=True, check_inf=False)
    env.reset()
    env.step(step)
    with pytest.raises(ValueError, match="nan"):
        env.step(np.array([np.nan]))
    env = VecCheckNan(DummyVecEnv([Walk]), warn_once=False)
    env.reset()
    for _ in range(2):
        with pytest.warns(UserWarning, match="inf"):
            env.step(step)


def test_a_reset_begins_the_count_of_every_episode_anew():
    env = VecMonitor(DummyVecEnv([Walk]))
    env.reset()
    env.step([0])
    env.reset()
    episodes = [env.step([0])[3][0].get("episode") for _ in range(3)]
    assert [(one["r"], one["l"]) for one in episodes if one] == [(6.0, 3)]


def test_images_are_left_as_they_are_where_that_is_asked_for():
    make = lambda: envs.FakeImageEnv(screen_height=36, screen_width=40)  # noqa: E731
    for skip, shape in ((True, (1, 36, 40, 1)), (False, (1, 1, 36, 40))):
        env = VecTransposeImage(DummyVecEnv([make]), skip)
        assert env.reset().shape == (1, *env.observation_space.shape) == shape
    with pytest.raises(ValueError, match="images"):
        VecTransposeImage(DummyVecEnv([lambda: gym.make("CartPole-v1")]))


def test_layers_end_as_asked():
    shapes = lambda *args, **kwargs: [  # noqa: E731
        getattr(layer, "weight", np.zeros(0)).shape for layer in create_mlp(*args, **kwargs, key=jax.random.key(0))
    ]
    assert shapes(4, 2, [16, 8]) == [(16, 4), (0,), (8, 16), (0,), (2, 8)]
    assert (shapes(4, 0, [3]), shapes(4, -1, [])) == ([(3, 4), (0,)], [])
    layers = create_mlp(2, 1, [], with_bias=False, squash_output=True, key=jax.random.key(0))
    assert (layers[0].bias, len(layers), len(shapes(2, 1, []))) == (None, 2, 1)
    assert np.abs(eqx.nn.Sequential(layers)(np.full(2, 1e3, np.float32))).max() <= 1
