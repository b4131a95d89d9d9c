"""The settings of the networks (``policy_kwargs``)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from jax import Array

from rejeu.core.spaces import Leaf
from rejeu.core.types import PyTree, Settings
from rejeu.core.validation import MOST_LAYERS, MOST_WIDTH, assign, choice, coerce, flag, number, whole
from rejeu.networks.layers import ACTIVATIONS, find_encoder


class Widths(NamedTuple):
    """Widths of hidden layers."""

    actor: tuple[int, ...]
    critics: tuple[int, ...]


BRANCHES = ("state_layers", "action_layers", "common_layers", "critic_layers", "actor_layers")
"""Settings of ``PolicyConfig`` of which any one turns the branch shape on."""


@dataclass(frozen=True)
class PolicyConfig:
    """The shape of an agent's networks (Stable-Baselines3's ``policy_kwargs``)."""

    net_arch: tuple[int, ...] | None = None
    """Widths of the hidden layers of actor and critics; a mapping ``{"pi": [...], "qf": [...]}`` sets them apart.
    None leaves the algorithm's own default, which may be another on images."""
    pi: tuple[int, ...] | None = None
    """Widths of the actor's hidden layers where they differ from ``net_arch``."""
    qf: tuple[int, ...] | None = None
    """Widths of each critic's hidden layers where they differ from ``net_arch``."""
    activation_fn: str = "relu"
    """Nonlinearity after each hidden layer: relu, tanh, elu, gelu, silu, leaky_relu or sigmoid. A function or class
    of that name (``jax.nn.relu``, ``torch.nn.ReLU``) is accepted too."""
    layer_norm: bool = False
    """Normalize each hidden layer before its nonlinearity: steadier critics, above all at high learning rates."""
    dropout: float = 0.0
    """Share of each critic's hidden units that is set to 0 at random while it learns and is learned from (DroQ, arXiv
    2110.02034; SAC and TQC). A larger share regularizes more."""
    cnn_layer_norm: bool = False
    """Normalize the layers of the CNN of an image likewise, each pixel over its channels."""
    cnn_features: int | None = None
    """Width of the layer after the convolutions of each image. None: 512, or 256 for images below 36 pixels."""
    normalize_images: bool = True
    """Divide ``uint8`` images by 255. False takes them as they are, and reads arrays of three axes of any type as images,
    for environments that scale them."""
    architecture: Literal["mlp", "simba"] = "mlp"
    """``simba``: residual blocks with layer norm (arXiv 2410.09754) in place of plain layers; ``net_arch`` then holds
    one number a block, all equal, and is made from ``n_blocks`` and ``width`` where it is None."""
    n_blocks: int = 2
    """Residual blocks of ``simba`` in each network. Raising it computes deeper and slower."""
    width: int = 128
    """Width of ``simba``'s residual stream; inside a block it is 4 times that."""
    state_layers: tuple[int, ...] = ()
    """Widths of the branch that only the observation goes through. Any of the five branch settings turns the branch
    shape on: critics join a state and an action branch, the actor has the state branch alone."""
    action_layers: tuple[int, ...] = ()
    """Widths of the critics' branch that only the action goes through."""
    common_layers: tuple[int, ...] = ()
    """Widths after the branches have met; actor and critics have layers of this shape each, they share no weights."""
    critic_layers: tuple[int, ...] = ()
    """Widths between the common layers and the critics' values."""
    actor_layers: tuple[int, ...] = ()
    """Widths between the common layers and the actor's outputs."""
    encoder: Callable[[Array, tuple[Leaf, ...]], PyTree] | str | None = None
    """Encoder of your own in every network, such as another CNN: ``encoder(key, leaves)`` returns an ``equinox.Module``
    that maps an observation to a vector; or its name, see ``rejeu.networks.register_encoder``. A model file keeps its name
    only: give it again to ``load``, unless it is registered."""
    torso: Callable[[Array, int], PyTree] | None = None
    """Hidden layers of your own in every network: ``torso(key, n_inputs)`` returns an ``equinox.Module`` that maps
    ``(n_inputs,)`` to ``(n_outputs,)``, or batches of these. A model file keeps its name only: give it again to
    ``load``."""
    head: Callable[[Array, int, int], PyTree] | None = None
    """Last layer of your own in every network: ``head(key, n_inputs, n_outputs)`` returns an ``equinox.Module``
    likewise."""

    def __post_init__(self) -> None:
        if isinstance(self.net_arch, Mapping):
            split_net_arch(self, {"pi": "pi", "qf": "qf"})
        coerce(self, ("net_arch", "pi", "qf"), layer_widths, optional=True)
        coerce(self, BRANCHES, layer_widths)
        coerce(self, ("n_blocks", "width"), whole, least=1)
        coerce(self, "activation_fn", activation_name)
        coerce(self, ("layer_norm", "cnn_layer_norm", "normalize_images"), flag)
        coerce(self, "dropout", number, least=0, most=0.9)
        coerce(self, "cnn_features", whole, least=1, optional=True)
        coerce(self, "architecture", choice, among=("mlp", "simba"))
        self._check_shape()

    def _check_shape(self) -> None:
        """Raises where settings contradict each other: there is one way to shape a network at a time."""
        for key, module in (("encoder", find_encoder(self.encoder)), ("torso", self.torso), ("head", self.head)):
            if module is not None and not callable(module):
                raise TypeError(f"{key}={module!r} must be a class or function that returns an equinox.Module")
        arch = [key for key in ("net_arch", "pi", "qf") if getattr(self, key) is not None]
        branches = [key for key in BRANCHES if getattr(self, key)]
        simba = ["architecture='simba'"] * (self.architecture == "simba")
        torso = ["torso"] * (self.torso is not None)
        norm = ["layer_norm"] * self.layer_norm + ["dropout"] * (self.dropout > 0)
        pairs = [(branches, arch), (branches, simba), (simba, norm)]
        for settings, conflicting in pairs + [(torso, others) for others in (arch, branches, simba, norm)]:
            if settings and conflicting:
                raise ValueError(f"policy_kwargs: {settings[0]} conflicts with {conflicting[0]}; give one of the two")
        if simba and any(len(set(getattr(self, key))) != 1 for key in arch):
            raise ValueError(
                f"architecture='simba' has one width throughout: {arch[0]}={list(getattr(self, arch[0]))} must hold "
                "equal numbers, one a block, such as [128, 128]"
            )

    @property
    def has_branches(self) -> bool:
        """Whether the networks are nets of branches."""
        return any(getattr(self, key) for key in BRANCHES)

    def actor_widths(self, default: tuple[int, ...] = ()) -> tuple[int, ...]:
        """Returns the widths of the actor's hidden layers: of its last part with branches, of each block with SimBa."""
        return self._chosen(self.pi, self.actor_layers, default)

    def critic_widths(self, default: tuple[int, ...] = ()) -> tuple[int, ...]:
        """Returns the widths of each critic's hidden layers, likewise."""
        return self._chosen(self.qf, self.critic_layers, default)

    def _chosen(
        self, arch: tuple[int, ...] | None, branch: tuple[int, ...], default: tuple[int, ...]
    ) -> tuple[int, ...]:
        if self.torso is not None:
            return ()
        if self.has_branches:
            return branch
        simba = (self.width,) * self.n_blocks if self.architecture == "simba" else default
        return next(widths for widths in (arch, self.net_arch, simba) if widths is not None)


def settled(shape: Mapping[str, object], widths: Widths) -> Settings:
    """Returns the settings of widths that the settings ``shape`` leave to the default ``widths``.

    There are none where the hidden layers are of another kind: branches, SimBa or the user's own.
    """
    is_plain = shape.get("torso") is None and shape.get("architecture", "mlp") == "mlp"
    if not is_plain or any(shape.get(key) for key in BRANCHES) or shape.get("net_arch") is not None:
        return {}
    if widths.actor == widths.critics:
        return {"net_arch": widths.actor}
    return {key: width for key, width in zip(("pi", "qf"), widths, strict=True) if shape.get(key) is None}


def split_net_arch(config: Any, fields: Mapping[str, str]) -> None:
    """Moves the entries of a ``net_arch`` that is a mapping to the fields of these names.

    Raises:
        ValueError: for an unknown entry.
    """
    arch = dict(config.net_arch)
    if unknown := set(arch) - set(fields):
        expected = " and ".join(map(repr, fields))
        raise ValueError(f"net_arch has the unknown keys {sorted(unknown)}; expected {expected}")
    widths = {field: arch.get(key) for key, field in fields.items() if getattr(config, field) is None}
    assign(config, net_arch=None, **widths)


def activation_name(key: str, value: object) -> str:
    """Returns the name of an activation function, from the name or from a function or class of that name."""
    name = value if isinstance(value, str) else getattr(value, "__name__", repr(value))
    return choice(key, name.lower(), ACTIVATIONS)


def layer_widths(key: str, value: object) -> tuple[int, ...]:
    """Returns the widths of hidden layers."""
    if value is None:
        return ()
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise TypeError(f"{key}={value!r} must be a list of layer widths, such as [256, 256]")
    if len(value) > MOST_LAYERS:
        raise ValueError(f"{key} has {len(value)} layers, expected {MOST_LAYERS} at most")
    if not all(isinstance(width, int) and not isinstance(width, bool) and 0 < width <= MOST_WIDTH for width in value):
        raise ValueError(f"{key}={list(value)} must hold positive whole numbers up to {MOST_WIDTH}, such as [256, 256]")
    return tuple(value)
