"""Which hidden layers networks have where none are asked for: on numbers, on images and in files."""

import gymnasium as gym
import jax
import numpy as np
import pytest

import rejeu
from rejeu.algorithms import config as configs, crossq, ppo
from rejeu.algorithms.actor_critic.network import ActorCritic
from rejeu.core.spaces import leaves
from tests.environments import Sampled
from tests.tiers import exhaustive

IMAGE = gym.spaces.Box(0, 255, (8, 8, 1), np.uint8)
VECTOR = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
STACK = gym.spaces.Box(0, 255, (2, 8, 8, 1), np.uint8)
DICT = gym.spaces.Dict(image=IMAGE)
TINY = gym.spaces.Box(0, 255, (4, 4, 1), np.uint8)
BOX, DISCRETE = gym.spaces.Box(-1.0, 1.0, (1,), np.float32), gym.spaces.Discrete(2)
DISCRETE_ONLY = ("DQN", "QRDQN", "PQN", "MaskablePPO")


def networks_of(name, space, **settings):
    """Returns the networks that an algorithm builds for observations of a space, of shapes in place of arrays."""
    module = rejeu.AGENTS[name].algorithm
    action_space = DISCRETE if name in DISCRETE_ONLY else BOX
    state = jax.eval_shape(module.make(module.Config(**settings), space, action_space).init, jax.random.PRNGKey(0))
    if name in ("SAC", "TQC", "TD3"):
        return [state.actor, state.critics]
    if name == "DDPG":
        return [state.actor, state.critic]
    return [{"QRDQN": lambda n: n.outputs, "RecurrentPPO": lambda n: n.readers}.get(name, lambda n: n)(state.network)]


def widths_of(network):
    torsos = [network.torso] if not isinstance(network, ActorCritic) else [network.torso, network.value_torso]
    widths = [[layer.weight.shape[-1] for layer in getattr(torso, "last", torso).layers] for torso in torsos]
    assert all(one == widths[0] for one in widths)
    return widths[0]


# Stable-Baselines3 2.9.2 and sb3-contrib, policies.py of each: net_arch is None with a NatureCNN, and with other encoders.
SB3 = {
    **dict.fromkeys(("DQN", "QRDQN", "PPO", "A2C", "RecurrentPPO", "MaskablePPO"), ([], [64, 64])),
    **dict.fromkeys(("TD3", "DDPG"), ([256, 256], [400, 300])),
    **dict.fromkeys(("SAC", "TQC"), ([256, 256], [256, 256])),
}


@pytest.mark.parametrize("name", list(SB3))
def test_default_widths_are_those_of_stable_baselines3(name):
    for space, expected in zip((IMAGE, VECTOR), SB3[name], strict=True):
        assert [widths_of(network) for network in networks_of(name, space)] == [expected] * len(
            networks_of(name, space)
        )


@pytest.mark.parametrize(("space", "expected"), [(STACK, []), (DICT, [64, 64]), (TINY, [64, 64])])
def test_a_stack_of_images_is_an_image_and_a_dict_or_an_image_too_small_to_convolve_is_not(space, expected):
    assert widths_of(*networks_of("DQN", space)) == expected


@pytest.mark.parametrize("shape", [{"net_arch": [5]}, {"pi": [7], "qf": [5]}, {"critic_layers": [5]}])
def test_widths_that_are_asked_for_are_built_on_images_too(shape):
    assert widths_of(*networks_of("DQN", IMAGE, policy_kwargs=shape)) == [5]


@exhaustive
def test_a_network_without_hidden_layers_learns():
    agent = rejeu.PPO("CnnPolicy", Sampled(IMAGE, DISCRETE), n_steps=10, batch_size=10, n_epochs=1, seed=0)
    before = agent.get_parameters()
    agent.learn(10)
    after = agent.get_parameters()
    assert all((before[key] != after[key]).any() for key in before if key.startswith("network."))


def test_a_file_says_the_widths_so_that_no_other_default_changes_them():
    config = configs.with_widths(crossq.Config(policy_kwargs={"pi": [4]}), leaves(VECTOR))
    shape = configs.to_json(config)["policy_kwargs"]
    assert (shape["net_arch"], shape["pi"], shape["qf"]) == (None, [4], [1024, 1024])
    shape = configs.to_json(configs.with_widths(ppo.Config(), leaves(IMAGE)))["policy_kwargs"]
    assert shape["net_arch"] == []
