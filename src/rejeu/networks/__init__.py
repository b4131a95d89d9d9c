"""Neural networks: layers, and the networks that algorithms build from them.

A network is an encoder (observation to features, images by convolution), a torso (hidden layers) and a linear head. Each
of the three may be a module of the user's own. Before the torso there may be a memory (a recurrent cell). Every network is
an ``equinox.Module`` whose leaves are arrays; static fields (names, shapes of observations) are hashable. Inputs have one
batch axis.
"""

from rejeu.networks.encoder import (
    Convolution as Convolution,
    Encoder as Encoder,
    convolutions as convolutions,
    make_encoder as make_encoder,
    reads_image as reads_image,
)
from rejeu.networks.layers import (
    ACTIVATIONS as ACTIVATIONS,
    ENCODERS as ENCODERS,
    MLP as MLP,
    LayerNorm as LayerNorm,
    Linear as Linear,
    register_encoder as register_encoder,
    with_dropout as with_dropout,
)
from rejeu.networks.memory import (
    Cell as Cell,
    MemoryConfig as MemoryConfig,
    Recurrent as Recurrent,
    each as each,
    first as first,
    some as some,
    with_memory as with_memory,
)
from rejeu.networks.network import (
    Branches as Branches,
    Network as Network,
    QNetwork as QNetwork,
    SimBa as SimBa,
    Torso as Torso,
    action_values as action_values,
    actor_and_critics as actor_and_critics,
    make_head as make_head,
    make_torso as make_torso,
    values_by_critics as values_by_critics,
)
from rejeu.networks.shape import (
    PolicyConfig as PolicyConfig,
    Widths as Widths,
    settled as settled,
    split_net_arch as split_net_arch,
)
