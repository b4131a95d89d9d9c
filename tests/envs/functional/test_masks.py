"""Action masks of environments in JAX."""

import numpy as np
import pytest

import rejeu
from rejeu.core.algorithm import Masked
from rejeu.envs.functional.gym_env import GymnasiumEnv
from rejeu.envs.masks import make_masked
from tests.jax_environments import Forbidden
from tests.tiers import only


def test_masks_are_passed_with_the_observations():
    vector = make_masked(Forbidden(), 2, seed=0)
    assert vector.backend == "jax"
    obs = vector.reset()
    assert isinstance(obs, Masked)
    assert obs.obs.shape == (2, 2)
    assert obs.mask.tolist() == [[True, True, False]] * 2
    step = vector.step(np.array([0, 2]), np.array([True, False]))
    assert step.obs.mask.tolist() == [[False, True, True], [True, True, False]]
    assert vector.reset_done(np.array([True, False])).mask[0].tolist() == [True, True, False]


@pytest.mark.parametrize("on_device", only([False], [True, False]))
def test_maskable_ppo_never_takes_a_forbidden_action(on_device):
    vector = rejeu.make_vector(Forbidden(), 2, seed=0)
    agent = rejeu.MaskablePPO("MlpPolicy", vector, n_steps=16, policy_kwargs={"net_arch": [8]}, seed=0)
    agent.on_device = on_device
    agent.learn(96)
    assert agent.num_timesteps == 96
    assert set(agent.history["return"]) == {0.0}


def test_a_gymnasium_environment_has_the_mask_in_its_info():
    env = GymnasiumEnv(Forbidden())
    assert env.reset(seed=0)[1]["action_mask"].tolist() == [1, 1, 0]
    assert env.step(0)[4]["action_mask"].tolist() == [0, 1, 1]
