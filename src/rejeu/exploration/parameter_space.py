"""Adaptive noise on the parameters of the acting network: an episode long, one consistently different policy.

Source: Plappert et al. 2017, "Parameter Space Noise for Exploration" (arXiv 1706.01905). At the start of each episode
every environment draws its own ``z ~ N(0, sigma^2 I)`` and acts by ``theta + z`` until the episode ends. ``sigma`` is
steered so that the two policies differ by a set amount in what they do, over the states that the episode visited
(section 3 and appendix C)::

    continuous   d = sqrt(mean (pi_{theta + z}(s)_i - pi_theta(s)_i)^2),     target: target_distance
    discrete     d = mean KL(softmax Q_theta(s) || softmax Q_{theta + z}(s)),
                                                   target: -log(1 - target_distance + target_distance / |A|)
    sigma       <- sigma adaptation      if d <= target
                   sigma / adaptation    otherwise

Normalization layers are not perturbed, as in the paper (:data:`NORMALIZATION_LAYERS`). Departures from the paper: ``z``
is added to the current parameters at each step rather than to a copy from the start of the episode, so that ``d``
measures the noise and not what was learned meanwhile; ``d`` is taken over the states of the episode rather than a batch
of the replay buffer; and an episode counts as one adaptation per ``adaptation_interval`` steps (at least one), so that
long episodes adapt as fast as short ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rejeu.core.algorithm import Algorithm, Clock, PyTree, renew
from rejeu.core.validation import coerce, number, whole
from rejeu.networks import LayerNorm
from rejeu.networks.batch_renorm import BatchRenorm
from rejeu.networks.layers import RMSNorm

NORMALIZATION_LAYERS: tuple[type[eqx.Module], ...] = (
    LayerNorm,
    BatchRenorm,
    RMSNorm,
    eqx.nn.LayerNorm,
    eqx.nn.RMSNorm,
    eqx.nn.GroupNorm,
)
"""Layers whose parameters are not perturbed."""


@dataclass(frozen=True)
class ParameterNoise:
    """Settings of adaptive noise on the actor's parameters; layer norm (``policy_kwargs``) makes it work well.

    >>> ParameterNoise(target_distance=0.2)
    ParameterNoise(initial_sigma=0.1, target_distance=0.2, adaptation=1.01, adaptation_interval=50)
    """

    initial_sigma: float = 0.1
    """Standard deviation of the noise on each parameter at first, at least 0. 0 stays 0: no noise."""
    target_distance: float = 0.1
    """How differently the perturbed policy is to act. For continuous actions in [-1, 1], the standard deviation of
    Gaussian action noise that differs as much; for discrete ones, the epsilon (below 1) of an epsilon-greedy policy
    that does. Raising it explores more."""
    adaptation: float = 1.01
    """Factor by which the noise grows or shrinks at each adaptation, at least 1; 1 keeps it as it is."""
    adaptation_interval: int = 50
    """Steps of an episode that count as one adaptation. Raising it adapts more slowly."""

    def __post_init__(self) -> None:
        for key, least in (("initial_sigma", 0.0), ("target_distance", 0.0), ("adaptation", 1.0)):
            coerce(self, key, number, least=least)
        coerce(self, "adaptation_interval", whole, least=1)


class State(eqx.Module):
    """The state of parameter noise; every leaf is an array with one row per environment, except ``sigma``."""

    perturbation: list[Array]
    """Added to the leaves of the actor that are perturbed, in order; each ``(n_envs, ...)``."""
    sigma: Array
    """Standard deviation of the next perturbation, ``float32[]``, shared: every environment's episodes steer it."""
    distance: Array
    """Sum over the running episode of the squared distance (continuous) or the divergence (discrete), ``(n_envs,)``."""
    count: Array
    """Steps in that sum, ``int32 (n_envs,)``; -1 before the first perturbation is drawn."""


def initial(noise: ParameterNoise, actor: PyTree, n_envs: int) -> State:
    """Returns the state before the first episodes; of ``actor`` only the shapes are used."""
    leaves, perturbed = jax.tree.leaves(actor), perturbed_leaves(actor)
    return State(
        perturbation=[jnp.zeros((n_envs, *leaves[i].shape), leaves[i].dtype) for i in perturbed],
        sigma=jnp.float32(noise.initial_sigma),
        distance=jnp.zeros(n_envs, jnp.float32),
        count=jnp.full(n_envs, -1, jnp.int32),
    )


def act(
    noise: ParameterNoise,
    algorithm: Algorithm,
    state: State,
    actor: PyTree,
    obs: PyTree,
    ended: Array,
    key: Array,
    clock: Clock,
) -> tuple[Array, State]:
    """Returns the exploring actions of the perturbed actors, ``(n_envs, ...)``, and the state after this step."""
    draw_key, action_key = jax.random.split(key)
    n_envs = ended.shape[0]
    discrete = jnp.issubdtype(jax.eval_shape(algorithm.exploit, actor, obs).dtype, jnp.integer)
    behavior = (lambda actor, obs: actor(obs)) if discrete else algorithm.exploit  # values or logits of all actions
    plain = behavior(actor, obs)
    target = divergence_target(noise.target_distance, plain.shape[-1]) if discrete else noise.target_distance**2
    state = begin_episodes(noise, state, ended | (state.count < 0), target, draw_key)

    def one(perturbation: list[Array], obs: PyTree, key: Array) -> tuple[Array, Array]:
        perturbed, obs = perturb(actor, perturbation), jax.tree.map(lambda leaf: leaf[None], obs)
        return algorithm.explore(perturbed, obs, key, clock)[0], behavior(perturbed, obs)[0]

    action, varied = jax.vmap(one)(state.perturbation, obs, jax.random.split(action_key, n_envs))
    distance = divergence(plain, varied) if discrete else squared_distance(plain, varied)
    return action, State(state.perturbation, state.sigma, state.distance + distance, state.count + 1)


def begin_episodes(noise: ParameterNoise, state: State, begins: Array, target: float, key: Array) -> State:
    """Returns the state with ``sigma`` adapted by the episodes that are over and new noise where ``begins``.

    ``target`` is what the mean of ``distance`` is compared with. Noise is only drawn when an episode begins: that
    costs more than acting does.
    """
    sigma = adapt(noise, state, begins, target)

    def drawn() -> list[Array]:
        fresh = [
            sigma.astype(old.dtype) * jax.random.normal(jax.random.fold_in(key, i), old.shape, old.dtype)
            for i, old in enumerate(state.perturbation)
        ]
        return renew(begins, fresh, state.perturbation)

    return State(
        perturbation=jax.lax.cond(begins.any(), drawn, lambda: state.perturbation),
        sigma=sigma,
        distance=jnp.where(begins, 0.0, state.distance),
        count=jnp.where(begins, 0, state.count),
    )


def adapt(noise: ParameterNoise, state: State, ended: Array, target: float) -> Array:
    """Returns ``sigma`` after the episodes that ``ended``, each of which moves it toward the target distance."""
    count = state.count.astype(jnp.float32)
    too_close = state.distance <= target * count
    times = jnp.maximum(count / noise.adaptation_interval, 1.0)
    votes = jnp.where(ended & (state.count > 0), jnp.where(too_close, times, -times), 0.0)
    return state.sigma * jnp.exp(math.log(noise.adaptation) * jnp.sum(votes))


def perturb(actor: PyTree, perturbation: list[Array]) -> PyTree:
    """Returns ``actor`` with ``perturbation`` added to the leaves that are perturbed."""
    leaves, structure = jax.tree.flatten(actor)
    for i, change in zip(perturbed_leaves(actor), perturbation, strict=True):
        leaves[i] = leaves[i] + change
    return jax.tree.unflatten(structure, leaves)


def perturbed_leaves(actor: PyTree) -> list[int]:
    """Returns the positions of the leaves that are perturbed: floating-point numbers outside normalization layers."""
    positions: list[int] = []
    n = 0
    for node in jax.tree.leaves(actor, is_leaf=lambda node: isinstance(node, NORMALIZATION_LAYERS)):
        leaves = jax.tree.leaves(node)
        if not isinstance(node, NORMALIZATION_LAYERS) and jnp.issubdtype(leaves[0].dtype, jnp.floating):
            positions.append(n)
        n += len(leaves)
    return positions


def squared_distance(plain: Array, varied: Array) -> Array:
    """Returns the mean squared difference of actions ``(batch, action_dim)``, ``(batch,)``."""
    return jnp.mean(jnp.square(varied - plain), axis=-1)


def divergence(plain: Array, varied: Array) -> Array:
    """Returns ``KL(softmax plain || softmax varied)`` in nats, ``(batch,)``."""
    log_plain, log_varied = jax.nn.log_softmax(plain, axis=-1), jax.nn.log_softmax(varied, axis=-1)
    return jnp.sum(jnp.exp(log_plain) * (log_plain - log_varied), axis=-1)


def divergence_target(epsilon: float, n_actions: int) -> float:
    """Returns the divergence in nats of an epsilon-greedy policy from the greedy one.

    Raises:
        ValueError: if ``epsilon`` is 1 or more.
    """
    if epsilon >= 1.0:
        raise ValueError(f"ParameterNoise: target_distance={epsilon} must be below 1 for discrete actions")
    return -math.log(1.0 - epsilon + epsilon / n_actions)
