"""What users get wrong: each mistake is one line that names it and the way out, and costs nothing on disk."""

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu import sb3
from rejeu.agents.zip_files import load_zip
from rejeu.callbacks import Checkpoint, RecordVideo
from rejeu.core.errors import BadEnvironmentError
from rejeu.logs.video import VideoFile
from tests.environments import Counter, Reach, Sampled
from tests.helpers import small_sac

pytestmark = pytest.mark.usefixtures("learners_are_shared")


class WithoutGoal(Sampled):
    """A Dict observation without ``desired_goal``."""

    def __init__(self):
        box = gym.spaces.Box(-1.0, 1.0, (2,))
        super().__init__(gym.spaces.Dict({"observation": box, "achieved_goal": box}))


class WithoutReward(Sampled):
    """A goal observation, but no ``compute_reward``."""

    def __init__(self):
        box = gym.spaces.Box(-1.0, 1.0, (2,))
        super().__init__(gym.spaces.Dict(dict.fromkeys(("observation", "achieved_goal", "desired_goal"), box)))


def sac(env, policy="MlpPolicy", **settings):
    return lambda: rejeu.SAC(policy, env, **settings)


HER = {"replay_buffer_class": rejeu.HerReplayBuffer}
MISTAKES = {
    "misspelt hyperparameter": (
        sac(Counter(), learning_rat=1e-3),
        TypeError,
        "SAC has no setting 'learning_rat'; did you mean learning_rate?",
    ),
    "several seeds": (
        sac(Counter(), seeds=3),
        TypeError,
        "SAC has no setting 'seeds'; several runs at once are rejeu.train_seeds",
    ),
    "hyperparameter of nothing": (sac(Counter(), zzz=1), TypeError, "SAC has no setting 'zzz'; known: learning_rate"),
    "unbounded actions": (
        sac(Sampled(gym.spaces.Box(-1.0, 1.0, (2,)), gym.spaces.Box(-np.inf, np.inf, (2,)))),
        ValueError,
        "SAC needs finite action bounds, .*RescaleAction",
    ),
    "text observation": (sac(Sampled(gym.spaces.Text(5))), TypeError, "observation space is Text.* expected Box"),
    "HER without desired_goal": (
        sac(WithoutGoal(), "MultiInputPolicy", **HER),
        ValueError,
        "desired_goal is missing from a Dict with the keys .* use a goal environment or replay_buffer_class=None",
    ),
    "HER on a plain environment": (sac(Counter(), **HER), ValueError, "hindsight replay needs a Dict observation"),
    "HER without compute_reward": (
        sac(WithoutReward(), "MultiInputPolicy", **HER),
        ValueError,
        r"hindsight replay needs .*compute_reward.* WithoutReward has none; add it, or use replay_buffer_class=None",
    ),
    "buffer larger than the memory": (
        sac(Counter(), buffer_size=10**12),
        MemoryError,
        r"buffer_size=1000000000000 takes .* GiB .* are free; try buffer_size=\d+",
    ),
    "unknown environment": (
        sac("Pendulum-v9000x"),
        ValueError,
        "no environment is called 'Pendulum-v9000x'; did you mean .*Pendulum-v1",
    ),
    "class instead of environment": (sac(3), TypeError, "env must be an id, a Gymnasium environment, .* got int"),
    "unknown policy": (sac(Counter(), "MlpPolcy"), ValueError, "policy='MlpPolcy' must be one of MlpPolicy"),
    "MlpPolicy for a Dict": (sac(Reach()), ValueError, "does not fit a Dict observation; use 'MultiInputPolicy'"),
    "MultiInputPolicy for a Box": (sac(Counter(), "MultiInputPolicy"), ValueError, "needs a Dict .*use 'MlpPolicy'"),
    "CnnPolicy for numbers": (sac(Counter(), "CnnPolicy"), ValueError, "needs a uint8 image .*use 'MlpPolicy'"),
    "fractional seed": (sac(Counter(), seed=0.5), ValueError, "seed=0.5 must be a whole number"),
    "noise of another dimension": (
        sac(Counter(), action_noise=rejeu.NormalActionNoise([0.0, 0.0], [0.1, 0.1])),
        ValueError,
        "action_noise has 2 dimensions and the actions have 1; try NormalActionNoise",
    ),
    "window of nothing": (
        sac(Counter(), stats_window_size=0),
        ValueError,
        "stats_window_size=0 must be a whole number",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_that_names_the_way_out(name):
    make, error, words = MISTAKES[name]
    with pytest.raises(error, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_reward_that_is_no_number_ends_training_with_its_place(value):
    env = Sampled(gym.spaces.Box(-1.0, 1.0, (3,)))
    agent = small_sac(env, learning_starts=99).learn(7)
    env.reward = lambda action: value
    with pytest.raises(BadEnvironmentError, match=rf"Sampled returned the reward {value} .* after 7 steps; .* finite"):
        agent.learn(5)
    assert agent.replay_buffer.size() == 7
    assert np.isfinite(agent.replay_buffer.arrays()["reward"]).all()
    del env.reward  # and the agent can be trained on
    agent.learn(3, reset_num_timesteps=False)
    assert agent.replay_buffer.size() == 10


def test_what_an_agent_does_not_have_is_said(tmp_path):
    with pytest.raises(ValueError, match="ARS learns no values"):
        rejeu.ARS("MlpPolicy", Counter(), seed=0).value(np.zeros(3))
    loaded = rejeu.SAC.load(small_sac(Counter()).save(tmp_path / "model"))
    with pytest.raises(ValueError, match="no environment and so no replay buffer"):
        loaded.save_replay_buffer(tmp_path / "buffer")


def test_numbers_of_numpy_are_taken_as_those_of_python():
    env = rejeu.make_vector(Counter, np.int64(2))
    shape = {"net_arch": [np.int64(8)]}
    config = rejeu.SAC(
        "MlpPolicy",
        env,
        batch_size=np.int64(8),
        train_freq=(np.int32(1), "episode"),
        gamma=np.float32(0.5),
        use_sde=np.bool_(False),
        policy_kwargs=shape,
        seed=0,
    ).config
    values = config.batch_size, config.train_freq[0], config.gamma, config.use_sde, config.policy_kwargs.net_arch[0]
    assert values == (8, 1, 0.5, False, 8)
    assert [*map(type, values)] == [int, int, float, bool, int]
    with pytest.raises(ValueError, match="batch_size=0 must be a whole number of at least 1"):
        sac(Counter(), batch_size=np.int64(0))()


@pytest.mark.parametrize("callback", [5, [5], "Checkpoint"])
def test_a_callback_that_cannot_be_called_is_named(callback):
    with pytest.raises(TypeError, match=r"callback=.* must be a function \(agent, progress\), or a list of such"):
        small_sac(Counter()).learn(5, callback=callback)


def agent():
    return small_sac(Counter())


@pytest.mark.parametrize(
    "call",
    [
        lambda path: rejeu.load(path),
        lambda path: rejeu.SAC.load(path),
        lambda path: rejeu.SAC.resume(path),
        lambda path: rejeu.load_policy(path),
        lambda path: rejeu.compare([path]),
        lambda path: rejeu.compare(path),
        lambda path: rejeu.write_report(path),
        lambda path: rejeu.sweep(path),
        lambda path: rejeu.show_videos(path),
        lambda path: load_zip(path),
        lambda path: sb3.SAC.load(path),
        lambda path: agent().save(path),
        lambda path: agent().export(path),
        lambda path: agent().set_parameters(path),
        lambda path: agent().save_replay_buffer(path),
        lambda path: agent().history.write_csv(path),
        lambda path: VideoFile(path, 30),
        lambda path: Checkpoint(path, minutes=1),
        lambda path: RecordVideo(path, 10),
    ],
    ids=lambda call: " ".join(name for name in call.__code__.co_names if name not in ("rejeu", "agent")),
)
def test_none_as_a_path_is_named(call):
    with pytest.raises(TypeError, match="None is not a path; give that of a file or folder"):
        call(None)


@pytest.mark.parametrize("algorithm", ["SAC", None])
def test_seeds_are_trained_of_a_class_and_not_of_its_name(algorithm):
    with pytest.raises(TypeError, match=r"kind=.* must be the class of an algorithm, such as rejeu.SAC"):
        rejeu.train_seeds(algorithm, "MlpPolicy", "Pendulum-v1", 10, seeds=2)


@pytest.mark.parametrize(
    ("module", "name", "hint"),
    [(rejeu, "PPo", "PPO"), (rejeu, "make_vectr", "make_vector"), (sb3, "Ppo", "PPO"), (sb3, "DNQ", "DQN")],
)
def test_a_misspelt_public_name_is_named_with_the_right_one(module, name, hint):
    with pytest.raises(AttributeError, match=f"has no attribute '{name}'; did you mean {hint}"):
        getattr(module, name)
