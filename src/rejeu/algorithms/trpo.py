"""Trust region policy optimization: the largest step of the policy within a bound on its KL divergence.

Source: Schulman et al. 2015, "Trust Region Policy Optimization" (arXiv 1502.05477, appendix C), with the advantages of
:mod:`rejeu.algorithms.actor_critic.gae`. With the policy ``pi``, the policy ``pi_old`` that collected the rollout,
advantages ``A``, the mean divergence ``D(theta) = mean KL(pi_old(. | s) || pi(. | s))``, its Hessian ``F`` at ``pi_old``
and the bound ``delta``::

    L(theta)  = mean pi(a | s) / pi_old(a | s) A
    x         = (F + cg_damping I)^-1 g,     g = gradient of L at pi_old,        by conjugate gradients
    theta     = theta_old + shrink^i sqrt(2 delta / (x . (F + cg_damping I) x)) x

for the first ``i`` from 0 at which ``L`` has improved and ``D < delta``; the policy stays if there is none. Then the value
takes ``n_critic_updates`` passes of gradient steps on ``mean (V(s) - R)^2``, ``R = A + V_old``. Products with ``F`` are
derivatives of the gradient of ``D``, so the matrix is never formed.

Defaults are those of Stable-Baselines3 Contrib. Unlike there, ``D`` is the paper's divergence also in the line search, where
sb3-contrib has the reversed one; to second order the two are equal.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array
from jax.scipy.sparse.linalg import cg

from rejeu.algorithms import optimizers
from rejeu.algorithms.actor_critic.config import OnPolicyConfig
from rejeu.algorithms.actor_critic.network import ActorCritic, algorithm_of, checked, is_value
from rejeu.algorithms.actor_critic.steps import (
    RolloutState as State,
    Samples,
    explained_variance,
    initial_state,
    masked_mean,
    minibatches,
    samples,
    standardized,
    std_of,
)
from rejeu.algorithms.search import LogUniform, NearOne, SearchSpace
from rejeu.core.algorithm import (
    EXPLAINED_VARIANCE,
    GRADIENT_STEPS,
    Algorithm,
    Clock,
    Metrics,
    PyTree,
    Rollout,
    minimize,
)
from rejeu.core.prng import nth
from rejeu.core.schedules import Schedule, at
from rejeu.core.validation import coerce, number, whole


@dataclass(frozen=True, kw_only=True)
class Config(OnPolicyConfig):
    """Hyperparameters of TRPO; the defaults are those of Stable-Baselines3 Contrib."""

    learning_rate: float | Schedule = 1e-3
    """Learning rate of the value. The policy's step follows from ``target_kl``."""
    batch_size: int = 128
    """Steps per gradient step of the value."""
    target_kl: float = 0.01
    """Bound on the mean KL divergence between two policies, in nats. A larger value takes larger, riskier steps."""
    cg_max_steps: int = 15
    """Steps of conjugate gradients. More find the direction more precisely, at a higher cost."""
    cg_damping: float = 0.1
    """Added to the diagonal of the Hessian. A larger value is more stable and turns the step toward the plain gradient."""
    line_search_shrinking_factor: float = 0.8
    """Factor of the step after each attempt that is refused, in (0, 1)."""
    line_search_max_iter: int = 10
    """Attempts before the policy stays as it is."""
    n_critic_updates: int = 10
    """Passes of the value over every rollout."""
    sub_sampling_factor: int = 1
    """Every so many steps of the rollout count for the policy's step. A larger number computes less. With several
    environments it should have no divisor in common with their number, because they lie side by side."""
    max_grad_norm: float | None = None
    """Limit of the norm of the value's gradient. None: no limit."""
    # Class variables in place of inherited fields take the fields away: they have no meaning here.
    ent_coef: ClassVar[float] = 0.0  # type: ignore[misc]
    vf_coef: ClassVar[float] = 1.0  # type: ignore[misc]
    critic_learning_rate: ClassVar[None] = None  # type: ignore[misc]

    name: ClassVar[str] = "TRPO"
    search_space: ClassVar[SearchSpace] = {
        "gamma": NearOne(0.9, 0.9999),
        "gae_lambda": NearOne(0.8, 0.99),
        "learning_rate": LogUniform(1e-5, 1e-2),
        "target_kl": LogUniform(1e-3, 1e-1),
    }

    def __post_init__(self) -> None:
        OnPolicyConfig.__post_init__(self)
        whole_fields = ("batch_size", "cg_max_steps", "line_search_max_iter", "n_critic_updates", "sub_sampling_factor")
        coerce(self, whole_fields, whole, least=1)
        coerce(self, "target_kl", number, above=0)
        coerce(self, "cg_damping", number, least=0)
        coerce(self, "line_search_shrinking_factor", number, above=0, most=1)

    def gradient_steps(self, n: int) -> int:
        """Returns the number of gradient steps on a rollout of ``n`` steps: those of the value, and one of the policy."""
        return 1 + self.n_critic_updates * -(-n // self.batch_size)


class TrustRegionStep(NamedTuple):
    """The policy's step on a rollout, each ``float32[]``."""

    objective: Array
    """``L`` after the step."""
    kl: Array
    """Mean KL divergence from the policy before, in nats."""
    accepted: Array
    """1 if the line search took a step, else 0."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns TRPO for these spaces.

    Raises:
        ValueError: if no policy can act in the action space, or if the settings do not fit the observation space.
    """
    obs_leaves, action_kind, shape = checked(config, observation_space, action_space)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm)

    def init(key: Array) -> State:
        def make_network(key: Array) -> ActorCritic:
            return ActorCritic(key, obs_leaves, action_kind, shape, config.use_sde)

        return initial_state(key, make_network, optimizer)

    def update(state: State, rollout: Rollout, clock: Clock) -> tuple[State, Metrics]:
        warn_of_unused(config.sub_sampling_factor, rollout.reward.shape[1])
        data = samples(state.network, rollout, config.gae_lambda)
        network, trust_region_step = policy_step(state.network, data, config)
        order_key = nth(state.key, state.n_rollouts)
        minibatch, n_steps = minibatches(data, order_key, config.n_critic_updates, config.batch_size)
        rate = at(config.learning_rate, clock.progress)

        def fit(i: Array, learned: tuple[ActorCritic, PyTree, Array]) -> tuple[ActorCritic, PyTree, Array]:
            network, optimizer_state, total = learned
            batch = minibatch(i)
            network, optimizer_state, loss, _ = minimize(value_loss, network, optimizer_state, optimizer, rate, batch)
            return network, optimizer_state, total + loss

        before = network, state.optimizer, jnp.float32(0.0)
        network, optimizer_state, total = jax.lax.fori_loop(0, n_steps, fit, before)
        metrics = {
            "policy_objective": trust_region_step.objective,
            "kl_divergence_loss": trust_region_step.kl,
            "is_line_search_success": trust_region_step.accepted,
            "value_loss": total / jnp.maximum(n_steps, 1),
            GRADIENT_STEPS: (1 + n_steps).astype(jnp.float32),
            EXPLAINED_VARIANCE: explained_variance(data.value, data.target, data.valid),
            "learning_rate": jnp.asarray(rate, jnp.float32),
            **std_of(network),
        }
        return state.after(network, optimizer_state, 1 + n_steps), metrics

    return algorithm_of(config, action_kind, init, update)


def warn_of_unused(factor: int, n_envs: int) -> None:
    """Warns if every ``factor``-th step is always one of the same environments, as they are side by side in a rollout."""
    if (shared := math.gcd(factor, n_envs)) > 1:
        text = f"sub_sampling_factor={factor} takes {n_envs // shared} of {n_envs} environments only"
        warnings.warn(text, stacklevel=2)


def policy_step(network: ActorCritic, data: Samples, config: Config) -> tuple[ActorCritic, TrustRegionStep]:
    """Returns the network after the policy's step, and the figures of that step.

    What belongs to the value alone stays. Layers that policy and value share move with the policy.
    """
    data = jax.tree.map(lambda x: x[:: config.sub_sampling_factor], data)
    if config.normalize_advantage:
        data = data._replace(advantage=standardized(data.advantage, data.valid))
    of_value, policy = eqx.partition(network, is_value(network))
    before = jax.lax.stop_gradient(network.policy(data.obs))

    def objective(policy: PyTree) -> Array:
        distribution = eqx.combine(policy, of_value).policy(data.obs)
        log_ratio = jnp.where(data.valid, distribution.log_prob(data.action) - data.log_prob, 0.0)
        return masked_mean(jnp.exp(log_ratio) * data.advantage, data.valid)

    def divergence(policy: PyTree) -> Array:
        after = eqx.combine(policy, of_value).policy(data.obs)
        return masked_mean(before.kl_divergence(after), data.valid)

    start, gradient = jax.value_and_grad(objective)(policy)
    product = damped_product(divergence, policy, config.cg_damping)
    direction, _ = cg(product, gradient, maxiter=config.cg_max_steps)
    curvature = dot(direction, product(direction))
    longest = jnp.sqrt(2.0 * config.target_kl / jnp.maximum(curvature, jnp.finfo(jnp.float32).tiny))

    def moved(attempt: Array) -> PyTree:
        length = longest * config.line_search_shrinking_factor ** attempt.astype(jnp.float32)
        return jax.tree.map(lambda p, d: p + length * d, policy, direction)

    def tried(attempt: Array) -> TrustRegionStep:
        candidate = moved(attempt)
        reached, kl = objective(candidate), divergence(candidate)
        return TrustRegionStep(reached, kl, ((reached > start) & (kl < config.target_kl)).astype(jnp.float32))

    def search(attempt: tuple[Array, TrustRegionStep]) -> tuple[Array, TrustRegionStep]:
        return attempt[0] + 1, tried(attempt[0] + 1)

    refused = lambda attempt: (attempt[1].accepted == 0) & (attempt[0] + 1 < config.line_search_max_iter)  # noqa: E731
    attempt, step = jax.lax.while_loop(refused, search, (jnp.int32(0), tried(jnp.int32(0))))
    stays = TrustRegionStep(start, jnp.float32(0.0), jnp.float32(0.0))
    accepted = step.accepted > 0
    policy, step = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), (moved(attempt), step), (policy, stays))
    return eqx.combine(policy, of_value), step


def damped_product(function: Callable[[PyTree], Array], at_point: PyTree, damping: float) -> Callable[[PyTree], PyTree]:
    """Returns the product of a vector with the Hessian of ``function`` at ``at_point``, plus ``damping`` times the vector."""

    def product(vector: PyTree) -> PyTree:
        _, curved = jax.jvp(jax.grad(function), (at_point,), (vector,))
        return jax.tree.map(lambda h, v: h + damping * v, curved, vector)

    return product


def dot(first: PyTree, second: PyTree) -> Array:
    """Returns the sum of the products of all numbers of two trees, ``float32[]``."""
    return jnp.sum(jnp.stack(jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), first, second))))


def value_loss(network: ActorCritic, batch: Samples) -> tuple[Array, None]:
    """Returns the mean square of the value's errors in a minibatch."""
    return masked_mean(jnp.square(network.value(batch.obs) - batch.target), batch.valid), None
