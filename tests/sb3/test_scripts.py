"""Scripts as Stable-Baselines3's documentation has them, with the imports of rejeu's mirror and nothing else changed."""

from __future__ import annotations

import importlib

import pytest

from rejeu import sb3
from rejeu.core.schedules import at
from tests.golden.vec_env_script import Walk

PATHS = {
    "": ["PPO", "A2C", "DQN", "SAC", "TD3", "DDPG", "HerReplayBuffer", "QRDQN", "TQC", "RecurrentPPO", "MaskablePPO"],
    ".ppo": ["PPO", "MlpPolicy", "CnnPolicy", "MultiInputPolicy"],
    ".a2c": ["A2C", "MlpPolicy"],
    ".dqn": ["DQN", "MlpPolicy"],
    ".sac": ["SAC", "MlpPolicy"],
    ".td3": ["TD3", "MlpPolicy"],
    ".ddpg": ["DDPG", "MlpPolicy"],
    ".ppo.policies": ["MlpPolicy"],
    ".sac.policies": ["MlpPolicy"],
    ".ppo.ppo": ["PPO"],
    ".common.base_class": ["BaseAlgorithm"],
    ".common.callbacks": ["BaseCallback", "EvalCallback", "CheckpointCallback", "CallbackList", "EventCallback"],
    ".common.env_checker": ["check_env"],
    ".common.env_util": ["make_vec_env", "is_wrapped", "unwrap_wrapper"],
    ".common.evaluation": ["evaluate_policy"],
    ".common.logger": ["configure", "Logger"],
    ".common.monitor": ["Monitor", "load_results", "get_monitor_files", "LoadMonitorResultsError"],
    ".common.results_plotter": ["load_results", "ts2xy", "plot_results", "plot_curves", "X_TIMESTEPS", "window_func"],
    ".common.running_mean_std": ["RunningMeanStd"],
    ".common.utils": ["set_random_seed", "get_schedule_fn", "get_linear_fn", "LinearSchedule"],
    ".common.vec_env": ["VecEnv", "VecEnvWrapper", "VecNormalize", "VecFrameStack", "VecMonitor", "VecVideoRecorder"],
    ".common.vec_env.base_vec_env": ["VecEnv", "VecEnvWrapper"],
    ".common.vec_env.dummy_vec_env": ["DummyVecEnv"],
    ".common.vec_env.subproc_vec_env": ["SubprocVecEnv"],
    ".common.vec_env.vec_check_nan": ["VecCheckNan"],
    ".common.vec_env.vec_extract_dict_obs": ["VecExtractDictObs"],
    ".common.vec_env.vec_frame_stack": ["VecFrameStack"],
    ".common.vec_env.vec_monitor": ["VecMonitor"],
    ".common.vec_env.vec_normalize": ["VecNormalize"],
    ".common.vec_env.vec_transpose": ["VecTransposeImage"],
    ".common.vec_env.vec_video_recorder": ["VecVideoRecorder"],
}
"""Where Stable-Baselines3 has what."""


@pytest.fixture
def in_tmp_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("path", PATHS)
def test_names_stand_where_stable_baselines3_has_them(path):
    module = importlib.import_module(f"rejeu.sb3{path}")
    for name in PATHS[path]:
        assert hasattr(module, name), name
        assert name in module.__all__


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
