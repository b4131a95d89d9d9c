"""Noise added to actions in [-1, 1]: frozen settings, and pure functions over a small state per environment.

Everything here is in the scale of the algorithms' actions, where every dimension ranges from -1 to 1. Values in the
environment's units, over ``[low, high]``, convert by the half width ``h = (high - low) / 2``: means, ``sigma`` and
``drift`` are divided by ``h``, the strength of the repulsive boundary by ``h^2``; ``theta`` and ``dt`` stay the same.

Noise of your own is an object with the two methods of :class:`NoiseProcess`.
"""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import KW_ONLY, InitVar, asdict, dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array
from numpy.typing import ArrayLike, DTypeLike

from rejeu.core.algorithm import Action, AnyArray, PyTree
from rejeu.core.validation import assign, coerce, number
from rejeu.exploration.parameter_space import ParameterNoise

PerDimension = Any
"""A number for all action dimensions, or a sequence of one for each; kept as a tuple of floats."""


@runtime_checkable
class NoiseProcess(Protocol):
    """The interface of ``action_noise``: any object with these two methods.

    For example noise that alternates its sign from step to step::

        class Alternating:
            def init(self, n_envs):
                return jnp.ones(n_envs)

            def perturb(self, state, action, key):
                return -state, action + 0.1 * state[:, None]

        rejeu.TD3("MlpPolicy", env, action_noise=Alternating())

    A model file mentions only the name of its class, so it must be given again to ``load``.
    """

    def init(self, n_envs: int) -> Any:
        """Returns the state of ``n_envs`` processes at the start of an episode: a pytree of arrays ``(n_envs, ...)``."""

    def perturb(self, state: PyTree, action: Array, key: Array) -> tuple[Any, Array]:
        """Returns the state after one step, and ``action`` ``(n_envs, action_dim)`` with noise.

        ``key`` is a JAX random key. The result is clipped to [-1, 1]. JAX traces the function.
        """


class ActionNoise(ABC):
    """Noise on actions in [-1, 1], with the settings of Stable-Baselines3's. Abstract.

    The object holds settings only: agents keep the state of each environment. Called by hand it runs a process
    of its own, as Stable-Baselines3's noise does, which does not affect equality, files or agents.

    >>> noise = NormalActionNoise(mean=[0.0, 0.0], sigma=0.2)
    >>> noise.reset(seed=0)
    >>> noise().shape
    (2,)
    """

    mean: tuple[float, ...]
    sigma: tuple[float, ...]
    _rng: np.random.Generator | None = None
    """Of :meth:`__call__`."""
    _state: PyTree = None
    """That of :meth:`__call__`; None at the start of an episode."""

    @abstractmethod
    def init(self, n_envs: int) -> Any:
        """Returns the state of ``n_envs`` processes at the start of an episode, ``float32 (n_envs, ...)``."""

    @abstractmethod
    def advance(self, state: PyTree, action: Action, normal: AnyArray) -> tuple[PyTree, Any]:
        """Returns the state after one step, and ``action`` ``(n_envs, action_dim)`` with noise, not yet clipped.

        ``normal`` has standard normal numbers, one for each action dimension. NumPy or JAX arrays.
        """

    def perturb(self, state: Array, action: Array, key: Array) -> tuple[Array, Array]:
        """Returns the result of :meth:`advance` with random numbers drawn from ``key``."""
        return self.advance(state, action, jax.random.normal(key, action.shape))

    def __call__(self, action: ArrayLike = 0.0) -> np.ndarray:
        """Returns the noise of the next step, ``float32 (action_dim,)``: what is to be added to ``action``.

        Args:
            action: the policy's action in [-1, 1], a number or ``(action_dim,)``. The noise depends on it only with a
                repulsive boundary.

        The result is not clipped: use ``np.clip(action + noise(action), -1, 1)``, scaled to the environment's range.
        """
        rng = self._rng or np.random.default_rng()
        before = np.broadcast_to(np.asarray(action, np.float32), (1, len(self.mean)))
        state = self.init(1) if self._state is None else self._state  # NumPy does not start JAX's device
        state, after = self.advance(state, before, rng.standard_normal(before.shape, np.float32))
        assign(self, _rng=rng, _state=state)
        return (after - before)[0]

    def reset(self, seed: int | None = None) -> None:
        """Resets the process of :meth:`__call__` to the start of an episode.

        Args:
            seed: also restarts its random numbers; None lets them continue.
        """
        assign(self, _rng=self._rng if seed is None else np.random.default_rng(seed), _state=None)


@dataclass(frozen=True)
class NormalActionNoise(ActionNoise):
    """Independent Gaussian noise, the same at every step (Stable-Baselines3's class of that name).

    >>> NormalActionNoise(mean=[0.0, 0.0], sigma=[0.2, 0.2])
    NormalActionNoise(mean=(0.0, 0.0), sigma=(0.2, 0.2), random=0.0)
    """

    mean: PerDimension
    """Mean per action dimension, in the scale of actions in [-1, 1]."""
    sigma: PerDimension
    """Standard deviation per action dimension, at least 0."""
    dtype: InitVar[Any] = np.float32
    """Accepted for compatibility with Stable-Baselines3; the noise is always float32."""
    _: KW_ONLY
    random: float = 0.0
    """Probability that an action is replaced by a uniformly random one, as in hindsight experience replay's experiments
    (Plappert et al. 2018, arXiv 1802.09464: 0.3, with ``sigma=0.2``). An agent replaces them, a call by hand does not."""

    def __post_init__(self, dtype: DTypeLike) -> None:
        _check_dtype(self, dtype)
        _as_tuples(self, "mean", "sigma")
        coerce(self, "random", number, least=0, most=1)

    def init(self, n_envs: int) -> Any:
        """Returns the state of the noise of ``n_envs`` environments: nothing."""
        return np.zeros((n_envs, 0), np.float32)

    def advance(self, state: PyTree, action: Action, normal: AnyArray) -> tuple[PyTree, Any]:
        return state, action + (_row(self.mean) + _row(self.sigma) * normal)

    def perturb(self, state: Array, action: Array, key: Array) -> tuple[Array, Array]:
        state, noisy = super().perturb(state, action, key)
        if self.random == 0:
            return state, noisy
        choice_key, action_key = jax.random.split(jax.random.fold_in(key, 1))
        is_random = jax.random.bernoulli(choice_key, self.random, action.shape[:1])
        uniform = jax.random.uniform(action_key, action.shape, action.dtype, -1.0, 1.0)
        return state, jnp.where(is_random[:, None], uniform, noisy)


@dataclass(frozen=True)
class OrnsteinUhlenbeckActionNoise(ActionNoise):
    """Noise that drifts back to its mean: an Ornstein-Uhlenbeck process, one per environment.

    From ``initial_noise`` at the start of every episode, each step takes (Uhlenbeck and Ornstein 1930; for DDPG,
    Lillicrap et al. 2015, arXiv 1509.02971)::

        x <- x + theta (mean - x) dt + sigma sqrt(dt) N(0, 1)
        u  = action + x
        g  = repulsive B'(u),    B(u) = (pi u / 2)^6
        x <- x + drift dt - g
        action taken = clip(u - g, -1, 1)

    Without the repulsive boundary ``B``, a long excursion of the process holds the action at its bound; with it the
    action is pushed back from there and the process with it. The push goes no further than to the middle, ``u = 0``,
    because a large ``u`` would otherwise leave on the other side and diverge.

    >>> OrnsteinUhlenbeckActionNoise(mean=[0.0], sigma=[0.2], repulsive=1e-4).repulsive
    (0.0001,)
    """

    mean: PerDimension
    """Mean to which the process returns, per action dimension."""
    sigma: PerDimension
    """Standard deviation of the increments per square root of time, at least 0."""
    theta: float = 0.15
    """Rate of return to the mean, per unit of time."""
    dt: float = 1e-2
    """Time between two steps."""
    initial_noise: PerDimension = (0.0,)
    """Where the process starts each episode; None starts at 0."""
    dtype: InitVar[Any] = np.float32
    """Accepted for compatibility with Stable-Baselines3; the noise is always float32."""
    _: KW_ONLY
    drift: PerDimension = (0.0,)
    """Constant added to the process per unit of time, after its value is used: its mean is then ``mean + drift / theta``."""
    repulsive: PerDimension = (0.0,)
    """Strength of the repulsive boundary, at least 0; 0 or None for none. A larger value keeps actions further inside. A
    strength ``s`` for actions in ``[low, high]`` is ``4 s / (high - low)^2`` here: 1e-4 over [-2, 2] is 2.5e-5."""

    def __post_init__(self, dtype: DTypeLike) -> None:
        _check_dtype(self, dtype)
        for key in ("initial_noise", "repulsive"):
            if getattr(self, key) is None:
                assign(self, **{key: (0.0,)})
        _as_tuples(self, "mean", "sigma", "initial_noise", "drift", "repulsive")
        coerce(self, "theta", number, least=0)
        coerce(self, "dt", number, above=0)
        if min(self.repulsive) < 0:
            raise ValueError(f"{type(self).__name__}: repulsive={self.repulsive} must not be negative")

    def init(self, n_envs: int) -> Any:
        """Returns the processes of ``n_envs`` environments at the start of an episode, ``(n_envs, action_dim)``."""
        return np.tile(_row(self.initial_noise), (n_envs, 1))

    def advance(self, state: PyTree, action: Action, normal: Any) -> tuple[Any, Any]:
        kick = _row(self.sigma) * math.sqrt(self.dt) * normal
        state = state + self.theta * (_row(self.mean) - state) * self.dt + kick
        action = action + state
        state = state + _row(self.drift) * self.dt
        if max(self.repulsive) > 0:
            push = (_row(self.repulsive) * barrier_slope(action)).clip(-abs(action), abs(action))
            state, action = state - push, action - push
        return state, action


def barrier(action: Action) -> AnyArray:
    """Returns the repulsive barrier ``B(u) = (pi u / 2)^6``, which is flat within [-1, 1] and steep beyond.

    >>> float(barrier(2 / math.pi))
    1.0
    """
    return (0.5 * math.pi * action) ** 6


def barrier_slope(action: Action) -> AnyArray:
    """Returns the barrier's derivative ``B'(u) = 3 pi (pi u / 2)^5``: the push for a ``repulsive`` of 1."""
    return 3.0 * math.pi * (0.5 * math.pi * action) ** 5


Noise = NoiseProcess | ParameterNoise
"""Noise on actions, also of your own, or on parameters."""
NOISES: dict[str, type[NormalActionNoise] | type[OrnsteinUhlenbeckActionNoise] | type[ParameterNoise]] = {
    "normal": NormalActionNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise,
    "parameter": ParameterNoise,
}


WRITTEN = re.compile(r"([a-z-]+)\s*\(([^()]*)\)")
"""Noise as a string, such as ``ou(0.2)``."""


def parse(value: object) -> Noise | str | None:
    """Returns noise settings from themselves, from None, from a number or a string, or from their JSON form.

    A number is the standard deviation of Gaussian noise; a string is ``"normal(0.1)"``, ``"ou(0.2)"``,
    ``"ou(0.2, theta=0.3)"`` or ``"parameter(0.1)"``. The number of action dimensions is not known here, so noise on
    actions stays a string until :func:`for_actions`. The JSON form is ``{"noise": "normal", ...}``.

    Raises:
        TypeError: for anything else.
        ValueError: for settings that are out of range.

    >>> parse(0.1), parse("parameter(0.2)").initial_sigma
    ('normal(0.1)', 0.2)
    """
    if value is None or (isinstance(value, Noise) and not isinstance(value, type)):
        return value
    if isinstance(value, Mapping) and value.get("noise") in NOISES:
        fields = {key: setting for key, setting in value.items() if key != "noise"}
        return NOISES[value["noise"]](**fields)
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = f"normal({float(value)!r})"
    if isinstance(value, str) and WRITTEN.fullmatch(value.strip().lower()):
        text = value.strip().lower()
        noise = read(text, 1)
        return noise if isinstance(noise, ParameterNoise) else text
    raise TypeError(
        f"action_noise={value!r} must be None, a standard deviation such as 0.1, a string such as 'ou(0.2)', one of "
        f"{', '.join(noise.__name__ for noise in NOISES.values())}, such as NormalActionNoise(mean=[0, 0], sigma=[0.1, 0.1]), "
        "or an object with the methods init and perturb (see rejeu.exploration.noise.NoiseProcess)"
    )


def read(text: str, n: int) -> Noise:
    """Returns the noise that a string describes, for actions of ``n`` dimensions.

    Raises:
        TypeError: for an unknown kind or setting.
        ValueError: for a value that is not a number or out of range.

    >>> read("ou(0.2, theta=0.3)", 2).theta
    0.3
    """
    match = WRITTEN.fullmatch(text)
    noise_classes = {**NOISES, "ou": OrnsteinUhlenbeckActionNoise}
    if match is None or match[1] not in noise_classes:
        raise TypeError(f"action_noise={text!r} must be one of {', '.join(f'{name}(0.1)' for name in noise_classes)}")
    noise_class = noise_classes[match[1]]
    first = "initial_sigma" if noise_class is ParameterNoise else "sigma"
    settings: dict[str, Any] = {}
    setting_names = [field.name for field in dataclasses.fields(noise_class) if field.name != "mean"]
    for i, assignment in enumerate(filter(None, (assignment.strip() for assignment in match[2].split(",")))):
        name, equals, value = assignment.partition("=")
        name, value = (name.strip(), value) if equals else (first, name)
        if name not in setting_names or name in settings or (not equals and i > 0):
            raise TypeError(
                f"action_noise={text!r} takes no {assignment!r}; {match[1]} takes {', '.join(setting_names)}, each once"
            )
        try:
            settings[name] = float(value)
        except ValueError:
            raise ValueError(f"action_noise={text!r}: {value.strip()!r} is not a number") from None
        if name == "adaptation_interval":
            settings[name] = int(settings[name])
    if noise_class is ParameterNoise:
        return noise_class(**settings)
    return noise_class(**{"mean": [0.0] * n, first: 0.1, **settings})


def for_actions(noise: Noise | str, action_space: spaces.Space) -> Noise:
    """Returns noise for these actions: a string from :func:`parse` gets as many dimensions as they have.

    >>> for_actions("normal(0.1)", spaces.Box(-1, 1, (2,)))
    NormalActionNoise(mean=(0.0, 0.0), sigma=(0.1, 0.1), random=0.0)
    """
    return read(noise, math.prod(action_space.shape or (1,))) if isinstance(noise, str) else noise


def to_json(noise: Any) -> dict[str, Any]:
    """Returns the JSON form that :func:`parse` reads."""
    name = next(key for key, noise_class in NOISES.items() if isinstance(noise, noise_class))
    return {"noise": name, **{k: list(v) if isinstance(v, tuple) else v for k, v in asdict(noise).items()}}


def check_fits(noise: Noise | None, action_space: spaces.Space) -> None:
    """Raises ``ValueError`` unless the noise can be used with these actions.

    Noise on actions needs a Box with as many dimensions as it has; noise on parameters goes with all.
    """
    if noise is None or isinstance(noise, ParameterNoise):
        return
    if not isinstance(action_space, spaces.Box):
        raise ValueError(
            f"{type(noise).__name__} adds to continuous actions and the action space is {action_space}; use "
            "action_noise=ParameterNoise(), or None"
        )
    if isinstance(noise, ActionNoise) and len(noise.mean) != math.prod(action_space.shape):
        raise ValueError(
            f"action_noise has {len(noise.mean)} dimensions and the actions have {math.prod(action_space.shape)}; "
            f"try {type(noise).__name__}(mean=[0.0] * {math.prod(action_space.shape)}, sigma={noise.sigma[0]})"
        )


def warn_without_noise(agent: Any) -> None:
    """Warns at the start of a run if an agent whose policy for Box actions is deterministic has no exploration noise."""
    is_continuous = isinstance(agent.action_space, spaces.Box)
    if is_continuous and agent.make_noise() is None and agent.run.step == 0:
        warnings.warn(
            f"{agent.name} trains without exploration noise: its policy is deterministic, so after the random steps of "
            f"learning_starts={agent.config.learning_starts} it explores nothing new; set action_noise=0.1 (--set "
            "action_noise=0.1), 'ou(0.2)' or ParameterNoise()",
            UserWarning,
            stacklevel=4,
        )


def _row(values: tuple[float, ...]) -> np.ndarray:
    return np.array([values], np.float32)


def _check_dtype(noise: object, dtype: DTypeLike) -> None:
    if not np.issubdtype(np.dtype(dtype), np.floating):
        raise ValueError(f"{type(noise).__name__}: dtype={dtype!r} must be a floating dtype")


def _as_tuples(noise: Any, *keys: str) -> None:
    """Turns array-like fields into tuples of finite floats of one length, so that the settings are hashable."""
    name = type(noise).__name__
    arrays = {key: np.atleast_1d(np.asarray(getattr(noise, key), np.float64)) for key in keys}
    n = max(len(array) for array in arrays.values())
    if any(array.ndim != 1 or len(array) not in (1, n) for array in arrays.values()):
        raise ValueError(f"{name}: {', '.join(f'{key} has {array.size}' for key, array in arrays.items())} entries")
    for key, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: {key}={getattr(noise, key)!r} must be finite")
        assign(noise, **{key: tuple(np.broadcast_to(array, n).tolist())})
    if min(noise.sigma) < 0:
        raise ValueError(f"{name}: sigma={noise.sigma} must not be negative")
