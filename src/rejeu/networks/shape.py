"""What shape a user wants an agent's networks to have (``policy_kwargs``), checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from jax import Array

from rejeu.networks.layers import ACTIVATIONS


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
    """Normalise each hidden layer before its nonlinearity: steadier critics, above all at high learning rates."""
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
    torso: Callable[[Array, int], Any] | None = None
    """Hidden layers of your own in every network: ``torso(key, n_inputs)`` returns an ``equinox.Module`` that maps
    ``(batch, n_inputs)`` to ``(batch, n_outputs)`` and has the static attribute ``n_outputs``. A model file keeps its
    name only: give it again to ``load``."""

    def __post_init__(self) -> None:
        put = lambda key, value: object.__setattr__(self, key, value)  # noqa: E731
        arch = self.net_arch
        if isinstance(arch, Mapping):
            if unknown := set(arch) - {"pi", "qf"}:
                raise ValueError(f"net_arch has the unknown keys {sorted(unknown)}; expected 'pi' and 'qf'")
            for key in ("pi", "qf"):
                if key in arch and getattr(self, key) is None:
                    put(key, arch[key])
            put("net_arch", None)
        for key in ("net_arch", "pi", "qf"):
            put(key, _widths(key, getattr(self, key)))
        for key in BRANCHES:
            put(key, _widths(key, getattr(self, key)) or ())
        for key in ("n_blocks", "width"):
            value = getattr(self, key)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{key}={value!r} must be a whole number of at least 1")
        name = self.activation_fn if isinstance(self.activation_fn, str) else self.activation_fn.__name__
        if name.lower() not in ACTIVATIONS:
            raise ValueError(f"activation_fn={name!r} is unknown; choose one of {', '.join(ACTIVATIONS)}")
        put("activation_fn", name.lower())
        if not isinstance(self.layer_norm, bool):
            raise TypeError(f"layer_norm={self.layer_norm!r} must be True or False")
        self._check_shape()

    def _check_shape(self) -> None:
        """Raises where settings contradict each other: there is one way to shape a network at a time."""
        if self.architecture not in ("mlp", "simba"):
            raise ValueError(f"architecture={self.architecture!r} must be 'mlp' or 'simba'")
        if self.torso is not None and not callable(self.torso):
            raise TypeError(f"torso={self.torso!r} must be a class or function: torso(key, n_inputs) -> equinox.Module")
        arch = [key for key in ("net_arch", "pi", "qf") if getattr(self, key) is not None]
        branches = [key for key in BRANCHES if getattr(self, key)]
        simba = ["architecture='simba'"] * (self.architecture == "simba")
        own = ["torso"] * (self.torso is not None)
        norm = ["layer_norm"] * self.layer_norm
        pairs = [(branches, arch), (branches, simba), (simba, norm)]
        for one, other in pairs + [(own, others) for others in (arch, branches, simba, norm)]:
            if one and other:
                raise ValueError(f"policy_kwargs: {one[0]} leaves {other[0]} without meaning; give one of the two")
        if simba and any(len(set(getattr(self, key))) != 1 for key in arch):
            raise ValueError(
                f"architecture='simba' has one width throughout: {arch[0]}={list(getattr(self, arch[0]))} must hold "
                "equal numbers, one a block, such as [128, 128]"
            )

    @property
    def has_branches(self) -> bool:
        """Whether the networks are nets of branches."""
        return any(getattr(self, key) for key in BRANCHES)

    def actor_widths(self, default: tuple[int, ...]) -> tuple[int, ...]:
        """Returns the widths of the actor's hidden layers: of its last part with branches, of each block with SimBa."""
        return self._chosen(self.pi, self.actor_layers, default)

    def critic_widths(self, default: tuple[int, ...]) -> tuple[int, ...]:
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


def settled(shape: Mapping[str, Any], widths: Widths) -> dict[str, Any]:
    """Returns settings that say which ``widths`` the settings ``shape`` leave to the default.

    There are none where the hidden layers are of another kind: branches, SimBa or the user's own.
    """
    is_plain = shape.get("torso") is None and shape.get("architecture", "mlp") == "mlp"
    if not is_plain or any(shape.get(key) for key in BRANCHES) or shape.get("net_arch") is not None:
        return {}
    if widths.actor == widths.critics:
        return {"net_arch": widths.actor}
    return {key: width for key, width in zip(("pi", "qf"), widths, strict=True) if shape.get(key) is None}


def _widths(key: str, value: Any) -> tuple[int, ...] | None:
    if value is None:
        return None
    if isinstance(value, str) or not isinstance(value, Sequence):
        raise TypeError(f"{key}={value!r} must be a list of layer widths, such as [256, 256]")
    if not all(isinstance(width, int) and not isinstance(width, bool) and width > 0 for width in value):
        raise ValueError(f"{key}={list(value)} must hold positive whole numbers, such as [256, 256]")
    return tuple(value)
