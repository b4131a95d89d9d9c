"""The hyper-parameters that the on-policy algorithms share, and the shape of their network."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from rejeu import normalization, schedules
from rejeu.loops import finite
from rejeu.networks import PolicyConfig, Widths, convolutions
from rejeu.normalization import NormalizationConfig
from rejeu.schedules import Schedule
from rejeu.spaces import Leaf
from rejeu.validation import nested, number, whole

HIDDEN_LAYERS = (64, 64)
"""Default widths of policy and value."""


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
        self._check_shared_widths()

    def _check_shared_widths(self) -> None:
        """Raises ``ValueError`` if layers that policy and value share are given widths for each."""
        key, own = ("critic_layers", self.critic_layers or None) if self.has_branches else ("vf", self.vf)
        widths = self.actor_widths(HIDDEN_LAYERS)
        if self.share_layers and own is not None and own != widths:
            raise ValueError(
                f"policy_kwargs: share_layers=True has one stack of hidden layers, of the policy's widths {list(widths)}, "
                f"and leaves {key}={list(own)} without meaning; leave out one"
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
    hidden_layers: ClassVar[Widths] = Widths(HIDDEN_LAYERS, HIDDEN_LAYERS)
    """Default widths of policy and value."""
    hidden_layers_on_images: ClassVar[Widths] = Widths((), ())
    """The same where the observation is an image."""

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
        put("normalize", normalization.parse(self.normalize))
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

    def learns_from_part(self, n: int, n_envs: int) -> bool:
        """Returns whether an incomplete rollout of ``n`` steps is learned from when ``learn`` ends.

        It must hold a minibatch at least. Where a whole rollout is one minibatch it is never learned from.
        """
        return False

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
