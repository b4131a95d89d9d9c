"""What the on-policy algorithms share: their hyper-parameters, the network of policy and value, and how it acts.

The network reads an observation into features, and separate or shared hidden layers turn these into the parameters of a
distribution over actions and into a value. Actions may be Box (a normal distribution, squashed by option), Discrete,
MultiDiscrete or MultiBinary. A policy with memory puts a recurrent cell between the features and the hidden layers.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from jax import Array

from rejeu import finite, running_stats, schedules
from rejeu.config import nested, number, whole
from rejeu.core import Clock, Explorer, Masked, PyTree, Rollout
from rejeu.distributions import FORBIDDEN, Bernoulli, Categorical, MultiCategorical, Normal, TanhNormal, sum_of
from rejeu.networks import Convolution, Encoder, Linear, PolicyConfig, Torso, convolutions, make_torso
from rejeu.replay.rollout import advantages
from rejeu.running_stats import NormalizationConfig
from rejeu.schedules import Schedule
from rejeu.spaces import Leaf

HIDDEN_LAYERS = (64, 64)
"""Default widths of policy and value."""
LOG_STD_RANGE = (-20.0, 2.0)
"""Bounds of a log standard deviation that depends on the observation, in nats."""
POLICY_GAIN, VALUE_GAIN, HIDDEN_GAIN = 0.01, 1.0, math.sqrt(2.0)
"""Gains of the orthogonal initialisation: a policy that begins nearly the same everywhere explores evenly."""


@dataclass(frozen=True)
class ActorCriticConfig(PolicyConfig):
    """The shape of policy and value networks (Stable-Baselines3's ``policy_kwargs`` of PPO and A2C)."""

    activation_fn: Any = "tanh"
    """Nonlinearity after each hidden layer: relu, tanh, elu, gelu, silu, leaky_relu or sigmoid, or a function or class
    of that name."""
    vf: tuple[int, ...] | None = None
    """Widths of the value's hidden layers where they differ from ``net_arch``; also ``net_arch={"pi": [...], "vf":
    [...]}``."""
    share_features_extractor: bool = True
    """Policy and value read images through the same convolutions."""
    share_layers: bool = False
    """Policy and value share the hidden layers as well and differ in their heads only."""
    ortho_init: bool = True
    """Draw weights orthogonal, with gains for each part, rather than uniform."""
    log_std_init: float = 0.0
    """Logarithm of the standard deviation of Box actions at the start, the action's range being [-1, 1]."""
    learn_std: bool = True
    """Learn the standard deviation; False keeps it at ``log_std_init``."""
    state_dependent_std: bool = False
    """Compute the standard deviation from the observation rather than learn one for all."""
    squash_output: bool = False
    """Squash Box actions into their bounds by tanh, where otherwise they are clipped."""

    def __post_init__(self) -> None:
        put = lambda key, value: object.__setattr__(self, key, value)  # noqa: E731
        if isinstance(self.net_arch, Mapping) and "vf" in self.net_arch:
            arch = dict(self.net_arch)
            put("vf", arch.pop("vf") if self.vf is None else self.vf)
            put("net_arch", arch)
        if self.vf is not None:
            put("qf", self.vf)
        PolicyConfig.__post_init__(self)
        put("vf", self.qf)
        for key in ("share_features_extractor", "share_layers", "ortho_init", "learn_std", "state_dependent_std"):
            check_flag(key, getattr(self, key))
        check_flag("squash_output", self.squash_output)
        put("log_std_init", number("log_std_init", self.log_std_init))
        if self.state_dependent_std and not self.learn_std:
            raise ValueError("policy_kwargs: state_dependent_std=True leaves learn_std=False without meaning")
        if self.share_layers and not self.share_features_extractor:
            raise ValueError(
                "policy_kwargs: share_layers=True leaves share_features_extractor=False without meaning; leave out one"
            )


@dataclass(frozen=True, kw_only=True)
class OnPolicyConfig:
    """What every algorithm that learns from the experience of its present policy can be told."""

    learning_rate: float | Schedule = 3e-4
    """Step size of the optimizer; a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)`` or
    ``"lin_3e-4"``. Raising it learns faster until it diverges."""
    n_steps: int = 2048
    """Steps of each environment between two updates. Raising it estimates the gradient better and updates more rarely."""
    n_episodes: int | None = None
    """Whole episodes of each environment between two updates, in place of ``n_steps``: who is done waits for the others.
    In an environment without a time limit ``n_steps`` bounds an episode's share. None takes ``n_steps``."""
    gamma: float = 0.99
    """Discount factor, in [0, 1]. Raising it looks further ahead."""
    gae_lambda: float = 0.95
    """Mixes advantages of all lengths, in [0, 1]: 0 trusts the value after one step, 1 sums all rewards to the episode's
    end and subtracts the value (returns-to-go minus value). Raising it has less bias and more variance."""
    ent_coef: float | Schedule = 0.0
    """Weight of the entropy bonus. Raising it keeps the policy random for longer."""
    vf_coef: float = 0.5
    """Weight of the value's loss beside the policy's. Without shared layers it matters for the clipping alone."""
    max_grad_norm: float | None = 0.5
    """Largest norm of a gradient; longer ones are scaled down. None leaves them."""
    critic_learning_rate: float | Schedule | None = None
    """Gives the value an optimizer of its own, with this step size and a gradient norm of its own. None has one
    optimizer for both. Needs ``share_layers=False``, and of images ``share_features_extractor=False``."""
    use_sde: bool = False
    """Explore by noise that depends on the state and stays for many steps (gSDE): smooth motion. Box actions only."""
    sde_sample_freq: int = -1
    """Steps after which that noise is drawn anew; -1: with every episode. Raising it explores more slowly."""
    normalize_advantage: bool = True
    """Scale the advantages of every batch to mean 0 and standard deviation 1."""
    normalize: NormalizationConfig | None = None
    """Scale observations and rewards by what has been seen: True, or a dict with ``norm_obs``, ``norm_reward``,
    ``clip_obs``, ``clip_reward``. The statistics are learnt and saved with the agent, which takes raw observations."""
    nonfinite: finite.Nonfinite = "stop"
    """What to do when an update leaves a loss or a weight that is NaN or infinite: ``"stop"`` with an error that names
    it and saves the rollout, or ``"skip"`` that update as if its rollout had never been played, and count it."""
    policy_kwargs: ActorCriticConfig = dataclasses.field(default_factory=ActorCriticConfig)
    """Shape of the networks: ``net_arch`` (also ``dict(pi=[...], vf=[...])``), ``activation_fn``, ``ortho_init``,
    ``log_std_init``, ``share_layers``, ``squash_output``, ``state_dependent_std``, ``layer_norm``, ``architecture`` or a
    ``torso`` of your own."""

    name: ClassVar[str] = ""

    def __post_init__(self) -> None:
        put = lambda key, value: object.__setattr__(self, key, value)  # noqa: E731
        for key in ("learning_rate", "ent_coef", "critic_learning_rate"):
            value = getattr(self, key)
            if key != "critic_learning_rate" or value is not None:
                put(key, schedules.parse(key, value))
                if min(schedules.at(getattr(self, key), at) for at in (0.0, 1.0)) < 0:
                    raise ValueError(f"{key}={value!r} must not fall below 0")
        put("n_steps", whole("n_steps", self.n_steps, least=1))
        if self.n_episodes is not None:
            put("n_episodes", whole("n_episodes", self.n_episodes, least=1))
        for key in ("gamma", "gae_lambda"):
            put(key, number(key, getattr(self, key), least=0, most=1))
        put("vf_coef", number("vf_coef", self.vf_coef, least=0))
        if self.max_grad_norm is not None:
            put("max_grad_norm", number("max_grad_norm", self.max_grad_norm, above=0))
        check_flag("normalize_advantage", self.normalize_advantage)
        check_flag("use_sde", self.use_sde)
        put("sde_sample_freq", whole("sde_sample_freq", self.sde_sample_freq, least=-1))
        if self.sde_sample_freq == 0:
            raise ValueError("sde_sample_freq=0 would draw no noise; use 1 or more, or -1 for once an episode")
        put("normalize", running_stats.parse(self.normalize))
        put("nonfinite", finite.parse(self.nonfinite))
        put("policy_kwargs", nested("policy_kwargs", ActorCriticConfig, self.policy_kwargs))
        if self.critic_learning_rate is not None and self.policy_kwargs.share_layers:
            raise ValueError(
                "critic_learning_rate gives the value an optimizer of its own, which share_layers=True forbids; leave "
                "one of them out"
            )
        if self.use_sde and (self.policy_kwargs.state_dependent_std or not self.policy_kwargs.learn_std):
            raise ValueError(
                "use_sde=True has a standard deviation of its own; leave state_dependent_std and learn_std out"
            )

    def steps_per_gradient(self, n_envs: int) -> int:
        """Returns how many steps of ``n_envs`` environments one gradient is taken on."""
        return self.n_steps * n_envs

    def gradient_steps(self, n: int) -> int:
        """Returns how many gradient steps a rollout of ``n`` steps is worth, if nothing stops them early."""
        return 1

    @property
    def stops_early(self) -> bool:
        """Whether something may stop them; an update then says under ``gradient_steps`` how many it took."""
        return False


def check_flag(key: str, value: Any) -> None:
    """Raises ``TypeError`` unless ``value`` is True or False."""
    if not isinstance(value, bool):
        raise TypeError(f"{key}={value!r} must be True or False")


def check_value_rate(config: OnPolicyConfig, obs_leaves: tuple[Leaf, ...]) -> None:
    """Raises ``ValueError`` if the value has an optimizer of its own and its convolutions are the policy's too."""
    shared = config.policy_kwargs.share_features_extractor and any(convolutions(leaf) for leaf in obs_leaves)
    if config.critic_learning_rate is not None and shared:
        raise ValueError(
            "critic_learning_rate gives the value an optimizer of its own, and of images policy and value share the "
            "convolutions; give policy_kwargs=dict(share_features_extractor=False) or leave it out"
        )


class ActionKind(NamedTuple):
    """What a policy must give for an action space; static and hashable."""

    kind: Literal["box", "categorical", "binary"]
    sizes: tuple[int, ...]
    """Box: the number of components. Discrete and MultiDiscrete: possibilities of each choice. MultiBinary: the bits."""
    single: bool
    """Whether an action is one choice without an axis (Discrete)."""

    @property
    def n_outputs(self) -> int:
        """Numbers that the policy's head gives, leaving out a standard deviation."""
        return sum(self.sizes)


def action_kind(space: spaces.Space) -> ActionKind:
    """Returns the kind of a checked action space (see :func:`rejeu.spaces.check_action`)."""
    if isinstance(space, spaces.Box):
        return ActionKind("box", (int(np.prod(space.shape, dtype=int)),), False)
    if isinstance(space, spaces.Discrete):
        return ActionKind("categorical", (int(space.n),), True)
    if isinstance(space, spaces.MultiDiscrete):
        return ActionKind("categorical", tuple(int(n) for n in space.nvec.ravel()), False)
    assert isinstance(space, spaces.MultiBinary)
    return ActionKind("binary", (int(np.prod(space.shape, dtype=int)),), False)


Distribution = Normal | TanhNormal | Categorical | MultiCategorical | Bernoulli


class ActorCritic(eqx.Module):
    """Observation to a distribution over actions and to a value."""

    encoder: Encoder
    torso: Torso
    head: Linear
    log_std: Array | None
    """``(action_dim,)``, with gSDE ``(width, action_dim)``; None where the head gives it or there is none."""
    value_encoder: Encoder | None
    """None where the policy's is shared."""
    value_torso: Torso | None
    """None where the policy's is shared."""
    value_head: Linear
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
        std = shape.state_dependent_std and action.kind == "box"
        encoder = Encoder(leaves, keys[0])
        torso, n_hidden = make_torso(keys[1], encoder.n_features, None, widths, shape)
        head = Linear(keys[2], n_hidden, action.n_outputs * (2 if std else 1))
        value_encoder = None if shape.share_features_extractor else Encoder(leaves, keys[3])
        value_torso, n_value = (
            (None, n_hidden)
            if shape.share_layers
            else make_torso(keys[4], encoder.n_features, None, value_widths, shape)
        )
        value_head = Linear(keys[5], n_value, 1)
        if shape.ortho_init:
            fresh = jax.random.split(jax.random.fold_in(key, 1), 6)
            encoder, torso = orthogonal(encoder, fresh[0], HIDDEN_GAIN), orthogonal(torso, fresh[1], HIDDEN_GAIN)
            value_encoder = orthogonal(value_encoder, fresh[3], HIDDEN_GAIN)
            value_torso = orthogonal(value_torso, fresh[4], HIDDEN_GAIN)
            head, value_head = orthogonal(head, fresh[2], POLICY_GAIN), orthogonal(value_head, fresh[5], VALUE_GAIN)
        if std:
            bias = head.bias.at[action.n_outputs :].set(shape.log_std_init)
            head = eqx.tree_at(lambda linear: linear.bias, head, bias)
        self.encoder, self.torso, self.head = encoder, torso, head
        self.value_encoder, self.value_torso, self.value_head = value_encoder, value_torso, value_head
        has_log_std = action.kind == "box" and not std
        std_shape = (n_hidden, action.n_outputs) if use_sde else (action.n_outputs,)
        self.log_std = jnp.full(std_shape, shape.log_std_init, jnp.float32) if has_log_std else None
        self.action, self.shape = action, shape

    def policy(self, obs: PyTree) -> Distribution:
        """Returns the distribution of actions at observations ``(batch, ...)``, which may be :class:`Masked`."""
        obs, mask = unmasked(obs)
        return self.distribution(self.hidden(obs), mask)

    def hidden(self, obs: PyTree) -> Array:
        """Returns the policy's last hidden layer at observations ``(batch, ...)``."""
        return self.torso(self.encoder(obs))

    def value(self, obs: PyTree) -> Array:
        """Returns the values of observations ``(batch, ...)``, ``(batch,)``."""
        obs, _ = unmasked(obs)
        encoder = self.encoder if self.value_encoder is None else self.value_encoder
        torso = self.torso if self.value_torso is None else self.value_torso
        return self.value_head(torso(encoder(obs)))[:, 0]

    def both(self, obs: PyTree) -> tuple[Distribution, Array]:
        """Returns :meth:`policy` and :meth:`value`, computing what they share once."""
        obs, mask = unmasked(obs)
        features = self.encoder(obs)
        hidden = self.torso(features)
        value_features = features if self.value_encoder is None else self.value_encoder(obs)
        value_hidden = hidden if self.value_torso is None else self.value_torso(value_features)
        return self.distribution(hidden, mask), self.value_head(value_hidden)[:, 0]

    def distribution(self, hidden: Array, mask: Array | None) -> Distribution:
        """Returns the distribution that the last hidden layer ``(batch, width)`` asks for."""
        outputs = self.head(hidden)
        if self.action.kind == "box":
            if self.log_std is None:
                outputs, log_std = jnp.split(outputs, 2, axis=-1)
                log_std = jnp.clip(log_std, *LOG_STD_RANGE)
            else:
                log_std = self.log_std[None] if self.log_std.ndim == 1 else sde_log_std(self.log_std, hidden)
                if not self.shape.learn_std:
                    log_std = jax.lax.stop_gradient(log_std)
            return (TanhNormal if self.shape.squash_output else Normal)(outputs, log_std)
        if mask is not None:
            outputs = jnp.where(mask, outputs, jnp.float32(FORBIDDEN))
        if self.action.kind == "binary":
            return Bernoulli(outputs)
        if self.action.single:
            return Categorical(outputs)
        ends = np.cumsum(self.action.sizes)[:-1].tolist()
        return MultiCategorical(tuple(Categorical(part) for part in jnp.split(outputs, ends, axis=-1)))


SDE_EPSILON = 1e-6
"""Added to the variance of state-dependent noise, which is 0 where the hidden layer is."""


def sde_log_std(log_std: Array, hidden: Array) -> Array:
    """Returns the log standard deviation of state-dependent noise at hidden layers ``(batch, width)``.

    The noise is ``hidden @ E`` with a matrix ``E`` of independent normals of standard deviations ``exp(log_std)`` (Raffin et
    al. 2020, "Smooth Exploration for Robotic Reinforcement Learning", arXiv 2005.05719, equation 8). No gradient reaches
    the hidden layer this way.
    """
    variance = jnp.square(jax.lax.stop_gradient(hidden)) @ jnp.exp(2.0 * log_std)
    return 0.5 * jnp.log(variance + SDE_EPSILON)


def sde_explorer(n_steps: int) -> Explorer:
    """Returns exploration by state-dependent noise (gSDE), whose matrix is drawn anew every ``n_steps``, or -1: episode.

    The carry is each environment's matrix ``(n_envs, width, action_dim)`` and its age in steps ``int32 (n_envs,)``.
    """

    def init(actor: ActorCritic, n_envs: int) -> tuple[Array, Array]:
        assert actor.log_std is not None
        return jnp.zeros((n_envs, *actor.log_std.shape), jnp.float32), jnp.zeros((n_envs,), jnp.int32)

    def act(
        carry: tuple[Array, Array], actor: ActorCritic, obs: PyTree, ended: Array, key: Array, clock: Clock
    ) -> tuple[Array, tuple[Array, Array]]:
        matrix, age = carry
        assert actor.log_std is not None
        due = ended if n_steps == -1 else ended | (age % n_steps == 0)
        fresh = jnp.exp(actor.log_std)[None] * jax.random.normal(key, matrix.shape, matrix.dtype)
        matrix = jnp.where(due[:, None, None], fresh, matrix)
        hidden = actor.hidden(obs)
        mean = actor.distribution(hidden, None).mean  # type: ignore[union-attr]
        action = mean + jnp.einsum("nh,nhd->nd", hidden, matrix)
        age = jnp.where(ended, 0, age) + 1
        return jnp.tanh(action) if actor.shape.squash_output else action, (matrix, age)

    return Explorer(init, act)


def explorer_of(config: OnPolicyConfig, kind: ActionKind) -> Explorer | None:
    """Returns how the policy explores where that takes more than drawing from its distribution, else None.

    Raises:
        ValueError: for state-dependent noise on actions that are no numbers.
    """
    if not config.use_sde:
        return None
    if kind.kind != "box":
        raise ValueError("use_sde=True needs Box actions: there is no noise to add to choices; leave it out")
    return sde_explorer(config.sde_sample_freq)


def unmasked(obs: PyTree) -> tuple[PyTree, Array | None]:
    """Returns an observation and its mask, None where it has none."""
    return (obs.obs, obs.mask) if isinstance(obs, Masked) else (obs, None)


def orthogonal(module: Any, key: Array, gain: float) -> Any:
    """Returns ``module`` with the weights of every linear layer and convolution orthogonal times ``gain``, biases 0.

    Source: Saxe et al. 2014, "Exact solutions to the nonlinear dynamics of learning" (arXiv 1312.6120). None stays None.
    """
    drawn = 0

    def draw(node: Any) -> Any:
        nonlocal drawn
        if not isinstance(node, Linear | Convolution):
            return node
        drawn += 1
        initializer = jax.nn.initializers.orthogonal(gain)
        weight = node.weight.reshape(-1, node.weight.shape[-1])
        fresh = initializer(jax.random.fold_in(key, drawn), weight.shape, jnp.float32).reshape(node.weight.shape)
        return eqx.tree_at(lambda n: (n.weight, n.bias), node, (fresh, jnp.zeros_like(node.bias)))

    return jax.tree.map(draw, module, is_leaf=lambda node: isinstance(node, Linear | Convolution))


class Samples(NamedTuple):
    """The steps of a rollout as the losses need them, leaves ``(batch, ...)``."""

    obs: PyTree
    action: Array
    log_prob: Array
    """Of the action under the policy that chose it, in nats."""
    value: Array
    """Of the observation before any update."""
    advantage: Array
    target: Array
    """What the value should have been: advantage plus value (the lambda-return)."""
    valid: Array
    """Whether the step exists, ``bool``."""


def samples(network: ActorCritic, rollout: Rollout, gae_lambda: float) -> Samples:
    """Returns the steps of a rollout in one row, environment by environment within a step, and their advantages.

    Values and log-probabilities are computed here, in one pass over all steps, rather than while acting: the network is
    still the one that acted.
    """
    shape = rollout.reward.shape
    flat = jax.tree.map(
        lambda x: x.reshape(shape[0] * shape[1], *x.shape[2:]), rollout._replace(started=None, carry=())
    )
    distribution, value = network.both(flat.obs)
    next_value = network.value(flat.next_obs)
    last = jnp.concatenate([~rollout.valid[1:], jnp.ones_like(rollout.valid[:1])])
    advantage = advantages(
        rollout.reward,
        value.reshape(shape),
        next_value.reshape(shape),
        rollout.discount,
        rollout.ended | last,
        gae_lambda,
    ).reshape(-1)
    log_prob = distribution.log_prob(flat.action)
    return Samples(flat.obs, flat.action, log_prob, value, advantage, advantage + value, flat.valid)


def entropy_of(distribution: Distribution, log_prob: Array) -> Array:
    """Returns the entropy, ``(batch,)``; of a squashed normal, which has none in closed form, its estimate -log pi."""
    return -log_prob if isinstance(distribution, TanhNormal) else distribution.entropy()


def clipped(gradients: PyTree, most: float | None) -> tuple[PyTree, Array]:
    """Returns ``gradients`` scaled down to the norm ``most`` if they are longer (None: never), and their norm before."""
    norm = jnp.sqrt(sum_of([jnp.sum(jnp.square(g)) for g in jax.tree.leaves(gradients)]))
    if most is None:
        return gradients, norm
    factor = jnp.minimum(1.0, most / (norm + 1e-6))
    return jax.tree.map(lambda g: g * factor, gradients), norm


def is_value(network: Any) -> Any:
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


def explained_variance(predicted: Array, target: Array, valid: Array) -> Array:
    """Returns ``1 - Var(target - predicted) / Var(target)`` over the valid entries; NaN where the target is constant."""
    spread = masked_variance(target, valid)
    return jnp.where(spread > 0, 1.0 - masked_variance(target - predicted, valid) / spread, jnp.nan)


def masked_mean(values: Array, valid: Array) -> Array:
    """Returns the mean over the entries where ``valid``; 0 where there is none."""
    return jnp.sum(jnp.where(valid, values, 0.0)) / jnp.maximum(jnp.sum(valid), 1)


def masked_variance(values: Array, valid: Array) -> Array:
    """Returns the variance over the entries where ``valid``, divided by their number."""
    return masked_mean(jnp.square(values - masked_mean(values, valid)), valid)


def standardised(values: Array, valid: Array) -> Array:
    """Returns ``values`` with mean 0 and standard deviation 1 over the entries where ``valid``.

    Where only one is valid, which has no deviation, ``values`` are left as they are.
    """
    scaled = (values - masked_mean(values, valid)) / (jnp.sqrt(masked_variance(values, valid)) + 1e-8)
    return jnp.where(jnp.sum(valid) > 1, scaled, values)
