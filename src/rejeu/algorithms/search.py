"""Search spaces: the ranges in which ``rejeu tune`` looks for hyperparameters.

Each configuration declares its own as the class variable ``search_space``, by the name of the hyperparameter, dotted where it
is nested. The ranges follow those of RL Baselines3 Zoo (Raffin 2020, ``hyperparams_opt.py``), with two differences: learning
rates of off-policy algorithms end at 1e-2 instead of 1, where they diverge, and what mainly changes the computing time of a
trial (``train_freq``, ``buffer_size``, ``n_quantiles``) is left out.

>>> LogUniform(1e-5, 1e-2)
LogUniform(low=1e-05, high=0.01)
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from rejeu.core.validation import is_number


@dataclass(frozen=True)
class Range:
    """Numbers from ``low`` to ``high``. Abstract: a subclass says which of them are likely."""

    low: float
    high: float

    above: ClassVar[float] = -math.inf
    """Both ends are greater than this."""
    below: ClassVar[float] = math.inf
    """Both ends are less than this."""
    is_whole: ClassVar[bool] = False
    """Whether only whole numbers are meant."""
    prefix: ClassVar[str]
    """Stands before the ends on the command line and in files."""

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            value = getattr(self, name)
            if not is_number(value) or not self.above < value < self.below or (self.is_whole and value != int(value)):
                raise ValueError(f"{name}={value!r} is no end of a range of {type(self).__name__}; see {__name__}")
        if not self.low < self.high:
            raise ValueError(f"the range from {self.low!r} to {self.high!r} is empty; give the lower end first")

    def contains(self, value: Any) -> bool:
        """Returns whether a value lies in the range."""
        return is_number(value) and self.low <= value <= self.high and not (self.is_whole and value != int(value))

    def ends(self) -> tuple[float, ...]:
        """Returns the extreme values."""
        return self.low, self.high

    def __str__(self) -> str:
        return f"{self.prefix}:{self.low}..{self.high}"


@dataclass(frozen=True)
class Uniform(Range):
    """Numbers from ``low`` to ``high``, all equally likely."""

    prefix = "uniform"


@dataclass(frozen=True)
class LogUniform(Range):
    """Numbers from ``low`` to ``high``, all orders of magnitude equally likely."""

    prefix = "log"
    above = 0.0


@dataclass(frozen=True)
class NearOne(Range):
    """Numbers from ``low`` to ``high`` below 1, all orders of magnitude of ``1 - value`` equally likely."""

    prefix = "near-one"
    below = 1.0


@dataclass(frozen=True)
class Integers(Range):
    """Whole numbers from ``low`` to ``high``, both included, all equally likely."""

    prefix = "int"
    is_whole = True


@dataclass(frozen=True)
class Choice:
    """One of several values, which may be anything that JSON can express."""

    values: tuple[object, ...]

    def __post_init__(self) -> None:
        if len({plain(value) for value in self.values}) < max(len(self.values), 2):
            raise ValueError(f"a choice needs two or more different values, got {list(self.values)}")

    def contains(self, value: object) -> bool:
        """Returns whether a value is one of them."""
        return plain(value) in map(plain, self.values)

    def index(self, value: object) -> int:
        """Returns the position of a value, which is one of them; 1 and 1.0 are the same."""
        return [*map(plain, self.values)].index(plain(value))

    def ends(self) -> tuple[object, ...]:
        """Returns all values."""
        return self.values

    def __str__(self) -> str:
        return json.dumps(self.values)


Dimension = Range | Choice
"""Where the value of one hyperparameter is searched."""
SearchSpace = Mapping[str, Dimension]
"""Where hyperparameters are searched, by their names."""


def plain(value: object) -> str:
    """Returns a value as JSON text, the same for equal numbers of different types.

    >>> plain((1, True)) == plain([1.0, True])
    True
    """
    return json.dumps(json.loads(json.dumps(value), parse_int=float), sort_keys=True)


OFF_POLICY: SearchSpace = {
    "learning_rate": LogUniform(1e-5, 1e-2),
    "gamma": NearOne(0.9, 0.9999),
    "batch_size": Choice((32, 64, 128, 256, 512)),
    "tau": LogUniform(0.001, 0.08),
    "learning_starts": Choice((100, 1_000, 10_000)),
    "policy_kwargs.net_arch": Choice(([64, 64], [256, 256], [400, 300])),
}
"""Of every algorithm with a replay buffer."""
OFFLINE: SearchSpace = {name: values for name, values in OFF_POLICY.items() if name != "learning_starts"}
"""Of algorithms for recorded episodes; each adds how far it may go from the recorded actions."""
HINDSIGHT: SearchSpace = {
    "replay_buffer_kwargs.n_sampled_goal": Integers(1, 5),
    "replay_buffer_kwargs.goal_selection_strategy": Choice(("final", "episode", "future")),
}
"""Further ones with :class:`rejeu.HerReplayBuffer`."""
ACTION_NOISE: SearchSpace = {"action_noise": Uniform(0.05, 1.0)}
"""Further ones of deterministic policies."""
Q_LEARNING: SearchSpace = {
    **{name: values for name, values in OFF_POLICY.items() if name != "tau"},
    "exploration_fraction": Uniform(0.02, 0.5),
    "exploration_final_eps": Uniform(0.0, 0.2),
    "target_update_interval": Choice((100, 1_000, 5_000, 10_000)),
    "policy_kwargs.net_arch": Choice(([64], [64, 64], [256, 256])),
}
"""Of DQN and QR-DQN."""
ROLLOUT: SearchSpace = {
    "learning_rate": LogUniform(1e-5, 2e-3),
    "n_steps": Choice((32, 64, 128, 256, 512, 1024, 2048)),
    "gamma": NearOne(0.97, 0.9999),
    "policy_kwargs.net_arch": Choice(([64], [64, 64], [256, 256])),
}
"""Of every algorithm that learns from rollouts."""
ON_POLICY: SearchSpace = {
    **ROLLOUT,
    "gae_lambda": NearOne(0.9, 0.9999),
    "ent_coef": LogUniform(1e-8, 0.1),
    "max_grad_norm": Uniform(0.3, 2.0),
    "policy_kwargs.activation_fn": Choice(("tanh", "relu")),
}
"""Of every algorithm with a policy and a value that learns from rollouts."""
PPO: SearchSpace = {
    **ON_POLICY,
    "batch_size": Choice((32, 64, 128, 256, 512)),
    "n_epochs": Choice((1, 5, 10, 20)),
    "clip_range": Choice((0.1, 0.2, 0.3, 0.4)),
}
PQN: SearchSpace = {
    **ROLLOUT,
    "n_steps": Choice((8, 16, 32, 64, 128)),
    "batch_size": Choice((64, 128, 256, 512)),
    "n_epochs": Choice((1, 2, 4)),
    "q_lambda": Uniform(0.3, 0.99),
    "exploration_fraction": Uniform(0.02, 0.5),
    "exploration_final_eps": Uniform(0.0, 0.2),
    "policy_kwargs.net_arch": Choice(([64, 64], [128, 128], [256, 256])),
}
