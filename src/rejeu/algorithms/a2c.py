"""Advantage actor-critic: one gradient step on each short rollout.

Source: Mnih et al. 2016, "Asynchronous Methods for Deep Reinforcement Learning" (arXiv 1602.01783, algorithm S3), in its
synchronous form: all environments step together and the gradient is that of all their steps. With advantages ``A`` and the
value's targets ``R = A + V_old``::

    loss = -mean log pi(a | s) A + vf_coef mean (V(s) - R)^2 - ent_coef mean entropy(pi(. | s))

By default advantages sum the rewards to the rollout's end and add the value there (``gae_lambda`` 1), and the optimizer is
RMSprop, as in the paper. It is PyTorch's, as in Stable-Baselines3: the mean ``v`` of squared gradients begins at 0, and a step
is ``g / (sqrt(v) + rms_prop_eps)``. TensorFlow's, with epsilon under the root, hardly moves a policy whose gradients are small
beside those of the values: it does not learn LunarLander. ``optimizer`` takes it as well, with ``"initial_scale": 1.0``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.actor_critic.config import OnPolicyConfig
from rejeu.algorithms.actor_critic.network import ActorCritic, algorithm_of, checked
from rejeu.algorithms.actor_critic.steps import (
    Samples,
    clip_and_descend,
    entropy_of,
    explained_variance,
    masked_mean,
    samples,
    standardized,
    std_of,
)
from rejeu.core.algorithm import EXPLAINED_VARIANCE, Algorithm, Clock, Metrics, PyTree, Rollout
from rejeu.core.schedules import Schedule, at
from rejeu.core.validation import coerce, flag, number


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """Hyperparameters of A2C; the defaults are Stable-Baselines3's."""

    learning_rate: float | Schedule = 7e-4
    n_steps: int = 5
    """Steps of each environment between two updates. A larger number estimates the gradient better and updates less
    often."""
    gae_lambda: float = 1.0
    """Lambda of generalized advantage estimation, in [0, 1]: 0 bootstraps after one step, 1 sums all rewards of the
    rollout. A larger value has less bias and more variance."""
    normalize_advantage: bool = False
    """Normalize the advantages of every rollout to mean 0 and standard deviation 1."""
    use_rms_prop: bool = True
    """Use RMSprop as the paper does; False uses Adam."""
    rms_prop_eps: float = 1e-5
    """Epsilon of RMSprop or Adam, added to the square root."""

    optimizer: Any = None
    """As for the other algorithms, such as ``"adamw"`` or ``optax.lamb``. None follows ``use_rms_prop``."""

    name: ClassVar[str] = "A2C"

    def __post_init__(self) -> None:
        OnPolicyConfig.__post_init__(self)
        coerce(self, "use_rms_prop", flag)
        coerce(self, "rms_prop_eps", number, above=0)


class State(eqx.Module):
    """Everything that A2C learns; every leaf is an array."""

    network: ActorCritic
    optimizer: PyTree
    n_updates: Array
    """Gradient steps so far, ``int32[]``."""


class Losses(NamedTuple):
    """The losses of a rollout, each ``float32[]``."""

    policy_loss: Array
    value_loss: Array
    entropy: Array


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns A2C for these spaces.

    Raises:
        ValueError: if no policy can act in the action space, or if the settings do not fit the observation space.
    """
    obs_leaves, action_kind, shape = checked(config, observation_space, action_space)
    optimizer = optimizer_of(config)

    def init(key: Array) -> State:
        network = ActorCritic(key, obs_leaves, action_kind, shape, config.use_sde)
        return State(network, optimizer.init(network), jnp.int32(0))

    def update(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        data = samples(state.network, rollout, config.gae_lambda)
        if config.normalize_advantage:
            data = data._replace(advantage=standardized(data.advantage, data.valid))
        (_, losses), gradients = jax.value_and_grad(loss, has_aux=True)(state.network, data, config, clock)
        descent = state.optimizer, optimizer, config, clock.progress
        network, optimizer_state = clip_and_descend(state.network, gradients, *descent)
        metrics = {
            "policy_loss": losses.policy_loss,
            "value_loss": losses.value_loss,
            "entropy_loss": -losses.entropy,
            EXPLAINED_VARIANCE: explained_variance(data.value, data.target, data.valid),
            **std_of(network),
        }
        return State(network, optimizer_state, state.n_updates + 1), metrics

    return algorithm_of(config, action_kind, init, update)


def optimizer_of(config: Config) -> optax.GradientTransformation:
    """Returns the optimizer of a configuration: RMSprop, unless it chooses another."""
    if config.optimizer is None and config.use_rms_prop:
        return optax.scale_by_rms(optimizers.RMSPROP_DECAY, config.rms_prop_eps, eps_in_sqrt=False)
    return optimizers.make(config.optimizer or "adam", eps=config.rms_prop_eps)


def loss(network: ActorCritic, batch: Samples, config: Config, clock: Clock) -> tuple[Array, Losses]:
    """Returns the total loss of a rollout and its parts (see the docstring of this module)."""
    distribution, value = network.both(batch.obs)
    log_prob = distribution.log_prob(batch.action)
    policy_loss = -masked_mean(batch.advantage * log_prob, batch.valid)
    value_loss = masked_mean(jnp.square(value - batch.target), batch.valid)
    entropy = masked_mean(entropy_of(distribution, log_prob), batch.valid)
    total = policy_loss + config.vf_coef * value_loss - at(config.ent_coef, clock.progress) * entropy
    return total, Losses(policy_loss, value_loss, entropy)
