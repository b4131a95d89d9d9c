"""Recorded files are read, and hold what they held: a change of the format must change the schema."""

from pathlib import Path

import numpy as np
import pytest

import rejeu
from rejeu.sb3.common.vec_env import DummyVecEnv, VecNormalize
from tests.environments import Counter
from tests.golden import record_files

GOLDEN = Path(record_files.__file__).parent
FILES = GOLDEN / "files"
MODELS = ("sac", "td3", "dqn", "ppo")


def recorded():
    with np.load(FILES / "expected.npz") as file:
        return dict(file)


@pytest.mark.parametrize("name", MODELS)
def test_a_model_holds_what_it_held_and_predicts_what_it_predicted(name):
    expected = recorded()
    agent = rejeu.load(FILES / f"{name}.safetensors")
    np.testing.assert_array_equal(record_files.flat(agent), expected[f"{name}.parameters"])
    predictions = agent.predict(record_files.observations(name), deterministic=True)[0]
    np.testing.assert_allclose(predictions, expected[f"{name}.predictions"], rtol=1e-4, atol=1e-6)


def test_a_replay_buffer_holds_what_it_held():
    expected = recorded()
    agent = record_files.replay_agent()
    agent.load_replay_buffer(FILES / "replay.safetensors")
    assert agent.replay_buffer.size() == 23
    arrays = agent.replay_buffer.arrays()
    assert {f"replay.{name}" for name in arrays} == {name for name in expected if name.startswith("replay.")}
    for name, value in arrays.items():
        np.testing.assert_array_equal(value, expected[f"replay.{name}"], err_msg=name)


def test_the_statistics_of_a_wrapper_are_what_they_were():
    expected = recorded()
    env = VecNormalize.load(FILES / "vec_normalize.safetensors", DummyVecEnv([lambda: Counter((5,))]))
    assert (env.clip_obs, env.clip_reward, env.norm_obs_keys) == (7.0, 10.0, None)
    for key, moments in (("obs", env.obs_rms), ("returns", env.ret_rms)):
        for part in ("mean", "var", "count"):
            np.testing.assert_array_equal(getattr(moments, part), expected[f"vec_normalize.{key}.{part}"])
