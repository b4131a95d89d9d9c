"""The deterministic policy of a model file in NumPy, for processes without JAX."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from rejeu.algorithms.catalog import CATALOG
from rejeu.checkpoints.run_folder import find_model
from rejeu.core import checkpoint, spaces
from rejeu.core.errors import CheckpointError
from rejeu.core.spaces import Leaf
from rejeu.core.validation import LARGEST_VALUE, MOST_OUTPUTS, number, whole

Function = Callable[[np.ndarray], np.ndarray]
GELU = math.sqrt(2 / math.pi)
ACTIVATIONS: dict[str, Function] = {
    "relu": lambda x: np.maximum(x, 0.0),
    "tanh": np.tanh,
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0.0))),
    "gelu": lambda x: 0.5 * x * (1.0 + np.tanh(GELU * (x + 0.044715 * x * x * x))),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
    "leaky_relu": lambda x: np.where(x >= 0, x, 0.01 * x),
    "leakyrelu": lambda x: np.where(x >= 0, x, 0.01 * x),
    "sigmoid": lambda x: 1.0 / (1.0 + np.exp(-x)),
}
WRONG = (ArithmeticError, AttributeError, LookupError, TypeError, ValueError)


class NumpyPolicy:
    """The deterministic policy of an agent with fully connected layers."""

    def __init__(self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], largest: int) -> None:
        """Builds the policy from the header and the arrays of a model file."""
        config, name = header["config"], header["algorithm"]
        self._name = name
        self.observation_space = spaces.rebuild(header["observation_space"], largest)
        self.action_space = spaces.rebuild(header["action_space"], largest)
        self._leaves = spaces.leaves(self.observation_space)
        is_normalized = config.get("normalize") is not None
        self._arrays = {key.rpartition("learner.")[2]: array for key, array in arrays.items()}
        scaled = self._normalizations(config["normalize"]) if is_normalized else [None] * len(self._leaves)
        self._encoders = [encoder(leaf, scale) for leaf, scale in zip(self._leaves, scaled, strict=True)]
        self._shape = config["policy_kwargs"]
        n_outputs = _count(config, "n_quantiles") if name == "QRDQN" else None
        prefix = CATALOG[name].actor
        if config.get("distribution") == "categorical":
            prefix, n_outputs = "network.outputs", _count(config, "n_atoms")
        hidden = self._torso(f"{prefix}.torso")
        if name == "IQN":
            described = self._described(_count(config, "n_policy_quantiles"))
            hidden += [lambda x: x[..., None, :] * described, *self._torso("network.reader.torso")]
            prefix = "network.reader"
        if f"{prefix}.value_head.weight" in self._arrays and f"{prefix}.advantage_head.weight" in self._arrays:
            value, advantage = (
                [*self._layers(f"{prefix}.{part}"), self._linear(f"{prefix}.{part}_head")]
                for part in ("value", "advantage")
            )
            hidden.append(lambda x: joined(applied(value, x), applied(advantage, x), n_outputs or 1))
        else:
            hidden.append(self._linear(f"{prefix}.head"))
        if n_outputs is not None:
            mean = np.mean if name == "QRDQN" else categorical_mean(config, n_outputs)
            hidden.append(lambda x: mean(x.reshape(*x.shape[:-1], -1, n_outputs), axis=-1))
        if name == "IQN":
            hidden.append(lambda x: x.mean(axis=-2))
        self._steps = hidden
        self.takes_masks = config.get("action_masks", name == "MaskablePPO")
        is_squashed = CATALOG[name].is_squashed or (
            len(hidden) > 1 if name == "ARS" else self._shape.get("squash_output", False)
        )
        self._choose = chooser(self.action_space, is_squashed)
        self._scale = spaces.action_scaler(self.action_space)
        zero = [np.zeros((1, *leaf.shape), leaf.dtype) for leaf in self._leaves]
        n, width = self._outputs(zero).shape[-1], spaces.leaves(self.action_space)[0].n_features  # wrong shapes raise
        if n < width if isinstance(self.action_space, Box) else n != width:
            raise ValueError(f"its network has {n} outputs, expected {width}")
        if not np.isfinite(self._act(zero, None)).all():
            raise ValueError("its actions are not finite")

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
        action_masks: Any = None,
    ) -> tuple[np.ndarray, Any]:
        """Returns the actions of the agent's ``predict(deterministic=True)``, and ``state``.

        Args:
            observation: one observation, or a batch with a leading axis.
            state: returned unchanged.
            episode_start: ignored; there is no memory.
            deterministic: must be True.
            action_masks: which actions are allowed, ``bool (batch, n)`` or ``(n,)``, if the agent takes them; None allows all.

        Raises:
            ValueError: if the shapes do not match, or ``deterministic`` is False.
        """
        if not deterministic:
            raise ValueError("a policy in NumPy is deterministic; leave out deterministic=False, or use rejeu.load")
        if action_masks is not None and not self.takes_masks:
            raise ValueError("this policy takes no action_masks")
        given = spaces.parts(self.observation_space, observation)
        arrays = [np.asarray(one, leaf.dtype) for one, leaf in zip(given, self._leaves, strict=True)]
        is_single = arrays[0].ndim == len(self._leaves[0].shape)
        for array, leaf in zip(arrays, self._leaves, strict=True):
            if array.shape[0 if is_single else 1 :] != leaf.shape:
                where = f" of {leaf.path!r}" if leaf.path else ""
                raise ValueError(
                    f"the observation{where} has shape {array.shape}, expected {leaf.shape}, or a batch of it"
                )
        action = self._act([one[None] for one in arrays] if is_single else arrays, action_masks)
        return (action[0] if is_single else action), state

    def _outputs(self, arrays: list[np.ndarray]) -> np.ndarray:
        parts = [encode(array) for encode, array in zip(self._encoders, arrays, strict=True)]
        return applied(self._steps, parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1))

    def _act(self, arrays: list[np.ndarray], masks: Any) -> np.ndarray:
        x = self._outputs(arrays)
        if masks is not None:
            x = np.where(np.asarray(masks, bool), x, np.float32(-1e9))
        return self._scale(self._choose(x))

    def _normalizations(self, settings: Mapping[str, Any]) -> list[Function | None]:
        """Returns what normalizes each leaf; None for leaves that are not."""
        found: list[Function | None] = []
        for group in spaces.groups(self._leaves, settings["share_goals"]):
            moments = [self._arrays.get(f"statistics.obs.{group}.{one}") for one in ("mean", "variance", "n_seen")]
            if group is None or not settings["norm_obs"] or moments[2] is None or moments[2] == 0:
                found.append(None)
                continue
            found.append(standardizer(moments[0], moments[1], settings["epsilon"], settings["clip_obs"]))
        return found

    def _torso(self, prefix: str) -> list[Function]:
        """Returns the hidden layers: a stack, branches, SimBa, or FlashSAC's blocks."""
        if f"{prefix}.embedding.weight" not in self._arrays:
            parts = (prefix, f"{prefix}.state", f"{prefix}.common", f"{prefix}.last")
            return [step for part in parts for step in self._layers(part)]
        embedding, norm = self._linear(f"{prefix}.embedding"), self._norm(f"{prefix}.norm")
        activation, blocks, i = ACTIVATIONS[self._shape["activation_fn"]], [], 0
        while f"{prefix}.blocks.{i}.expand.weight" in self._arrays:
            block = f"{prefix}.blocks.{i}"
            expand, contract = self._linear(f"{block}.expand"), self._linear(f"{block}.contract")
            if self._name == "FlashSAC":
                inner, outer = self._norm(f"{block}.inner"), self._norm(f"{block}.outer")
                blocks.append(residual([expand, inner, activation, contract, outer, activation]))
            else:
                blocks.append(residual([self._norm(f"{block}.norm"), expand, activation, contract]))
            i += 1
        if self._name == "FlashSAC":
            return [norm, embedding, *blocks, self._norm(f"{prefix}.last")]
        return [embedding, *blocks, norm]

    def _layers(self, prefix: str) -> list[Function]:
        """Returns a stack of layers; empty if there are none."""
        steps: list[Function] = []
        is_renormalized = f"{prefix}.norms.0.n_batches" in self._arrays
        if is_renormalized:
            steps.append(self._norm(f"{prefix}.norms.0"))
        i = 0
        while f"{prefix}.layers.{i}.weight" in self._arrays:
            norm = (
                [self._norm(f"{prefix}.norms.{i + is_renormalized}")]
                if f"{prefix}.norms.0.scale" in self._arrays
                else []
            )
            activation = [ACTIVATIONS[self._shape["activation_fn"]]]
            steps += [self._linear(f"{prefix}.layers.{i}")]
            steps += activation + norm if self._name == "CrossQ" else norm + activation
            i += 1
        return steps

    def _described(self, n: int) -> np.ndarray:
        """Returns what describes the fractions of ``n`` quantiles of IQN, ``(n, n_features)``."""
        embed = self._linear("network.embedding")
        frequencies = np.pi * np.arange(len(self._arrays["network.embedding.weight"]), dtype=np.float32)
        fractions = (np.arange(n, dtype=np.float32) + 0.5) / n
        return np.maximum(embed(np.cos(fractions[:, None] * frequencies.astype(np.float32))), 0.0).astype(np.float32)

    def _linear(self, prefix: str) -> Function:
        weight = self._arrays[f"{prefix}.weight"]
        if CATALOG[self._name].is_projected and not prefix.endswith(".head"):
            return lambda x: x @ weight
        bias = self._arrays[f"{prefix}.bias"]
        return lambda x: x @ weight + bias

    def _norm(self, prefix: str) -> Function:
        """Returns a layer norm, an RMS norm, or a batch renormalization by its running statistics."""
        scale = self._arrays[f"{prefix}.scale"]
        if self._name == "FlashSAC" and prefix.endswith(".last"):
            return lambda x: x / np.sqrt(np.square(x).mean(axis=-1, keepdims=True) + np.float32(1e-6)) * scale
        offset = self._arrays[f"{prefix}.offset"]
        if f"{prefix}.n_batches" in self._arrays:
            epsilon = np.float32(1e-5 if self._name == "FlashSAC" else 1e-3)
            factor = scale / np.sqrt(self._arrays[f"{prefix}.variance"] + epsilon)
            shift = offset - self._arrays[f"{prefix}.mean"] * factor
            return lambda x: x * factor + shift

        def normalized(x: np.ndarray) -> np.ndarray:
            centered = x - x.mean(axis=-1, keepdims=True)
            return (
                centered / np.sqrt(np.square(centered).mean(axis=-1, keepdims=True) + np.float32(1e-5)) * scale + offset
            )

        return normalized


def applied(steps: list[Function], x: np.ndarray) -> np.ndarray:
    """Returns ``x`` after all steps."""
    for step in steps:
        x = step(x)
    return x


def residual(steps: list[Function]) -> Function:
    """Returns the function that adds the steps' output to its input."""
    return lambda x: x + applied(steps, x)


def joined(value: np.ndarray, advantage: np.ndarray, n: int) -> np.ndarray:
    """Returns ``V + A - mean A``, for each action ``n`` numbers, ``(batch, n_actions * n)``."""
    advantages = advantage.reshape(*advantage.shape[:-1], -1, n)
    return (value[..., None, :] + advantages - advantages.mean(axis=-2, keepdims=True)).reshape(advantage.shape)


def _count(config: Mapping[str, Any], key: str) -> int:
    return whole(key, config[key], least=1, most=MOST_OUTPUTS)


def categorical_mean(config: Mapping[str, Any], n: int) -> Callable[..., np.ndarray]:
    """Returns the function from logits to the means of their distributions."""
    low, high = (number(key, config[key], least=-LARGEST_VALUE, most=LARGEST_VALUE) for key in ("v_min", "v_max"))
    atoms = np.linspace(low, high, n, dtype=np.float32)

    def mean(logits: np.ndarray, axis: int) -> np.ndarray:
        exponential = np.exp(logits - logits.max(axis=axis, keepdims=True))
        return exponential @ atoms / exponential.sum(axis=axis)

    return mean


def standardizer(mean: Any, variance: Any, epsilon: float, limit: float) -> Function:
    """Returns the function that standardizes observations and clips them to ``limit``."""
    epsilon, limit = number("epsilon", epsilon, above=0), number("clip_obs", limit, above=0)
    factor = (1.0 / np.sqrt(variance + np.float32(epsilon))).astype(np.float32)
    low, high = np.float32(-limit), np.float32(limit)
    return lambda x: np.minimum(np.maximum((x - mean) * factor, low), high)


def encoder(leaf: Leaf, scale: Function | None) -> Function:
    """Returns the function from a batch of a leaf to its features, ``(batch, leaf.n_features)``."""
    if leaf.kind == "categorical":
        pairs = [np.arange(start, start + n) for start, n in zip(leaf.starts, leaf.sizes, strict=True)]
        hot = lambda x: [x.reshape(len(x), -1)[:, i : i + 1] == values for i, values in enumerate(pairs)]  # noqa: E731
        return lambda x: np.concatenate(hot(x), axis=-1).astype(np.float32)
    size = leaf.n_features
    if leaf.kind == "image":
        return lambda x: x.reshape(-1, size).astype(np.float32) / np.float32(255.0)
    if scale is None:
        return lambda x: x.reshape(-1, size).astype(np.float32)
    return lambda x: scale(x.astype(np.float32)).reshape(-1, size)


def chooser(space: Any, is_squashed: bool) -> Function:
    """Returns the function from the network's outputs to an action in the range of algorithms."""
    if isinstance(space, Box):
        n = math.prod(space.shape)
        return (lambda x: np.tanh(x[..., :n])) if is_squashed else (lambda x: x[..., :n])
    if isinstance(space, MultiBinary):
        return lambda x: x > 0
    if isinstance(space, MultiDiscrete):
        ends = np.cumsum(space.nvec.ravel())[:-1]
        return lambda x: np.stack([part.argmax(axis=-1) for part in np.split(x, ends, axis=-1)], axis=-1)
    if not isinstance(space, Discrete):
        raise ValueError("Dict or Tuple actions")
    return lambda x: x.argmax(axis=-1)


def load_policy(path: str | Path) -> NumpyPolicy:
    """Returns the deterministic policy of a model file, which acts with NumPy alone; JAX is not imported.

    For fully connected networks of every algorithm but RecurrentPPO. No code from the file is run.

    Args:
        path: of a run folder or a model file; see :func:`rejeu.load`.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if the file is damaged, or its policy has images, memory or modules of the user's own.

    >>> import rejeu
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=0)
    >>> path = agent.save("pendulum")
    >>> action, _ = rejeu.load_policy(path).predict(agent.observation_space.sample())
    >>> action.shape
    (1,)
    """
    to_do = "export it with rejeu export --to onnx"
    with checkpoint.opened(find_model(path), "agent") as file:
        name = file.header.get("algorithm")
        prefix = CATALOG[name].actor if isinstance(name, str) and name in CATALOG else ""
        prefixes = [f"{before}{prefix}." for before in ("", "learner.", "learner.learner.")]
        if not prefix or any(key.startswith(f"{one}encoder.") for one in prefixes for key in file.specs):
            raise CheckpointError(
                f"{file.path}: the policy of {str(name)[:40]} has images, memory or modules of your own, which NumPy cannot "
                f"act with; {to_do}"
            )
        arrays = {key: array for one in (*prefixes, "statistics.obs.") for key, array in file.read(one).items()}
        checkpoint.require_finite(arrays, file.path)
        try:
            return NumpyPolicy(file.header, arrays, max(spaces.MAX_NUMBERS, file.room))
        except WRONG as error:
            raise CheckpointError(
                f"{file.path}: its policy is damaged, or has other than fully connected layers ({error}); {to_do}"
            ) from None
