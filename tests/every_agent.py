"""Small agents of every algorithm and kind of action space. They share compiled functions (see ``sharing``)."""

from typing import Any, NamedTuple

import gymnasium as gym
import pytest

import rejeu
from rejeu import agents
from rejeu.envs.make import InProcess
from tests.algorithms.probes.environments import Discretely, Probe
from tests.sharing import shared_learners
from tests.tiers import only


class Kind(NamedTuple):
    """An algorithm with one kind of action space."""

    name: str
    discrete: bool
    settings: dict[str, Any]
    """Hyperparameters with which it learns the probes."""
    delay: int = 1
    """Number of gradient steps after which all parameters have changed."""

    @property
    def agent(self) -> type[agents.Agent]:
        return agents.AGENTS[self.name]

    def envs(self, probe: type[Probe], n_envs: int = 1) -> InProcess:
        """Returns a vector environment of ``n_envs`` probes with such actions."""
        return InProcess([env_of(self, probe()) for _ in range(n_envs)])

    def small(self, env: Any, **settings: Any) -> agents.Agent:
        """Returns a small agent of this kind."""
        return small(self, env, **settings)

    @property
    def has_temperature(self) -> bool:
        return "ent_coef" in self.settings

    @property
    def has_targets(self) -> bool:
        return self.name != "CrossQ"


NOISE = rejeu.NormalActionNoise([0.0], [0.3])
TEMPERATURE = {"ent_coef": "auto_0.01"}
CALMING = {"learning_rate": rejeu.Linear(1e-2, 1e-3)}
"""Without target networks, the last steps must be smaller."""
SCALED = {"normalize": None, "value_limit": 3.0, "noise_repeat": 1, "gradient_steps": 1}
"""Values of the probes as they are."""
EPSILON = {"train_freq": 1, "target_update_interval": 1, "exploration_fraction": 0.5}

KINDS = {
    "SAC": Kind("SAC", False, TEMPERATURE),
    "DDPG": Kind("DDPG", False, {"action_noise": NOISE}),
    "TD3": Kind("TD3", False, {"action_noise": NOISE}, delay=2),
    "TQC": Kind("TQC", False, {**TEMPERATURE, "n_quantiles": 5, "top_quantiles_to_drop_per_net": 1}),
    "CrossQ": Kind("CrossQ", False, {**TEMPERATURE, **CALMING, "policy_delay": 2}, delay=2),
    "FlashSAC": Kind("FlashSAC", False, {**TEMPERATURE, **CALMING, **SCALED}, delay=2),
    "XQC": Kind("XQC", False, {**TEMPERATURE, **CALMING, **SCALED}, delay=3),
    "IQL": Kind("IQL", False, {"action_noise": NOISE, "expectile": 0.9, "inverse_temperature": 10.0}),
    "TD3BC": Kind("TD3BC", False, {"action_noise": NOISE, "normalize": None, "alpha": 100.0}, delay=2),
    "ReBRAC": Kind("ReBRAC", False, {"action_noise": NOISE}, delay=2),
    "SAC, Discrete": Kind("SAC", True, TEMPERATURE),
    "DDPG, Discrete": Kind("DDPG", True, {}),
    "DQN": Kind("DQN", True, EPSILON),
    "QRDQN": Kind("QRDQN", True, {**EPSILON, "n_quantiles": 5}),
    "IQN": Kind("IQN", True, {**EPSILON, "n_quantiles": 8, "n_target_quantiles": 8, "n_policy_quantiles": 8}),
}
"""Every algorithm with every kind of action space that it supports."""

SAMPLE = ("SAC", "CrossQ", "DQN")
"""Actor-critic, batch normalization without targets, and Q-learning, which run by default; the others are exhaustive."""
every_kind = pytest.mark.parametrize("kind", only([KINDS[name] for name in SAMPLE], KINDS.values()), ids=KINDS)

LEARNING = {"learning_rate": 1e-2, "batch_size": 32, "tau": 0.05, "policy_kwargs": {"net_arch": [32]}}
RUN = {"gamma": 0.5, "buffer_size": 2000, "learning_starts": 64, "seed": 0}


def env_of(kind: Kind, probe: Probe | None = None) -> gym.Env:
    """Returns the probe (None: the default one) with this kind of action space."""
    probe = Probe() if probe is None else probe
    return Discretely(probe) if kind.discrete else probe


def small(kind: Kind, env: Any, **settings: Any) -> agents.Agent:
    """Returns a small agent of this kind."""
    settings = {**LEARNING, **RUN, **kind.settings, **settings}
    if not kind.has_targets:
        settings.pop("tau")
    with shared_learners():
        return kind.agent("MlpPolicy", env, **settings)
