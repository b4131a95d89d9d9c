"""Whole updates of the off-policy actor-critics in float64 NumPy, as the docstrings of the algorithms have them.

A reference starts from copies of a state's arrays. ``update`` takes the step and returns the expected metrics.
"""

from typing import Any

import jax
import numpy as np
from scipy import stats

from rejeu.core.algorithm import TD_ERROR, Transition
from tests.algorithms.batches import noise_of
from tests.numpy_networks import Adam, Layers, action_value, ensemble, follow, forward, layers, softmax, squashed_sample


def members(network: Any) -> list[Layers]:
    """Copies the weights of a network, or of each member of an ensemble; log standard deviations are a last layer."""
    if hasattr(network, "log_std"):
        return [[*layers(network.network), [np.array(np.float64(network.log_std)), np.zeros(0)]]]
    return ensemble(network) if network.head.bias.ndim > 1 else [layers(network)]


def entropy_of(probabilities: np.ndarray) -> np.ndarray:
    """Returns the entropies in nats, ``(batch,)``."""
    return -(probabilities * np.log(probabilities)).sum(axis=1)


def quantile_huber(quantiles: Any, samples: Any, kappa: float = 1.0) -> float:
    """Returns the mean over all pairs of ``|fraction - 1[u < 0]| Huber(u)``, ``u = sample - quantile``, by loops."""
    total = 0.0
    for i, quantile in enumerate(quantiles):
        fraction = (i + 0.5) / len(quantiles)
        for sample in samples:
            u = sample - quantile
            huber = 0.5 * u * u if abs(u) <= kappa else kappa * (abs(u) - 0.5 * kappa)
            total += (1.0 - fraction if u < 0 else fraction) * huber
    return total / (len(quantiles) * len(samples))


class Reference:
    """The order of an update: critics, actor by the new critics, targets. Abstract."""

    def __init__(self, state: Any, config: Any, rate: float) -> None:
        self.config, self.tau = config, config.tau
        self.delay = getattr(config, "policy_delay", 1)
        self.interval = getattr(config, "target_update_interval", self.delay)
        self.critics_name = "critic" if hasattr(state, "critic") else "critics"
        self.actor, self.critics = layers(state.actor), members(getattr(state, self.critics_name))
        self.target_critics = members(getattr(state, f"target_{self.critics_name}"))
        self.target_actor = layers(state.target_actor) if hasattr(state, "target_actor") else None
        self.actor_adam = Adam(self.actor, rate)
        self.critic_adams = [Adam(critic, rate) for critic in self.critics]
        self.key, self.n = getattr(state, "key", None), 0
        self.met: set[str] = set()
        """Branches of the equations that the batches have reached so far."""

    def networks(self) -> dict[str, list[Layers]]:
        """Returns every network by its name in the state."""
        found = {"actor": [self.actor], self.critics_name: self.critics}
        if self.target_actor is not None:
            found["target_actor"] = [self.target_actor]
        return {**found, f"target_{self.critics_name}": self.target_critics}

    def first_moments(self) -> dict[str, list[Layers]]:
        """Returns the first moments of Adam by the name of the optimizer in the state."""
        return {
            "actor_optimizer": [self.actor_adam.first],
            f"{self.critics_name}_optimizer": [adam.first for adam in self.critic_adams],
        }

    def update(self, batch: Transition) -> dict[str, Any]:
        """Takes one step and returns the metrics."""
        weight = np.ones(len(batch.reward)) if batch.weight is None else np.float64(batch.weight)
        self.keys = None if self.key is None else jax.random.fold_in(self.key, self.n)
        target = self.target(batch)
        predictions = [self.predict(critic, batch) for critic in self.critics]
        metrics = {
            "critic_loss": sum(self.penalty(prediction, target, weight) for prediction in predictions),
            "q_value": np.mean(predictions),
            TD_ERROR: np.mean([self.error(prediction, target) for prediction in predictions], axis=0),
        }
        for critic, adam in zip(self.critics, self.critic_adams, strict=True):
            adam.descend(lambda critic=critic: self.penalty(self.predict(critic, batch), target, weight))
        self.n += 1
        metrics |= self.improve(batch)
        if self.n % self.interval == 0:
            self.move_targets()
        return metrics

    def move_targets(self) -> None:
        if self.target_actor is not None:
            follow(self.target_actor, self.actor, self.tau)
        for target, critic in zip(self.target_critics, self.critics, strict=True):
            follow(target, critic, self.tau)

    def predict(self, critic: Layers, batch: Transition) -> np.ndarray:
        """Returns what a critic says of the actions taken, ``(batch,)``."""
        return action_value(critic, batch.obs, batch.action)

    def penalty(self, prediction: np.ndarray, target: np.ndarray, weight: np.ndarray) -> float:
        """Returns the loss of one critic."""
        return np.mean(weight * (prediction - target) ** 2)

    def error(self, prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
        return np.abs(prediction - target)

    @property
    def branches(self) -> set[str]:
        """The branches that the batches of a test must reach."""
        return set()

    def smallest(self, values: Any) -> np.ndarray:
        """Returns the smallest of the critics' values along the first axis."""
        values = np.array(values)
        if len(set(values.argmin(axis=0).ravel())) > 1:
            self.met.add("no critic is the smallest everywhere")
        return np.sort(values, axis=0)[0]

    def target(self, batch: Transition) -> np.ndarray:
        raise NotImplementedError

    def improve(self, batch: Transition) -> dict[str, float]:
        """Takes the step of the actor, and of the temperature, and returns their metrics."""
        raise NotImplementedError


class DDPG(Reference):
    """Deterministic actor."""

    def act(self, actor: Layers, obs: Any) -> np.ndarray:
        return np.tanh(forward(actor, obs))

    def target(self, batch: Transition) -> np.ndarray:
        action = self.act(self.target_actor, batch.next_obs)
        return batch.reward + batch.discount * action_value(self.target_critics[0], batch.next_obs, action)

    def actor_loss(self, batch: Transition) -> float:
        return -np.mean(action_value(self.critics[0], batch.obs, self.act(self.actor, batch.obs)))

    def improve(self, batch: Transition) -> dict[str, float]:
        loss = self.actor_loss(batch)
        self.actor_adam.descend(lambda: self.actor_loss(batch))
        return {"actor_loss": loss}


class TD3(DDPG):
    """Several critics, noise on the target's action, and an actor that moves at every ``policy_delay``-th update."""

    last_loss = 0.0

    @property
    def branches(self) -> set[str]:
        clipped = {"clipped noise", "clipped action"} if self.config.target_policy_noise else set()
        return {"no critic is the smallest everywhere"} | clipped

    def target(self, batch: Transition) -> np.ndarray:
        noise, limit = noise_of(self.keys, len(batch.reward)), self.config.target_noise_clip
        kick = np.minimum(np.maximum(self.config.target_policy_noise * noise, -limit), limit)
        moved = self.act(self.target_actor, batch.next_obs) + kick
        action = np.minimum(np.maximum(moved, -1.0), 1.0)
        if (np.abs(self.config.target_policy_noise * noise) > limit).any():
            self.met.add("clipped noise")
        if (np.abs(moved) > 1.0).any():
            self.met.add("clipped action")
        return batch.reward + batch.discount * self.smallest(
            [action_value(critic, batch.next_obs, action) for critic in self.target_critics]
        )

    def improve(self, batch: Transition) -> dict[str, float]:
        if self.n % self.delay == 0:
            self.last_loss = super().improve(batch)["actor_loss"]
        return {"actor_loss": self.last_loss}


class TD3BC(TD3):
    """Values over their mean size, and the mean squared distance from recorded actions."""

    def improve(self, batch: Transition) -> dict[str, float]:
        values = action_value(self.critics[0], batch.obs, self.act(self.actor, batch.obs))
        self.scale = self.config.alpha / np.abs(values).mean()
        return super().improve(batch)

    def actor_loss(self, batch: Transition) -> float:
        return self.scale * super().actor_loss(batch) + np.square(self.act(self.actor, batch.obs) - batch.action).mean()


class ReBRAC(TD3):
    """Penalties on the actor and on the target; the actor follows the smallest of the critics."""

    def target(self, batch: Transition) -> np.ndarray:
        noise, limit = noise_of(self.keys, len(batch.reward)), self.config.target_noise_clip
        kick = np.clip(self.config.target_policy_noise * noise, -limit, limit)
        action = np.clip(self.act(self.target_actor, batch.next_obs) + kick, -1.0, 1.0)
        penalty = [
            0.0 if np.isnan(recorded).any() else np.sum((one - recorded) ** 2)
            for one, recorded in zip(action, np.float64(batch.next_action), strict=True)
        ]
        return super().target(batch) - batch.discount * self.config.critic_bc * np.array(penalty)

    def improve(self, batch: Transition) -> dict[str, float]:
        self.scale = 1.0 / np.abs(self.values(batch)).mean()
        return super().improve(batch)

    def values(self, batch: Transition) -> np.ndarray:
        action = self.act(self.actor, batch.obs)
        return self.smallest([action_value(critic, batch.obs, action) for critic in self.critics])

    def actor_loss(self, batch: Transition) -> float:
        distance = np.square(self.act(self.actor, batch.obs) - batch.action).sum(axis=1)
        return np.mean(self.config.actor_bc * distance - self.scale * self.values(batch))


class DiscreteDDPG(DDPG):
    """Classifier as actor, and a critic with one value for each action."""

    def predict(self, critic: Layers, batch: Transition) -> np.ndarray:
        return forward(critic, batch.obs)[np.arange(len(batch.action)), batch.action]

    def target(self, batch: Transition) -> np.ndarray:
        probabilities = softmax(forward(self.target_actor, batch.next_obs))
        values = forward(self.target_critics[0], batch.next_obs)
        expected = [sum(p * q for p, q in zip(*row, strict=True)) for row in zip(probabilities, values, strict=True)]
        return batch.reward + batch.discount * expected

    def actor_loss(self, batch: Transition) -> float:
        probabilities = softmax(forward(self.actor, batch.obs))
        expected = (probabilities * forward(self.critics[0], batch.obs)).sum(axis=1)
        return -np.mean(expected) - 0.01 * np.mean(entropy_of(probabilities))

    def improve(self, batch: Transition) -> dict[str, float]:
        entropy = entropy_of(softmax(forward(self.actor, batch.obs))).mean()
        return {**super().improve(batch), "entropy": entropy}


class SAC(Reference):
    """Stochastic actor with a temperature; half of the squared errors."""

    last = 0.0, 0.0
    """Loss and entropy at the actor's last step."""

    def __init__(self, state: Any, config: Any, rate: float) -> None:
        super().__init__(state, config, rate)
        self.log_alphas = [[np.array(float(state.log_alpha))]]
        self.alpha_adam = Adam(self.log_alphas, rate)
        self.target_entropy = self.automatic if config.target_entropy == "auto" else config.target_entropy

    @property
    def automatic(self) -> float:
        return -float(self.actor[-1][1].size // 2)

    @property
    def branches(self) -> set[str]:
        return {"no critic is the smallest everywhere"}

    @property
    def alpha(self) -> float:
        return np.exp(float(self.log_alphas[0][0]))

    def sample(self, obs: Any, key: Any) -> tuple[np.ndarray, np.ndarray]:
        return squashed_sample(forward(self.actor, obs), noise_of(key, len(obs)))

    def penalty(self, prediction: np.ndarray, target: np.ndarray, weight: np.ndarray) -> float:
        return 0.5 * super().penalty(prediction, target, weight)

    def bootstrap(self, critics: list[Layers], obs: Any, action: Any) -> np.ndarray:
        """Returns the values of the TD target, ``(batch,)``."""
        return self.smallest([action_value(critic, obs, action) for critic in critics])

    def judge(self, critics: list[Layers], obs: Any, action: Any) -> np.ndarray:
        """Returns the values that the actor climbs, ``(batch,)``: with ``target_subset`` the mean of all critics."""
        if self.config.target_subset is None:
            return self.bootstrap(critics, obs, action)
        return np.mean([action_value(critic, obs, action) for critic in critics], axis=0)

    def drawn(self, key: Any) -> list[Layers]:
        """Returns the target critics of this update; with ``target_subset`` those that its random numbers name."""
        n, size = len(self.target_critics), self.config.target_subset
        if size is None:
            return self.target_critics
        chosen = np.asarray(jax.random.choice(jax.random.fold_in(key, 2), n, (size,), replace=False))
        assert len(set(chosen.tolist())) == size
        return [self.target_critics[i] for i in chosen]

    def target(self, batch: Transition) -> np.ndarray:
        target_key = jax.random.split(self.keys)[0]
        action, log_prob = self.sample(batch.next_obs, target_key)
        value = self.bootstrap(self.drawn(target_key), batch.next_obs, action)
        return self.backed_up(batch, value, self.alpha * log_prob)

    def backed_up(self, batch: Transition, value: np.ndarray, cost: np.ndarray) -> np.ndarray:
        target = batch.reward + batch.discount * (value - cost)
        bounds = self.config.v_min, self.config.v_max
        return target if bounds == (None, None) else np.clip(target, *bounds)

    def actor_loss(self, batch: Transition) -> tuple[float, np.ndarray]:
        """Returns the loss, and the entropies of the policy or their estimates, ``(batch,)``."""
        action, log_prob = self.sample(batch.obs, jax.random.split(self.keys)[1])
        return np.mean(self.alpha * log_prob - self.judge(self.critics, batch.obs, action)), -log_prob

    def improve(self, batch: Transition) -> dict[str, float]:
        alpha, learns_alpha = self.alpha, isinstance(self.config.ent_coef, str)
        alpha_loss = lambda: float(self.log_alphas[0][0]) * (self.last[1] - self.target_entropy)  # noqa: E731
        due = self.n % self.delay == 0
        if due:
            loss, entropies = self.actor_loss(batch)
            self.last = loss, entropies.mean()
            self.actor_adam.descend(lambda: self.actor_loss(batch)[0])
        found = {"actor_loss": self.last[0], "ent_coef": alpha, "entropy": self.last[1]}
        if learns_alpha:
            found["ent_coef_loss"] = alpha_loss()
        if learns_alpha and due:
            self.alpha_adam.descend(alpha_loss)
        return found


class DiscreteSAC(SAC):
    """Expectations over the actions in place of samples."""

    predict = DiscreteDDPG.predict

    @property
    def automatic(self) -> float:
        return 0.3 * np.log(self.actor[-1][1].size)

    def least(self, critics: list[Layers], obs: Any) -> np.ndarray:
        return self.smallest([forward(critic, obs) for critic in critics])

    def judge(self, critics: list[Layers], obs: Any, action: Any = None) -> np.ndarray:
        values = [forward(critic, obs) for critic in critics]
        return self.least(critics, obs) if self.config.target_subset is None else np.mean(values, axis=0)

    def target(self, batch: Transition) -> np.ndarray:
        probabilities = softmax(forward(self.actor, batch.next_obs))
        rows = zip(probabilities, self.least(self.drawn(self.keys), batch.next_obs), strict=True)
        soft = [sum(p * (q - self.alpha * np.log(p)) for p, q in zip(*row, strict=True)) for row in rows]
        return self.backed_up(batch, np.array(soft), 0.0)

    def actor_loss(self, batch: Transition) -> tuple[float, np.ndarray]:
        probabilities = softmax(forward(self.actor, batch.obs))
        costs = self.alpha * np.log(probabilities) - self.judge(self.critics, batch.obs)
        return np.mean((probabilities * costs).sum(axis=1)), entropy_of(probabilities)


class TQC(SAC):
    """Critics of quantiles, of which the target drops the largest of all critics together."""

    @property
    def branches(self) -> set[str]:
        return set()

    def predict(self, critic: Layers, batch: Transition) -> np.ndarray:
        return self.quantiles(critic, batch.obs, batch.action)

    def quantiles(self, critic: Layers, obs: Any, action: Any) -> np.ndarray:
        return forward(critic, np.concatenate([np.float64(obs), np.float64(action)], axis=1))

    def penalty(self, prediction: np.ndarray, target: np.ndarray, weight: np.ndarray) -> float:
        return np.mean([w * quantile_huber(*row) for w, *row in zip(weight, prediction, target, strict=True)])

    def error(self, prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
        return np.abs(prediction.mean(axis=1) - target.mean(axis=1))

    def bootstrap(self, critics: list[Layers], obs: Any, action: Any) -> np.ndarray:
        each = [self.quantiles(critic, obs, action) for critic in critics]
        dropped = self.config.top_quantiles_to_drop_per_net * len(critics)
        pooled = np.sort(np.concatenate(each, axis=1), axis=1)
        return pooled[:, : pooled.shape[1] - dropped]

    def backed_up(self, batch: Transition, value: np.ndarray, cost: np.ndarray) -> np.ndarray:
        return batch.reward[:, None] + batch.discount[:, None] * (value - cost[:, None])

    def judge(self, critics: list[Layers], obs: Any, action: Any) -> np.ndarray:
        return np.mean([self.quantiles(critic, obs, action) for critic in critics], axis=(0, 2))


class IQL(Reference):
    """A value, an actor that imitates what was better than it, and critics that learn from the value, in this order."""

    def __init__(self, state: Any, config: Any, rate: float) -> None:
        self.config, self.met = config, set()
        (self.actor,), (self.value,), self.critics = members(state.actor), members(state.value), members(state.critics)
        self.target_critics, self.target_actor, self.tau = members(state.target_critics), None, config.tau
        learned = [*self.networks().items()][:3]
        self.adams = {name: [Adam(network, rate) for network in networks] for name, networks in learned}

    @property
    def branches(self) -> set[str]:
        return {"no critic is the smallest everywhere", "largest weight", "above", "below"}

    def networks(self) -> dict[str, list[Layers]]:
        targets = {"target_critics": self.target_critics}
        return {"actor": [self.actor], "value": [self.value], "critics": self.critics, **targets}

    def first_moments(self) -> dict[str, list[Layers]]:
        return {f"{name}_optimizer": [adam.first for adam in adams] for name, adams in self.adams.items()}

    def update(self, batch: Transition) -> dict[str, Any]:
        recorded = self.smallest([action_value(critic, batch.obs, batch.action) for critic in self.target_critics])

        def value_loss() -> float:
            errors = recorded - forward(self.value, batch.obs)[:, 0]
            self.met |= {"above" if error > 0 else "below" for error in errors}
            return np.mean([(self.config.expectile if u > 0 else 1 - self.config.expectile) * u**2 for u in errors])

        metrics = {"value_loss": self.descend("value", value_loss)}
        weight = np.exp(self.config.inverse_temperature * (recorded - forward(self.value, batch.obs)[:, 0]))
        self.met |= {"largest weight"} if (weight > 100).any() else set()
        weight[weight > 100] = 100

        def actor_loss() -> float:
            mean, std = np.tanh(forward(self.actor[:-1], batch.obs)), np.exp(self.actor[-1][0])
            return -np.mean(weight * stats.norm.logpdf(np.float64(batch.action), mean, std).sum(axis=1))

        metrics["actor_loss"] = self.descend("actor", actor_loss)
        target = batch.reward + batch.discount * forward(self.value, batch.next_obs)[:, 0]
        values = np.array([self.predict(critic, batch) for critic in self.critics])
        losses = [lambda one=one: np.mean((self.predict(one, batch) - target) ** 2) for one in self.critics]
        metrics["critic_loss"] = sum(self.descend("critics", loss, i) for i, loss in enumerate(losses))
        self.move_targets()
        return metrics | {"q_value": values.mean(), TD_ERROR: np.abs(values - target).mean(axis=0)}

    def descend(self, name: str, loss: Any, index: int = 0) -> float:
        """Takes one step of a network against the gradient of ``loss()``, and returns the loss before."""
        before = loss()
        self.adams[name][index].descend(loss)
        return before
