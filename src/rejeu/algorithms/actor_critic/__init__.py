"""The common parts of the on-policy algorithms: hyperparameters, the network of policy and value, GAE, exploration by gSDE.

An encoder maps an observation to features, and separate or shared hidden layers map these to the parameters of a
distribution over actions and to a value. Actions may be Box (a normal distribution, optionally squashed), Discrete,
MultiDiscrete or MultiBinary. A policy with memory puts a recurrent cell between the features and the hidden layers.
"""

from rejeu.algorithms.actor_critic.config import OnPolicyConfig
from rejeu.algorithms.actor_critic.steps import minibatches

__all__ = ["OnPolicyConfig", "minibatches"]
