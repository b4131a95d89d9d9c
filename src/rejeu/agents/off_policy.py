"""The base class of agents that learn from a replay buffer."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from rejeu.agents.agent import Agent
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.checkpoints import model_files
from rejeu.core import checkpoint, spaces
from rejeu.core.errors import CheckpointError
from rejeu.core.records import brief
from rejeu.envs.goals import GoalFunctions
from rejeu.envs.make import VectorEnv
from rejeu.exploration.noise import Noise, for_actions
from rejeu.replay import ring_io
from rejeu.replay.hindsight import HerReplayBuffer, counters
from rejeu.replay.prioritized import Priorities, PriorityConfig
from rejeu.replay.ring import Ring
from rejeu.replay.uniform import ReplayBuffer
from rejeu.training.checks import checked_restart
from rejeu.training.compiled import train_one
from rejeu.training.off_policy import off_policy, offline
from rejeu.training.run import Progress

if TYPE_CHECKING:
    from rejeu.demonstrations import Demonstrations

BUFFERS: dict[str, type[ReplayBuffer] | type[HerReplayBuffer]] = {
    "ReplayBuffer": ReplayBuffer,
    "HerReplayBuffer": HerReplayBuffer,
}
"""Replay buffers by the name of their class."""


class OffPolicyAgent(Agent):
    """The base class of agents that learn from a replay buffer. Abstract: subclasses set ``algorithm``.

    They may override :meth:`make_buffer`, :meth:`make_noise`, :meth:`make_envs` and :meth:`loop`.
    """

    config: OffPolicyConfig

    @property
    def replay_buffer(self) -> ReplayBuffer | HerReplayBuffer:
        """The replay buffer."""
        return self.run.replay

    def save_replay_buffer(self, path: str | Path) -> Path:
        """Writes the replay buffer to one safetensors file and returns its path.

        A file that exists, perhaps that of an earlier buffer, is kept with a warning if the buffer is empty.

        Raises:
            ValueError: if the agent has no buffer.
        """
        file, replay = checkpoint.resolve(path), self.run.replay
        if (replay is None or not replay.size()) and file.exists():
            warnings.warn(
                f"{path} exists and is kept, as the replay buffer of this {self.name} is empty; call load_replay_buffer "
                "first, or give another path",
                stacklevel=2,
            )
            return file
        self._require_replay()
        header = {
            "observation_space": spaces.describe(self.observation_space),
            "action_space": spaces.describe(self.action_space),
        }
        return checkpoint.write(path, "replay", self.run.replay.arrays(), header)

    def load_replay_buffer(self, path: str | Path, truncate_last_traj: bool = True) -> None:
        """Replaces the replay buffer by a saved one; gradient steps can then continue at once.

        Args:
            path: as given to :meth:`save_replay_buffer`.
            truncate_last_traj: accepted and ignored; episodes that were running when it was saved are truncated.

        Raises:
            CheckpointError: if the file is damaged, or its spaces or size do not match; the buffer is then unchanged.
        """
        self._require_replay()
        try:
            with checkpoint.opened(path, "replay") as file:
                for name, space in (("observation", self.observation_space), ("action", self.action_space)):
                    model_files.check_space(file.header.get(f"{name}_space"), space, name)
                ring_io.check(self.run.replay.ring, file.specs)
                arrays = file.read()
            self.run.replay.restore(arrays)
        except CheckpointError:
            raise
        except (TypeError, ValueError) as error:
            raise CheckpointError(f"{path}: {brief(error)}") from None
        self.run.learn_from = self.config.learning_starts
        self.run.td_errors = []  # of transitions that are gone
        self.abandon_episodes()

    def _require_replay(self) -> None:
        if self.run.replay is None:
            raise ValueError("this agent has no environment and so no replay buffer; give one to load(path, env=...)")

    def make_noise(self) -> Noise | None:
        noise = self.config.action_noise
        return None if noise is None else for_actions(noise, self.action_space)

    def gradient_batch_size(self, n_envs: int) -> int:
        return self.config.batch_size

    def first_learning_step(self, step: int) -> int:
        return step + self.config.learning_starts

    def steps_to_take(self, n_steps: int) -> int:
        return n_steps

    def loop(self, n_steps: int | None, progress: Callable[[int], float]) -> Iterator[Progress]:
        if self.call.stops is not None:
            return train_one(self.run, self.learner, self.config, n_steps, progress, self.call.stops)
        if self.config.demonstrations is not None and self.learner.observe is not None and not self.run.step:
            from rejeu import demonstrations

            demonstrations.observe(self, demonstrations.read(self.config.demonstrations))
        if self.config.offline:
            return offline(self.run, self.learner, self.config, n_steps, progress)
        return off_policy(self.run, self.learner, self.config, n_steps, progress)

    def start_episodes(self) -> None:
        self.run.replay.begin(checked_restart(self.run))

    def make_buffer(self, env: VectorEnv) -> Any:
        config = self.config
        buffer = self.empty_buffer(env, env.n_envs, config.buffer_size, config.priorities)
        if config.demonstrations is None:
            return buffer
        from rejeu import demonstrations

        recorded = demonstrations.read(config.demonstrations)
        share = 1.0 if config.offline else config.demonstration_share
        return demonstrations.WithDemonstrations(buffer, self.replay_of(recorded, env), share)

    def replay_of(self, recorded: Demonstrations, env: VectorEnv) -> ReplayBuffer | HerReplayBuffer:
        """Returns a replay buffer that holds demonstrations, from which batches are drawn as from the agent's own.

        Raises:
            ValueError: if the spaces differ, the actions were not taken, or the agent uses action masks.
        """
        from rejeu import demonstrations

        demonstrations.check(self, recorded)
        if any(episode.is_labeled for episode in recorded.episodes):
            raise ValueError(
                "these episodes have an expert's answers in place of the actions that were taken, as those of dagger, and "
                "rewards that do not follow from them; clone them, or record(expert, env, ...) what the expert does"
            )
        if self.takes_masks:
            raise ValueError(
                f"{self.name} has action_masks=True, and a dataset has no masks, so that its targets would value forbidden "
                "actions; leave out one of them, or clone the dataset"
            )
        n_rows = recorded.n_steps + len(recorded.episodes) + 1
        buffer = self.empty_buffer(env, 1, n_rows, None)
        if isinstance(buffer, HerReplayBuffer):
            buffer.last_infos = tuple  # a dataset has none
        demonstrations.fill(buffer, self, recorded)
        return buffer

    def empty_buffer(
        self, env: VectorEnv, n_envs: int, size: int, priorities: PriorityConfig | None
    ) -> ReplayBuffer | HerReplayBuffer:
        """Returns an empty replay buffer for ``n_envs`` environments like those of ``env``, and ``size`` steps in all."""
        config = self.config
        if config.hindsight is not None:
            spaces.check_goal_space(env.observation_space)
        action = spaces.random_action(env.action_space, 1, np.random.default_rng(0))
        leaves, structure = self.observed(env)
        ring = Ring(
            capacity=size,
            n_envs=n_envs,
            obs_leaves=leaves,
            obs_structure=structure,
            action_shape=action.shape[1:],
            action_dtype=action.dtype,
            frame_stack=config.frame_stack,
            counters=() if config.hindsight is None else counters(config.hindsight),
            memory_size=sum(leaf.size for leaf in jax.tree.leaves(self.learner.initial_memory(1))),
        )
        tree = None if priorities is None else Priorities(ring, priorities)
        each_reward = config.normalize is not None and config.normalize.norm_reward
        cls: Any = config.replay_buffer_class
        cls = BUFFERS[cls] if isinstance(cls, str) else cls
        if config.hindsight is not None:
            buffer = cls(ring, config.gamma, config.hindsight, self._goals(env), config.n_steps, tree, each_reward)
            buffer.last_infos = env.infos
        else:
            settings: Any = config.replay_buffer_kwargs or ()
            if config.has_memory:
                shape = config.policy_kwargs
                settings = {"sequence": (shape.sequence_length, shape.burn_in)}
            buffer = cls(ring, config.gamma, config.n_steps, tree, each_reward, **dict(settings))
        if config.needs_next_action:
            buffer.with_next_action = True
        return buffer

    def drop_rollout(self) -> None:
        """Does nothing: off-policy algorithms learn from the transitions of any policy."""

    def keep_buffer(self, env: VectorEnv) -> None:
        replay = self.run.replay
        for buffer in (getattr(replay, "own", replay), getattr(replay, "demonstrations", None)):
            if isinstance(buffer, HerReplayBuffer):
                buffer.goals, buffer.last_infos = self._goals(env), env.infos

    @staticmethod
    def _goals(env: VectorEnv) -> GoalFunctions:
        goals = env.goals()
        if goals is None:
            raise ValueError(
                f"hindsight replay needs the environment's compute_reward(achieved_goal, desired_goal, info), and "
                f"{env.env_id} has none; add it, or use replay_buffer_class=None"
            )
        return goals
