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
    Encoder,
    channels_last,
    convolutions,
    image_shape,
    make_encoder,
    reads_image,
)
from rejeu.networks.layers import ACTIVATIONS, MLP, LayerNorm, Linear, product
from rejeu.networks.network import Network, QNetwork, action_values, values_by_critics
from rejeu.networks.own import ENCODERS, register_encoder
from rejeu.networks.shape import BRANCHES, PolicyConfig, Widths, settled, split_net_arch
from rejeu.networks.torsos import Branches, SimBa, Torso, make_head, make_torso

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
    "Encoder",
    "LayerNorm",
    "Linear",
    "Network",
    "PolicyConfig",
    "QNetwork",
    "SimBa",
    "Torso",
    "Widths",
    "action_values",
    "channels_last",
    "convolutions",
    "image_shape",
    "make_encoder",
    "make_head",
    "make_torso",
    "product",
    "reads_image",
    "register_encoder",
    "settled",
    "split_net_arch",
    "values_by_critics",
]
