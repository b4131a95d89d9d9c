"""Implicit quantile networks: DQN that learns the quantile of the return of each action at any fraction.

Source: Dabney et al. 2018, "Implicit Quantile Networks for Distributional Reinforcement Learning" (arXiv 1806.06923). With the
features ``psi`` of an observation, the last layers ``f``, and target quantiles ``Z'``::

    phi_j(tau)   = relu(sum_i cos(pi i tau) w_ij + b_j),   i from 0 to n_cosines - 1         equation 4
    Z_tau(s, a)  = f(psi(s) * phi(tau))_a
    Q(s, a)      = 1/K sum_k Z_tau_k(s, a)
    a'           = argmax_a Q'(s', a)
    y_j          = r + d Z'_tau_j(s', a'),                 tau_j ~ U(0, 1), j = 1..N'
    u_ij         = y_j - Z_tau_i(s, a),                    tau_i ~ U(0, 1), i = 1..N
    J            = mean sum_i 1/N' sum_j |tau_i - 1{u_ij < 0}| h(u_ij)                         equation 3

The product is before the last hidden layer, or before the head if there are no hidden layers. The mean of ``K`` quantiles is
taken at the fractions ``(k + 1/2) / K``, where the paper draws them: the same mean with less noise, and equal actions for
equal observations. Target network, exploration and everything else are those of :mod:`rejeu.algorithms.dqn`; the optimizer is
that of QR-DQN, as in the paper. With ``munchausen_alpha`` it is M-IQN (Vieillard et al. 2020, arXiv 2007.14430).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers
from rejeu.algorithms.dqn import HIDDEN_LAYERS, Dueling, QLearningConfig, Returns, parted, q_learning, taken
from rejeu.algorithms.qrdqn import quantile_loss, quantile_target
from rejeu.algorithms.quantile_loss import quantile_fractions
from rejeu.core.algorithm import Algorithm, PyTree, rows_read
from rejeu.core.schedules import Schedule
from rejeu.core.spaces import Leaf
from rejeu.core.validation import coerce, whole
from rejeu.networks import Linear, Network, PolicyConfig, Torso, make_encoder, make_torso


@dataclass(frozen=True, kw_only=True)
class Config(QLearningConfig):
    """Hyperparameters of IQN; the defaults are those of the paper, and QR-DQN's where it names none."""

    learning_rate: float | Schedule = 5e-5
    n_quantiles: int = 64
    """Quantiles of each prediction that is learned from. A larger number has less noise, at a higher cost."""
    n_target_quantiles: int = 64
    """Quantiles of each target, likewise."""
    n_policy_quantiles: int = 32
    """Quantiles whose mean is the value by which actions are chosen."""
    n_cosines: int = 64
    """Cosines by which a fraction is described. A larger number tells closer fractions apart."""
    exploration_fraction: float = 0.005
    exploration_final_eps: float = 0.01
    max_grad_norm: float | None = None

    name: ClassVar[str] = "IQN"

    def __post_init__(self) -> None:
        QLearningConfig.__post_init__(self)
        coerce(self, ("n_quantiles", "n_target_quantiles", "n_policy_quantiles", "n_cosines"), whole, least=1)


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns IQN for these spaces; its state is DQN's, with :class:`ImplicitNetwork`.

    Raises:
        ValueError: if the action space is not Discrete.
        TypeError: if the observation space holds something that is not an array.
    """
    counts = config.n_quantiles, config.n_target_quantiles, config.n_policy_quantiles
    returns = implicit_returns(*counts, config.n_cosines)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm, eps=0.01 / config.batch_size)
    return q_learning(config, observation_space, action_space, returns, optimizer)


class ImplicitNetwork(eqx.Module):
    """Observation and fractions to the quantiles of the return of every action at these fractions."""

    encoder: PyTree
    torso: Torso
    """Hidden layers before the product with the description of the fractions."""
    embedding: Linear
    reader: PyTree
    """Maps the product to the quantiles of all actions."""

    def __init__(
        self, key: Array, leaves: tuple[Leaf, ...], shape: PolicyConfig, n_actions: int, dueling: bool, n_cosines: int
    ) -> None:
        keys = jax.random.split(key, 4)
        shared, reader_widths = parted(shape.critic_widths(HIDDEN_LAYERS), shape)
        self.encoder = make_encoder(keys[0], leaves, shape)
        self.torso, n_shared = make_torso(keys[1], self.encoder.n_features, None, shared, shape)
        self.embedding = Linear(keys[2], n_cosines, n_shared)
        plain = PolicyConfig(activation_fn=shape.activation_fn, layer_norm=shape.layer_norm, head=shape.head)
        features = (Leaf("", "continuous", (n_shared,), "float32"),)
        self.reader = (Dueling if dueling else Network)(keys[3], features, n_actions, reader_widths, plain)

    def __call__(self, obs: PyTree, fractions: Array) -> Array:
        """Maps observations ``(batch, ...)`` and fractions to quantiles ``(batch, n_actions, n)``.

        Fractions are ``(batch, n)``, or ``(1, n)`` for the same ones everywhere.
        """
        features = self.torso(self.encoder(obs))[:, None]
        frequencies = jnp.pi * jnp.arange(self.embedding.weight.shape[0], dtype=jnp.float32)
        cosines = jnp.cos(fractions.reshape(-1, 1) * frequencies[None])
        product = features * jax.nn.relu(self.embedding(cosines)).reshape(*fractions.shape, -1)
        quantiles = self.reader(product.reshape(-1, product.shape[-1]))
        return jnp.swapaxes(quantiles.reshape(*product.shape[:2], -1), 1, 2)


def implicit_returns(n_quantiles: int, n_target_quantiles: int, n_policy_quantiles: int, n_cosines: int) -> Returns:
    """Returns the prediction of the quantiles of the return at random fractions."""

    def values(network: PyTree, obs: PyTree, key: Array | None) -> Array:
        return jnp.mean(network(obs, quantile_fractions(n_policy_quantiles)[None]), axis=-1)

    def describe(network: PyTree, obs: PyTree, key: Array) -> Array:
        n = jax.tree.leaves(rows_read(obs))[0].shape[0]
        return network(obs, jax.random.uniform(key, (n, n_target_quantiles), jnp.float32))

    def loss(network: PyTree, obs: PyTree, action: Array, target: Array, key: Array) -> tuple[Array, Array, Array]:
        fractions = jax.random.uniform(key, (target.shape[0], n_quantiles), jnp.float32)
        return quantile_loss(taken(network(obs, fractions), action), target, fractions)

    build = partial(ImplicitNetwork, n_cosines=n_cosines)
    return Returns(build, values, describe, quantile_target, loss, is_random=True)
