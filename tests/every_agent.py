"""A small agent of every algorithm on every kind of action it takes, sharing what is compiled.

Building compiled functions dominates such tests. They depend on the settings of the networks and of the gradient, but not
on those of loop and replay buffer, so agents that differ in the latter only share them.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple
from unittest import mock

import gymnasium as gym

import rejeu
from rejeu import agents, spaces
from rejeu.loops.learner import Learner
from tests.algorithms.probes.environments import Discretely, Probe


class Kind(NamedTuple):
    """An algorithm with one kind of action space."""

    name: str
    discrete: bool
    settings: dict[str, Any]
    """What it needs to learn the probes."""
    delay: int = 1
    """Gradient steps until everything has moved once."""

    @property
    def agent(self) -> type[agents.Agent]:
        return agents.AGENTS[self.name]

    @property
    def has_temperature(self) -> bool:
        return "ent_coef" in self.settings

    @property
    def has_targets(self) -> bool:
        return self.name != "CrossQ"


NOISE = rejeu.NormalActionNoise([0.0], [0.3])
TEMPERATURE = {"ent_coef": "auto_0.01"}
CALMING = {"learning_rate": rejeu.Linear(1e-2, 1e-3)}
"""Without targets to follow slowly, the last steps must be smaller."""
EPSILON = {"train_freq": 1, "target_update_interval": 1, "exploration_fraction": 0.5}

KINDS = {
    "SAC": Kind("SAC", False, TEMPERATURE),
    "DDPG": Kind("DDPG", False, {"action_noise": NOISE}),
    "TD3": Kind("TD3", False, {"action_noise": NOISE}, delay=2),
    "TQC": Kind("TQC", False, {**TEMPERATURE, "n_quantiles": 5, "top_quantiles_to_drop_per_net": 1}),
    "CrossQ": Kind("CrossQ", False, {**TEMPERATURE, **CALMING, "policy_delay": 2}, delay=2),
    "SAC, Discrete": Kind("SAC", True, TEMPERATURE),
    "DDPG, Discrete": Kind("DDPG", True, {}),
    "DQN": Kind("DQN", True, EPSILON),
    "QRDQN": Kind("QRDQN", True, {**EPSILON, "n_quantiles": 5}),
}
"""Every algorithm with every kind of action space that it takes."""

LEARNING = {"learning_rate": 1e-2, "batch_size": 32, "tau": 0.05, "policy_kwargs": {"net_arch": [32]}}
RUN = {"gamma": 0.5, "buffer_size": 2000, "learning_starts": 64, "seed": 0}

_compiled: dict[Any, Learner] = {}


def env_of(kind: Kind, probe: Probe | None = None) -> gym.Env:
    """The probe (None: any) with the kind's actions."""
    probe = Probe() if probe is None else probe
    return Discretely(probe) if kind.discrete else probe


def small(kind: Kind, env: Any, **settings: Any) -> agents.Agent:
    """A small agent of this kind."""
    settings = {**LEARNING, **RUN, **kind.settings, **settings}
    if not kind.has_targets:
        settings.pop("tau")
    with shared_functions(kind):
        return kind.agent("MlpPolicy", env, **settings)


@contextlib.contextmanager
def shared_functions(kind: Kind) -> Iterator[None]:
    """Agents of this kind that are made or loaded within share their compiled functions."""
    make, settings = kind.agent.algorithm.make, []

    def noted(config: Any, observation_space: gym.Space, action_space: gym.Space) -> Any:
        actions = action_space.shape if isinstance(action_space, gym.spaces.Box) else repr(action_space)
        settings.append((_of_gradients(config), spaces.leaves(observation_space), actions))
        return make(config, observation_space, action_space)

    def compile_once(algorithm: Any, noise: Any, skips: bool) -> Learner:
        key = settings.pop(), noise, skips
        if key not in _compiled:
            _compiled[key] = Learner(algorithm, noise, skips)
        return copy.copy(_compiled[key])

    with (
        mock.patch.object(kind.agent.algorithm, "make", noted),
        mock.patch.object(agents.base, "Learner", compile_once),
    ):
        yield


def _of_gradients(config: Any) -> Any:
    """The configuration with all that only loop and buffer read at its default."""
    read_elsewhere = {"learning_starts", "buffer_size", "gamma", "train_freq", "gradient_steps", "n_steps"}
    defaults = type(config)()
    names = read_elsewhere & {field.name for field in dataclasses.fields(config)}
    return dataclasses.replace(config, **{key: getattr(defaults, key) for key in names})
