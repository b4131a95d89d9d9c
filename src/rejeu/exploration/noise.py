"""Noise added to actions in [-1, 1]: frozen settings, and pure functions over a small state per environment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array


@dataclass(frozen=True)
class NormalActionNoise:
    """Independent Gaussian noise, the same at every step (Stable-Baselines3's class of that name).

    >>> NormalActionNoise(mean=[0.0, 0.0], sigma=[0.2, 0.2])
    NormalActionNoise(mean=(0.0, 0.0), sigma=(0.2, 0.2))
    """

    mean: tuple[float, ...]
    """Mean per action dimension, in the scale of actions in [-1, 1]."""
    sigma: tuple[float, ...]
    """Standard deviation per action dimension, at least 0."""

    def __post_init__(self) -> None:
        _as_tuples(self, "mean", "sigma")

    def init(self, n_envs: int) -> Array:
        """Returns the state of the noise of ``n_envs`` environments: nothing."""
        return jnp.zeros((n_envs, 0), jnp.float32)

    def sample(self, state: Array, key: Array) -> tuple[Array, Array]:
        """Returns the state and noise ``(n_envs, action_dim)``."""
        shape = (state.shape[0], len(self.mean))
        return state, jnp.array(self.mean) + jnp.array(self.sigma) * jax.random.normal(key, shape)


@dataclass(frozen=True)
class OrnsteinUhlenbeckActionNoise:
    """Noise that drifts back to its mean: an Ornstein-Uhlenbeck process, one per environment.

    ``x <- x + theta (mean - x) dt + sigma sqrt(dt) N(0, 1)``, from 0 at the start of every episode (Uhlenbeck and
    Ornstein 1930; for DDPG, Lillicrap et al. 2015, arXiv 1509.02971).
    """

    mean: tuple[float, ...]
    """What the process returns to, per action dimension."""
    sigma: tuple[float, ...]
    """Size of the random kicks per square root of time, at least 0."""
    theta: float = 0.15
    """Rate of return to the mean, per unit of time."""
    dt: float = 1e-2
    """Time between two steps."""

    def __post_init__(self) -> None:
        _as_tuples(self, "mean", "sigma")

    def init(self, n_envs: int) -> Array:
        """Returns the processes of ``n_envs`` environments at rest, ``(n_envs, action_dim)``."""
        return jnp.zeros((n_envs, len(self.mean)), jnp.float32)

    def sample(self, state: Array, key: Array) -> tuple[Array, Array]:
        """Returns the state after one step of the processes, which is the noise too, ``(n_envs, action_dim)``."""
        kick = jnp.array(self.sigma) * np.sqrt(self.dt) * jax.random.normal(key, state.shape)
        state = state + self.theta * (jnp.array(self.mean) - state) * self.dt + kick
        return state, state


Noise = NormalActionNoise | OrnsteinUhlenbeckActionNoise
NOISES: dict[str, type[NormalActionNoise] | type[OrnsteinUhlenbeckActionNoise]] = {
    "normal": NormalActionNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise,
}


def parse(value: Any) -> Noise | None:
    """Returns noise settings from themselves, from None, or from their JSON form ``{"noise": "normal", ...}``.

    Raises:
        TypeError: for anything else.
    """
    if value is None or isinstance(value, Noise):
        return value
    if isinstance(value, Mapping) and value.get("noise") in NOISES:
        fields = {key: setting for key, setting in value.items() if key != "noise"}
        return NOISES[value["noise"]](**fields)
    raise TypeError(
        f"action_noise={value!r} must be None or one of {', '.join(kind.__name__ for kind in NOISES.values())}, "
        "such as NormalActionNoise(mean=[0, 0], sigma=[0.1, 0.1])"
    )


def to_json(noise: Noise) -> dict[str, Any]:
    """Returns the JSON form that :func:`parse` reads."""
    name = next(key for key, kind in NOISES.items() if isinstance(noise, kind))
    return {"noise": name, **{k: list(v) if isinstance(v, tuple) else v for k, v in asdict(noise).items()}}


def _as_tuples(noise: Any, *keys: str) -> None:
    """Turns array-like fields into tuples of floats of one length, so that the settings are hashable."""
    for key in keys:
        values = tuple(float(v) for v in np.atleast_1d(np.asarray(getattr(noise, key), np.float64)))
        object.__setattr__(noise, key, values)
    lengths = {key: len(getattr(noise, key)) for key in keys}
    if len(set(lengths.values())) != 1:
        raise ValueError(f"{type(noise).__name__}: {', '.join(f'{k} has {n}' for k, n in lengths.items())} entries")
    if min(noise.sigma) < 0:
        raise ValueError(f"{type(noise).__name__}: sigma={noise.sigma} must not be negative")
