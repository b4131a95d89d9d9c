"""The base class of agents that learn from rollouts of their current policy."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import numpy as np

from rejeu.agents import policy
from rejeu.agents.agent import Agent
from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.core import devices, spaces
from rejeu.core.types import AnyArray, Observation, PyTree
from rejeu.envs.make import VectorEnv
from rejeu.envs.masks import split
from rejeu.exploration.noise import Noise
from rejeu.replay.rollout import RolloutBuffer
from rejeu.training import finite
from rejeu.training.compiled import train_one
from rejeu.training.on_policy import begin_episodes, on_policy, steps_to_take
from rejeu.training.run import Progress


class OnPolicyAgent(Agent):
    """The base class of agents that learn from rollouts of their current policy. Abstract: subclasses set ``algorithm``.

    They may override :meth:`make_buffer`, :meth:`make_envs` and :meth:`loop`.
    """

    config: RolloutConfig

    def value(self, observation: Observation, state: PyTree = None, episode_start: AnyArray = None) -> np.ndarray:
        """Returns the critic's values of observations, that is, the expected discounted return, as ``float32``.

        With ``normalize``, observations are scaled as in training; if rewards are scaled, so are the values.

        Args:
            observation: one of the environment's space, or a batch of them with a leading axis.
            state: the state of a recurrent policy, which ``predict`` returned before these observations; None at the start
                of episodes.
            episode_start: whether an episode starts with this observation, ``bool (batch,)``; None for nowhere.

        Returns:
            ``(batch,)``, or one number if the observation has no batch axis.

        Raises:
            ValueError: if the observation or ``state`` has the wrong structure or shape, or if the algorithm has no critic.

        >>> import gymnasium as gym, rejeu
        >>> agent = rejeu.PPO("MlpPolicy", gym.make("CartPole-v1"), seed=0)
        >>> agent.value(np.zeros((50, 4), np.float32)).shape
        (50,)
        """
        if self.learner.algorithm.state_value is None:
            raise ValueError(f"{self.name} learns no values, only a policy")
        if self.takes_masks:
            observation, _ = split(observation, None)
        obs, single = spaces.as_batch(observation, self.observation_space, self.obs_leaves)
        n = len(jax.tree.leaves(obs)[0])
        ended = np.zeros(n, bool) if episode_start is None else np.asarray(episode_start, bool).reshape(n)
        with devices.chosen(self.device):
            finite.settle(self)
            memory = policy.memory_of(self, state, n)
            values = np.asarray(self.learner.state_value(self.run.state, memory, obs, ended))
        return values[0] if single else values

    def make_noise(self) -> Noise | None:
        return None

    def gradient_batch_size(self, n_envs: int) -> int:
        return self.config.steps_per_gradient(n_envs)

    def first_learning_step(self, step: int) -> int:
        return step

    def steps_to_take(self, n_steps: int) -> int:
        return steps_to_take(self.run, self.config, n_steps)

    def loop(self, n_steps: int | None, progress: Callable[[int], float]) -> Iterator[Progress]:
        if self.call.stops is not None:
            return train_one(self.run, self.learner, self.config, n_steps, progress, self.call.stops)
        return on_policy(self.run, self.learner, self.config, n_steps, progress)

    def start_episodes(self) -> None:
        begin_episodes(self.run, self.config, self.learner)

    def make_buffer(self, env: VectorEnv) -> RolloutBuffer:
        config = self.config
        action = spaces.random_action(env.action_space, 1, np.random.default_rng(0))
        obs_leaves, structure = self.observed(env)
        n_steps = config.n_steps
        if config.n_episodes is not None:
            n_steps = config.episodes(env.n_envs) * (env.max_episode_steps or config.n_steps)
        return RolloutBuffer(n_steps, env.n_envs, obs_leaves, structure, action.shape[1:], action.dtype, config.gamma)

    def keep_buffer(self, env: VectorEnv) -> None:
        """Discards the current rollout, which comes from another environment."""
        self.drop_rollout()

    def drop_rollout(self) -> None:
        """Discards the current rollout; the next one starts with new episodes."""
        run = self.run
        if run.replay is not None and run.replay.length:
            run.replay.length = 0
            run.obs = run.action = None
