"""Neural networks: layers, and the networks that algorithms build from them.

A network is an encoder (observation to features, images by convolution), a torso (hidden layers) and a linear head. Each
of the three may be a module of the user's own. Every network is an ``equinox.Module`` whose leaves are arrays; static
fields (names, shapes of observations) are hashable. Inputs have one batch axis.
"""

from rejeu.networks.encoder import (
    CNN,
    NATURE,
    SMALL,
    Convolution,
    Convolutions,
    Encoder,
    OwnEncoder,
    channels_last,
    convolutions,
    encode_leaf,
    image_shape,
    make_encoder,
    n_features,
    reads_image,
)
from rejeu.networks.layers import ACTIVATIONS, MLP, LayerNorm, Linear, product
from rejeu.networks.network import Network, QNetwork, action_values, values_by_critics
from rejeu.networks.own import ENCODERS, OwnModule, own_module, register_encoder
from rejeu.networks.shape import BRANCHES, PolicyConfig, Widths, settled, split_net_arch
from rejeu.networks.torsos import Branches, ResidualBlock, SimBa, Torso, joined_width, make_head, make_torso

__all__ = [
    "ACTIVATIONS",
    "BRANCHES",
    "CNN",
    "ENCODERS",
    "MLP",
    "NATURE",
    "SMALL",
    "Branches",
    "Convolution",
    "Convolutions",
    "Encoder",
    "LayerNorm",
    "Linear",
    "Network",
    "OwnEncoder",
    "OwnModule",
    "PolicyConfig",
    "QNetwork",
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
    "make_encoder",
    "make_head",
    "make_torso",
    "n_features",
    "own_module",
    "product",
    "reads_image",
    "register_encoder",
    "settled",
    "split_net_arch",
    "values_by_critics",
]
