"""Modules of the user's own as encoder, torso or head, and encoders by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, ShapeDtypeStruct

from rejeu.core import PyTree

M = TypeVar("M", bound=Callable[..., Any])
ENCODERS: dict[str, Callable[..., Any]] = {}
"""Encoders by name; :func:`register_encoder` adds to it."""


def register_encoder(name: str) -> Callable[[M], M]:
    """Returns a decorator that makes an encoder known by a name, which ``policy_kwargs`` and model files can contain.

    A later registration of the same name replaces the earlier one.

    >>> @register_encoder("numbers")
    ... def numbers(key, leaves):
    ...     return eqx.nn.Linear(leaves[0].n_features, 8, key=key)
    >>> import rejeu
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", policy_kwargs={"encoder": "numbers"})
    """

    def register(make: M) -> M:
        ENCODERS[name] = make
        return make

    return register


def find_encoder(encoder: Any) -> Any:
    """Returns the encoder of a name; anything but a name is returned unchanged.

    Raises:
        ValueError: if the name is not registered.
    """
    if not isinstance(encoder, str):
        return encoder
    if encoder not in ENCODERS:
        raise ValueError(
            f"encoder={encoder!r} is not registered; import the module that registers it (--import MODULE); there are "
            f"{', '.join(ENCODERS) or 'none'}"
        )
    return ENCODERS[encoder]


class OwnModule(eqx.Module):
    """A module of the user's own that is not called with a batch, or that holds functions, as ``eqx.nn.MLP`` does.

    Its arrays are learned; everything else, such as an activation function, is constant.
    """

    arrays: Any
    """The module, with None in place of what is no array."""
    constants: Any = eqx.field(static=True)
    """The module, with None in place of arrays."""
    takes_batch: bool = eqx.field(static=True)
    n_outputs: int = eqx.field(static=True)

    def __call__(self, x: PyTree) -> Array:
        """Maps ``(batch, ...)`` to ``(batch, n_outputs)``."""
        module = eqx.combine(self.arrays, self.constants)
        return module(x) if self.takes_batch else jax.vmap(module)(x)


def own_module(role: str, module: Any, example: PyTree) -> tuple[Any, int]:
    """Returns a module of the user's own as one that takes a batch, and the number of its outputs.

    Args:
        role: the setting it was given as, with its name, for messages.
        module: maps inputs ``(batch, ...)`` to ``(batch, n_outputs)``, or one input to ``(n_outputs,)``.
        example: shape and dtype of one input, without the batch axis.

    Raises:
        TypeError: if it is no ``equinox.Module``, does not map such inputs, or holds arrays that are not float32.
    """
    if not isinstance(module, eqx.Module):
        raise TypeError(f"{role} made {type(module).__name__}, expected an equinox.Module")
    for path, leaf in jax.tree_util.tree_leaves_with_path(module):
        if eqx.is_array_like(leaf) and not (isinstance(leaf, jax.Array) and leaf.dtype == jnp.float32):
            kind = f"array of {leaf.dtype}" if hasattr(leaf, "dtype") else type(leaf).__name__
            where = jax.tree_util.keystr(path, simple=True, separator=".")
            raise TypeError(
                f"{role} holds {where}, which is of type {kind} and cannot be learned; declare that field "
                "eqx.field(static=True)"
            )
    size = 2 + sum(sum(leaf.shape) for leaf in jax.tree.leaves(example))  # no axis of the input has that length
    batch = jax.tree.map(lambda leaf: ShapeDtypeStruct((size, *leaf.shape), leaf.dtype), example)
    takes_batch = True
    n_outputs = outputs_of(module, batch, (size,))
    if n_outputs is None:
        takes_batch, n_outputs = False, outputs_of(module, example, ())
    if n_outputs is None:
        shapes = jax.tree.map(lambda leaf: leaf.shape, example)
        raise TypeError(
            f"{role} must map inputs of shape {shapes} to a vector, or a batch of them to (batch, n_outputs)"
        )
    arrays, constants = eqx.partition(module, eqx.is_array)
    is_complete = takes_batch and not jax.tree.leaves(constants)
    if is_complete and getattr(module, "n_outputs", None) == n_outputs:
        return module, n_outputs
    return OwnModule(arrays, constants, takes_batch, n_outputs), n_outputs


def outputs_of(module: Any, inputs: PyTree, leading: tuple[int, ...]) -> int | None:
    """Returns the length of the last axis that ``module`` gives for ``inputs``, None if it gives another shape."""
    try:
        shape = eqx.filter_eval_shape(module, inputs).shape
    except Exception:  # whatever a module raises for inputs that it is not made for
        return None
    return shape[-1] if len(shape) == len(leading) + 1 and shape[:-1] == leading else None
