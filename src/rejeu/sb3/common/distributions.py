"""Distributions of actions with Stable-Baselines3's methods, in NumPy, over those of :mod:`rejeu.core.distributions`.

Random numbers come from NumPy's global generator, which ``set_random_seed`` seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from rejeu.algorithms.actor_critic.network import sde_std
from rejeu.core.distributions import Bernoulli, Categorical, MultiCategorical, Normal, TanhNormal, forbid
from rejeu.sb3.common.preprocessing import get_action_dim
from rejeu.sb3.common.torch_layers import create_mlp
from rejeu.sb3.common.utils import Tensor

__all__ = [
    "BernoulliDistribution",
    "CategoricalDistribution",
    "DiagGaussianDistribution",
    "Distribution",
    "MultiCategoricalDistribution",
    "SquashedDiagGaussianDistribution",
    "StateDependentNoiseDistribution",
    "kl_divergence",
    "make_proba_distribution",
    "sum_independent_dims",
]


def half_widths(space: spaces.Space) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the centers and half widths of Box actions, None for others."""
    if not isinstance(space, spaces.Box):
        return None
    return (space.high + space.low).ravel() / 2, (space.high - space.low).ravel() / 2


class Distribution:
    """A distribution of actions.

    Args:
        distribution: of actions in the algorithm's range.
        widths: centers and half widths of the environment's range; None: it is the same.
    """

    def __init__(self, distribution: Any = None, widths: tuple[np.ndarray, np.ndarray] | None = None) -> None:
        self.distribution, self.widths = distribution, widths

    def _own(self, actions: Any) -> Any:
        actions = np.asarray(actions)
        return actions if self.widths is None else (actions - self.widths[0]) / self.widths[1]

    def _shown(self, actions: Any) -> np.ndarray:
        actions = np.asarray(actions)
        return Tensor.of(actions if self.widths is None else actions * self.widths[1] + self.widths[0])

    def _log_width(self) -> float:
        return 0.0 if self.widths is None else float(np.sum(np.log(self.widths[1])))

    def log_prob(self, actions: Any) -> np.ndarray:
        """Returns the log-probabilities or densities of actions, ``(batch,)``, in nats."""
        return Tensor.of(self.distribution.log_prob(self._own(actions))) - self._log_width()

    def entropy(self) -> np.ndarray | None:
        """Returns the entropy, ``(batch,)``, in nats; None for a squashed Gaussian, which has no closed form."""
        if isinstance(self.distribution, TanhNormal):
            return None
        return Tensor.of(self.distribution.entropy()) + self._log_width()

    def sample(self) -> np.ndarray:
        """Returns random actions."""
        return self._shown(self.distribution.sample(jax.random.key(np.random.randint(2**31))))  # noqa: NPY002

    def mode(self) -> np.ndarray:
        """Returns the most likely actions; of a Gaussian the means."""
        return self._shown(self.distribution.mode())

    def get_actions(self, deterministic: bool = False) -> np.ndarray:
        """Returns the most likely or random actions."""
        return self.mode() if deterministic else self.sample()


class GaussianDistribution(Distribution):
    """Independent normal distributions, squashed or not.

    Args:
        action_dim: number of components.
    """

    kind: Any = Normal

    def __init__(self, action_dim: int) -> None:
        super().__init__()
        self.action_dim = action_dim

    def proba_distribution_net(
        self, latent_dim: int, log_std_init: float | None = None, latent_sde_dim: int | None = None
    ) -> tuple[eqx.Module, np.ndarray]:
        """Returns a linear layer for the means, and logarithms of standard deviations.

        They are ``log_std_init``; None: -2 for gSDE, where they are ``(latent_sde_dim or latent_dim, action_dim)``, else 0.
        """
        by_state = isinstance(self, StateDependentNoiseDistribution)
        shape = (latent_sde_dim or latent_dim, self.action_dim) if by_state else self.action_dim
        start = (-2.0 if by_state else 0.0) if log_std_init is None else log_std_init
        return create_mlp(latent_dim, self.action_dim, [])[0], Tensor.of(np.full(shape, np.float32(start)))

    def proba_distribution(self, mean_actions: Any, log_std: Any) -> Self:
        """Sets the parameters, and returns itself."""
        mean, log_std = (jnp.asarray(np.asarray(part, np.float32)) for part in (mean_actions, log_std))
        self.distribution = self.kind(*jnp.broadcast_arrays(mean, log_std))
        return self


class DiagGaussianDistribution(GaussianDistribution):
    """Independent normal distributions."""


class SquashedDiagGaussianDistribution(DiagGaussianDistribution):
    """Independent normal distributions squashed by tanh."""

    kind = TanhNormal


class StateDependentNoiseDistribution(GaussianDistribution):
    """Normal distributions of gSDE: the noise is linear in features of the observation (arXiv 2005.05719).

    Args:
        action_dim: number of components.
        full_std: accepted; the matrix has a standard deviation for each feature and component.
        use_expln: let large standard deviations grow linearly.
        squash_output: squash the actions by tanh.
        learn_features: accepted.
        epsilon: added to variances.
    """

    def __init__(
        self,
        action_dim: int,
        full_std: bool = True,
        use_expln: bool = False,
        squash_output: bool = False,
        learn_features: bool = False,
        epsilon: float = 1e-6,
    ) -> None:
        super().__init__(action_dim)
        self.kind = TanhNormal if squash_output else Normal
        self.use_expln, self.epsilon = use_expln, epsilon
        self._matrices: Any = None

    def sample_weights(self, log_std: Any, batch_size: int = 1) -> None:
        """Draws the matrices of the noise, ``(batch_size, width, action_dim)``, which :meth:`sample` uses from then on."""
        std = np.asarray(sde_std(jnp.asarray(np.asarray(log_std, np.float32)), self.use_expln))
        self._matrices = std * np.random.normal(size=(batch_size, *std.shape)).astype(np.float32)  # noqa: NPY002

    def proba_distribution(self, mean_actions: Any, log_std: Any, latent_sde: Any = None) -> Self:
        """Sets the parameters, and returns itself: ``log_std (width, action_dim)``, ``latent_sde (batch, width)``."""
        std = sde_std(jnp.asarray(np.asarray(log_std, np.float32)), self.use_expln)
        self._latent = np.asarray(latent_sde, np.float32)
        variance = jnp.square(self._latent) @ jnp.square(std) + self.epsilon
        return super().proba_distribution(mean_actions, 0.5 * jnp.log(variance))

    def sample(self) -> np.ndarray:
        """Returns actions with the noise of the matrices that were drawn last; without any, independent ones."""
        if self._matrices is None or len(self._matrices) not in (1, len(self._latent)):
            return super().sample()
        noisy = self.distribution.mean + jnp.einsum("...i,...ij->...j", self._latent, self._matrices)
        return self._shown(jnp.tanh(noisy) if self.kind is TanhNormal else noisy)


class LogitsDistribution(Distribution):
    """A distribution that ``action_dim`` logits determine. Abstract."""

    kind: Any

    def __init__(self, action_dim: int) -> None:
        super().__init__()
        self.action_dim = action_dim

    def _made(self, logits: Any) -> Any:
        return self.kind(logits)

    def proba_distribution_net(self, latent_dim: int) -> eqx.Module:
        """Returns a linear layer for the logits."""
        return create_mlp(latent_dim, self.action_dim, [])[0]

    def proba_distribution(self, action_logits: Any) -> Self:
        """Sets the parameters, and returns itself."""
        self.logits = jnp.asarray(np.asarray(action_logits, np.float32))
        self.distribution = self._made(self.logits)
        return self

    def apply_masking(self, masks: Any) -> None:
        """Forbids choices, or allows all with None."""
        allowed = None if masks is None else jnp.asarray(np.asarray(masks, bool)).reshape(self.logits.shape)
        self.distribution = self._made(forbid(self.logits, allowed))


class CategoricalDistribution(LogitsDistribution):
    """One choice among ``action_dim``."""

    kind = Categorical


class MultiCategoricalDistribution(LogitsDistribution):
    """Several choices, each among its own number."""

    def __init__(self, action_dims: Sequence[int]) -> None:
        super().__init__(sum(action_dims))
        self.action_dims = list(action_dims)

    def _made(self, logits: Any) -> Any:
        ends = np.cumsum(self.action_dims)[:-1].tolist()
        return MultiCategorical(tuple(Categorical(part) for part in jnp.split(logits, ends, axis=-1)))


class BernoulliDistribution(LogitsDistribution):
    """Independent bits."""

    kind = Bernoulli

    def apply_masking(self, masks: Any) -> None:
        """Forbids values, two for each bit: 0 and 1; or allows all with None."""
        super().apply_masking(None)
        if masks is not None:
            allowed = jnp.asarray(np.asarray(masks, bool)).reshape(*self.logits.shape, 2)
            self.distribution = self._made(-forbid(-forbid(self.logits, allowed[..., 1]), allowed[..., 0]))


def sum_independent_dims(tensor: Any) -> np.ndarray:
    """Returns the sums over the last axis; one sum of an array of one axis."""
    return Tensor.of(np.sum(np.asarray(tensor), axis=-1))


def make_proba_distribution(action_space: spaces.Space, use_sde: bool = False, dist_kwargs: Any = None) -> Distribution:
    """Returns a distribution for an action space.

    Raises:
        NotImplementedError: for other spaces.
    """
    if not isinstance(action_space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        raise NotImplementedError(f"no distribution for {action_space}")
    if isinstance(action_space, spaces.Box):
        kind = StateDependentNoiseDistribution if use_sde else DiagGaussianDistribution
        return kind(get_action_dim(action_space), **(dist_kwargs or {}))
    if isinstance(action_space, spaces.Discrete):
        return CategoricalDistribution(int(action_space.n))
    if isinstance(action_space, spaces.MultiDiscrete):
        return MultiCategoricalDistribution(action_space.nvec.tolist())
    return BernoulliDistribution(get_action_dim(action_space))


def kl_divergence(dist_true: Distribution, dist_pred: Distribution) -> np.ndarray:
    """Returns ``KL(true || pred)`` in nats, of each component where there are several.

    Raises:
        TypeError: if the distributions are of different kinds.
    """
    p, q = dist_true.distribution, dist_pred.distribution
    if type(p) is not type(q):
        raise TypeError(f"the distributions are of different kinds: {type(p).__name__} and {type(q).__name__}")
    if isinstance(p, Normal | TanhNormal | Bernoulli):  # those of rejeu sum over the last axis
        p, q = (type(one)(*(part[..., None] for part in one)) for one in (p, q))
    return Tensor.of(p.kl_divergence(q))
