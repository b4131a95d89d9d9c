"""Neural networks: layers, and the networks that algorithms build from them.

A network is an encoder (observation to features, images by convolution), a torso (hidden layers) and a linear head. Each
of the three may be a module of the user's own. Before the torso there may be a memory (a recurrent cell). Every network is
an ``equinox.Module`` whose leaves are arrays; static fields (names, shapes of observations) are hashable. Inputs have one
batch axis.
"""

from rejeu.networks.encoder import (
    Convolution,
    Encoder,
    convolutions,
    make_encoder,
    reads_image,
)
from rejeu.networks.layers import ACTIVATIONS, ENCODERS, MLP, LayerNorm, Linear, register_encoder, with_dropout
from rejeu.networks.memory import Cell, MemoryConfig, Recurrent, each, first, some, with_memory
from rejeu.networks.network import (
    Branches,
    Network,
    QNetwork,
    SimBa,
    Torso,
    action_values,
    actor_and_critics,
    make_head,
    make_torso,
    values_by_critics,
)
from rejeu.networks.shape import PolicyConfig, Widths, settled, split_net_arch

__all__ = [
    "ACTIVATIONS",
    "ENCODERS",
    "MLP",
    "Branches",
    "Cell",
    "Convolution",
    "Encoder",
    "LayerNorm",
    "Linear",
    "MemoryConfig",
    "Network",
    "PolicyConfig",
    "QNetwork",
    "Recurrent",
    "SimBa",
    "Torso",
    "Widths",
    "action_values",
    "actor_and_critics",
    "convolutions",
    "each",
    "first",
    "make_encoder",
    "make_head",
    "make_torso",
    "reads_image",
    "register_encoder",
    "settled",
    "some",
    "split_net_arch",
    "values_by_critics",
    "with_dropout",
    "with_memory",
]
