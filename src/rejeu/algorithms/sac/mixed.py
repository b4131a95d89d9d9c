"""Soft actor-critic for Dict and Tuple actions: expectations over the choices, samples of the Box components.

Source: Delalleau et al. 2019, "Discrete and Continuous Action Representation for Practical RL in Video Games" (arXiv
1912.11077), with its two temperatures, in the special case in which the Box components ``c`` do not depend on the choice
``d``, one of the combinations of all Discrete, MultiDiscrete and MultiBinary parts. With ``pi(d, c | s) = pi_d(d | s)
pi_c(c | s)``, critics ``Q_i(s, c)`` with one value per combination, target critics ``Q'_i`` and discount ``g``::

    V(s')  = sum_d pi_d(d | s') (min_i Q'_i(s', c')[d] - alpha_d log pi_d(d | s')) - alpha_c log pi_c(c' | s')
    J_Q    = mean_i mean (Q_i(s, c)[d] - (r + g V(s')))^2 / 2
    J_pi   = mean (sum_d pi_d(d | s) (alpha_d log pi_d(d | s) - min_i Q_i(s, c)[d]) + alpha_c log pi_c(c | s))

where ``c ~ pi_c(. | s)`` is reparameterized, and likewise ``c'``. Each temperature is learned as in :mod:`continuous`. The
automatic target entropies are 0.3 log n of the choices, n being the number of combinations, and minus the number of Box
components; a number given as ``target_entropy`` is that of the Box components.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.sac.continuous import Config, algorithm_of, check_discrete, networks, squared_error, squashed
from rejeu.algorithms.sac.discrete import TARGET_ENTROPY_SHARE, taken
from rejeu.algorithms.soft import SoftCritic
from rejeu.core.algorithm import Algorithm, Clock, Metrics, PyTree, Transition
from rejeu.core.distributions import Categorical, TanhNormal
from rejeu.core.spaces import action_width, check_action, check_box_action, members
from rejeu.networks import Network, QNetwork

MOST_COMBINATIONS = 1024
"""Upper limit on the combinations of choices, each of which is an output of every critic."""


def make(config: Config, observation_space: spaces.Space, action_space: spaces.Space) -> Algorithm:
    """Returns SAC for Dict or Tuple actions.

    Raises:
        ValueError: with gSDE or memory, for a Box without finite bounds, and for more than :data:`MOST_COMBINATIONS`.
    """
    check_discrete(config)
    if config.has_memory:
        raise ValueError(
            "lstm_hidden_size is not available for Dict and Tuple actions; leave it out, or use RecurrentPPO"
        )
    sizes = column_sizes(check_action(action_space, config.name))
    choices = tuple(size for size in sizes if size)
    n, n_box = math.prod(choices), len(sizes) - len(choices)
    if n > MOST_COMBINATIONS:
        raise ValueError(f"SAC takes at most {MOST_COMBINATIONS:,} combinations of choices, got {n:,}; use PPO")
    order = np.argsort(np.argsort([size > 0 for size in sizes], kind="stable"))
    target_entropy = jnp.array([[TARGET_ENTROPY_SHARE * math.log(n), config.entropy_target(-float(n_box))]])

    def joined(choice: Array, box: Array) -> Array:
        """Returns combinations ``(batch,)`` and Box components as actions ``(batch, action_width)``."""
        components = jnp.unravel_index(choice, choices) if choices else ()
        return jnp.concatenate([box, *(x.astype(jnp.float32)[:, None] for x in components)], axis=-1)[:, order]

    def parted(action: Array) -> tuple[Array, Array]:
        """Returns the combinations and Box components of actions."""
        is_choice = np.array(sizes) > 0
        strides = np.cumprod([1, *choices[:0:-1]])[::-1].astype(np.int32)[: len(choices)]
        weighted_choices = action[:, is_choice].astype(jnp.int32) * strides[None]
        return jnp.sum(weighted_choices, axis=-1, dtype=jnp.int32), action[:, ~is_choice]

    def explore(actor: Network, obs: PyTree, key: Array, clock: Clock) -> Array:
        choice_key, box_key = jax.random.split(key)
        choice, box = policy(actor, obs, n)
        return joined(choice.sample(choice_key), box.sample(box_key))

    def exploit(actor: Network, obs: PyTree) -> Array:
        choice, box = policy(actor, obs, n)
        return joined(choice.mode(), box.mode())

    def policy_loss(actor: PyTree, critics: PyTree, alpha: Array, batch: Transition, key: Array) -> tuple[Array, Array]:
        return actor_loss(actor, critics, alpha, batch.obs, key, n, config.judged_by)

    parts = SoftCritic(
        *networks(config, observation_space, n + 2 * n_box, QNetwork, n_box, n),
        target=lambda actor, critics, alpha, batch, key: td_target(actor, critics, alpha, batch, key, n),
        critics_loss=lambda critics, batch, target, key: critics_loss(critics, batch, *parted(batch.action), target),
        actor_loss=policy_loss,
        target_entropy=lambda obs: target_entropy,
        temperatures=(2,),
    )
    algorithm = algorithm_of(parts, config, explore, exploit, {})

    def update(state: PyTree, batch: Transition, clock: Clock) -> tuple[PyTree, Metrics]:
        """Returns the state after an update and the metrics, those of the two temperatures by names of their own."""
        state, metrics = algorithm.update(state, batch, clock)
        for name in ("ent_coef", "entropy"):
            metrics[name], metrics[f"{name}_box"] = metrics[name]
        return state, metrics

    return algorithm._replace(update=update)


def column_sizes(space: spaces.Space) -> list[int]:
    """Returns the number of possibilities of each number of an action, 0 for the components of a Box."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        return [size for member in members(space) for size in column_sizes(member)]
    if isinstance(space, spaces.Box):
        return [0] * action_width(check_box_action(space, Config.name))
    if isinstance(space, spaces.Discrete):
        return [int(space.n)]
    if isinstance(space, spaces.MultiDiscrete):
        return [int(n) for n in space.nvec.ravel()]
    return [2] * action_width(space)


def policy(actor: Network, obs: PyTree, n: int) -> tuple[Categorical, TanhNormal]:
    """Returns the distributions of the ``n`` combinations and of the Box components."""
    outputs = actor(obs)
    return Categorical(outputs[:, :n]), squashed(outputs[:, n:])


def all_values(critics: PyTree, obs: PyTree, box: Array) -> Array:
    """Returns every critic's value of every combination with Box components, ``(n_critics, batch, n)``."""
    return jax.vmap(lambda critic: critic(obs, box))(critics)


def soft_value(
    actor: Network,
    critics: PyTree,
    alpha: Array,
    obs: PyTree,
    key: Array,
    n: int,
    judged_by: Callable[..., Array] = jnp.min,
) -> tuple[Array, tuple[Array, Array]]:
    """Returns ``V``, ``(batch,)``, and the mean log-probability of the choice and that of the sampled Box components."""
    choice, box = policy(actor, obs, n)
    sample, box_log_prob = box.sample_and_log_prob(key)
    log_probabilities = jax.nn.log_softmax(choice.logits)
    values = judged_by(all_values(critics, obs, sample), axis=0) - alpha[0] * log_probabilities
    value = jnp.sum(jnp.exp(log_probabilities) * values, axis=-1) - alpha[1] * box_log_prob
    return value, (-choice.entropy(), box_log_prob)


def td_target(actor: Network, target_critics: PyTree, alpha: Array, batch: Transition, key: Array, n: int) -> Array:
    """Returns the TD targets, ``(batch,)``; ``alpha`` are the temperatures of choice and Box components, ``(2,)``."""
    return batch.reward + batch.discount * soft_value(actor, target_critics, alpha, batch.next_obs, key, n)[0]


def critics_loss(
    critics: PyTree, batch: Transition, choice: Array, box: Array, target: Array
) -> tuple[Array, tuple[Array, Array]]:
    """Returns half the squared TD error summed over critics; the values of the actions and the TD errors."""
    return squared_error(taken(all_values(critics, batch.obs, box), choice), target, batch)


def actor_loss(
    actor: Network,
    critics: PyTree,
    alpha: Array,
    obs: PyTree,
    key: Array,
    n: int,
    judged_by: Callable[..., Array] = jnp.min,
) -> tuple[Array, PyTree]:
    """Returns the soft policy loss, and the log-probabilities of choice and Box components, ``(batch, 2)``."""
    value, log_probs = soft_value(actor, critics, alpha, obs, key, n, judged_by)
    return -jnp.mean(value), jnp.stack(log_probs, axis=-1)
