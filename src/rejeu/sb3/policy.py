"""``model.policy`` and its parts: views of an agent with the methods of Stable-Baselines3's policies, in NumPy.

A policy holds nothing itself: it reads and sets the parameters of its agent. A class of one's own subclasses one of these and
gives its constructor other settings, which become the agent's ``policy_kwargs``::

    class Wide(ActorCriticPolicy):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs, net_arch=[256, 256])
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Self

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from rejeu.core import spaces as rejeu_spaces
from rejeu.core.distributions import TanhNormal
from rejeu.core.spaces import as_batch
from rejeu.core.types import Action, AnyArray, Observation, PyTree
from rejeu.sb3.common.preprocessing import maybe_transpose
from rejeu.sb3.common.utils import Tensor, is_vectorized_observation

NETWORKS = {
    "actor": ("actor",),
    "critic": ("critics", "critic"),
    "actor_target": ("target_actor",),
    "critic_target": ("target_critics", "target_critic"),
    "q_net": ("network",),
    "quantile_net": ("network",),
    "q_net_target": ("target_network",),
    "quantile_net_target": ("target_network",),
}
"""Fields of the algorithms' states that are networks, by the names of Stable-Baselines3's."""
ALL_NETWORKS = frozenset(field for fields in NETWORKS.values() for field in fields)


class BaseModel:
    """Some of the networks of an agent.

    Args:
        observation_space: the space of observations.
        action_space: the space of actions.
        lr_schedule: accepted.
        settings: the ``policy_kwargs`` of the agent.
    """

    model: Any = None
    """The agent."""
    fields: frozenset[str] = ALL_NETWORKS
    """The fields of its state."""
    load_agent: Any = None
    """Function of path and device that returns an agent; set by :mod:`rejeu.sb3.algorithms`."""

    def __init__(
        self, observation_space: gym.Space, action_space: gym.Space, lr_schedule: object = None, **settings: Any
    ) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self.settings = settings

    @classmethod
    def of(cls, model: Any, fields: frozenset[str] = ALL_NETWORKS) -> Self:
        """Returns a view of an agent."""
        view = cls.__new__(cls)
        view.model, view.fields = model, fields
        view.observation_space, view.action_space = model.observation_space, model.action_space
        return view

    @property
    def device(self) -> Any:
        """Where the agent computes."""
        return self.model.device

    @property
    def training(self) -> bool:
        """False: no layer of rejeu computes otherwise while it acts."""
        return False

    def state_dict(self) -> dict[str, Tensor]:
        """Returns a copy of the parameters as arrays by name."""
        arrays = self.model.get_parameters()["policy"].items()
        return {name: array for name, array in arrays if self.fields & {*name.split(".")}}

    def load_state_dict(self, state_dict: Mapping[str, object], strict: bool = True) -> None:
        """Sets parameters.

        Raises:
            CheckpointError: if a name, shape or dtype does not match, or with ``strict`` if one is missing.
        """
        missing = [name for name in self.state_dict() if name not in state_dict]
        if strict and missing:
            raise RuntimeError(f"load_state_dict: {missing[0]} is missing; give all parameters, or strict=False")
        arrays = {name: np.asarray(value) for name, value in state_dict.items()}
        self.model.set_parameters(arrays, exact_match=False)

    def named_parameters(self) -> Iterator[tuple[str, np.ndarray]]:
        """Yields names and copies of the parameters."""
        yield from self.state_dict().items()

    def parameters(self) -> Iterator[np.ndarray]:
        """Yields copies of the parameters."""
        yield from self.state_dict().values()

    def parameters_to_vector(self) -> np.ndarray:
        """Returns the parameters as one vector."""
        return np.concatenate([array.ravel() for array in self.parameters()])

    def load_from_vector(self, vector: np.ndarray) -> None:
        """Sets the parameters from what :meth:`parameters_to_vector` returned."""
        current = self.state_dict()
        ends = np.cumsum([array.size for array in current.values()])[:-1]
        parts = zip(current.items(), np.split(np.asarray(vector), ends), strict=True)
        self.load_state_dict({name: values.reshape(array.shape).astype(array.dtype) for (name, array), values in parts})

    def save(self, path: str | Path) -> None:
        """Writes the whole agent; :meth:`load` returns the view of it."""
        self.model.save(path)

    @classmethod
    def load(cls, path: str | Path, device: object = "auto") -> Any:
        """Returns the view of the agent in a file that :meth:`save` wrote."""
        return cls.of(cls.load_agent(path, device), cls.fields)

    def set_training_mode(self, mode: bool) -> None:
        """Does nothing: no layer of rejeu computes otherwise while it acts."""

    def to(self, *args: object, **kwargs: object) -> Self:
        """Returns itself: an agent stays on the device that it was made for, and is not told when it is trained."""
        return self

    train = eval = to

    def is_vectorized_observation(self, observation: Observation) -> bool:
        """Returns whether an observation is a batch; images may have their channels first or last."""
        if isinstance(self.observation_space, spaces.Dict):
            parts = self.observation_space.spaces.items()
            observation = {key: maybe_transpose(np.asarray(observation[key]), space) for key, space in parts}
        else:
            observation = maybe_transpose(np.asarray(observation), self.observation_space)
        return is_vectorized_observation(observation, self.observation_space)

    @property
    def features_extractor(self) -> FeaturesExtractor:
        """The function from observations to features: of PPO and A2C the policy's, of several critics the first one's."""
        return FeaturesExtractor.of(self.model, self.fields)

    def extract_features(self, obs: Observation, features_extractor: Any = None) -> np.ndarray:
        """Returns the features of a batch of observations, ``(batch, features_dim)``."""
        return (features_extractor or self.features_extractor)(obs)

    def obs_to_tensor(self, observation: Observation) -> tuple[Any, bool]:
        """Returns observations as a batch of arrays, and whether they were a batch."""
        batch, single = as_batch(observation, self.model.observation_space, self.model.obs_leaves)
        return jax.tree.map(Tensor.of, batch), not single

    def predict(
        self,
        observation: Observation,
        state: PyTree = None,
        episode_start: AnyArray = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, PyTree]:
        """Returns actions in the environment's range, and the next state of a recurrent policy."""
        return self.model.predict(observation, state, episode_start, deterministic)

    def _batch(self, obs: Observation) -> Observation:
        return self.obs_to_tensor(obs)[0]


class FeaturesExtractor(BaseModel):
    """The function from observations to features, in one network of an agent or in several."""

    def state_dict(self) -> dict[str, Tensor]:
        """Returns a copy of the parameters as arrays by name."""
        return {name: array for name, array in super().state_dict().items() if "encoder" in name.split(".")}

    def __call__(self, obs: Observation) -> np.ndarray:
        """Returns the features of a batch of observations, ``(batch, features_dim)``."""
        return Tensor.of(self._encoder()(jax.tree.map(jnp.asarray, self._batch(obs))))

    forward = __call__

    @property
    def features_dim(self) -> int:
        """The number of features."""
        return self._encoder().n_features

    def _encoder(self) -> Any:
        state = self.model.state
        state = getattr(state, "learner", state)  # of normalize or rnd
        field = next(field for field in vars(state) if field in self.fields)
        network = getattr(state, field)
        return jax.tree.map(lambda x: x[0], network.encoder) if field.endswith("critics") else network.encoder


class Actor(BaseModel):
    """The actor of an off-policy agent."""

    def __call__(self, obs: Observation, deterministic: bool = True) -> np.ndarray:
        """Returns actions in [-1, 1] for a batch of observations."""
        action, _ = self.model.predict(self._batch(obs), deterministic=deterministic)
        return Tensor.of(rejeu_spaces.unscale_action(self.action_space, action))

    forward = __call__

    def get_std(self) -> np.ndarray:
        """Returns the standard deviations of the matrix of gSDE, ``(width, action_dim)``."""
        return np.exp(next(array for name, array in self.named_parameters() if name.endswith("log_std")))


class ContinuousCritic(BaseModel):
    """The critics of an off-policy agent for Box actions."""

    def __call__(self, obs: Observation, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Returns the values of actions in [-1, 1] by each critic, ``(batch, 1)`` each."""
        scaled = rejeu_spaces.scale_action(self.action_space, np.asarray(actions))
        values = self.model.q_values(self._batch(obs), scaled, "all")
        return tuple(Tensor.of(value[:, None]) for value in values)

    forward = __call__

    def q1_forward(self, obs: Observation, actions: np.ndarray) -> np.ndarray:
        """Returns the values of the first critic, ``(batch, 1)``."""
        return self(obs, actions)[0]


class QNetwork(BaseModel):
    """The network of DQN or QR-DQN."""

    def __call__(self, obs: Observation) -> np.ndarray:
        """Returns the values of all actions, ``(batch, n_actions)``."""
        return Tensor.of(self.model.q_values(self._batch(obs)))

    forward = __call__


class BasePolicy(BaseModel):
    """All networks of an agent."""

    policy_name: str | None = None
    """Name of the policy; None: by the observations."""

    def __call__(self, obs: Observation, deterministic: bool = False) -> Any:
        """Returns actions in the environment's range."""
        return self.predict(obs, deterministic=deterministic)[0]

    def forward(self, obs: Observation, deterministic: bool = False) -> Any:
        """Returns the result of calling it."""
        return self(obs, deterministic)

    @property
    def net_arch(self) -> Any:
        """Widths of the hidden layers."""
        shape = self.model.config.policy_kwargs
        return list(shape.net_arch) if shape.net_arch is not None else {"pi": list(shape.pi), "qf": list(shape.qf)}

    def __getattr__(self, name: str) -> Any:
        """Returns one of its networks: ``actor``, ``critic``, ``q_net`` and so on."""
        if name in NETWORKS and self.model is not None:
            has = {field for field in NETWORKS[name] if getattr(self.model.learner.shapes, field, None) is not None}
            if has:
                module_class = Actor if "actor" in name else ContinuousCritic if "critic" in name else QNetwork
                return module_class.of(self.model, frozenset(has))
        raise AttributeError(f"{type(self).__name__} has no {name!r}; see state_dict() and model.learning_rate")

    def scale_action(self, action: np.ndarray) -> np.ndarray:
        """Returns actions of the environment's range in [-1, 1]."""
        return np.asarray(rejeu_spaces.unscale_action(self.action_space, np.asarray(action)))

    def unscale_action(self, scaled_action: np.ndarray) -> np.ndarray:
        """Returns actions in [-1, 1] in the environment's range."""
        return np.asarray(rejeu_spaces.scale_action(self.action_space, np.asarray(scaled_action)))

    def reset_noise(self, n_envs: int = 1) -> None:
        """Resamples the noise of gSDE with the next step."""
        run = self.model.run
        if run.ended.size and jax.tree.leaves(run.carry):
            run.carry = self.model.learner.initial_carry(len(run.ended))


def half_widths(space: spaces.Space) -> tuple[np.ndarray, np.ndarray] | None:
    """Returns the centers and half widths of Box actions, None for others."""
    if not isinstance(space, spaces.Box):
        return None
    return (space.high + space.low).ravel() / 2, (space.high - space.low).ravel() / 2


class Distribution:
    """A distribution of actions, in NumPy. Random numbers come from NumPy's global generator, which ``set_random_seed`` seeds.

    Args:
        distribution: of actions in the algorithm's range.
        widths: centers and half widths of the environment's range; None: it is the same.
    """

    def __init__(self, distribution: Any = None, widths: tuple[np.ndarray, np.ndarray] | None = None) -> None:
        self.distribution, self.widths = distribution, widths

    def _own(self, actions: Action) -> Any:
        actions = np.asarray(actions)
        return actions if self.widths is None else (actions - self.widths[0]) / self.widths[1]

    def _shown(self, actions: Action) -> np.ndarray:
        actions = np.asarray(actions)
        return Tensor.of(actions if self.widths is None else actions * self.widths[1] + self.widths[0])

    def _log_width(self) -> float:
        return 0.0 if self.widths is None else float(np.sum(np.log(self.widths[1])))

    def log_prob(self, actions: Action) -> np.ndarray:
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


class ActorCriticPolicy(BasePolicy):
    """Policy and value of PPO or A2C."""

    def __call__(self, obs: Observation, deterministic: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns actions, their values ``(batch, 1)`` and log-probabilities ``(batch,)``."""
        distribution = self.get_distribution(obs)
        actions = distribution.get_actions(deterministic)
        return actions, self.predict_values(obs), distribution.log_prob(actions)

    def get_distribution(self, obs: Observation, action_masks: AnyArray = None) -> Distribution:
        """Returns the distribution of actions, in the environment's range."""
        network = self.model.state.network
        distribution = network.policy(jax.tree.map(jnp.asarray, self.model.with_masks(self._batch(obs), action_masks)))
        return Distribution(distribution, half_widths(self.action_space))

    def predict_values(self, obs: Observation) -> np.ndarray:
        """Returns the values of observations, ``(batch, 1)``."""
        return Tensor.of(self.model.value(self._batch(obs)).reshape(-1, 1))

    def evaluate_actions(
        self, obs: Observation, actions: np.ndarray, action_masks: AnyArray = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Returns values ``(batch, 1)``, log-probabilities of actions and the entropy of the policy, ``(batch,)`` each."""
        distribution = self.get_distribution(obs, action_masks)
        return self.predict_values(obs), distribution.log_prob(actions), distribution.entropy()


class MultiInputActorCriticPolicy(ActorCriticPolicy):
    """Policy and value for Dict observations."""

    policy_name = "MultiInputPolicy"


class ActorCriticCnnPolicy(ActorCriticPolicy):
    """Policy and value for images."""

    policy_name = "CnnPolicy"


class DQNPolicy(BasePolicy):
    """The networks of DQN and QR-DQN."""


class SACPolicy(BasePolicy):
    """The networks of SAC, TQC and CrossQ."""


class TD3Policy(BasePolicy):
    """The networks of TD3 and DDPG."""


class MlpPolicy(ActorCriticPolicy):
    """The policy of any algorithm for observations that are vectors."""

    policy_name = "MlpPolicy"


CnnPolicy, MultiInputPolicy = ActorCriticCnnPolicy, MultiInputActorCriticPolicy
