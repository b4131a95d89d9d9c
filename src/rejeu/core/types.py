"""Names of types that Python cannot write, or only at length. Imports no JAX, so that worker processes start without it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, Union

import numpy as np

if TYPE_CHECKING:
    from jax import Array

PyTree: TypeAlias = Any
"""A tree of arrays: the state of an algorithm, the parameters of a network, or the network itself."""
AnyArray: TypeAlias = Any
"""An array of NumPy or of JAX; which of them, only the caller knows."""
Scalar: TypeAlias = Union["Array", np.ndarray, np.number, float]
"""A number, also while JAX traces a function."""
Observation: TypeAlias = Any
"""An observation, or a batch of them, as the space has it: an array, or a dict or tuple of observations."""
Action: TypeAlias = Any
"""An action, or a batch of them, as the space has it."""
Info: TypeAlias = dict[str, Any]
"""The info dictionary of Gymnasium's ``reset`` and ``step``, or their options."""
Settings: TypeAlias = dict[str, Any]
"""Values of a configuration by name."""
Arguments: TypeAlias = Mapping[str, Any]
"""Keyword arguments of a call."""
Variables: TypeAlias = dict[str, Any]
"""Local or global variables of a function by name."""
JsonObject: TypeAlias = dict[str, Any]
"""A dict of values that JSON can express."""
