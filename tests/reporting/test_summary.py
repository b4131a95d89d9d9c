"""The text drawing of networks."""

from __future__ import annotations

import textwrap

import equinox as eqx
import gymnasium as gym
import jax
import numpy as np
import pytest
from gymnasium import spaces

import rejeu
from rejeu.core import AVERAGED, ensemble
from rejeu.networks import Network, PolicyConfig, QNetwork
from rejeu.reporting.summary import describe, draw, n_parameters
from rejeu.spaces import leaves
from tests.environments import Sampled

DOCUMENT = PolicyConfig(
    action_layers=(16, 32), state_layers=(17, 33), common_layers=(60, 70), critic_layers=(12,), actor_layers=(24,)
)
FIGURE_OF_THE_CRITIC = r"""
    action -16-32-
                   \
                    \
                     -60-70- 12-1
                    /
    state -17-33-  /
"""
FIGURE_OF_THE_ACTOR = """
                     -60-70- 24-4
                    /
    state -17-33-  /
"""
"""Both as in the course's document, the actor's for 4-dimensional actions."""


class State(eqx.Module):
    actor: Network
    critics: QNetwork
    target_critics: QNetwork = eqx.field(metadata=AVERAGED)
    n_updates: jax.Array


def state(shape, n_observations=3, space=None, n_outputs=4):
    """The shapes of what a learner with two critics would hold; nothing is drawn or computed."""
    obs = leaves(space or spaces.Box(-1, 1, (n_observations,), np.float32))

    def init(key):
        actor = Network(key, obs, n_outputs, shape.actor_widths((64, 64)), shape)
        critics = ensemble(lambda k: QNetwork(k, obs, 4, shape.critic_widths((64, 64)), shape), key, 2)
        return State(actor, critics, critics, jax.numpy.int32(0))

    return jax.eval_shape(init, jax.random.PRNGKey(0)), obs


def as_in_the_document(drawing):
    return "\n" + textwrap.indent(drawing, "    ") + "\n"


def test_the_documents_figure_is_reproduced():
    learner, obs = state(DOCUMENT)
    actor, critics, _ = describe(learner, obs).split("\n\n")
    assert as_in_the_document(critics.split("\n", 1)[1]) == FIGURE_OF_THE_CRITIC
    assert as_in_the_document(actor.split("\n", 1)[1]) == FIGURE_OF_THE_ACTOR


def test_each_network_is_named_with_its_number_of_parameters():
    learner, obs = state(DOCUMENT)
    actor = (3 + 1) * 17 + (17 + 1) * 33 + (33 + 1) * 60 + (60 + 1) * 70 + (70 + 1) * 24 + (24 + 1) * 4
    critic = (3 + 1) * 17 + (17 + 1) * 33 + (4 + 1) * 16 + (16 + 1) * 32
    critic += (33 + 32 + 1) * 60 + (60 + 1) * 70 + (70 + 1) * 12 + (12 + 1) * 1
    titles = [paragraph.split("\n")[0] for paragraph in describe(learner, obs).split("\n\n")]
    assert titles == [
        f"actor: {actor:,} parameters", f"critics: 2 x {critic:,} = {2 * critic:,} parameters", "state: 3"
    ]  # fmt: skip
    assert n_parameters(learner.critics) == 2 * critic


def test_the_longer_branch_sets_the_joint():
    learner, _ = state(PolicyConfig(state_layers=(1000, 1000), action_layers=(8,), actor_layers=(5, 6)))
    drawing = r"""
    action -8-
                      \
                       \
                        - 1
                       /
    state -1000-1000- /
"""
    assert as_in_the_document(draw(learner.critics)) == drawing
    assert as_in_the_document(draw(learner.actor)) == "\n".join(["", *drawing.split("\n")[4:]]).replace(
        "- 1\n", "- 5-6-4\n"
    )


@pytest.mark.parametrize(
    ("given", "actor", "critic"),
    [
        ({"net_arch": [64, 32]}, "state -64-32- 2", "state, action -64-32- 1"),
        ({"net_arch": []}, "state - 2", "state, action - 1"),
        ({"net_arch": {"pi": [8], "qf": [9, 9, 9]}, "layer_norm": True}, "state -8- 2", "state, action -9-9-9- 1"),
        (
            {"architecture": "simba", "n_blocks": 2, "width": 16},
            "state -16-[+64]-[+64]- 2",
            "state, action -16-[+64]-[+64]- 1",
        ),
    ],
)
def test_other_shapes_are_drawn_on_one_line(given, actor, critic):
    learner, _ = state(PolicyConfig(**given), n_outputs=2)
    assert draw(learner.actor) == actor
    assert draw(learner.critics) == critic


class Cube(eqx.Module):
    weight: jax.Array
    n_outputs: int = eqx.field(static=True)

    def __init__(self, key, n_inputs):
        self.weight = jax.random.normal(key, (n_inputs, 5))
        self.n_outputs = 5

    def __call__(self, x):
        return (x @ self.weight) ** 3


def test_a_module_of_the_users_own_is_named():
    learner, _ = state(PolicyConfig(torso=Cube))
    assert draw(learner.actor) == "state -(Cube 5)- 4"
    assert draw(learner.critics) == "state, action -(Cube 5)- 1"


def test_the_parts_of_a_nested_observation_are_listed():
    space = spaces.Dict(
        camera=spaces.Box(0, 255, (84, 84, 4), np.uint8),
        gear=spaces.Discrete(5),
        icon=spaces.Box(0, 255, (9, 9, 3), np.uint8),
        pose=spaces.Box(-1, 1, (2, 3)),
    )
    learner, obs = state(PolicyConfig(), space=space)
    assert describe(learner, obs).split("\n\n")[-1].split("\n") == [
        "state:",
        "  camera (84, 84, 4) -> 32 x 8x8/4 -> 64 x 4x4/2 -> 64 x 3x3/1 -> 512",
        "  gear () -> 5 (one-hot)",
        "  icon (9, 9, 3) -> 32 x 4x4/2 -> 64 x 3x3/1 -> 256",
        "  pose (2, 3) -> 6",
    ]
    learner, obs = state(PolicyConfig(cnn_features=20), space=space)
    assert "  icon (9, 9, 3) -> 32 x 4x4/2 -> 64 x 3x3/1 -> 20" in describe(learner, obs)


class Pixels(eqx.Module):
    linear: eqx.nn.Linear

    def __call__(self, obs):
        return jax.vmap(self.linear)(obs.reshape(len(obs), -1) / 255.0)


def test_an_encoder_of_the_users_own_is_named_instead_of_layers_that_are_not_there():
    make = lambda key, leaves: Pixels(eqx.nn.Linear(leaves[0].n_features, 32, key=key))  # noqa: E731
    learner, obs = state(PolicyConfig(encoder=make), space=spaces.Box(0, 255, (9, 9, 3), np.uint8))
    text = describe(learner, obs)
    assert text.endswith("state:\n  observation (9, 9, 3)\n  an encoder of your own -> 32")


def test_an_agent_draws_itself():
    agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [64, 64]}, seed=0)
    actor, critic = 3 * 64 + 64 + 64 * 64 + 64 + 64 * 2 + 2, 4 * 64 + 64 + 64 * 64 + 64 + 64 + 1
    assert agent.summary().split("\n") == [
        f"actor: {actor:,} parameters",
        "state -64-64- 2",
        "",
        f"critics: 2 x {critic:,} = {2 * critic:,} parameters",
        "state, action -64-64- 1",
        "",
        "state: 3",
    ]


def test_networks_without_a_drawing_are_counted():
    agent = rejeu.DQN("MlpPolicy", Sampled(spaces.Discrete(4), spaces.Discrete(2)), dueling=True, seed=0)
    (first, second), last = (paragraph.split("\n") for paragraph in agent.summary().split("\n\n"))
    assert first.startswith("network: ")
    assert second == "(Dueling)"
    assert last == ["state:", "  observation () -> 4 (one-hot)"]


def test_policy_and_value_are_drawn_on_a_line_each():
    env = gym.make("CartPole-v1")
    agent = rejeu.PPO("MlpPolicy", env, policy_kwargs={"net_arch": {"pi": [32], "vf": [16, 8]}})
    n = (4 * 32 + 32) + (32 * 2 + 2) + (4 * 16 + 16) + (16 * 8 + 8) + (8 + 1)
    assert agent.summary() == f"network: {n} parameters\npolicy: state -32- 2\nvalue:  state -16-8- 1\n\nstate: 4"


def test_shared_layers_and_memories_are_named():
    env = gym.make("CartPole-v1")
    shared = rejeu.A2C("MlpPolicy", env, policy_kwargs={"net_arch": [16], "share_layers": True})
    assert "policy: state -16- 2\nvalue:  state -16- 1 (shared layers)" in shared.summary()
    recurrent = rejeu.RecurrentPPO(
        "MlpPolicy", env, policy_kwargs={"net_arch": [16], "lstm_hidden_size": 8, "cell": "gru"}
    )
    assert "policy: state [gru 8] -16- 2\nvalue:  state [gru 8] -16- 1" in recurrent.summary()
