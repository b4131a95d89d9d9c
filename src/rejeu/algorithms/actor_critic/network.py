"""The network of policy and value, for every type of action, and its exploration by state-dependent noise (gSDE)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu.algorithms.actor_critic.config import HIDDEN_LAYERS, ActorCriticConfig, OnPolicyConfig, check_value_rate
from rejeu.algorithms.config import network_inputs
from rejeu.core.algorithm import Algorithm, Clock, Explorer, PyTree, unmasked
from rejeu.core.distributions import Bernoulli, Categorical, Joint, MultiCategorical, Normal, TanhNormal, forbid
from rejeu.core.spaces import Leaf, check_action, members
from rejeu.networks import Convolution, Linear, Torso, make_encoder, make_head, make_torso

LOG_STD_RANGE = (-20.0, 2.0)
"""Bounds of a log standard deviation that depends on the observation, in nats."""
POLICY_GAIN, VALUE_GAIN, HIDDEN_GAIN = 0.01, 1.0, math.sqrt(2.0)
"""Gains of the orthogonal initialization: a policy that begins nearly the same everywhere explores evenly."""


SDE_EPSILON = 1e-6
"""Added to the variance of state-dependent noise, which is 0 where the hidden layer is."""


class ActionKind(NamedTuple):
    """The outputs that a policy must have for an action space; static and hashable."""

    kind: Literal["box", "categorical", "binary", "joint"]
    sizes: tuple[int, ...]
    """Box: the number of components. Discrete and MultiDiscrete: possibilities of each choice. MultiBinary: the bits.
    Dict and Tuple: the outputs of each part."""
    single: bool
    """Whether an action is one choice without an axis (Discrete)."""
    parts: tuple[ActionKind, ...] = ()
    """Those of a Dict or Tuple."""

    @property
    def n_outputs(self) -> int:
        """Numbers that the policy's head gives, leaving out a standard deviation."""
        return sum(self.sizes)

    @property
    def n_stds(self) -> int:
        """Standard deviations of an action: one for each component of a Box."""
        return self.n_outputs if self.kind == "box" else sum(component.n_stds for component in self.parts)

    def distribution(self, outputs: Array, log_std: Any, box: type[Normal] | type[TanhNormal]) -> Distribution:
        """Returns the distribution of a head's ``outputs`` ``(batch, n_outputs)``.

        ``log_std`` is broadcastable to ``(batch, n_stds)``, and ``box`` the distribution of Box actions.
        """
        if self.kind == "box":
            return box(outputs, log_std)
        if self.kind == "binary":
            return Bernoulli(outputs)
        if self.single:
            return Categorical(outputs)
        columns = jnp.split(outputs, np.cumsum(self.sizes)[:-1].tolist(), axis=-1)
        if self.kind == "categorical":
            return MultiCategorical(tuple(map(Categorical, columns)))
        ends = np.cumsum([component.n_stds for component in self.parts])[:-1].tolist()
        stds = [None] * len(columns) if log_std is None else jnp.split(log_std, ends, axis=-1)
        triples = zip(self.parts, columns, stds, strict=True)
        return Joint(tuple(component.distribution(column, std, box) for component, column, std in triples))


def action_kind(space: spaces.Space) -> ActionKind:
    """Returns the kind of a checked action space (see :func:`rejeu.core.spaces.check_action`)."""
    if isinstance(space, spaces.Box):
        return ActionKind("box", (int(np.prod(space.shape, dtype=int)),), False)
    if isinstance(space, spaces.Discrete):
        return ActionKind("categorical", (int(space.n),), True)
    if isinstance(space, spaces.MultiDiscrete):
        return ActionKind("categorical", tuple(int(n) for n in space.nvec.ravel()), False)
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = tuple(map(action_kind, members(space)))
        return ActionKind("joint", tuple(component.n_outputs for component in parts), False, parts)
    assert isinstance(space, spaces.MultiBinary)
    return ActionKind("binary", (int(np.prod(space.shape, dtype=int)),), False)


def checked(
    config: OnPolicyConfig, observation_space: spaces.Space, action_space: spaces.Space
) -> tuple[tuple[Leaf, ...], ActionKind, Any]:
    """Returns the leaves of observations, the kind of actions, and the settings of the network with their widths.

    Raises:
        ValueError: if no policy can act in the action space, or if the settings do not fit the observation space.
    """
    check_action(action_space, config.name)
    obs_leaves, network_shape = network_inputs(config, observation_space)
    check_value_rate(config, obs_leaves)
    return obs_leaves, action_kind(action_space), network_shape


Distribution = Normal | TanhNormal | Categorical | MultiCategorical | Bernoulli | Joint


class ActorCritic(eqx.Module):
    """Observation to a distribution over actions and to a value."""

    encoder: PyTree
    torso: Torso
    head: PyTree
    log_std: Array | None
    """``(action_dim,)``, with gSDE ``(width, action_dim)``; None where the head gives it or there is none."""
    value_encoder: PyTree
    """None where the policy's is shared."""
    value_torso: PyTree
    """None where the policy's is shared."""
    value_head: PyTree
    action: ActionKind = eqx.field(static=True)
    shape: ActorCriticConfig = eqx.field(static=True)

    def __init__(
        self,
        key: Array,
        leaves: tuple[Leaf, ...],
        action: ActionKind,
        shape: ActorCriticConfig,
        use_sde: bool = False,
    ) -> None:
        """Draws the weights."""
        keys = jax.random.split(key, 6)
        widths, value_widths = shape.actor_widths(HIDDEN_LAYERS), shape.critic_widths(HIDDEN_LAYERS)
        std = shape.state_dependent_std and action.n_stds > 0
        encoder = make_encoder(keys[0], leaves, shape)
        torso, n_hidden = make_torso(keys[1], encoder.n_features, None, widths, shape)
        head = make_head(keys[2], n_hidden, action.n_outputs + std * action.n_stds, shape)
        value_encoder = None if shape.share_features_extractor else make_encoder(keys[3], leaves, shape)
        value_torso, n_value = None, n_hidden
        if not shape.share_layers:
            value_torso, n_value = make_torso(keys[4], encoder.n_features, None, value_widths, shape)
        value_head = make_head(keys[5], n_value, 1, shape)
        if shape.ortho_init:
            fresh = jax.random.split(jax.random.fold_in(key, 1), 6)
            encoder, torso = orthogonal(encoder, fresh[0], HIDDEN_GAIN), orthogonal(torso, fresh[1], HIDDEN_GAIN)
            value_encoder = orthogonal(value_encoder, fresh[3], HIDDEN_GAIN)
            value_torso = orthogonal(value_torso, fresh[4], HIDDEN_GAIN)
            head, value_head = orthogonal(head, fresh[2], POLICY_GAIN), orthogonal(value_head, fresh[5], VALUE_GAIN)
        if std and isinstance(head, Linear):
            bias = head.bias.at[action.n_outputs :].set(shape.log_std_init)
            head = eqx.tree_at(lambda linear: linear.bias, head, bias)
        self.encoder, self.torso, self.head = encoder, torso, head
        self.value_encoder, self.value_torso, self.value_head = value_encoder, value_torso, value_head
        has_log_std = action.n_stds > 0 and not std
        std_shape = (n_hidden, action.n_stds) if use_sde else (action.n_stds,)
        self.log_std = jnp.full(std_shape, shape.log_std_init, jnp.float32) if has_log_std else None
        self.action, self.shape = action, shape

    @property
    def use_expln(self) -> bool:
        """Whether state-dependent noise grows linearly; see :func:`sde_std`."""
        return self.shape.use_expln

    def policy(self, obs: PyTree) -> Distribution:
        """Returns the distribution of actions at observations ``(batch, ...)``, which may be :class:`Masked`."""
        return self.distribution(self.hidden(obs), unmasked(obs)[1])

    def hidden(self, obs: PyTree) -> Array:
        """Returns the policy's last hidden layer at observations ``(batch, ...)``."""
        return self.torso(self.encoder(obs))

    def value(self, obs: PyTree) -> Array:
        """Returns the values of observations ``(batch, ...)``, ``(batch,)``."""
        encoder = self.encoder if self.value_encoder is None else self.value_encoder
        torso = self.torso if self.value_torso is None else self.value_torso
        return self.value_head(torso(encoder(obs)))[:, 0]

    def both(self, obs: PyTree) -> tuple[Distribution, Array]:
        """Returns :meth:`policy` and :meth:`value`, computing what they share once."""
        features = self.encoder(obs)
        hidden = self.torso(features)
        value_features = features if self.value_encoder is None else self.value_encoder(obs)
        value_hidden = hidden if self.value_torso is None else self.value_torso(value_features)
        return self.distribution(hidden, unmasked(obs)[1]), self.value_head(value_hidden)[:, 0]

    def distribution(self, hidden: Array, mask: Array | None) -> Distribution:
        """Returns the distribution that the last hidden layer ``(batch, width)`` asks for."""
        outputs, log_std = forbid(self.head(hidden), mask), None
        if self.log_std is not None:
            read = jax.lax.stop_gradient(hidden)
            log_std = self.log_std[None] if self.log_std.ndim == 1 else sde_log_std(self.log_std, read, self.use_expln)
            if not self.shape.learn_std:
                log_std = jax.lax.stop_gradient(log_std)
        elif self.action.n_stds:
            outputs, log_std = jnp.split(outputs, [self.action.n_outputs], axis=-1)
            log_std = jnp.clip(log_std, *LOG_STD_RANGE)
        return self.action.distribution(outputs, log_std, TanhNormal if self.shape.squash_output else Normal)


def explore(actor: ActorCritic, obs: PyTree, key: Array, clock: Clock) -> Array:
    """Returns actions sampled from the policy; for :class:`rejeu.core.algorithm.Algorithm`, as are the next two."""
    return actor.policy(obs).sample(key)


def exploit(actor: ActorCritic, obs: PyTree) -> Array:
    """Returns the likeliest actions."""
    return actor.policy(obs).mode()


def state_value(carry: PyTree, actor: ActorCritic, obs: PyTree, ended: Array) -> Array:
    """Returns the values of observations, ``(batch,)``."""
    return actor.value(obs)


def sde_std(log_std: Array, use_expln: bool = False) -> Array:
    """Returns the standard deviations of the matrix of state-dependent noise.

    They are ``exp(log_std)``; with ``use_expln`` ``log(1 + log_std) + 1`` where ``log_std`` is positive, which continues
    the exponential smoothly.
    """
    if not use_expln:
        return jnp.exp(log_std)
    positive = jnp.maximum(log_std, 0.0)
    return jnp.where(log_std > 0.0, jnp.log1p(positive) + 1.0, jnp.exp(jnp.minimum(log_std, 0.0)))


def sde_log_std(log_std: Array, hidden: Array, use_expln: bool = False) -> Array:
    """Returns the log standard deviation of state-dependent noise at hidden layers ``(batch, width)``.

    The noise is ``hidden @ E`` with a matrix ``E`` of independent normals of standard deviations :func:`sde_std` (Raffin et
    al. 2020, "Smooth Exploration for Robotic Reinforcement Learning", arXiv 2005.05719, equation 8). As in
    Stable-Baselines3, gradients reach the hidden layer this way in SAC and TQC, and not in PPO and A2C.
    """
    variance = jnp.square(hidden) @ jnp.square(sde_std(log_std, use_expln))
    return 0.5 * jnp.log(variance + SDE_EPSILON)


def sde_explorer(n_steps: int, restarts: bool = True) -> Explorer:
    """Returns exploration by state-dependent noise (gSDE), whose matrix is sampled every ``n_steps``, or -1: in every episode.

    The steps are counted from the beginning of an episode, or without ``restarts`` of the run, as its rollouts are.

    The actor is an :class:`ActorCritic` or another module with ``log_std (width, action_dim)``, ``hidden``,
    ``distribution`` and ``use_expln``.

    The carry is each environment's matrix ``(n_envs, width, action_dim)`` and its age in steps ``int32 (n_envs,)``.
    """

    def init(actor: PyTree, n_envs: int) -> tuple[Array, Array]:
        return jnp.zeros((n_envs, *actor.log_std.shape), jnp.float32), jnp.zeros((n_envs,), jnp.int32)

    def act(
        carry: tuple[Array, Array], actor: PyTree, obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, tuple[Array, Array]]:
        matrix, age = carry
        due = ended if n_steps == -1 else ended | (age % n_steps == 0)
        fresh = sde_std(actor.log_std, actor.use_expln)[None] * jax.random.normal(key, matrix.shape, matrix.dtype)
        matrix = jnp.where(due[:, None, None], fresh, matrix)
        hidden = actor.hidden(obs)
        distribution = actor.distribution(hidden, None)
        action = distribution.mean + jnp.einsum("nh,nhd->nd", hidden, matrix)
        age = (jnp.where(ended, 0, age) if restarts else age) + 1
        return jnp.tanh(action) if isinstance(distribution, TanhNormal) else action, (matrix, age)

    return Explorer(init, act)


def explorer_of(config: OnPolicyConfig, action_kind: ActionKind) -> Explorer | None:
    """Returns exploration by state-dependent noise if the configuration uses it, else None.

    Raises:
        ValueError: for state-dependent noise on actions other than Box.
    """
    if not config.use_sde:
        return None
    if action_kind.kind != "box":
        raise ValueError("use_sde=True needs Box actions: noise cannot be added to discrete actions; leave it out")
    by_rollout = config.sde_sample_freq == -1 and config.n_episodes is None
    return sde_explorer(config.n_steps if by_rollout else config.sde_sample_freq, restarts=not by_rollout)


def algorithm_of(
    config: OnPolicyConfig, action_kind: ActionKind, init: Callable[[Array], PyTree], update: Callable[..., PyTree]
) -> Algorithm:
    """Returns the algorithm whose state has an :class:`ActorCritic` as ``network``, from how it begins and learns.

    Demonstrated actions other than Box are imitated by their log-probabilities.
    """
    imitation = None if action_kind.kind == "box" else lambda actor, obs, action: -actor.policy(obs).log_prob(action)
    return Algorithm(
        init,
        lambda state: state.network,
        explore,
        exploit,
        update,
        explorer_of(config, action_kind),
        state_value=state_value,
        imitation=imitation,
    )


def orthogonal(module: PyTree, key: Array, gain: float) -> PyTree:
    """Returns ``module`` with the weights of every linear layer and convolution orthogonal times ``gain``, biases 0.

    Source: Saxe et al. 2014, "Exact solutions to the nonlinear dynamics of learning" (arXiv 1312.6120). None stays None.
    """
    drawn = 0

    def draw(node: PyTree) -> PyTree:
        nonlocal drawn
        if not isinstance(node, Linear | Convolution):
            return node
        drawn += 1
        initializer = jax.nn.initializers.orthogonal(gain)
        weight = node.weight.reshape(-1, node.weight.shape[-1])
        fresh = initializer(jax.random.fold_in(key, drawn), weight.shape, jnp.float32).reshape(node.weight.shape)
        return eqx.tree_at(lambda n: (n.weight, n.bias), node, (fresh, jnp.zeros_like(node.bias)))

    return jax.tree.map(draw, module, is_leaf=lambda node: isinstance(node, Linear | Convolution))


def is_value(network: PyTree) -> PyTree:
    """Returns a tree like ``network``, an :class:`ActorCritic` or a module that holds one, of bools.

    They say of each array whether it belongs to the value alone.
    """
    if not isinstance(network, ActorCritic):
        mark = lambda node: is_value(node) if isinstance(node, ActorCritic) else False  # noqa: E731
        return jax.tree.map(mark, network, is_leaf=lambda node: isinstance(node, ActorCritic))
    parts = (network.value_encoder, network.value_torso, network.value_head)
    flags = jax.tree.map(lambda _: False, network)
    return eqx.tree_at(
        lambda n: (n.value_encoder, n.value_torso, n.value_head),
        flags,
        jax.tree.map(lambda _: True, parts),
        is_leaf=lambda node: node is None,
    )
