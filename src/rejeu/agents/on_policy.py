"""The agents that learn from the experience of their present policy: PPO, RecurrentPPO and A2C."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import ModuleType
from typing import ClassVar

import numpy as np

from rejeu import spaces
from rejeu.agents.base import Agent
from rejeu.algorithms import a2c, ppo, recurrent_ppo
from rejeu.algorithms.actor_critic import OnPolicyConfig
from rejeu.envs.vector import VectorEnv
from rejeu.exploration.noise import Noise
from rejeu.loops.host import Progress
from rejeu.loops.on_policy import on_policy
from rejeu.replay.rollout import RolloutBuffer


class OnPolicyAgent(Agent):
    """What the agents share that learn from rollouts of their present policy. Abstract."""

    config: OnPolicyConfig

    def _noise(self) -> Noise | None:
        return None

    def _batch_size(self, n_envs: int) -> int:
        return self.config.steps_per_gradient(n_envs)

    def _learn_from(self, step: int) -> int:
        return step

    def _turns(self, n_steps: int | None, progress: Callable[[int], float]) -> Iterator[Progress]:
        return on_policy(self._run, self._compiled, self.config, n_steps, progress)

    def _make_buffer(self, env: VectorEnv) -> RolloutBuffer:
        config = self.config
        action = spaces.random_action(env.action_space, 1, np.random.default_rng(0))
        structure = spaces.structure(env.observation_space)
        n_steps = config.n_steps
        if config.n_episodes is not None:
            n_steps = config.n_episodes * (env.max_episode_steps or config.n_steps)
        return RolloutBuffer(
            n_steps, env.n_envs, self._obs_leaves, structure, action.shape[1:], action.dtype, config.gamma
        )

    def _keep_buffer(self, env: VectorEnv) -> None:
        """Nothing is kept: what was collected elsewhere is forgotten when the next rollout begins."""


class PPO(OnPolicyAgent):
    """Proximal policy optimisation (Schulman et al. 2017), for Box, Discrete, MultiDiscrete and MultiBinary actions."""

    algorithm: ClassVar[ModuleType] = ppo


class A2C(OnPolicyAgent):
    """Advantage actor-critic (Mnih et al. 2016), for Box, Discrete, MultiDiscrete and MultiBinary actions."""

    algorithm: ClassVar[ModuleType] = a2c


class RecurrentPPO(OnPolicyAgent):
    """PPO with an LSTM or GRU between observation and hidden layers, for environments that hide part of their state."""

    algorithm: ClassVar[ModuleType] = recurrent_ppo
