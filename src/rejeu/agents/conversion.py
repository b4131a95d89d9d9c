"""The networks and optimizers of Stable-Baselines3's policies as those of rejeu, by name.

Each array of ours is a function of theirs (:data:`Made`): PyTorch's weights are transposed, convolutions read channels
last, critics are stacked, and policies of Box actions, which give actions in the environment's unit there, give them in
[-1, 1] here. The same functions convert the moments of Adam and RMSprop, because all of them are linear but for a shift.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from rejeu.core.records import Malformed
from rejeu.core.spaces import Leaf, bounded

EXTRACTORS = ("NatureCNN", "FlattenExtractor", "CombinedExtractor")
"""The feature extractors that have a counterpart here."""
ALL = slice(None)
BUFFERS = ("ra_mean", "ra_var", "steps")
"""Ends of the names of arrays that are no parameters."""


class View(NamedTuple):
    """One of three collections of arrays by PyTorch's names: parameters, or first or second moments of their gradients."""

    get: Callable[[str], np.ndarray]
    power: int
    """How a factor of the parameters enters: 1, of first moments -1, of second moments -2."""

    def scaled(self, array: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """Returns ``factor * array`` of parameters, and the moments that go with it."""
        return array * factor**self.power

    def shifted(self, array: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Returns ``array + shift`` of parameters; the moments do not change."""
        return array + shift if self.power == 1 else array


Made = Callable[[View], np.ndarray]
Network = dict[str, Made]
"""Every array of a network of ours by its name."""


class Part(NamedTuple):
    """One field of the state of an algorithm."""

    field: str
    network: Network
    optimizer: str = ""
    """The field with its optimizer; empty for targets."""
    file: str = ""
    """The optimizer's file, without ``.optimizer.pth``."""
    prefix: str = ""
    """How the names of its parameters begin in PyTorch."""


class OriginalPolicy(NamedTuple):
    """A policy of Stable-Baselines3."""

    weights: Mapping[str, np.ndarray]
    """By PyTorch's names, in the order of its modules."""
    leaves: tuple[Leaf, ...]
    """Of observations, in our order."""
    keys: list[str]
    """Keys of a Dict observation in the file's order, in which their features follow each other; else empty."""
    action_space: spaces.Space
    squashes: bool
    """Whether an on-policy algorithm squashes its actions."""

    def layers(self, prefix: str) -> list[str]:
        """Returns the names of the linear layers of a sequence, in their order."""
        pattern = re.compile(rf"{re.escape(prefix)}\.(\d+)\.weight")
        matches = [match for key in self.weights if (match := pattern.fullmatch(key)) and self.weights[key].ndim == 2]
        return [f"{prefix}.{i}" for i in sorted(int(match[1]) for match in matches)]

    def widths(self, prefix: str) -> list[int]:
        """Returns the numbers of outputs of these layers."""
        return [int(self.weights[f"{name}.weight"].shape[0]) for name in self.layers(prefix)]

    def has(self, prefix: str) -> bool:
        """Returns whether there is a module of that name."""
        return any(key.startswith(f"{prefix}.") for key in self.weights)

    def order(self, extra: int = 0) -> np.ndarray | slice:
        """Returns the index in theirs of each feature of ours, with ``extra`` further inputs at the end."""
        sizes = {leaf.path: self.n_features(leaf) for leaf in self.leaves}
        if not self.keys or self.keys == [*sizes]:
            return ALL
        starts = dict(zip(self.keys, np.cumsum([0, *(sizes[key] for key in self.keys)]).tolist(), strict=False))
        index = [starts[path] + i for path, size in sizes.items() for i in range(size)]
        return np.array(index + [len(index) + i for i in range(extra)])

    def is_image(self, leaf: Leaf) -> bool:
        """Returns whether convolutions read a leaf, which may be of floats without ``normalize_images``."""
        return any((f"extractors.{leaf.path}.cnn." if leaf.path else "extractor.cnn.") in key for key in self.weights)

    def n_features(self, leaf: Leaf) -> int:
        """Returns the features of a leaf."""
        if not self.is_image(leaf):
            return leaf.n_features
        end = f"extractors.{leaf.path}.linear.0.bias" if leaf.path else "features_extractor.linear.0.bias"
        return next((value.size for key, value in self.weights.items() if key.endswith(end)), 0)


def under(prefix: str, network: Network) -> Network:
    """Returns the arrays of a network as a part of that name."""
    return {f"{prefix}.{name}": make for name, make in network.items()}


def linear(name: str, order: np.ndarray | slice = ALL) -> Network:
    """Returns a linear layer whose inputs are in another order."""
    return {"weight": lambda view: view.get(f"{name}.weight").T[order], "bias": lambda view: view.get(f"{name}.bias")}


def linear_or_zero(name: str, policy: OriginalPolicy) -> Network:
    """Returns a linear layer, whose bias is 0 if it has none there."""
    layer = linear(name)
    if f"{name}.bias" not in policy.weights:
        layer["bias"] = lambda view: np.zeros(len(view.get(f"{name}.weight")), np.float32)
    return layer


def action_layers(policy: OriginalPolicy) -> list[str]:
    """Returns the names of the layers of ARS, whose only one has no number in older versions."""
    return policy.layers("action_net") or ["action_net"]


def searched(policy: OriginalPolicy) -> Network:
    """Returns the policy of ARS, whose actions are clipped where it is linear, and else squashed."""
    *hidden, last = action_layers(policy)
    if any(f"{name}.bias" not in policy.weights for name in hidden):
        raise Malformed("its hidden layers have no bias")
    head = linear_or_zero(last, policy)
    if isinstance(policy.action_space, spaces.Box) and not hidden:
        head = in_unit_range(policy.action_space, head)
    return plain(policy, "features_extractor", hidden, head)


def mlp(names: Sequence[str], order: np.ndarray | slice) -> Network:
    """Returns hidden layers."""
    layers: Network = {}
    for i, name in enumerate(names):
        layers |= under(f"layers.{i}", linear(name, order if i == 0 else ALL))
    return layers


def encoder(policy: OriginalPolicy, prefix: str) -> Network:
    """Returns the CNNs of all images."""
    network: Network = {}
    images = [leaf for leaf in policy.leaves if policy.is_image(leaf)]
    for i, leaf in enumerate(images):
        base = f"{prefix}.extractors.{leaf.path}" if leaf.path else prefix
        for j in range(3):
            network |= under(f"images.{i}.layers.{j}", convolution(f"{base}.cnn.{2 * j}"))
        network |= under(f"images.{i}.linear", {**linear(f"{base}.linear.0"), "weight": flattened(base)})
    return network


def convolution(name: str) -> Network:
    """Returns a convolution: the axes of its kernel are rows, columns, channels and filters here."""
    weight = lambda view: view.get(f"{name}.weight").transpose(2, 3, 1, 0)  # noqa: E731
    return {"weight": weight, "bias": lambda view: view.get(f"{name}.bias")}


def flattened(base: str) -> Made:
    """Returns the linear layer after convolutions, whose inputs are channels of pixels there and pixels of channels here."""

    def made(view: View) -> np.ndarray:
        n_channels = view.get(f"{base}.cnn.4.bias").size
        weight = view.get(f"{base}.linear.0.weight")
        return weight.reshape(len(weight), n_channels, -1).transpose(2, 1, 0).reshape(-1, len(weight))

    return made


def joined(networks: Sequence[Network], join: Callable[..., np.ndarray]) -> Network:
    """Returns networks of equal structure joined array by array."""
    return {name: lambda view, name=name: join([network[name](view) for network in networks]) for name in networks[0]}  # type: ignore[misc]


def plain(policy: OriginalPolicy, extractor: str, hidden: Sequence[str], head: Network, extra: int = 0) -> Network:
    """Returns an encoder, hidden layers and a head; ``extra`` is the number of inputs besides the features."""
    order = policy.order(extra)
    head = head if hidden else reordered(head, order)
    return under("encoder", encoder(policy, extractor)) | under("torso", mlp(hidden, order)) | under("head", head)


def reordered(head: Network, order: np.ndarray | slice) -> Network:
    """Returns a layer whose inputs are in another order."""
    weight = head["weight"]
    return {**head, "weight": lambda view: weight(view)[order]}


def q_network(policy: OriginalPolicy, prefix: str, name: str, n_quantiles: int) -> Network:
    """Returns a network of the values of all actions; quantiles of an action are adjacent here, and apart there."""
    *hidden, last = policy.layers(f"{prefix}.{name}")
    head = linear(last)
    if n_quantiles > 1:
        apart = lambda x: np.moveaxis(x.reshape(*x.shape[:-1], n_quantiles, -1), -1, -2).reshape(x.shape)  # noqa: E731
        head = {key: lambda view, make=make: apart(make(view)) for key, make in head.items()}  # type: ignore[misc]
    return plain(policy, f"{prefix}.features_extractor", hidden, head)


def gaussian_actor(policy: OriginalPolicy, prefix: str) -> Network:
    """Returns an actor whose head gives mean and log standard deviation, or the mean only with state-dependent noise."""
    hidden = policy.layers(f"{prefix}.latent_pi")
    if (log_std := f"{prefix}.log_std") in policy.weights:
        network = plain(policy, f"{prefix}.features_extractor", hidden, linear(f"{prefix}.mu.0"))
        return network | {"log_std": lambda view: view.get(log_std)}
    head = joined([linear(f"{prefix}.mu"), linear(f"{prefix}.log_std")], lambda parts: np.concatenate(parts, axis=-1))
    return plain(policy, f"{prefix}.features_extractor", hidden, head)


def actor(policy: OriginalPolicy, prefix: str) -> Network:
    """Returns a deterministic actor."""
    *hidden, last = policy.layers(f"{prefix}.mu")
    return plain(policy, f"{prefix}.features_extractor", hidden, linear(last))


def critics(policy: OriginalPolicy, prefix: str) -> list[Network]:
    """Returns the critics."""
    networks: list[Network] = []
    while hidden := policy.layers(f"{prefix}.qf{len(networks)}"):
        last = hidden.pop()
        n_actions = int(np.prod(policy.action_space.shape or ()))
        networks.append(plain(policy, f"{prefix}.features_extractor", hidden, linear(last), n_actions))
    if not networks:
        raise Malformed(f"policy.pth has no critics under {prefix}")
    return networks


def renormalized(policy: OriginalPolicy, network: Network, prefix: str, extra: int = 0) -> Network:
    """Returns a network of CrossQ: ``network`` with the normalization layers that are in the sequence ``prefix``."""
    norms = [key.split(".")[-2] for key in policy.weights if key.startswith(f"{prefix}.") and key.endswith(".ra_mean")]
    names = {"scale": "scale", "offset": "bias", "mean": "ra_mean", "variance": "ra_var", "n_batches": "steps"}
    for i, index in enumerate(sorted(norms, key=int)):
        for ours, theirs in names.items():
            order = policy.order(extra) if i == 0 and theirs != "steps" else ...
            make = lambda view, name=f"{prefix}.{index}.{theirs}", order=order: view.get(name)[order]  # noqa: E731
            network[f"torso.norms.{i}.{ours}"] = make
    return network


def actor_critic(policy: OriginalPolicy, latent: bool) -> Network:
    """Returns policy and value of an on-policy algorithm.

    Layers that both shared in files of Stable-Baselines3 before 1.8 are copied to each.

    Args:
        policy: with its weights.
        latent: whether both read the output of recurrent cells in place of features.
    """
    order = ALL if latent else policy.order()
    shared = policy.layers("mlp_extractor.shared_net")
    network: Network = under("torso", mlp(shared + policy.layers("mlp_extractor.policy_net"), order))
    network |= under("value_torso", mlp(shared + policy.layers("mlp_extractor.value_net"), order))
    action, value = linear("action_net"), linear("value_net")
    if isinstance(policy.action_space, spaces.Box):
        action |= {"log_std": lambda view: view.get("log_std")}
        if not policy.squashes:
            action = in_unit_range(policy.action_space, action, "log_std")
        network["log_std"] = action.pop("log_std")
    for name, head in (("", action), ("value_", value)):
        network |= under(f"{name}head", head if f"{name}torso.layers.0.bias" in network else reordered(head, order))
    return network if latent else network | encoders(policy)


def in_unit_range(space: spaces.Box, head: Network, log_std: str = "") -> Network:
    """Returns the head of a policy in the environment's unit as one in [-1, 1]: as far as actions are bounded."""
    low, high = space.low.ravel().astype(np.float64), space.high.ravel().astype(np.float64)
    is_bounded = bounded(space).ravel()
    with np.errstate(invalid="ignore"):
        half, middle = np.where(is_bounded, 0.5 * (high - low), 1.0), np.where(is_bounded, 0.5 * (high + low), 0.0)
    weight, bias = head["weight"], head["bias"]
    network: Network = {
        "weight": lambda view: view.scaled(weight(view), 1.0 / half),
        "bias": lambda view: view.scaled(view.shifted(bias(view), -middle), 1.0 / half),
    }
    return network | ({"log_std": lambda view: view.shifted(view.get(log_std), -np.log(half))} if log_std else {})


def encoders(policy: OriginalPolicy) -> Network:
    """Returns the encoder of the policy, and that of the value where it has its own."""
    extractor = "pi_features_extractor" if policy.has("pi_features_extractor") else "features_extractor"
    net = under("encoder", encoder(policy, extractor))
    return net if shares_extractor(policy) else net | under("value_encoder", encoder(policy, "vf_features_extractor"))


def shares_extractor(policy: OriginalPolicy) -> bool:
    """Returns whether policy and value of an on-policy algorithm read images through the same convolutions."""
    pairs = [(key, f"vf{key.removeprefix('pi')}") for key in policy.weights if key.startswith("pi_features_extractor.")]
    return all(address(policy.weights[pi]) == address(policy.weights[vf]) for pi, vf in pairs)


def address(array: np.ndarray) -> int:
    """Returns where an array begins in memory, by which two names of one tensor are known."""
    return int(array.__array_interface__["data"][0])


def cell(policy: OriginalPolicy, name: str) -> Network:
    """Returns the LSTM of that name, whose gates are in the same order."""
    pairs = {"recurrent": "weight_hh_l0", "bias": "bias_ih_l0", "recurrent_bias": "bias_hh_l0"}
    network: Network = {ours: lambda view, key=f"{name}.{theirs}": view.get(key).T for ours, theirs in pairs.items()}  # type: ignore[misc]
    return network | {"inputs": lambda view: view.get(f"{name}.weight_ih_l0").T[policy.order()]}


def parts_of(algorithm: str, policy: OriginalPolicy, n_quantiles: int) -> list[Part]:
    """Returns how the state of an algorithm is made of a policy, field by field.

    Raises:
        Malformed: for a policy of another structure.
    """
    stack = lambda networks: joined(networks, np.stack)  # noqa: E731
    if algorithm in ("DQN", "QRDQN"):
        name, field = ("q_net", "") if algorithm == "DQN" else ("quantile_net", "outputs")
        nest = lambda network: under(field, network) if field else network  # noqa: E731
        online = nest(q_network(policy, name, name, n_quantiles))
        target = nest(q_network(policy, f"{name}_target", name, n_quantiles))
        return [Part("network", online, "optimizer", "policy", f"{name}."), Part("target_network", target)]
    if algorithm in ("SAC", "TQC", "CrossQ"):
        network, online_critics = gaussian_actor(policy, "actor"), critics(policy, "critic")
        if algorithm == "CrossQ":
            network = renormalized(policy, network, "actor.latent_pi")
            n_actions = int(np.prod(policy.action_space.shape or ()))
            numbered = enumerate(online_critics)
            online_critics = [renormalized(policy, critic, f"critic.qf{i}", n_actions) for i, critic in numbered]
        parts = [Part("actor", network, "actor_optimizer", "actor", "actor.")]
        parts += [Part("critics", stack(online_critics), "critics_optimizer", "critic", "critic.")]
        if algorithm != "CrossQ":
            parts.append(Part("target_critics", stack(critics(policy, "critic_target"))))
        return parts
    if algorithm in ("TD3", "DDPG"):
        name, gather = ("critics", stack) if algorithm == "TD3" else ("critic", lambda networks: networks[0])
        return [
            Part("actor", actor(policy, "actor"), "actor_optimizer", "actor", "actor."),
            Part(name, gather(critics(policy, "critic")), f"{name}_optimizer", "critic", "critic."),
            Part("target_actor", actor(policy, "actor_target")),
            Part(f"target_{name}", gather(critics(policy, "critic_target"))),
        ]
    if algorithm == "ARS":
        return [Part("actor.network", searched(policy))]
    if algorithm == "RecurrentPPO":
        network = under("readers", actor_critic(policy, latent=True)) | encoders(policy)
        names = ["lstm_actor", *(["lstm_critic"] if policy.has("lstm_critic") else [])]
        for i, name in enumerate(names):
            network |= under(f"cells.{i}", cell(policy, name))
        return [Part("network", network, "optimizer", "policy")]
    return [Part("network", actor_critic(policy, latent=False), "optimizer", "policy")]


def converted(
    parts: Sequence[Part], policy: OriginalPolicy, optimizers: Mapping[str, object]
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Returns the arrays of the state by name, and the files of the optimizers that were left out.

    Args:
        parts: what :func:`parts_of` returned.
        policy: with its weights.
        optimizers: the states of PyTorch's optimizers by the names of their files.

    Raises:
        Malformed: if the policy lacks a weight.
    """

    def weight(name: str) -> np.ndarray:
        if name not in policy.weights:
            raise Malformed(f"policy.pth has no {name}: the policy is of another structure than Stable-Baselines3's")
        return policy.weights[name]

    arrays: dict[str, np.ndarray] = {}
    left_out: list[str] = []
    for component in parts:
        views = {component.field: View(weight, 1)}
        if component.optimizer:
            count, moments = moments_of(optimizers.get(f"{component.file}.optimizer"), policy, component.prefix)
            left_out += [] if moments else [f"{component.file}.optimizer.pth"]
            if "exp_avg" in moments:
                arrays[f"{component.optimizer}.count"] = np.asarray(count)
            for moment, name, power in (("exp_avg", "mu", -1), ("exp_avg_sq", "nu", -2), ("square_avg", "nu", -2)):
                if moment in moments:
                    views[f"{component.optimizer}.{name}"] = View(moments[moment], power)
        for field, view in views.items():
            arrays |= {f"{field}.{name}": make(view) for name, make in component.network.items()}
    return arrays, left_out


def moments_of(
    optimizer: Any, policy: OriginalPolicy, prefix: str
) -> tuple[int, dict[str, Callable[[str], np.ndarray]]]:
    """Returns the steps of an optimizer and its moments by PyTorch's names, each as a function of the parameter's name.

    There are none unless they are those of Adam or RMSprop on these parameters. PyTorch numbers parameters in the order
    of their modules, and counts one that has two names once; those that had no gradient have no moments.
    """
    state = optimizer.get("state") if isinstance(optimizer, dict) else None
    if not isinstance(state, dict) or not state:
        return 0, {}
    params = {name: i for i, name in enumerate(optimizer["param_groups"][0]["params"])}
    n_params = len(params)
    state = {params[name]: slots for name, slots in state.items()}
    keys = {key for slots in state.values() for key in slots}
    moment_names = sorted(keys & {"exp_avg", "exp_avg_sq", "square_avg"})
    # An extractor that actor and critic share is the actor's, and older versions of DQN number the target's parameters too.
    for begin, without in ((prefix, "/"), (prefix, "features_extractor"), ("", "/")):
        names = [name for name in policy.weights if name.startswith(begin) and without not in name]
        names = [name for name in names if not name.endswith(BUFFERS)]
        places = dict.fromkeys(address(policy.weights[name]) for name in names)
        if len(places) == n_params:
            break
    else:
        return 0, {}
    number = dict(zip(places, range(n_params), strict=True))
    shapes = {number[address(policy.weights[name])]: policy.weights[name].shape for name in names}
    fits = all(slots[moment].shape == shapes.get(i) for i, slots in state.items() for moment in moment_names)
    if moment_names not in (["exp_avg", "exp_avg_sq"], ["square_avg"]) or "max_exp_avg_sq" in keys or not fits:
        return 0, {}

    def moments(moment: str) -> Callable[[str], np.ndarray]:
        def get(name: str) -> np.ndarray:
            weight = policy.weights[name]
            slots = state.get(number.get(address(weight)))
            return np.zeros(weight.shape, np.float32) if slots is None else slots[moment]

        return get

    return max(int(slots["step"]) for slots in state.values()), {moment: moments(moment) for moment in moment_names}
