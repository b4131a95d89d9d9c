"""What the on-policy algorithms share: their hyper-parameters, the network of policy and value, and how it acts.

The network reads an observation into features, and separate or shared hidden layers turn these into the parameters of a
distribution over actions and into a value. Actions may be Box (a normal distribution, squashed by option), Discrete,
MultiDiscrete or MultiBinary. A policy with memory puts a recurrent cell between the features and the hidden layers.
"""

from rejeu.algorithms.actor_critic.config import (
    HIDDEN_LAYERS,
    ActorCriticConfig,
    OnPolicyConfig,
    check_flag,
    check_value_rate,
)
from rejeu.algorithms.actor_critic.network import (
    HIDDEN_GAIN,
    LOG_STD_RANGE,
    POLICY_GAIN,
    VALUE_GAIN,
    ActionKind,
    ActorCritic,
    Distribution,
    action_kind,
    is_value,
    orthogonal,
    unmasked,
)
from rejeu.algorithms.actor_critic.steps import (
    Samples,
    clipped,
    entropy_of,
    explained_variance,
    masked_mean,
    masked_variance,
    samples,
    standardised,
)
from rejeu.exploration.state_dependent import SDE_EPSILON, explorer_of, sde_explorer, sde_log_std

__all__ = [
    "HIDDEN_GAIN",
    "HIDDEN_LAYERS",
    "LOG_STD_RANGE",
    "POLICY_GAIN",
    "SDE_EPSILON",
    "VALUE_GAIN",
    "ActionKind",
    "ActorCritic",
    "ActorCriticConfig",
    "Distribution",
    "OnPolicyConfig",
    "Samples",
    "action_kind",
    "check_flag",
    "check_value_rate",
    "clipped",
    "entropy_of",
    "explained_variance",
    "explorer_of",
    "is_value",
    "masked_mean",
    "masked_variance",
    "orthogonal",
    "samples",
    "sde_explorer",
    "sde_log_std",
    "standardised",
    "unmasked",
]
