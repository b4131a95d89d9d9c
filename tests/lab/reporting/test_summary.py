"""The table of an agent's networks."""

import equinox as eqx
import jax
import numpy as np
from gymnasium import spaces

import rejeu
from rejeu.agents.summary import describe, n_parameters
from rejeu.core.algorithm import AVERAGED, ensemble
from rejeu.core.spaces import leaves
from rejeu.networks import Network, PolicyConfig, QNetwork

SHAPE = PolicyConfig(
    action_layers=(16, 32), state_layers=(17, 33), common_layers=(60, 70), critic_layers=(12,), actor_layers=(24,)
)


class State(eqx.Module):
    actor: Network
    critics: QNetwork
    target_critics: QNetwork = eqx.field(metadata=AVERAGED)
    n_updates: jax.Array


def state(shape, space=None, n_outputs=4):
    """The shapes of what a learner with two critics would hold; nothing is computed."""
    obs = leaves(space or spaces.Box(-1, 1, (3,), np.float32))

    def init(key):
        actor = Network(key, obs, n_outputs, shape.actor_widths((64, 64)), shape)
        critics = ensemble(lambda k: QNetwork(k, obs, 4, shape.critic_widths((64, 64)), shape), key, 2)
        return State(actor, critics, critics, jax.numpy.int32(0))

    return jax.eval_shape(init, jax.random.PRNGKey(0)), obs


def rows_of(text):
    """The rows of a table as lists of cells, without the parts of the observation."""
    return [[cell for cell in line.split("  ") if cell] for line in text.split("\n\n")[0].split("\n")]


def test_each_network_is_named_with_its_number_of_parameters_but_no_target():
    learner, obs = state(SHAPE)
    actor = (3 + 1) * 17 + (17 + 1) * 33 + (33 + 1) * 60 + (60 + 1) * 70 + (70 + 1) * 24 + (24 + 1) * 4
    critic = (3 + 1) * 17 + (17 + 1) * 33 + (4 + 1) * 16 + (16 + 1) * 32
    critic += (33 + 32 + 1) * 60 + (60 + 1) * 70 + (70 + 1) * 12 + (12 + 1) * 1
    networks = [row for row in rows_of(describe(learner, obs)) if len(row) == 2]
    assert [[name, count.strip()] for name, count in networks] == [
        ["actor", f"{actor:,}"],
        ["critics", f"{2 * critic:,}"],
    ]
    assert n_parameters(learner.critics) == 2 * critic


def test_layers_add_up_to_their_network():
    rows = rows_of(describe(*state(SHAPE)))
    counts = [int(row[-1].replace(",", "")) for row in rows]
    begins = [i for i, row in enumerate(rows) if len(row) == 2]
    for begin, end in zip(begins, [*begins[1:], len(rows)], strict=True):
        assert counts[begin] == sum(counts[begin + 1 : end])


def test_the_parts_of_a_nested_observation_are_listed():
    space = spaces.Dict(camera=spaces.Box(0, 255, (36, 36, 4), np.uint8), gear=spaces.Discrete(5))
    assert describe(*state(PolicyConfig(), space)).split("\n\n")[-1].split("\n") == [
        "observation camera: image (36, 36, 4)",
        "observation gear: categorical ()",
    ]


def test_an_agent_shows_its_layers_as_model_files_name_them():
    agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, seed=0)
    assert agent.summary().split("\n") == [
        "actor                                            50",
        "  torso.layers.0  weight (3, 8), bias (8,)       32",
        "  head            weight (8, 2), bias (2,)       18",
        "critics                                          98",
        "  torso.layers.0  weight (2, 4, 8), bias (2, 8)  80",
        "  head            weight (2, 8, 1), bias (2, 1)  18",
        "",
        "observation: continuous (3,)",
    ]
