"""Feature extractors: the names of Stable-Baselines3's, and those of one's own as ``equinox`` modules.

An extractor of one's own is a subclass of :class:`BaseFeaturesExtractor` with the constructor that Stable-Baselines3 calls,
and with a ``key`` for its random weights if it takes one::

    class Features(BaseFeaturesExtractor):
        linear: eqx.nn.Linear

        def __init__(self, observation_space, features_dim=32, *, key):
            super().__init__(observation_space, features_dim)
            self.linear = eqx.nn.Linear(observation_space.shape[0], features_dim, key=key)

        def forward(self, observations):
            return jax.nn.relu(self.linear(observations))

    PPO("MlpPolicy", env, policy_kwargs={"features_extractor_class": Features})

``forward`` takes one observation, or a batch of them, as float32: images in [0, 1] with the channels first, choices one-hot.
"""

from __future__ import annotations

import inspect
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import FrozenInstanceError
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.core.algorithm import PyTree
from rejeu.core.records import convert, parse_json
from rejeu.core.spaces import Leaf
from rejeu.core.types import Observation, Settings
from rejeu.envs.registry import are_plain
from rejeu.networks import ENCODERS, register_encoder
from rejeu.networks.layers import own_module
from rejeu.sb3.common.preprocessing import is_image_space, is_image_space_channels_first, preprocess_obs

PREFIX = "sb3:"
"""How the names of encoders that are extractors begin."""


class BaseFeaturesExtractor(eqx.Module):
    """Maps observations to features. Abstract: subclasses implement ``forward``.

    Args:
        observation_space: accepted.
        features_dim: number of features.
    """

    _features_dim: int = eqx.field(static=True)

    def __init__(self, observation_space: spaces.Space, features_dim: int = 0) -> None:
        self._features_dim = features_dim

    @property
    def features_dim(self) -> int:
        """The number of features."""
        return self._features_dim

    def forward(self, observations: Observation) -> Array:
        """Returns the features of one observation, or of a batch."""
        raise NotImplementedError(f"{type(self).__name__} does not define forward")

    def __call__(self, observations: Observation) -> Array:
        return self.forward(observations)


class FlattenExtractor(BaseFeaturesExtractor):
    """Observations as they are, in one vector."""

    def forward(self, observations: Observation) -> Array:
        return jnp.ravel(observations)


class NatureCNN(BaseFeaturesExtractor):
    """The name of rejeu's own convolutions; ``features_dim`` is the width of the layer after them."""


class CombinedExtractor(BaseFeaturesExtractor):
    """The name of rejeu's own encoder of a Dict; ``cnn_output_dim`` is the width for each image."""


def create_mlp(
    input_dim: int,
    output_dim: int,
    net_arch: Sequence[int],
    activation_fn: Callable[[Array], Array] = jax.nn.relu,
    squash_output: bool = False,
    with_bias: bool = True,
    *,
    key: Array | None = None,
) -> list[eqx.Module]:
    """Returns the layers of a network for ``equinox.nn.Sequential``; no output layer with ``output_dim`` of at most 0.

    ``key`` gives the random weights; None takes one from NumPy's global generator.
    """
    widths = [input_dim, *net_arch, *[output_dim] * (output_dim > 0)]
    key = jax.random.key(np.random.randint(2**31)) if key is None else key  # noqa: NPY002
    layers: list[eqx.Module] = []
    for i, (n_in, n_out) in enumerate(itertools.pairwise(widths)):
        layers.append(eqx.nn.Linear(n_in, n_out, use_bias=with_bias, key=jax.random.fold_in(key, i)))
        layers += [eqx.nn.Lambda(activation_fn)] * (i < len(net_arch))
    return layers + [eqx.nn.Lambda(jnp.tanh)] * bool(squash_output and layers)


def get_actor_critic_arch(net_arch: Any) -> tuple[list[int], list[int]]:
    """Returns the widths of actor and critic: those of a list for both, ``pi`` and ``qf`` of a dict."""
    each = (net_arch["pi"], net_arch["qf"]) if isinstance(net_arch, Mapping) else (net_arch, net_arch)
    return [*each[0]], [*each[1]]


def is_torch(value: object) -> bool:
    """Returns whether something is a class or an object of PyTorch, which need not be installed."""
    value_class = value if isinstance(value, type) else type(value)
    return any(base.__module__.partition(".")[0] == "torch" for base in value_class.__mro__)


class Prepared(eqx.Module):
    """An extractor that is given observations as they come."""

    extractor: Any
    leaves: tuple[Leaf, ...] = eqx.field(static=True)
    normalize_images: bool = eqx.field(static=True)

    def __call__(self, obs: PyTree) -> Array:
        """Maps a batch of observations to a batch of features."""
        return self.extractor(prepared(obs, self.leaves, self.normalize_images))


def prepared(obs: PyTree, leaves: tuple[Leaf, ...], normalize_images: bool) -> Observation:
    """Returns a batch of observations as extractors take them: a dict by path, or the only part as it is."""
    parts = {}
    for leaf in leaves:
        x = obs[leaf.path] if leaf.path else obs
        parts[leaf.path] = preprocess_obs(jnp.moveaxis(x, -1, 1) if _moves(leaf) else x, _space(leaf), normalize_images)
    return parts[""] if list(parts) == [""] else parts


def _moves(leaf: Leaf) -> bool:
    space = spaces.Box(0, 255, leaf.shape, np.uint8)
    return leaf.kind == "image" and is_image_space(space) and not is_image_space_channels_first(space)


def _space(leaf: Leaf) -> spaces.Space:
    if leaf.kind == "image":
        return spaces.Box(0, 255, (leaf.shape[-1], *leaf.shape[:-1]) if _moves(leaf) else leaf.shape, np.uint8)
    if leaf.kind == "categorical":
        return spaces.MultiDiscrete(list(leaf.sizes)) if leaf.shape else spaces.Discrete(leaf.sizes[0])
    return spaces.MultiBinary(leaf.shape) if leaf.kind == "binary" else spaces.Box(-np.inf, np.inf, leaf.shape)


def space_of(leaves: tuple[Leaf, ...]) -> spaces.Space:
    """Returns the space that an extractor is told: a Dict by path, or the space of the only leaf; images channels first."""
    parts: dict[str, spaces.Space] = {leaf.path: _space(leaf) for leaf in leaves}
    return parts[""] if list(parts) == [""] else spaces.Dict(parts)


def encoder_of(extractor: object, settings: Mapping[str, object], normalize_images: bool = True) -> Settings:
    """Returns the ``policy_kwargs`` of rejeu that stand for a feature extractor and its arguments.

    Raises:
        TypeError: for a class that is no ``equinox.Module``, such as one of PyTorch.
    """
    encoders = {
        None: ("features_dim", "cnn_output_dim"),
        NatureCNN: ("features_dim",),
        CombinedExtractor: ("cnn_output_dim",),
    }
    if isinstance(extractor, str):
        return {"encoder": extractor}
    if extractor in encoders:
        widths = [settings[key] for key in encoders[extractor] if key in settings]
        return {"cnn_features": widths[0]} if widths else {}
    if not (isinstance(extractor, type) and issubclass(extractor, eqx.Module)):
        raise TypeError(
            f"features_extractor_class={extractor!r} must be a subclass of BaseFeaturesExtractor, which is an equinox.Module "
            "here, not a PyTorch module; write its layers with equinox.nn, as docs/coming-from-sb3.md shows"
        )
    name = f"{PREFIX}{extractor.__name__} {json.dumps([dict(settings), normalize_images], default=repr)}"
    _register(name, extractor, settings, normalize_images)
    return {"encoder": name}


def _register(name: str, extractor: type[eqx.Module], settings: Mapping[str, object], normalize_images: bool) -> None:
    @register_encoder(name)
    def make(key: Array, leaves: tuple[Leaf, ...]) -> Any:
        takes_key = "key" in inspect.signature(extractor).parameters
        try:
            module = extractor(space_of(leaves), **settings, **({"key": key} if takes_key else {}))
        except FrozenInstanceError as error:
            raise TypeError(
                f"features_extractor_class={extractor.__name__}: {error}; an extractor is an equinox.Module here, with its "
                "layers of equinox.nn declared as fields and not those of PyTorch, as docs/coming-from-sb3.md shows"
            ) from None
        zeros = {leaf.path: np.zeros((1, *leaf.shape), leaf.dtype) for leaf in leaves}
        batch = prepared(zeros.get("", zeros), leaves, normalize_images)
        example = jax.tree.map(lambda x: x[0], batch)
        return Prepared(own_module(extractor.__name__, module, example)[0], leaves, normalize_images)


def register_again(name: object) -> None:
    """Makes the extractor that a model file names known again, if a class of that name is defined. Imports nothing.

    Its arguments must be numbers up to a million, words, or lists of these; else it must be given again.
    """
    if not isinstance(name, str) or not name.startswith(PREFIX) or name in ENCODERS:
        return
    title, _, text = name.removeprefix(PREFIX).partition(" ")
    settings, normalize_images = convert(parse_json(text), tuple[dict[str, Any], bool])
    each = [item for value in settings.values() for item in (value if isinstance(value, list) else [value])]
    if not all(item is None or are_plain({"value": item}) for item in each):
        return  # a file may ask the user's class for no path and no size without end
    for extractor in subclasses(BaseFeaturesExtractor):
        if extractor.__name__ == title:
            _register(name, extractor, settings, normalize_images)


def subclasses(base: type[Any]) -> Iterator[type[Any]]:
    """Yields the subclasses of a class, and theirs."""
    for subclass in base.__subclasses__():
        yield subclass
        yield from subclasses(subclass)
