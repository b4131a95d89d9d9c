r"""A text drawing of an agent's networks.

A plain actor of two hidden layers reads ``state -64-64- 2``: what goes in, the widths of the hidden layers, what comes
out. Critics of which observation and action go through branches of their own are drawn as branches::

    action -16-32-
                   \
                    \
                     -60-70- 12-1
                    /
    state -17-33-  /

Targets are not drawn: they are copies. Each network's number of parameters stands beside its name.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax

from rejeu import normalization
from rejeu.algorithms.actor_critic import ActorCritic
from rejeu.algorithms.recurrent_ppo import RecurrentActorCritic
from rejeu.core import averaged_fields
from rejeu.networks import MLP, Actor, Branches, Critic, SimBa, convolutions
from rejeu.spaces import Leaf

ARROW = " -> "


def describe(state: Any, leaves: tuple[Leaf, ...]) -> str:
    """Returns the drawing of every network of an algorithm's state, and what ``state`` is made of.

    Args:
        state: the algorithm's state, of arrays or of their shapes; its averaged fields (target networks) are left out.
        leaves: those of the observations.
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
    return "\n\n".join([*paragraphs, *inputs(leaves)])


def n_parameters(network: Any) -> int:
    """Returns how many numbers a network learns, all members of an ensemble together."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(network))


def n_members(network: Any) -> int | None:
    """Returns how many networks are stacked in one; None if it is a single one."""
    if isinstance(network, Actor | Critic) and len(network.head.bias.shape) == 2:
        return network.head.bias.shape[0]
    return None


def count(network: Any) -> str:
    """Returns the number of parameters in words: ``2 x 4,801 = 9,602 parameters``."""
    total, members = n_parameters(network), n_members(network)
    return f"{total:,} parameters" if members is None else f"{members} x {total // members:,} = {total:,} parameters"


def draw(network: Any, reach: int = 0) -> str:
    """Returns the drawing of one network.

    Args:
        network: an actor or a critic, single or stacked, or policy and value in one; of others only the class is named.
        reach: least width of the branches, so that actor and critic line up.
    """
    if isinstance(network, ActorCritic):
        return draw_policy_and_value(network, "state", "state")
    if isinstance(network, RecurrentActorCritic):
        cells = [f"state [{cell.kind} {cell.size}]" for cell in network.cells]
        return draw_policy_and_value(network.readers, cells[0], cells[-1])
    if not isinstance(network, Actor | Critic):
        return f"({type(network).__name__})"
    output = network.head.bias.shape[-1]
    if isinstance(network.torso, Branches):
        return draw_branches(network.torso, output, reach)
    return draw_torso("state, action" if isinstance(network, Critic) else "state", network.torso, output)


def draw_policy_and_value(network: ActorCritic, policy_entrance: str, value_entrance: str) -> str:
    """Returns policy and value, a line each; where they share layers the value's line shows them again."""
    torso = network.torso if network.value_torso is None else network.value_torso
    policy = draw_torso(policy_entrance, network.torso, network.head.bias.shape[-1])
    value = draw_torso(value_entrance, torso, 1) + (" (shared layers)" if network.value_torso is None else "")
    return f"policy: {policy}\nvalue:  {value}"


def draw_torso(entrance: str, torso: Any, output: int) -> str:
    """Returns on one line what goes in, the hidden layers and what comes out."""
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
    """Returns the widths of the layers of a perceptron."""
    return [str(layer.bias.shape[-1]) for layer in mlp.layers]


def chain(mlp: MLP) -> str:
    """Returns hidden layers as ``-64-64-``, no layers as ``-``."""
    return "-".join(["", *widths(mlp), ""])


def draw_branches(torso: Branches, output: int, reach: int) -> str:
    """Returns the branches, where they meet, and the way on from there."""
    state = f"state {chain(torso.state)}"
    trunk = f"{chain(torso.common)} {'-'.join([*widths(torso.last), str(output)])}"
    reach = max(reach, branches_width(torso))
    lines = [" " * (reach + 3) + trunk, " " * (reach + 2) + "/", state.ljust(reach + 1) + "/"]
    if torso.action is not None:
        lines = [f"action {chain(torso.action)}", " " * (reach + 1) + "\\", " " * (reach + 2) + "\\", *lines]
    return "\n".join(lines)


def branches_width(torso: Branches) -> int:
    """Returns how many characters the longer branch takes."""
    action = 0 if torso.action is None else len(f"action {chain(torso.action)}")
    return max(action, len(f"state {chain(torso.state)}"))


def branch_width(network: Any) -> int:
    """Returns how many characters the branches of a network take, 0 if it has none."""
    is_branched = isinstance(network, Actor | Critic) and isinstance(network.torso, Branches)
    return branches_width(network.torso) if is_branched else 0


def inputs(leaves: tuple[Leaf, ...]) -> list[str]:
    """Returns lines that say what ``state`` consists of, one a leaf; none for one plain vector."""
    if len(leaves) == 1 and leaves[0].kind == "continuous" and len(leaves[0].shape) == 1:
        return [f"state: {leaves[0].shape[0]}"]
    return ["state:\n" + "\n".join(f"  {leaf.path or 'observation'} {entrance(leaf)}" for leaf in leaves)]


def entrance(leaf: Leaf) -> str:
    """Returns an observation leaf's shape and what becomes of it: ``(84, 84, 4) -> 32x8x8/4 ... -> 512``."""
    kind = convolutions(leaf)
    steps = [str(leaf.shape)]
    if kind is not None:
        steps += [f"{filters} x {side}x{side}/{stride}" for filters, side, stride in kind.layers]
        return ARROW.join([*steps, str(kind.n_outputs)])
    how = {"categorical": " (one-hot)", "image": " (pixels / 255)"}.get(leaf.kind, "")
    return ARROW.join([*steps, f"{leaf.n_features}{how}"])
