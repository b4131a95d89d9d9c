"""An environment on MJX against MuJoCo itself."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.core.errors import MissingExtra
from rejeu.envs.functional import mjx

HAS_MJX = importlib.util.find_spec("mujoco") is not None and importlib.util.find_spec("mujoco.mjx") is not None


@pytest.mark.skipif(HAS_MJX, reason="MJX is installed")
def test_a_missing_package_is_named():
    with pytest.raises(MissingExtra, match=r'pip install "rejeu\[mjx\]"'):
        mjx.InvertedPendulum()


@pytest.mark.exhaustive
@pytest.mark.skipif(not HAS_MJX, reason="MJX is not installed")
def test_the_inverted_pendulum_moves_as_in_mujoco():
    import mujoco

    with jax.numpy_rank_promotion("allow"):
        vector = rejeu.make_vector(mjx.InvertedPendulum(max_episode_steps=30), 2, seed=0)
        obs = np.array(vector.reset())
        model = mujoco.MjModel.from_xml_string(mjx.INVERTED_PENDULUM)
        data = mujoco.MjData(model)
        rng = np.random.default_rng(0)
        for _ in range(30):
            action = rng.uniform(-3, 3, (2, 1)).astype(np.float32)
            data.qpos[:], data.qvel[:], data.ctrl[:] = obs[0, :2], obs[0, 2:], action[0]
            for _ in range(2):
                mujoco.mj_step(model, data)
            step = vector.step(action)
            np.testing.assert_allclose(step.obs[0], [*data.qpos, *data.qvel], atol=1e-4)
            assert step.terminated[0] == (abs(step.obs[0, 1]) > 0.2)
            obs = np.array(step.obs)
            if step.terminated.any():
                obs = np.array(vector.reset_done(step.terminated))
        assert vector.snapshot() is not None
        state = vector.state.env
        assert jnp.isfinite(state.qpos).all()
