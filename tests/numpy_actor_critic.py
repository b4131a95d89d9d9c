"""Reference implementation of policies, values, losses and on-policy updates in float64 NumPy, independent of JAX.

Networks have tanh between their layers and share none. A complete network is a list of layers (see ``numpy_networks``):
those of the policy, those of the value and, if there is one, a last layer that contains only the log standard
deviation.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from scipy import special, stats

from tests.numpy_networks import Adam, Layers, gradient


class Network:
    """A copy of the arrays of an ``ActorCritic``, or of its optimizer's moments."""

    def __init__(self, network: Any) -> None:
        parts = lambda torso, head: [  # noqa: E731
            [np.array(np.float64(one.weight)), np.array(np.float64(one.bias))] for one in (*torso.layers, head)
        ]
        self.pi = parts(network.torso, network.head)
        self.vf = parts(network.value_torso, network.value_head)
        self.log_std: Layers = [] if network.log_std is None else [[np.array(np.float64(network.log_std)), np.zeros(0)]]

    @property
    def policy(self) -> Layers:
        """The layers of the policy (not copied)."""
        return self.pi + self.log_std

    @property
    def everything(self) -> Layers:
        """All layers (not copied)."""
        return self.pi + self.vf + self.log_std

    def value(self, obs: Any) -> np.ndarray:
        """Returns the values ``(...)`` of observations ``(..., obs_dim)``."""
        return through(self.vf, obs)[..., 0]


def through(layers: Layers, x: Any) -> np.ndarray:
    """Returns the output of layers with tanh between them."""
    x = np.float64(x)
    for weight, bias in layers[:-1]:
        x = np.tanh(x @ weight + bias)
    return x @ layers[-1][0] + layers[-1][1]


def log_prob_and_entropy(network: Network, obs: Any, action: Any, kind: Any) -> tuple[np.ndarray, np.ndarray]:
    """Returns log-probabilities of actions and entropies, ``(batch,)`` each.

    ``kind`` is ``"box"``, ``"squashed"``, ``"binary"`` or the sizes of several choices. The entropy of a squashed
    normal distribution is estimated by -log pi.
    """
    outputs = through(network.pi, obs)
    if kind in ("box", "squashed"):
        mean, log_std = np.split(outputs, 2, axis=1) if not network.log_std else (outputs, network.log_std[0][0])
        std = np.exp(np.broadcast_to(log_std, mean.shape))
        if kind == "squashed":
            before = np.arctanh(np.float64(action))
            log_prob = (stats.norm.logpdf(before, mean, std) - np.log1p(-(np.float64(action) ** 2))).sum(axis=1)
            return log_prob, -log_prob
        log_prob = stats.norm.logpdf(np.float64(action), mean, std).sum(axis=1)
        return log_prob, stats.norm.entropy(0.0, std).sum(axis=1)
    if kind == "binary":
        one = special.expit(outputs)
        return stats.bernoulli.logpmf(action, one).sum(axis=1), stats.bernoulli.entropy(one).sum(axis=1)
    choices = np.reshape(action, (len(outputs), len(kind)))
    log_prob, entropy = np.zeros((2, len(outputs)))
    for i, logits in enumerate(np.split(outputs, np.cumsum(kind)[:-1], axis=1)):
        p = special.softmax(logits, axis=1)
        log_prob += np.log(p[np.arange(len(p)), choices[:, i]])
        entropy += stats.entropy(p, axis=1)
    return log_prob, entropy


def lambda_advantages(network: Network, rollout: Any, gae_lambda: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns advantages and values ``(steps, n_envs)``, computed per environment backward from the last valid step."""
    value, next_value = network.value(rollout.obs), network.value(rollout.next_obs)
    advantage = np.zeros_like(value)
    for env in range(value.shape[1]):
        following = 0.0
        for t in reversed(range(int(rollout.valid[:, env].sum()))):
            discount = float(rollout.discount[t, env])
            delta = rollout.reward[t, env] + discount * next_value[t, env] - value[t, env]
            following = delta + (0.0 if rollout.ended[t, env] else discount * gae_lambda * following)
            advantage[t, env] = following
    return advantage, value


def standard(values: np.ndarray) -> np.ndarray:
    """Returns values standardized to mean 0 and standard deviation 1. A single value is returned unchanged."""
    return values if len(values) == 1 else (values - values.mean()) / (values.std() + 1e-8)


class Losses:
    """The losses of a minibatch, from arrays ``(batch,)`` of its valid steps."""

    def __init__(
        self,
        network: Network,
        obs: Any,
        action: Any,
        kind: Any,
        old_log_prob: np.ndarray,
        old_value: np.ndarray,
        advantage: np.ndarray,
        target: np.ndarray,
        clip: float,
        clip_vf: float | None,
        vf_coef: float,
        ent_coef: float,
    ) -> None:
        log_prob, entropy = log_prob_and_entropy(network, obs, action, kind)
        ratio = np.exp(log_prob - old_log_prob)
        gains = [min(r * a, min(max(r, 1 - clip), 1 + clip) * a) for r, a in zip(ratio, advantage, strict=True)]
        value = network.value(obs)
        if clip_vf is not None:
            value = np.array([o + min(max(v - o, -clip_vf), clip_vf) for v, o in zip(value, old_value, strict=True)])
        self.policy_loss = -np.mean(gains)
        self.value_loss = np.mean((value - target) ** 2)
        self.entropy = np.mean(entropy)
        self.approx_kl = np.mean(ratio - 1.0 - np.log(ratio))
        self.clip_fraction = np.mean((ratio < 1 - clip) | (ratio > 1 + clip))
        self.total = self.policy_loss + vf_coef * self.value_loss - ent_coef * self.entropy


def norm(slopes: Layers) -> float:
    """Returns the global norm of the gradients."""
    return float(np.sqrt(sum(np.sum(array**2) for layer in slopes for array in layer)))


def cut(slopes: Layers, most: float | None) -> Layers:
    """Returns gradients scaled down to the norm ``most`` if they exceed it."""
    factor = 1.0 if most is None else min(1.0, most / (norm(slopes) + 1e-6))
    return [[factor * array for array in layer] for layer in slopes]


class PPO:
    """PPO as documented; ``two_rates`` uses one Adam optimizer for the policy and one for the value."""

    def __init__(self, network: Any, config: Any, kind: Any, two_rates: bool = False) -> None:
        self.network, self.config, self.kind = Network(network), config, kind
        parts = [self.network.policy, self.network.vf] if two_rates else [self.network.everything]
        self.adams = [Adam(part, 0.0, eps=1e-5) for part in parts]
        self.n_updates = 0

    def update(
        self,
        rollout: Any,
        orders: np.ndarray,
        rates: list[float],
        clip: float,
        clip_vf: float | None = None,
        ent_coef: float = 0.0,
    ) -> dict[str, float]:
        """Updates on a rollout with the given orders of valid steps ``(n_epochs, n)``; returns the mean losses."""
        config, network = self.config, self.network
        flat = lambda x: np.reshape(x, (-1, *x.shape[2:]))  # noqa: E731
        advantage, value = map(flat, lambda_advantages(network, rollout, config.gae_lambda))
        obs, action = flat(rollout.obs), flat(rollout.action)
        old_log_prob, _ = log_prob_and_entropy(network, obs, action, self.kind)
        seen = []
        for index in minibatches(orders, config.batch_size):
            scaled = standard(advantage[index]) if config.normalize_advantage else advantage[index]

            def losses(index: np.ndarray = index, scaled: np.ndarray = scaled) -> Losses:
                return Losses(
                    network,
                    obs[index],
                    action[index],
                    self.kind,
                    old_log_prob[index],
                    value[index],
                    scaled,
                    (advantage + value)[index],
                    clip,
                    clip_vf,
                    config.vf_coef,
                    ent_coef,
                )

            seen.append(vars(losses()))
            if config.target_kl is not None and seen[-1]["approx_kl"] > 1.5 * config.target_kl:
                break
            slopes = [gradient(adam.network, lambda: losses().total) for adam in self.adams]
            for adam, slope, rate in zip(self.adams, slopes, rates, strict=True):
                adam.rate = rate
                adam.step(cut(slope, config.max_grad_norm))
            self.n_updates += 1
        return {name: float(np.mean([one[name] for one in seen])) for name in seen[0]}


def minibatches(orders: np.ndarray, size: int) -> Iterator[np.ndarray]:
    """Yields minibatches of ``size`` from each order. The last one of an order contains the remaining steps."""
    for order in orders:
        for first in range(0, len(order), size):
            yield order[first : first + size]


class RMSprop:
    """RMSprop (Tieleman and Hinton 2012), which updates ``network`` in place as PyTorch does.

    The mean of squares starts at 0, and epsilon is added to its square root: r / (sqrt(v) + epsilon).
    """

    def __init__(self, network: Layers, rate: float, eps: float, decay: float = 0.99) -> None:
        self.network, self.rate, self.eps, self.decay = network, rate, eps, decay
        self.second = [[np.zeros_like(array) for array in layer] for layer in network]

    def step(self, slopes: Layers) -> None:
        """Takes one step against the gradients ``slopes``."""
        for layer, slope, v in zip(self.network, slopes, self.second, strict=True):
            for i, g in enumerate(slope):
                v[i] = self.decay * v[i] + (1.0 - self.decay) * g**2
                layer[i][...] = layer[i] - self.rate * g / (np.sqrt(v[i]) + self.eps)


class A2C:
    """A2C as documented; ``optimizers`` returns one or two optimizers that cover the whole network."""

    def __init__(self, network: Any, config: Any, kind: Any, optimizers: Callable[[Network], list[Any]]) -> None:
        self.network, self.config, self.kind = Network(network), config, kind
        self.optimizers = optimizers(self.network)

    def update(self, rollout: Any, ent_coef: float) -> dict[str, float]:
        """Takes one gradient step on the valid steps of a rollout; returns the losses before the step."""
        network, config, keep = self.network, self.config, rollout.valid
        advantage, value = (x[keep] for x in lambda_advantages(network, rollout, config.gae_lambda))
        target = advantage + value
        if config.normalize_advantage:
            advantage = standard(advantage)
        obs, action = rollout.obs[keep], rollout.action[keep]

        def losses() -> dict[str, float]:
            log_prob, entropy = log_prob_and_entropy(network, obs, action, self.kind)
            parts = {
                "policy_loss": -np.mean(log_prob * advantage),
                "value_loss": np.mean((network.value(obs) - target) ** 2),
                "entropy": np.mean(entropy),
            }
            total = parts["policy_loss"] + config.vf_coef * parts["value_loss"] - ent_coef * parts["entropy"]
            return parts | {"total": total}

        before = losses()
        slopes = [gradient(optimizer.network, lambda: losses()["total"]) for optimizer in self.optimizers]
        for optimizer, slope in zip(self.optimizers, slopes, strict=True):
            optimizer.step(cut(slope, config.max_grad_norm))
        return before
