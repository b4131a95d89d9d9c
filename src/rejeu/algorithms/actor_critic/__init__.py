"""What the on-policy algorithms share: hyperparameters, the network of policy and value, GAE, exploration by gSDE.

An encoder maps an observation to features, and separate or shared hidden layers map these to the parameters of a
distribution over actions and to a value. Actions may be Box (a normal distribution, optionally squashed), Discrete,
MultiDiscrete or MultiBinary. A policy with memory puts a recurrent cell between the features and the hidden layers.
"""

from rejeu.algorithms.actor_critic.config import ActorCriticConfig, OnPolicyConfig
from rejeu.algorithms.actor_critic.network import (
    HIDDEN_GAIN,
    ActionKind,
    ActorCritic,
    Distribution,
    action_kind,
    checked,
    is_value,
    orthogonal,
    unmasked,
)
from rejeu.algorithms.actor_critic.state_dependent import explorer_of, sde_explorer
from rejeu.algorithms.actor_critic.steps import (
    Samples,
    clip_and_descend,
    entropy_of,
    explained_variance,
    flat,
    masked_mean,
    minibatches,
    samples,
    shuffled,
    standardized,
    with_advantages,
)

__all__ = [
    "HIDDEN_GAIN",
    "ActionKind",
    "ActorCritic",
    "ActorCriticConfig",
    "Distribution",
    "OnPolicyConfig",
    "Samples",
    "action_kind",
    "checked",
    "clip_and_descend",
    "entropy_of",
    "explained_variance",
    "explorer_of",
    "flat",
    "is_value",
    "masked_mean",
    "minibatches",
    "orthogonal",
    "samples",
    "sde_explorer",
    "shuffled",
    "standardized",
    "unmasked",
    "with_advantages",
]
