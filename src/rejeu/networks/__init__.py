"""Neural networks: layers, and the actor and critics that algorithms put together from them.

A network is an encoder (observation to features, images by convolution), a torso (hidden layers) and one linear head.
The torso is a perceptron, a net of branches, SimBa or a module of the user's. Every network is an ``equinox.Module``
whose leaves are all arrays; what is static (names, shapes of observations) is hashable. Inputs carry one batch axis.
"""

from rejeu.networks.actor_and_critic import Actor, Critic, action_values
from rejeu.networks.encoder import (
    CNN,
    NATURE,
    SMALL,
    Convolution,
    Convolutions,
    Encoder,
    channels_last,
    convolutions,
    encode_leaf,
    image_shape,
    n_features,
    reads_image,
)
from rejeu.networks.layers import ACTIVATIONS, MLP, LayerNorm, Linear, product
from rejeu.networks.shape import BRANCHES, PolicyConfig, Widths, settled
from rejeu.networks.torsos import Branches, ResidualBlock, SimBa, Torso, joined_width, make_torso, own_torso

__all__ = [
    "ACTIVATIONS",
    "BRANCHES",
    "CNN",
    "MLP",
    "NATURE",
    "SMALL",
    "Actor",
    "Branches",
    "Convolution",
    "Convolutions",
    "Critic",
    "Encoder",
    "LayerNorm",
    "Linear",
    "PolicyConfig",
    "ResidualBlock",
    "SimBa",
    "Torso",
    "Widths",
    "action_values",
    "channels_last",
    "convolutions",
    "encode_leaf",
    "image_shape",
    "joined_width",
    "make_torso",
    "n_features",
    "own_torso",
    "product",
    "reads_image",
    "settled",
]
