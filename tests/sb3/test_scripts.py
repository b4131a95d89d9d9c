"""Scripts as Stable-Baselines3's documentation has them, with the imports of rejeu's mirror and nothing else changed."""

import importlib
import json
import os
import random

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu import sb3
from rejeu.core.schedules import at
from rejeu.sb3 import algorithms
from scripts import sb3_parity
from tests.environments import Timed
from tests.golden.vec_env_script import Walk
from tests.tiers import only

PASSED_ON = {
    "sb3.ppo.ppo": ["ActorCriticPolicy", "OnPolicyAlgorithm", "RolloutBuffer", "explained_variance"],
    "sb3.ppo.policies": ["ActorCriticCnnPolicy", "ActorCriticPolicy", "MultiInputActorCriticPolicy"],
    "sb3.sac.policies": ["BasePolicy", "ContinuousCritic", "NatureCNN", "create_mlp", "get_actor_critic_arch"],
    "sb3.dqn.dqn": ["LinearSchedule", "OffPolicyAlgorithm", "ReplayBuffer", "polyak_update"],
    "sb3.common.base_class": ["BaseCallback", "Logger", "Monitor", "VecEnv", "VecNormalize", "set_random_seed"],
    "sb3.common.policies": ["BaseFeaturesExtractor", "NatureCNN", "create_mlp", "is_image_space", "obs_as_tensor"],
    "sb3.common.off_policy_algorithm": ["BaseAlgorithm", "HerReplayBuffer", "ReplayBuffer", "VecEnv", "safe_mean"],
    "sb3.common.callbacks": ["DummyVecEnv", "Logger"],
    "sb3.common.env_util": ["SubprocVecEnv"],
    "sb3.common.vec_env.base_vec_env": ["VecEnvIndices", "VecEnvObs", "VecEnvStepReturn"],
    "sb3.common.vec_env.dummy_vec_env": ["VecEnv"],
    "sb3.common.envs.bit_flipping_env": ["BitFlippingEnv"],
    "sb3.common.envs.identity_env": ["FakeImageEnv", "IdentityEnvMultiBinary", "IdentityEnvMultiDiscrete"],
    "sb3.her.goal_selection_strategy": ["GoalSelectionStrategy", "KEY_TO_GOAL_STRATEGY"],
    "sb3_contrib.ppo_mask.policies": ["MaskableActorCriticPolicy", "MaskableMultiInputActorCriticPolicy"],
    "sb3_contrib.ppo_recurrent.policies": ["RecurrentActorCriticCnnPolicy", "RecurrentActorCriticPolicy"],
    "sb3_contrib.ppo_recurrent.ppo_recurrent": ["BasePolicy", "MlpLstmPolicy"],
    "sb3_contrib.tqc.tqc": ["OffPolicyAlgorithm", "TQCPolicy"],
    "sb3_contrib.trpo.policies": ["ActorCriticPolicy"],
    "sb3_contrib.common.maskable.callbacks": ["EvalCallback", "evaluate_policy"],
}
"""What the modules of both packages import from others, and scripts from them."""


@pytest.mark.parametrize("path", PASSED_ON)
def test_modules_pass_names_on_as_those_of_stable_baselines3_do(path):
    module = importlib.import_module(f"rejeu.{path}")
    for name in PASSED_ON[path]:
        assert getattr(module, name) is not None, name
    with pytest.raises(AttributeError, match=f"module '{module.__name__}' has no attribute 'Polcy'"):
        module.Polcy  # noqa: B018


def test_a_name_is_passed_on_from_the_nearest_module():
    from rejeu import sb3_contrib
    from rejeu.sb3.common.evaluation import evaluate_policy
    from rejeu.sb3_contrib.common.maskable import callbacks

    assert sb3_contrib.common.maskable.evaluation.evaluate_policy is callbacks.evaluate_policy is not evaluate_policy
    assert importlib.import_module("rejeu.sb3.common.callbacks").evaluate_policy is evaluate_policy


@pytest.fixture
def in_tmp_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_names_stand_where_the_original_has_them_also_for_star_imports():
    """What is missing is in a table of docs/coming-from-sb3.md, which another test compares."""
    modules, _, _ = sb3_parity.compared()
    for original, expected in json.loads(sb3_parity.DATA.read_text(encoding="utf-8")).items():
        package, names = original.partition(".")[0], {}
        path = original.replace(package, sb3_parity.PACKAGES[package], 1)
        n_here, _, missing = modules[path]
        if n_here:
            exec(f"from {path} import *", names)
            assert {*expected} - {*missing, "HER"} <= {*names}, path


@pytest.mark.parametrize("continuous", [False, True])
def test_bits_are_flipped_until_all_are_one(continuous):
    from rejeu.sb3.common.envs import BitFlippingEnv

    env = BitFlippingEnv(n_bits=4, continuous=continuous, max_steps=9)
    obs, _ = env.reset(seed=1)
    begin = obs["observation"].copy()
    assert 0 < begin.sum() < 4
    bits = np.flatnonzero(begin == 0)
    actions = np.where(np.eye(4)[bits] > 0, 0.5, -0.5) if continuous else bits
    episode = [env.step(action) for action in actions]
    assert [step[1] for step in episode] == [-1.0] * (len(episode) - 1) + [0.0]
    assert [step[2] for step in episode] == [False] * (len(episode) - 1) + [True]
    assert episode[-1][0]["achieved_goal"].tolist() == [1, 1, 1, 1] == episode[-1][0]["desired_goal"].tolist()
    assert obs["observation"].tolist() == begin.tolist(), "observations are not changed later"
    assert env.compute_reward(np.array([[1, 1], [1, 0]]), np.ones((2, 2)), [{}, {}]).tolist() == [0.0, -1.0]


def test_the_grid_ends_at_its_last_cell_and_has_walls():
    from rejeu.sb3.common.envs import SimpleMultiObsEnv

    env = SimpleMultiObsEnv(num_col=2, num_row=3, random_start=False)
    begin, _ = env.reset(seed=0)
    left, down, right, up = range(4)
    for wall in (left, up):
        obs, reward, *ends, _ = env.step(wall)
        assert (reward, ends) == (-0.1, [False, False])
        assert all(np.array_equal(obs[key], begin[key]) for key in begin)
    path = [env.step(action) for action in (right, down, right, down)]
    assert [step[1] for step in path] == [-0.1, -0.1, -0.1, 1.0]
    assert [step[4]["got_to_end"] for step in path] == [step[2] for step in path] == [False, False, False, True]
    assert env.observation_space.contains(path[-1][0])


def test_seeds_and_schedules():
    from rejeu.sb3.common.utils import LinearSchedule, get_linear_fn, get_schedule_fn, set_random_seed

    set_random_seed(3)
    first = random.random(), np.random.get_state()[1].tolist()  # noqa: NPY002
    set_random_seed(3)
    assert (random.random(), np.random.get_state()[1].tolist()) == first  # noqa: NPY002
    agent = sb3.DQN("MlpPolicy", Walk(), learning_rate=get_linear_fn(1e-3, 1e-4, 0.5), policy_kwargs={"net_arch": [4]})
    assert agent.config.learning_rate == rejeu.Linear(1e-3, 1e-4, 0.5)
    assert get_linear_fn(1.0, 0.1, 0.5) == LinearSchedule(1.0, 0.1, 0.5)
    assert [LinearSchedule(1.0, 0.0, 0.5)(x) for x in (1.0, 0.75, 0.5, 0.0)] == [1.0, 0.5, 0.0, 0.0]
    assert get_schedule_fn(3e-4)(0.5) == 3e-4


def count_down(x):
    return 1e-3 * x


@pytest.mark.parametrize(
    "schedule",
    [count_down, lambda progress: 1e-3 * progress, lambda progress_remaining: 1e-3 * progress_remaining],
)
def test_every_function_given_as_a_schedule_takes_the_remaining_progress(schedule, in_tmp_path):
    settings = {"n_steps": 4, "batch_size": 4, "policy_kwargs": {"net_arch": [4]}}
    agent = sb3.PPO("MlpPolicy", Walk(), learning_rate=schedule, clip_range=schedule, **settings)
    for config in (agent.config, sb3.PPO.load(agent.save("a"), learning_rate=schedule, clip_range=schedule).config):
        for given in (config.learning_rate, config.clip_range):
            assert [float(at(given, progress)) for progress in (0.0, 0.5, 1.0)] == pytest.approx([1e-3, 5e-4, 0.0])


class Counting(Timed):
    """Has four steps in an episode and rewards large actions."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    length = 4

    def __init__(self, action_space):
        self.action_space = action_space

    def observe(self):
        return np.full(2, self.time / 4, np.float32)

    def reward(self, action):
        return float(np.sum(action)) + self.time + 1

    def action_masks(self):
        return np.ones(2, bool)


def in_the_third_quarter(remaining):
    return 1e-2 if 0.25 < remaining <= 0.5 else 0.0


@pytest.mark.parametrize("name", only({"PPO", "SAC"}, algorithms.__all__))
@pytest.mark.filterwarnings("ignore:.*without exploration noise")
def test_schedules_of_every_algorithm_follow_the_remaining_progress_of_each_call_of_learn(name):
    kind = getattr(algorithms, name)
    is_off_policy = issubclass(kind, rejeu.OffPolicyAgent)
    small = {"batch_size": 4, "n_epochs": 1, "learning_starts": 0, "n_delta": 1, "n_top": 1, "policy_delay": 1}
    small |= {"train_freq": 1} if is_off_policy else {"n_steps": 4}
    fields = {*kind.algorithm.Config.__dataclass_fields__}
    settings = {key: value for key, value in small.items() if key in fields}
    is_clipped = "clip_range" in fields
    if is_clipped:
        settings["clip_range"] = lambda remaining: 0.5 * remaining
    is_discrete = name in ("DQN", "QRDQN", "MaskablePPO")
    env = Counting(gym.spaces.Discrete(2) if is_discrete else gym.spaces.Box(-1, 1, (1,), np.float32))
    agent = kind(
        "MlpPolicy", env, learning_rate=in_the_third_quarter, seed=0, policy_kwargs={"net_arch": [4]}, **settings
    )
    # TRPO's policy moves by its trust region, and target networks follow later.
    parts = "value" if name == "TRPO" else "weight"
    keys = [key for key in agent.policy.state_dict() if parts in key and "target" not in key]
    assert keys
    for _ in range(2):
        seen, clips = [agent.policy.state_dict()], {}

        def record(agent, progress, seen=seen, clips=clips):
            seen.append(agent.policy.state_dict())
            if is_clipped and progress.metrics is not None:
                clips[progress.step % 32 or 32] = float(progress.metrics["clip_range"])

        agent.learn(32, callback=record)
        moved = [i + 1 for i in range(32) if any(not np.array_equal(seen[i][key], seen[i + 1][key]) for key in keys)]
        assert moved
        assert set(moved) <= set(range(16, 24))
        assert moved[0] == 16
        for step, clip in clips.items():
            if step % 4 == 0:
                assert clip == pytest.approx(0.5 * (1 - step / 32), abs=1e-6)
        assert len(clips) >= 28 * is_clipped


def test_files_contain_functions_given_as_schedules_as_tables(in_tmp_path):
    from rejeu.sb3.common.utils import LinearSchedule

    curved = lambda remaining: 1e-3 * float(np.sqrt(remaining)) if remaining > 0.5 else 1e-4  # noqa: E731 - not for JAX
    sb3.DQN("MlpPolicy", Walk(), learning_rate=curved, policy_kwargs={"net_arch": [4]}).save("code")
    loaded = sb3.DQN.load("code")
    for remaining in (1.0, 0.9, 0.6, 0.3, 0.0):
        assert loaded.learning_rate(remaining) == pytest.approx(curved(remaining))
        assert float(at(rejeu.load("code").config.learning_rate, np.float32(1 - remaining))) == pytest.approx(
            curved(remaining), rel=1e-5
        )
    assert sb3.DQN("MlpPolicy", Walk(), learning_rate=lambda _: 0.5).learning_rate == 0.5
    sb3.DQN("MlpPolicy", Walk(), learning_rate=LinearSchedule(1e-3, 0, 1), policy_kwargs={"net_arch": [4]}).save("line")
    assert rejeu.load("line").config.learning_rate == rejeu.Linear(1e-3, 0.0)


def test_recording_goes_through_other_wrappers(in_tmp_path):
    from rejeu.sb3 import A2C
    from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize, VecVideoRecorder

    vec_env = DummyVecEnv([lambda: gym.make("CartPole-v1", render_mode="rgb_array")])
    model = A2C("MlpPolicy", vec_env)
    vec_env = VecVideoRecorder(
        VecNormalize(vec_env), "logs/videos", record_video_trigger=lambda x: x == 0, video_length=4, name_prefix="agent"
    )
    obs = vec_env.reset()
    for _ in range(5):
        obs, _, _, _ = vec_env.step(model.predict(obs)[0])
    vec_env.close()
    assert os.listdir("logs/videos") == ["agent-step-0-to-step-4.mp4"]
