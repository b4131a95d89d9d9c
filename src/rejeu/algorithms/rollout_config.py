"""The hyperparameters of every algorithm that learns from rollouts: what the loops and the rollout buffer read."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from rejeu import normalization, schedules
from rejeu.algorithms import optimizers, search
from rejeu.algorithms.search import SearchSpace
from rejeu.networks import PolicyConfig, Widths
from rejeu.normalization import NormalizationConfig
from rejeu.schedules import Schedule
from rejeu.validation import assign, choice, coerce, nested, number, whole


@dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """The hyperparameters of every algorithm that learns from rollouts of its present policy."""

    learning_rate: float | Schedule = 3e-4
    """Step size of the optimizer: a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)``,
    ``"lin_3e-4"`` or a function of the progress from 0 to 1. A larger value learns faster until it diverges."""
    n_steps: int = 2048
    """Steps of each environment between two updates. A larger number estimates the gradient better and updates less
    often."""
    n_episodes: int | None = None
    """Complete episodes of each environment between two updates, instead of ``n_steps``; environments that are done wait
    for the others. Without a time limit an episode counts at most ``n_steps`` steps. None uses ``n_steps``."""
    gamma: float = 0.99
    """Discount factor, in [0, 1]."""
    max_grad_norm: float | None = 0.5
    """Maximum norm of the gradient; larger gradients are scaled down. None: no limit."""
    normalize: NormalizationConfig | None = None
    """Normalize observations and rewards by running statistics: True, or a dict with ``norm_obs``, ``norm_reward``,
    ``clip_obs``, ``clip_reward``. The statistics are saved with the agent, which takes raw observations."""
    nonfinite: Literal["stop", "skip"] = "stop"
    """What to do if an update results in a loss or a weight that is NaN or infinite: ``"stop"`` with an error that names
    it and saves the rollout, or ``"skip"`` that update and count it."""
    optimizer: Any = "adam"
    """``"adam"``, ``"adamw"``, ``"nadam"``, ``"radam"``, ``"amsgrad"``, ``"lion"``, ``"rmsprop"``, ``"sgd"``, an Optax
    optimizer such as ``optax.lamb``, or one that was created with the learning rate 1, which is then ``learning_rate``."""
    policy_kwargs: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    """Shape of the networks: ``net_arch``, ``activation_fn``, ``layer_norm``, ``cnn_layer_norm``, ``architecture``, or
    modules of your own as ``encoder``, ``torso`` and ``head``."""

    name: ClassVar[str] = ""
    is_checked: ClassVar[bool] = False
    """Whether :meth:`__post_init__` has run; set on each instance."""
    policy_kwargs_class: ClassVar[type[PolicyConfig]] = PolicyConfig
    """The class of ``policy_kwargs``."""
    hidden_layers: ClassVar[Widths] = Widths((64, 64), (64, 64))
    """Default widths of the networks."""
    hidden_layers_on_images: ClassVar[Widths] = Widths((), ())
    """The same where the observation is an image."""
    search_space: ClassVar[SearchSpace] = search.ROLLOUT
    """Where ``rejeu tune`` searches, by the name of the hyperparameter."""

    def __post_init__(self) -> None:
        coerce(self, "learning_rate", schedules.parse, least=0)
        coerce(self, "optimizer", optimizers.parse, optional=True)
        coerce(self, "n_steps", whole, least=1)
        coerce(self, "n_episodes", whole, least=1, optional=True)
        coerce(self, "gamma", number, least=0, most=1)
        coerce(self, "max_grad_norm", number, above=0, optional=True)
        assign(self, normalize=normalization.parse(self.normalize))
        coerce(self, "nonfinite", choice, among=("stop", "skip"))
        coerce(self, "policy_kwargs", nested, kind=self.policy_kwargs_class)
        assign(self, is_checked=True)

    def steps_per_gradient(self, n_envs: int) -> int:
        """Returns the number of steps of ``n_envs`` environments per gradient step."""
        return self.n_steps * n_envs

    def gradient_steps(self, n: int) -> int:
        """Returns the number of gradient steps on a rollout of ``n`` steps, if nothing stops them early."""
        return 1

    def learns_from_part(self, n: int, n_envs: int) -> bool:
        """Returns whether an incomplete rollout of ``n`` steps is learned from when ``learn`` ends.

        It must hold a minibatch at least. Where a whole rollout is one minibatch it is never learned from.
        """
        return False

    @property
    def stops_early(self) -> bool:
        """Whether the gradient steps may stop early; the metric ``gradient_steps`` is then their number."""
        return False
