"""CrossQ: SAC without target networks, stabilized by batch renormalization instead, with wide critics.

Source: Bhatt et al. 2024, "CrossQ: Batch Normalization in Deep Reinforcement Learning for Greater Sample Efficiency and
Simplicity" (arXiv 1902.05605). Batch normalization fails in a critic that sees ``(s, a)`` in one pass and ``(s', a')``,
which are distributed otherwise, in another. Here they go through together and share their statistics. With policy
``pi``, critics ``Q_i``, temperature ``alpha`` and discount ``d`` (0 where the MDP terminated)::

    a'                          ~ pi(. | s')
    [Q_i(s, a), Q_i(s', a')]    = one training pass of both halves through Q_i
    y                           = r + d (min_i Q_i(s', a') - alpha log pi(a' | s')),      not differentiated
    J_Q                         = sum_i mean (Q_i(s, a) - y)^2 / 2
    J_pi                        = mean (alpha log pi(a | s) - min_i Q_i(s, a)),           a ~ pi(. | s), reparameterized

and every ``policy_delay``-th time, after the critics, the actor takes a step and with it the temperature, whose loss is
SAC's (:mod:`rejeu.algorithms.sac`). A network goes by the batch's statistics, and its running ones move on, only while
its own loss is taken (:mod:`rejeu.networks.batch_renorm`): the policy acts, draws ``a'`` and is judged by the critics with
running statistics. Adam's first moment forgets faster, ``b_1 = 1/2``, except for the temperature.

As in Stable-Baselines3 Contrib, the critics are 1024 wide by default, where the paper's are 2048.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from gymnasium import spaces
from jax import Array

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.sac.continuous import clipped, squared_error, squashed
from rejeu.algorithms.search import Integers, SearchSpace
from rejeu.algorithms.soft import EntropyConfig, SoftCritic, soft_actor_critic
from rejeu.core.algorithm import Algorithm, Optimizer, PyTree, Transition, ensemble, minimize
from rejeu.core.distributions import TanhNormal
from rejeu.core.schedules import Schedule
from rejeu.core.spaces import action_dimension, check_box_action, leaves
from rejeu.core.validation import coerce, whole
from rejeu.exploration.held_noise import held_explorer
from rejeu.networks import Linear, PolicyConfig, Widths, action_values
from rejeu.networks.batch_renorm import RenormalizedMLP, RenormalizedNetwork, in_training, with_statistics

ACTOR_LAYERS = (256, 256)
"""Default widths of the actor."""
CRITIC_LAYERS = (1024, 1024)
"""Default widths of each critic."""
ADAM_B1 = 0.5
"""Decay of the networks' first moments."""


@dataclass(frozen=True, kw_only=True)
class Config(EntropyConfig):
    """Hyperparameters of CrossQ; the defaults are those of Stable-Baselines3 Contrib."""

    learning_rate: float | Schedule = 1e-3
    policy_delay: int = 3
    renorm_warmup_steps: int = 100_000
    """Training passes through each layer that are normalized by the batch alone, before its renormalization begins; the
    actor's count is ``policy_delay`` times slower."""
    # A class variable in place of the inherited field takes the field away: CrossQ(tau=...) is then an unknown setting.
    tau: ClassVar[float] = 1.0  # type: ignore[misc]

    name: ClassVar[str] = "CrossQ"
    search_space: ClassVar[SearchSpace] = {
        **{name: distribution for name, distribution in search.OFF_POLICY.items() if name != "tau"},
        "policy_delay": Integers(1, 4),
    }
    hidden_layers: ClassVar[Widths] = Widths(ACTOR_LAYERS, CRITIC_LAYERS)
    hidden_layers_on_images: ClassVar[Widths] = hidden_layers

    entropy_per_action: ClassVar[float] = -1.0
    """Share of a target entropy of ``"auto"`` that each action dimension has, in nats."""

    def __post_init__(self) -> None:
        EntropyConfig.__post_init__(self)
        coerce(self, "renorm_warmup_steps", whole, least=0)
        check_shape(self.policy_kwargs, self.name)

    def torso(self, key: Array, n_inputs: int, widths: tuple[int, ...]) -> PyTree:
        """Returns hidden layers."""
        return RenormalizedMLP(key, n_inputs, widths, self.policy_kwargs.activation_fn, self.renorm_warmup_steps)


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns CrossQ for these spaces; its state is SAC's without target critics.

    Raises:
        ValueError: if the action space is not a finite Box.
        TypeError: if the observation space holds something that is not an array.
    """
    equations = Equations(lambda critics, batch, action, cost: cost, critics_loss, action_values, has_targets=False)
    optimizer = optimizers.make(config.optimizer, config.max_grad_norm, b1=ADAM_B1)
    return make_with(config, observation_space, action_space, equations, optimizer)


class Equations(NamedTuple):
    """The equations and layers in which CrossQ, FlashSAC and XQC differ."""

    target: Callable[[PyTree, Transition, Array, Array], Array]
    """``target(target_critics, batch, next_action, next_entropy_cost)``: what the critics learn."""
    critics_loss: Callable[[PyTree, Transition, Array, Array], tuple[Array, PyTree]]
    """``critics_loss(critics, batch, next_action, target)``, as :func:`critics_loss`."""
    values: Callable[[PyTree, PyTree, Array], Array]
    """``values(critics, obs, action)``: by the running statistics, ``(n_critics, batch)``."""
    measure: Callable[[PyTree, PyTree], tuple[Array, Array]] = lambda errors, target: errors
    """``measure(outputs, (next_action, target))``, as of :class:`rejeu.algorithms.soft.SoftCritic`."""
    n_outputs: int = 1
    """Of each critic."""
    head: Callable[[Array, int, int], PyTree] = Linear
    """``head(key, n_inputs, n_outputs)``: the last layer of a network."""
    log_std: Callable[[Array], Array] = clipped
    """``log_std(outputs)``: the policy's log standard deviations from outputs of the actor."""
    after_step: Callable[[PyTree], PyTree] = lambda network: network
    """``after_step(network)``: a network after a step of the optimizer."""
    seen: Callable[[Transition], PyTree] = lambda batch: batch.obs
    """``seen(batch)``: by which observations the actor normalizes; those of the batch are the first."""
    has_targets: bool = True
    """Whether there are target critics."""


def make_with(
    config: Any,
    observation_space: spaces.Space,
    action_space: spaces.Space,
    equations: Equations,
    optimizer: Optimizer,
) -> Algorithm:
    """Returns SAC with networks that are normalized by batches, and equations of its own."""
    action_dim = action_dimension(check_box_action(action_space, config.name))
    obs_leaves, shape = leaves(observation_space), config.policy_kwargs
    target_entropy = config.entropy_target(config.entropy_per_action * action_dim, action_dim)
    distribution = lambda outputs: squashed(outputs, equations.log_std)  # noqa: E731
    policy = lambda actor, obs: distribution(actor(obs))  # noqa: E731

    def network(key: Array, n_actions: int | None, n_outputs: int, widths: tuple[int, ...]) -> RenormalizedNetwork:
        torso = lambda key, n_inputs: config.torso(key, n_inputs, widths)  # noqa: E731
        return RenormalizedNetwork(key, obs_leaves, n_actions, n_outputs, torso, equations.head)

    def critics(key: Array) -> PyTree:
        widths = shape.critic_widths(config.hidden_layers.critics)
        return ensemble(lambda key: network(key, action_dim, equations.n_outputs, widths), key, config.n_critics)

    def target(
        actor: PyTree, target_critics: PyTree, alpha: Array, batch: Transition, key: Array
    ) -> tuple[Array, Array]:
        next_action, next_log_prob = policy(actor, batch.next_obs).sample_and_log_prob(key)
        return next_action, equations.target(target_critics, batch, next_action, alpha * next_log_prob)

    def policy_loss(
        actor: PyTree, critics: PyTree, alpha: Array, batch: Transition, key: Array
    ) -> tuple[Array, PyTree]:
        obs = equations.seen(batch)
        return actor_loss(actor, critics, alpha, batch.obs, key, obs, distribution, equations.values)

    def step(*arguments: PyTree) -> tuple[PyTree, PyTree, Array, PyTree]:
        network, optimizer_state, loss, (outputs, trained) = minimize(*arguments)
        return equations.after_step(with_statistics(network, trained)), optimizer_state, loss, outputs

    parts = SoftCritic(
        actor=lambda key: network(key, None, 2 * action_dim, shape.actor_widths(config.hidden_layers.actor)),
        critics=critics,
        target=target,
        critics_loss=lambda critics, batch, target, key: equations.critics_loss(critics, batch, *target),
        actor_loss=policy_loss,
        target_entropy=lambda obs: target_entropy,
        measure=equations.measure,
        minimize=step,
        has_targets=equations.has_targets,
        keeps_losses=True,
    )
    explore = lambda actor, obs, key, clock: policy(actor, obs).sample(key)  # noqa: E731
    exploit = lambda actor, obs: policy(actor, obs).mode()  # noqa: E731
    return soft_actor_critic(parts, config, explore, exploit, optimizer)._replace(
        explorer=held_explorer(policy, action_dim, config.noise_repeat) if config.noise_repeat > 1 else None,
        action_values=lambda state, obs, action: equations.values(state.critics, obs, action),
    )


def check_shape(shape: PolicyConfig, name: str) -> None:
    """Raises ``ValueError`` for network shapes other than widths: the algorithm ``name`` has normalized layers of its own."""
    settings = {
        "layer_norm": shape.layer_norm,
        "cnn_layer_norm": shape.cnn_layer_norm,
        "cnn_features": shape.cnn_features is not None,
        "normalize_images": not shape.normalize_images,
        "encoder": shape.encoder is not None,
        "head": shape.head is not None,
        "architecture": shape.architecture != "mlp",
        "torso": shape.torso is not None,
        "branches": shape.has_branches,
    }
    if refused := [key for key, present in settings.items() if present]:
        raise ValueError(
            f"{name} normalizes layers of its own; its policy_kwargs take net_arch and activation_fn, not "
            f"{', '.join(refused)}: leave that out, or use SAC or TQC"
        )


def joint_outputs(critics: PyTree, batch: Transition, next_action: Array) -> tuple[Array, Array, PyTree]:
    """Returns the outputs for ``(s, a)`` and for ``(s', a')``, ``(n_critics, batch, n_outputs)`` each, from one pass of both.

    The critics are in training; they are returned as they are after having seen the batch.
    """
    obs, action = joined(batch.obs, batch.next_obs), joined(batch.action, next_action)
    outputs, trained = jax.vmap(lambda critic: in_training(critic, lambda critic: critic(obs, action)))(critics)
    now, then = jnp.split(outputs, 2, axis=1)
    return now, then, trained


def joined(now: PyTree, then: PyTree) -> PyTree:
    """Returns two batches as one of twice the size."""
    return jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=0), now, then)


def td_target(next_values: Array, next_entropy_cost: Array, batch: Transition) -> Array:
    """Returns the TD targets, ``(batch,)``, without gradient.

    Args:
        next_values: of ``(s', a')`` by each critic, ``(n_critics, batch)``.
        next_entropy_cost: ``alpha log pi(a' | s')``, ``(batch,)``.
        batch: gives rewards and discounts.
    """
    return jax.lax.stop_gradient(batch.reward + batch.discount * (jnp.min(next_values, axis=0) - next_entropy_cost))


def critics_loss(
    critics: RenormalizedNetwork, batch: Transition, next_action: Array, next_entropy_cost: Array
) -> tuple[Array, tuple[tuple[Array, Array], RenormalizedNetwork]]:
    """Returns half the squared TD error, averaged over the batch and summed over critics.

    With it come the values and the TD errors, ``(n_critics, batch)`` each, and the critics that have seen the batch.
    ``next_entropy_cost`` is that of :func:`td_target`.
    """
    values, next_values, trained = joint_outputs(critics, batch, next_action)
    target = td_target(next_values[..., 0], next_entropy_cost, batch)
    loss, errors = squared_error(values[..., 0], target, batch)
    return loss, (errors, trained)


def actor_loss(
    actor: RenormalizedNetwork,
    critics: PyTree,
    alpha: Array,
    obs: PyTree,
    key: Array,
    seen: PyTree,
    policy: Callable[[Array], TanhNormal],
    values: Callable[[PyTree, PyTree, Array], Array] = action_values,
) -> tuple[Array, tuple[Array, RenormalizedNetwork]]:
    """Returns the soft policy loss at ``obs``, the critics judging by their running statistics.

    The actor normalizes by ``seen``, which begins with ``obs``. With the loss come the log-probabilities of the actions drawn,
    ``(batch,)``, and the actor that has seen the batch.
    """
    outputs, trained = in_training(actor, lambda actor: actor(seen))
    action, log_prob = policy(outputs[: len(jax.tree.leaves(obs)[0])]).sample_and_log_prob(key)
    return jnp.mean(alpha * log_prob - jnp.min(values(critics, obs, action), axis=0)), (log_prob, trained)
