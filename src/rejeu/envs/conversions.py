"""What environments return that is taken although they declare something else: other dtypes, NumPy's numbers, 0 and 1."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

FLAGS = frozenset((bool, np.bool_))
"""The types of ``terminated`` and ``truncated``."""
NUMBERS = frozenset((float, int, np.float64, np.float32, np.int64, np.int32))
"""The types of rewards that are taken as they are."""
LARGEST = float(np.finfo(np.float32).max)
"""The largest reward that can be kept."""


def keeps(array: np.ndarray, dtype: Any) -> bool:
    """Returns whether numbers stay what they are, but for precision, when they are cast to ``dtype``."""
    if array.dtype.kind not in "fiub":
        return False
    if np.can_cast(array.dtype, dtype, "same_kind"):
        return True
    with np.errstate(invalid="ignore", over="ignore"):
        return bool((array.astype(dtype) == array).all())


def fitted(value: Any, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Returns an array of that shape whose numbers a store of that dtype can keep.

    Raises:
        ValueError: if the shape is another, or integers are asked for and there are fractions, or larger numbers.
    """
    array = np.asarray(value)
    if array.shape != shape:
        raise ValueError(f"shape {array.shape}")
    if not keeps(array, dtype):
        raise ValueError(f"dtype {array.dtype}")
    return array


def parts(space: spaces.Space) -> list[spaces.Space]:
    """Returns the spaces at the leaves of a space, in the order of :func:`rejeu.spaces.leaves`."""
    if isinstance(space, spaces.Dict):
        return [part for key in sorted(space.spaces) for part in parts(space.spaces[key])]
    if isinstance(space, spaces.Tuple):
        return [part for one in space.spaces for part in parts(one)]
    return [space]


def numbers_of(answer: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Returns what ``step`` returned: observation, reward, terminated, truncated, info; the numbers as plain ones.

    Anything is raised if it is something else; :func:`rejeu.envs.faults.step_fault` then says what.
    """
    obs, reward, terminated, truncated, info = answer
    return obs, reward_of(reward), flag_of(terminated), flag_of(truncated), info


def reward_of(reward: Any) -> float:
    """Returns a reward as a float; arrays of one number are taken, None and text are not.

    Raises:
        OverflowError: if it is finite and beyond ``LARGEST``.
        TypeError, ValueError: if it is no number.
    """
    if type(reward) in NUMBERS:
        number = float(reward)
    elif reward is None or isinstance(reward, str | bytes):
        raise TypeError("no number")
    else:
        number = float(np.asarray(reward, np.float64).reshape(()) if np.size(reward) == 1 else reward)
    if LARGEST < abs(number) < math.inf:
        raise OverflowError("more than a float32 holds")
    return number


def flag_of(flag: Any) -> bool:
    """Returns ``terminated`` or ``truncated`` as a bool; zeros and ones are taken, None and text are not.

    Raises:
        TypeError, ValueError: if it is neither.
    """
    if type(flag) in FLAGS:
        return bool(flag)
    if flag is None or isinstance(flag, str | bytes) or np.size(flag) != 1:
        raise TypeError("no bool")
    number = np.asarray(flag).reshape(())
    if number.dtype.kind not in "fiub" or number not in (0, 1):
        raise ValueError("no bool")
    return bool(number)
