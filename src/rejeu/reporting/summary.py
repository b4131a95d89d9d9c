r"""A text drawing of an agent's networks.

An actor with two hidden layers is drawn as ``state -64-64- 2``: the input, the sizes of the hidden layers, the number of
outputs. Critics with separate branches for state and action are drawn as branches::

    action -16-32-
                   \
                    \
                     -60-70- 12-1
                    /
    state -17-33-  /

Target networks are left out. Each network has its number of parameters next to its name.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax

from rejeu import normalization
from rejeu.algorithms.actor_critic.network import ActorCritic
from rejeu.algorithms.recurrent_ppo import RecurrentActorCritic
from rejeu.core import averaged_fields
from rejeu.networks import (
    MLP,
    Branches,
    Encoder,
    Linear,
    Network,
    PolicyConfig,
    QNetwork,
    Recurrent,
    SimBa,
    convolutions,
)
from rejeu.networks.encoder import OwnEncoder
from rejeu.spaces import Leaf

ARROW = " -> "


def describe(state: Any, leaves: tuple[Leaf, ...]) -> str:
    """Returns the drawings of all networks of an algorithm's state, and the parts of the observation.

    Args:
        state: the algorithm's state, of arrays or shapes. Its averaged fields (target networks) are left out.
        leaves: leaves of the observation space.
    """
    if isinstance(state, normalization.State):
        state = state.learner
    names = [field.name for field in dataclasses.fields(state) if field.name not in averaged_fields(type(state))]
    networks = {
        name: network
        for name in names
        if isinstance(network := getattr(state, name), eqx.Module) and jax.tree.leaves(network)
    }
    reach = max((branch_width(network) for network in networks.values()), default=0)
    paragraphs = [f"{name}: {count(network)}\n{draw(network, reach)}" for name, network in networks.items()]
    parts = jax.tree.leaves(networks, is_leaf=lambda part: isinstance(part, Encoder | OwnEncoder))
    if own := next((part for part in parts if isinstance(part, OwnEncoder)), None):
        entrances = [f"  {leaf.path or 'observation'} {leaf.shape}" for leaf in leaves]
        return "\n\n".join(
            [*paragraphs, "\n".join(["state:", *entrances, f"  an encoder of your own -> {own.n_features}"])]
        )
    shape = next((part.shape for part in parts if isinstance(part, Encoder)), PolicyConfig())
    return "\n\n".join([*paragraphs, *inputs(leaves, shape)])


def n_parameters(network: Any) -> int:
    """Returns the number of parameters of a network, over all members of an ensemble."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(network))


def n_members(network: Any) -> int | None:
    """Returns the number of members of an ensemble, None for a single network."""
    if isinstance(network, Network | QNetwork) and isinstance(network.head, Linear) and network.head.bias.ndim == 2:
        return network.head.bias.shape[0]
    return None


def count(network: Any) -> str:
    """Returns the number of parameters as text: ``2 x 4,801 = 9,602 parameters``."""
    total, members = n_parameters(network), n_members(network)
    return f"{total:,} parameters" if members is None else f"{members} x {total // members:,} = {total:,} parameters"


def draw(network: Any, reach: int = 0) -> str:
    """Returns the drawing of one network.

    Args:
        network: an actor, a critic, an ensemble, or policy and value. Of other modules the class name is shown.
        reach: minimum width of the branches, which aligns actor and critic.
    """
    if isinstance(network, ActorCritic):
        return draw_policy_and_value(network, "state", "state")
    if isinstance(network, RecurrentActorCritic):
        cells = [f"state [{cell.kind} {cell.size}]" for cell in network.cells]
        return draw_policy_and_value(network.readers, cells[0], cells[-1])
    entrance = "state"
    if isinstance(network, Recurrent):
        entrance, network = f"state [{network.cell.kind} {network.cell.size}]", network.reader
    if not isinstance(network, Network | QNetwork):
        return f"({type(network).__name__})"
    output = network.head.n_outputs
    if isinstance(network.torso, Branches):
        return draw_branches(network.torso, output, reach)
    return draw_torso(entrance + ", action" * isinstance(network, QNetwork), network.torso, output)


def draw_policy_and_value(network: ActorCritic, policy_entrance: str, value_entrance: str) -> str:
    """Returns the lines of policy and value. Shared layers appear in both."""
    torso = network.torso if network.value_torso is None else network.value_torso
    policy = draw_torso(policy_entrance, network.torso, network.head.n_outputs)
    value = draw_torso(value_entrance, torso, 1) + (" (shared layers)" if network.value_torso is None else "")
    return f"policy: {policy}\nvalue:  {value}"


def draw_torso(entrance: str, torso: Any, output: int) -> str:
    """Returns input, hidden layers and output on one line."""
    if isinstance(torso, Branches):
        layers = [*widths(torso.state), *widths(torso.common), *widths(torso.last)]
        return f"{entrance} {'-'.join(['', *layers, ''])} {output}"
    if isinstance(torso, MLP):
        return f"{entrance} {chain(torso)} {output}"
    if isinstance(torso, SimBa):
        blocks = "".join(f"[+{block.expand.bias.shape[-1]}]-" for block in torso.blocks)
        return f"{entrance} -{torso.embedding.bias.shape[-1]}-{blocks} {output}"
    return f"{entrance} -({type(torso).__name__} {torso.n_outputs})- {output}"


def widths(mlp: MLP) -> list[str]:
    """Returns the sizes of the hidden layers of an MLP."""
    return [str(layer.bias.shape[-1]) for layer in mlp.layers]


def chain(mlp: MLP) -> str:
    """Returns hidden layers as ``-64-64-``, or ``-`` without layers."""
    return "-".join(["", *widths(mlp), ""])


def draw_branches(torso: Branches, output: int, reach: int) -> str:
    """Returns the drawing of branches and the layers after them."""
    state = f"state {chain(torso.state)}"
    trunk = f"{chain(torso.common)} {'-'.join([*widths(torso.last), str(output)])}"
    reach = max(reach, branches_width(torso))
    lines = [" " * (reach + 3) + trunk, " " * (reach + 2) + "/", state.ljust(reach + 1) + "/"]
    if torso.action is not None:
        lines = [f"action {chain(torso.action)}", " " * (reach + 1) + "\\", " " * (reach + 2) + "\\", *lines]
    return "\n".join(lines)


def branches_width(torso: Branches) -> int:
    """Returns the width of the longer branch in characters."""
    action = 0 if torso.action is None else len(f"action {chain(torso.action)}")
    return max(action, len(f"state {chain(torso.state)}"))


def branch_width(network: Any) -> int:
    """Returns the width of a network's branches in characters, 0 without branches."""
    is_branched = isinstance(network, Network | QNetwork) and isinstance(network.torso, Branches)
    return branches_width(network.torso) if is_branched else 0


def inputs(leaves: tuple[Leaf, ...], shape: PolicyConfig) -> list[str]:
    """Returns the parts of the observation, one line for each leaf."""
    if len(leaves) == 1 and leaves[0].kind == "continuous" and len(leaves[0].shape) == 1:
        return [f"state: {leaves[0].shape[0]}"]
    return ["state:\n" + "\n".join(f"  {leaf.path or 'observation'} {entrance(leaf, shape)}" for leaf in leaves)]


def entrance(leaf: Leaf, shape: PolicyConfig) -> str:
    """Returns the encoding of an observation leaf: ``(84, 84, 4) -> 32 x 8x8/4 ... -> 512``."""
    kind = convolutions(leaf, shape)
    steps = [str(leaf.shape)]
    if kind is not None:
        steps += [f"{filters} x {side}x{side}/{stride}" for filters, side, stride in kind.layers]
        return ARROW.join([*steps, str(kind.n_outputs)])
    how = {"categorical": " (one-hot)", "image": " (pixels / 255)"}.get(leaf.kind, "")
    return ARROW.join([*steps, f"{leaf.n_features}{how}"])
