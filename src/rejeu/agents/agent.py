"""The agent: the methods of Stable-Baselines3, over what :class:`~rejeu.agents.base.BaseAgent` holds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np

from rejeu import spaces
from rejeu.agents import model_files, policy, resume, training
from rejeu.agents.base import BaseAgent
from rejeu.agents.description import ClassOnly
from rejeu.agents.run_files import RunFolder, run_folder
from rejeu.callbacks.base import Callback
from rejeu.envs.masks import split
from rejeu.io import checkpoint
from rejeu.reporting import summary
from rejeu.reporting.evaluation import Evaluation
from rejeu.reporting.logging import Sink


class Agent(BaseAgent):
    """What all agents share. Abstract: use SAC, PPO or another algorithm."""

    def learn(
        self,
        total_timesteps: int | None = None,
        callback: Callback | Iterable[Callback] | None = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
        *,
        episodes: int | None = None,
        minutes: float | None = None,
        sinks: Iterable[Sink] = (),
    ) -> Self:
        """Trains, and returns the agent.

        Args:
            total_timesteps: environment steps to take, over all environments; exactly so many are taken. None with
                ``episodes`` or ``minutes``.
            callback: called after every step as ``callback(agent, progress)``, or several; ``False`` stops training.
                A :class:`rejeu.callbacks.TrainingCallback` is also told when training starts and ends; those of
                :mod:`rejeu.sb3.common.callbacks` are such.
            log_interval: episodes between two rows of statistics.
            tb_log_name: name of the run in ``tensorboard_log``; None: the algorithm's.
            reset_num_timesteps: count steps from 0 and begin schedules (learning rate, exploration, clip range, beta)
                again. With False both continue as in Stable-Baselines3: steps taken before count as done and as part of
                the whole, so ``learn(300, reset_num_timesteps=False)`` after 100 steps moves schedules from 1/4 of their
                way to the end. Learning itself continues in either case.
            progress_bar: show one.
            episodes: stop when so many episodes have ended, over all environments.
            minutes: stop after so much wall time. Schedules follow whichever limit is nearest; episodes and training time
                before this call count as steps do.
            sinks: further places for the rows of statistics, such as ``rejeu.reporting.logging.CsvFile(path)``.

        Without any limit, an agent from :meth:`resume` goes on with the ``learn`` that was cut off, to its end; arguments
        that count steps and rows are then those of that call.

        Ctrl-C and SIGTERM end training after the step it is in, with everything consistent; ``interrupted`` is then True.

        Raises:
            ValueError: without an environment, or if no limit is given.
        """
        call = training.start_call(self, total_timesteps, episodes, minutes, log_interval, reset_num_timesteps)
        training.train(self, call, callback, tb_log_name, progress_bar, sinks)
        return self

    def remember_best(self, score: float | tuple[float, ...], by: str = "evaluation") -> bool:
        """Keeps the present weights for :meth:`restore_best` if ``score`` is the best so far; returns whether it is.

        ``learn`` calls it with the mean return of the last ``best_window`` training episodes (20, or 1 for the best single
        episode), :class:`rejeu.callbacks.Evaluate` with success rate and mean return; once it was called with the score of
        an evaluation, evaluations alone count. Scores of one kind must compare with each other.
        """
        return training.remember_best(self, score, by)

    def restore_best(self) -> Self:
        """Puts back the best weights so far: actor, critics, their targets and optimizers as they were together.

        Raises:
            ValueError: if none were kept yet, which takes ``best_window`` finished episodes or one evaluation.
        """
        training.restore_best(self)
        return self

    def statistics(self) -> dict[str, float]:
        """Returns the numbers of one log row: means over the last episodes, losses, rates. Waits for the device."""
        return training.statistics_row(self)

    def predict(
        self,
        observation: Any,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = False,
        action_masks: Any = None,
    ) -> tuple[np.ndarray, Any]:
        """Returns actions in the environment's own range, and what a policy with a memory remembers (without, ``state``).

        Args:
            observation: one observation of the environment's space, or a batch of them with a leading axis; the action
                has a leading axis if and only if the observation has.
            state: what the last call returned, for a policy with a memory; None where episodes begin.
            episode_start: where an episode begins with this observation, ``bool (batch,)``, so that what was remembered
                is forgotten there; None for nowhere.
            deterministic: the policy's mode; False draws from the policy, which gives the same action again where the policy
                is deterministic (DDPG, TD3). ``action_noise`` is never added: it belongs to training.
            action_masks: which actions are allowed, ``bool (batch, n)`` or ``(n,)``, for agents that take masks; None
                allows all.

        Raises:
            ValueError: if the observation or the mask does not have the space's structure or shape, or ``state`` that of
                the policy's memory.
        """
        if self.takes_masks:
            observation, action_masks = split(observation, action_masks)
        batch, single = policy.as_batch(observation, self.observation_space, self.obs_leaves)
        batch = self.with_masks(batch, action_masks)
        n = len(jax.tree.leaves(batch)[0])
        ended = np.zeros(n, bool) if episode_start is None else np.asarray(episode_start, bool).reshape(n)
        action, memory = policy.act(self, batch, deterministic, state, ended)
        scaled = spaces.scale_action(self.action_space, action)
        return (scaled[0] if single else scaled), state if memory is None else memory

    def evaluate(
        self,
        episodes: int | None = None,
        env: Any = None,
        deterministic: bool = True,
        seed: int | None = None,
        success_threshold: float | None = None,
        *,
        minutes: float | None = None,
    ) -> Evaluation:
        """Plays whole episodes and returns their returns, lengths, successes and 95 % intervals.

        Args:
            episodes: how many; None: 100, or with ``minutes`` as many as there is time for.
            env: where, as for the constructor; None: new environments like the agent's own if it was given an id,
                else the agent's own, whose running episodes are then given up.
            deterministic: the policy's mode; False draws from the policy, as :meth:`predict` does.
            seed: of the environments, the agent's own included; None draws one for new environments, and lets the
                random numbers of others go on.
            success_threshold: return from which on an episode counts as a success where the environment does not say;
                None takes the agent's own.
            minutes: of wall time; when they are over, no further episode begins. Episodes that have begun are played to
                their end and count, so that long ones are not left out: it takes up to one episode longer, and every
                environment plays at least one. None for no limit.

        It may be called by a callback while the agent learns. Where it plays in the environments that the agent trains
        on, be they given or not, training goes on in new episodes.
        """
        return policy.play(self, episodes, env, deterministic, seed, success_threshold, minutes)

    def save(self, path: str | Path) -> Path:
        """Writes the model to one safetensors file and returns its path; the replay buffer is not part of it.

        ``.safetensors`` is added to a path without a suffix. The file holds everything learnt, the hyper-parameters, the
        spaces and the counters. An older file at that path is replaced only once the new one is complete.
        """
        return self.snapshot(path)()

    def snapshot(self, path: str | Path) -> Callable[[], Path]:
        """Returns a function that does what :meth:`save` does, with the model as it is now, whenever it is called."""
        arrays, header = self.get_parameters(), model_files.header(self)

        def write() -> Path:
            self.last_saved = checkpoint.write(path, "agent", arrays, header)
            return self.last_saved

        return write

    @classmethod
    def load(cls, path: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of a model file. Runs nothing that the file holds; it supplies numbers only.

        Args:
            path: as given to :meth:`save`, or a run folder, whose best model is taken.
            env: where it continues to learn; None for an agent that only predicts. Such an agent still evaluates in
                environments like those that it was trained on, where they were made from a registered id.
            changes: constructor arguments or hyper-parameters to set otherwise than they were saved.

        Raises:
            FileNotFoundError: if there is no such file.
            CheckpointError: if the file is damaged, of another algorithm, environment, schema or shape; it says which.
        """
        with checkpoint.opened(model_files.find(path), "agent") as file:
            agent = model_files.load(
                cls, file, lambda agent: None if env is None else agent.make_envs(env, seed=agent.seed), changes
            )
        agent.made_from_id = isinstance(env, str)
        return agent

    @classmethod
    def resume(cls, folder: str | Path, env: Any = None, **changes: Any) -> Self:
        """Returns the agent of a run as its newest checkpoint holds it; ``learn()`` then goes on to the end that was set.

        Everything stands as it stood: what was learnt, the replay buffer, running episodes, exploration, random numbers,
        counters, statistics, callbacks' own memory (give ``learn`` the same callbacks). Where the environments
        can be saved (see :mod:`rejeu.envs.snapshot`) or repeat their episodes (EnvPool), the run that follows is the same,
        bit for bit, that would have followed without a break; elsewhere new episodes begin, and a warning says so.
        ``resumed`` tells which.

        Args:
            folder: as given to :class:`rejeu.callbacks.Checkpoint`.
            env: as for the constructor; None makes environments of the id and number that the run had.
            changes: hyper-parameters to set otherwise than they were.

        Raises:
            FileNotFoundError: if there is no checkpoint.
            CheckpointError: if the checkpoints are damaged, or of another algorithm or environment.
        """
        return resume.resume(cls, Path(folder), env, changes)

    def run_folder(self, folder: str | Path) -> RunFolder:
        """Returns the folder of checkpoints of its run, as :class:`rejeu.callbacks.Checkpoint` writes them."""
        return run_folder(self, Path(folder))

    def summary(self) -> str:
        """Returns a text drawing of the networks with their numbers of parameters; see :mod:`rejeu.reporting.summary`."""
        return summary.describe(self.learner.shapes, self.obs_leaves)


Agent.load = ClassOnly(Agent.__dict__["load"])  # type: ignore[method-assign,assignment]
