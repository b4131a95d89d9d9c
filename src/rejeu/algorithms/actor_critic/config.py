"""The hyperparameters that the on-policy algorithms share, and the shape of their network."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from rejeu.algorithms import search
from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.algorithms.search import SearchSpace
from rejeu.core import schedules
from rejeu.core.schedules import Schedule
from rejeu.core.spaces import Leaf
from rejeu.core.validation import assign, coerce, flag, number, whole
from rejeu.networks import PolicyConfig, Widths, convolutions, split_net_arch

HIDDEN_LAYERS = (64, 64)
"""Default widths of policy and value."""


@dataclass(frozen=True)
class ActorCriticConfig(PolicyConfig):
    """The shape of policy and value networks (Stable-Baselines3's ``policy_kwargs`` of PPO and A2C)."""

    activation_fn: Any = "tanh"
    """Nonlinearity after each hidden layer: relu, tanh, elu, gelu, silu, leaky_relu or sigmoid, or a function or class
    of that name."""
    vf: tuple[int, ...] | None = None
    """Widths of the value's hidden layers where they differ from ``net_arch``; also ``net_arch={"pi": [...], "vf":
    [...]}``."""
    share_features_extractor: bool = True
    """Policy and value read images through the same convolutions."""
    share_layers: bool = False
    """Policy and value share the hidden layers as well and differ in their heads only."""
    ortho_init: bool = True
    """Draw weights orthogonal, with gains for each part, rather than uniform."""
    log_std_init: float = 0.0
    """Logarithm of the standard deviation of Box actions at the start, the action's range being [-1, 1]."""
    learn_std: bool = True
    """Learn the standard deviation; False keeps it at ``log_std_init``."""
    state_dependent_std: bool = False
    """Compute the standard deviation from the observation rather than learn one for all."""
    use_expln: bool = False
    """With ``use_sde``: let the standard deviation grow linearly and not exponentially where its parameter is positive
    (arXiv 2005.05719), so that it stays bounded."""
    squash_output: bool = False
    """Squash Box actions into their bounds by tanh, where otherwise they are clipped."""

    def __post_init__(self) -> None:
        if isinstance(self.net_arch, Mapping):
            split_net_arch(self, {"pi": "pi", "vf": "vf", "qf": "qf"})
        if self.vf is not None:
            assign(self, qf=self.vf)
        PolicyConfig.__post_init__(self)
        assign(self, vf=self.qf)
        flags = (
            "share_features_extractor",
            "share_layers",
            "ortho_init",
            "learn_std",
            "state_dependent_std",
            "use_expln",
        )
        coerce(self, (*flags, "squash_output"), flag)
        coerce(self, "log_std_init", number)
        if self.state_dependent_std and not self.learn_std:
            raise ValueError("policy_kwargs: state_dependent_std=True conflicts with learn_std=False")
        if self.share_layers and not self.share_features_extractor:
            raise ValueError(
                "policy_kwargs: share_layers=True conflicts with share_features_extractor=False; leave out one"
            )
        self._check_shared_widths()

    def _check_shared_widths(self) -> None:
        """Raises ``ValueError`` if layers that policy and value share are given widths for each."""
        key, value_widths = ("critic_layers", self.critic_layers or None) if self.has_branches else ("vf", self.vf)
        widths = self.actor_widths(HIDDEN_LAYERS)
        if self.share_layers and value_widths is not None and value_widths != widths:
            raise ValueError(
                f"policy_kwargs: share_layers=True has one stack of hidden layers, of the policy's widths {list(widths)}, "
                f"and conflicts with {key}={list(value_widths)}; leave out one"
            )


@dataclass(frozen=True, kw_only=True)
class OnPolicyConfig(RolloutConfig):
    """The hyperparameters of every on-policy algorithm with a policy and a value."""

    gae_lambda: float = 0.95
    """Lambda of generalized advantage estimation, in [0, 1]: 0 bootstraps after one step, 1 sums all rewards to the end
    of the episode and subtracts the value. A larger value has less bias and more variance."""
    ent_coef: float | Schedule = 0.0
    """Weight of the entropy bonus. A larger value keeps the policy random for longer."""
    vf_coef: float = 0.5
    """Weight of the value loss. Without shared layers it affects only the clipping of the gradient."""
    critic_learning_rate: float | Schedule | None = None
    """Learning rate of the value alone, whose gradient is then clipped separately. None uses ``learning_rate`` for
    both. Needs ``share_layers=False``, and of images ``share_features_extractor=False``."""
    use_sde: bool = False
    """Explore by state-dependent noise (gSDE), which is kept for many steps and gives smooth motion. Box actions only."""
    sde_sample_freq: int = -1
    """Steps after which that noise is resampled; -1: in every rollout. A new episode has new noise as well."""
    normalize_advantage: bool = True
    """Normalize the advantages of every batch to mean 0 and standard deviation 1."""
    policy_kwargs: ActorCriticConfig = dataclasses.field(default_factory=ActorCriticConfig)
    """Shape of the networks: ``net_arch`` (also ``dict(pi=[...], vf=[...])``), ``activation_fn``, ``ortho_init``,
    ``log_std_init``, ``share_layers``, ``squash_output``, ``state_dependent_std``, ``layer_norm``, ``architecture``, or
    modules of your own as ``encoder``, ``torso`` and ``head``."""

    can_mask: ClassVar[bool] = True
    policy_kwargs_class: ClassVar[type[PolicyConfig]] = ActorCriticConfig
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    """Default widths of policy and value."""
    search_space: ClassVar[SearchSpace] = search.ON_POLICY

    def __post_init__(self) -> None:
        RolloutConfig.__post_init__(self)
        coerce(self, "ent_coef", schedules.parse, least=0)
        coerce(self, "critic_learning_rate", schedules.parse, least=0, optional=True)
        coerce(self, "gae_lambda", number, least=0, most=1)
        coerce(self, "vf_coef", number, least=0)
        coerce(self, ("normalize_advantage", "use_sde"), flag)
        coerce(self, "sde_sample_freq", whole, least=-1)
        if self.sde_sample_freq == 0:
            raise ValueError("sde_sample_freq=0 would sample no noise; use 1 or more, or -1 for once per episode")
        if self.critic_learning_rate is not None and self.policy_kwargs.share_layers:
            raise ValueError(
                "critic_learning_rate is a learning rate of its own for the value, which share_layers=True forbids; leave "
                "one of them out"
            )
        if self.use_sde and (self.policy_kwargs.state_dependent_std or not self.policy_kwargs.learn_std):
            raise ValueError(
                "use_sde=True has a standard deviation of its own; leave state_dependent_std and learn_std out"
            )


def check_value_rate(config: OnPolicyConfig, obs_leaves: tuple[Leaf, ...]) -> None:
    """Raises ``ValueError`` if the value has an optimizer of its own and its convolutions are the policy's too."""
    shape = config.policy_kwargs
    learns = shape.encoder is not None or any(convolutions(leaf, shape) for leaf in obs_leaves)
    shared = shape.share_features_extractor and learns
    if config.critic_learning_rate is not None and shared:
        raise ValueError(
            "critic_learning_rate is a learning rate of its own for the value, and of images policy and value share the "
            "convolutions; give policy_kwargs=dict(share_features_extractor=False) or leave it out"
        )
