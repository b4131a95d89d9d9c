"""Callbacks with Stable-Baselines3's interface: checkpoints, evaluation, progress bar, and conditions to stop.

The base classes are those of :mod:`rejeu.sb3.common.base_callback`. A *call* is one step of all environments, so frequencies
in calls (``eval_freq``, ``save_freq``) correspond to ``n_envs`` times as many environment steps. The callbacks of
:mod:`rejeu.callbacks` are simpler, and their frequencies are in environment steps.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from rejeu.agents import Agent
from rejeu.agents.off_policy import OffPolicyAgent
from rejeu.callbacks.progress_bar import ProgressBar
from rejeu.core import atomic
from rejeu.core.types import Variables
from rejeu.core.validation import whole
from rejeu.envs.masks import make_masked
from rejeu.sb3.common.base_callback import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EventCallback,
    to_callback,
)
from rejeu.sb3.common.evaluation import evaluate_policy
from rejeu.sb3.common.vec_env.adapters import dummy_vec_env, identities
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv
from rejeu.sb3.common.vec_env.vec_normalize import sync_envs_normalization
from rejeu.sb3.modules import passes_on


class CheckpointCallback(BaseCallback):
    """Saves the agent every ``save_freq`` calls to ``save_path/{name_prefix}_{steps}_steps.zip``.

    Args:
        save_freq: calls between two checkpoints: ``n_envs`` times as many environment steps.
        save_path: folder; created if missing.
        name_prefix: prefix of the file names.
        save_replay_buffer: also save the replay buffer, as ``{name_prefix}_replay_buffer_{steps}_steps.pkl``.
        save_vecnormalize: also save the statistics of ``VecNormalize``, as ``{name_prefix}_vecnormalize_...``.
        verbose: 2 prints each path.
    """

    def __init__(
        self,
        save_freq: int,
        save_path: str | Path,
        name_prefix: str = "rl_model",
        save_replay_buffer: bool = False,
        save_vecnormalize: bool = False,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        self.save_freq = whole("save_freq", save_freq, least=1)
        self.save_path = Path(save_path)
        self.name_prefix = name_prefix
        self.save_replay_buffer, self.save_vecnormalize = save_replay_buffer, save_vecnormalize

    def _on_step(self) -> bool:
        if self.n_calls % self.save_freq == 0:
            self._write(self.model.save, "")
            if self.save_replay_buffer and isinstance(self.model, OffPolicyAgent):
                self._write(self.model.save_replay_buffer, "replay_buffer_")
            statistics = self.model.get_vec_normalize_env()
            if self.save_vecnormalize and statistics is not None:
                self._write(statistics.save, "vecnormalize_")
        return True

    def _write(self, save: Callable[[Path], object], prefix: str) -> None:
        """Saves one file, or warns."""
        suffix = ".pkl" if prefix else ".zip"
        path = self.save_path / f"{self.name_prefix}_{prefix}{self.num_timesteps}_steps{suffix}"
        is_saved = self.model.failed_writes.attempt(str(path), lambda: save(path))
        if is_saved and self.verbose >= 2:
            print(f"Saved {path}")


class EvalCallback(EventCallback):
    """Evaluates every ``eval_freq`` calls, saves the best model and records every result.

    An agent with action masks receives those of ``eval_env``, which must be a Gymnasium environment or a
    ``DummyVecEnv``.

    If the agent trains in a ``VecNormalize``, ``eval_env`` must be wrapped in the same way, with ``training=False``. The
    statistics are copied before each evaluation.

    Args:
        eval_env: a Gymnasium or vector environment, not the one that the agent trains in.
        callback_on_new_best: called after each evaluation with the best result so far.
        callback_after_eval: called after each evaluation.
        n_eval_episodes: number of episodes of an evaluation.
        eval_freq: calls between two evaluations: ``n_envs`` times as many environment steps.
        log_path: folder for ``evaluations.npz`` with ``timesteps (n,)``, ``results (n, episodes)``, ``ep_lengths`` and,
            if the environment reports it, ``successes``. None writes no file.
        best_model_save_path: folder for ``best_model.zip``. None saves none.
        deterministic: use the mode of the policy; False samples actions.
        render: render the environment.
        verbose: 1 prints each result.
        warn: accepted and ignored; see :func:`rejeu.evaluate_policy`.

    Raises:
        TypeError: if ``eval_env`` is not an environment.
    """

    carried: ClassVar[tuple[str, ...]] = (
        *BaseCallback.carried,
        "best_mean_reward",
        "last_mean_reward",
        "evaluations_timesteps",
        "evaluations_results",
        "evaluations_length",
        "evaluations_successes",
    )

    def __init__(
        self,
        eval_env: gym.Env | VecEnv,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 5,
        eval_freq: int = 10_000,
        log_path: str | Path | None = None,
        best_model_save_path: str | Path | None = None,
        deterministic: bool = True,
        render: bool = False,
        verbose: int = 1,
        warn: bool = True,
    ) -> None:
        super().__init__(callback_after_eval, verbose)
        self.callback_on_new_best = None if callback_on_new_best is None else to_callback(callback_on_new_best)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.parent = self
        if isinstance(eval_env, gym.Env):
            eval_env = dummy_vec_env([eval_env])
        if not isinstance(eval_env, VecEnv):
            raise TypeError(f"eval_env must be a Gymnasium or a vector environment, got {type(eval_env).__name__}")
        self.eval_env = eval_env
        self.n_eval_episodes = whole("n_eval_episodes", n_eval_episodes, least=1)
        self.eval_freq = eval_freq
        self.log_path = None if log_path is None else str(Path(log_path) / "evaluations")
        self.best_model_save_path = best_model_save_path
        self.deterministic, self.render = deterministic, render
        self.best_mean_reward = self.last_mean_reward = -np.inf
        self.evaluations_timesteps: list[int] = []
        self.evaluations_results: list[list[float]] = []
        self.evaluations_length: list[list[int]] = []
        self.evaluations_successes: list[list[bool]] = []
        self._is_success_buffer: list[bool] = []

    def _children(self) -> list[BaseCallback]:
        return super()._children() + ([] if self.callback_on_new_best is None else [self.callback_on_new_best])

    def init_callback(self, model: Agent) -> None:
        """Sets the agent.

        Raises:
            ValueError: if ``eval_env`` is the environment that the agent trains in.
            TypeError: if the agent uses action masks and those of ``eval_env`` cannot be accessed.
        """
        super().init_callback(model)
        if model.takes_masks:
            make_masked(self.eval_env)
        if identities(self.training_env) & identities(self.eval_env):
            raise ValueError("EvalCallback was given the environments that the agent trains in; give it others")

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq:
            return True
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        self._is_success_buffer = []
        settings = self.n_eval_episodes, self.deterministic, self.render, self._log_success_callback
        returns, lengths = evaluate_policy(self.model, self.eval_env, *settings, return_episode_rewards=True)
        assert isinstance(returns, list)
        assert isinstance(lengths, list)
        self._write(returns, lengths)
        self._report(returns, lengths)
        continues = True
        if self.last_mean_reward > self.best_mean_reward:
            self.best_mean_reward = self.last_mean_reward
            if self.verbose >= 1:
                print("New best mean reward!")
            if self.best_model_save_path is not None:
                path = Path(self.best_model_save_path) / "best_model.zip"
                self.model.failed_writes.attempt(f"best model {path}", self.model.snapshot(path), is_model=True)
            if self.callback_on_new_best is not None:
                continues = self.callback_on_new_best.on_step()
        return continues and self._on_event()

    def _log_success_callback(self, locals_: Variables, globals_: Variables) -> None:
        if locals_["done"] and (success := locals_["info"].get("is_success")) is not None:
            self._is_success_buffer.append(bool(success))

    def _write(self, returns: list[float], lengths: list[int]) -> None:
        if self.log_path is None:
            return
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(returns)
        self.evaluations_length.append(lengths)
        arrays: dict[str, np.ndarray] = {}
        if self._is_success_buffer:
            self.evaluations_successes.append(self._is_success_buffer)
            if {len(row) for row in self.evaluations_successes} == {self.n_eval_episodes}:
                arrays["successes"] = np.array(self.evaluations_successes)
        arrays["timesteps"] = np.array(self.evaluations_timesteps)
        arrays["results"] = np.array(self.evaluations_results)
        arrays["ep_lengths"] = np.array(self.evaluations_length)
        path = Path(f"{self.log_path}.npz")
        self.model.failed_writes.attempt(f"evaluations {path}", partial(_write_npz, path, arrays))

    def _report(self, returns: list[float], lengths: list[int]) -> None:
        self.last_mean_reward = float(np.mean(returns))
        if self.verbose >= 1:
            print(
                f"Eval num_timesteps={self.num_timesteps}, "
                f"episode_reward={self.last_mean_reward:.2f} +/- {np.std(returns):.2f}"
            )
            print(f"Episode length: {np.mean(lengths):.2f} +/- {np.std(lengths):.2f}")
        self.logger.record("eval/mean_reward", self.last_mean_reward)
        self.logger.record("eval/mean_ep_length", float(np.mean(lengths)))
        if self._is_success_buffer:
            self.logger.record("eval/success_rate", float(np.mean(self._is_success_buffer)))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)


class StopTrainingOnMaxEpisodes(BaseCallback):
    """Stops after ``max_episodes`` episodes per environment, counted over all environments.

    Args:
        max_episodes: number of episodes per environment.
        verbose: 1 prints a message.
    """

    carried: ClassVar[tuple[str, ...]] = (*BaseCallback.carried, "n_episodes")

    def __init__(self, max_episodes: int, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.max_episodes = whole("max_episodes", max_episodes, least=1)
        self.n_episodes = 0

    def _on_step(self) -> bool:
        self.n_episodes += int(np.sum(self.locals["dones"]))
        continues = self.n_episodes < self.max_episodes * self.model.n_envs
        if self.verbose >= 1 and not continues:
            print(f"Stopping after {self.n_episodes} episodes in {self.num_timesteps} steps")
        return continues


class EveryNTimesteps(EventCallback):
    """Calls another callback every ``n_steps`` environment steps, at the first call after them.

    Args:
        n_steps: number of steps, over all environments.
        callback: the callback, or a function of ``(locals, globals)``.
    """

    carried: ClassVar[tuple[str, ...]] = (*EventCallback.carried, "last_time_trigger")

    def __init__(self, n_steps: int, callback: BaseCallback | Callable[..., Any]) -> None:
        super().__init__(callback)
        self.n_steps = whole("n_steps", n_steps, least=1)
        self.last_time_trigger = 0

    def _on_step(self) -> bool:
        if self.num_timesteps - self.last_time_trigger < self.n_steps:
            return True
        self.last_time_trigger = self.num_timesteps
        return self._on_event()


class LogEveryNTimesteps(EveryNTimesteps):
    """Writes a row of statistics every ``n_steps`` environment steps; give ``learn`` ``log_interval=None`` for no others.

    Args:
        n_steps: number of steps, over all environments.
    """

    def __init__(self, n_steps: int) -> None:
        super().__init__(n_steps, ConvertCallback(self._log))

    def _log(self, locals_: Variables, globals_: Variables) -> bool:
        for name, value in self.model.statistics().items():
            self.logger.record(name, value)
        self.logger.dump(self.num_timesteps)
        return True


class ProgressBarCallback(BaseCallback):
    """Shows a progress bar, as ``learn(progress_bar=True)`` does."""

    def __init__(self) -> None:
        super().__init__()
        self._bar: Any = None

    def _on_training_start(self) -> None:
        self._bar = ProgressBar.of(self.locals["self"].call.training_call)

    def _on_step(self) -> bool:
        self._bar(self.model, self.locals["progress"])
        return True

    def _on_training_end(self) -> None:
        self._bar.close()


class StopTrainingOnRewardThreshold(BaseCallback):
    """Stops once the best evaluation reaches a mean return; for ``EvalCallback(callback_on_new_best=...)``.

    Args:
        reward_threshold: minimum mean return.
        verbose: 1 prints a message.
    """

    def __init__(self, reward_threshold: float, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.reward_threshold = reward_threshold

    def _on_step(self) -> bool:
        continues = _evaluation(self).best_mean_reward < self.reward_threshold
        if self.verbose >= 1 and not continues:
            print(f"Stopping: the mean return has reached {self.reward_threshold}")
        return continues


class StopTrainingOnNoModelImprovement(BaseCallback):
    """Stops after consecutive evaluations without a new best result; for ``EvalCallback(callback_after_eval=...)``.

    Args:
        max_no_improvement_evals: number of evaluations that are allowed.
        min_evals: number of evaluations before counting starts.
        verbose: 1 prints a message.
    """

    carried: ClassVar[tuple[str, ...]] = (*BaseCallback.carried, "last_best_mean_reward", "no_improvement_evals")

    def __init__(self, max_no_improvement_evals: int, min_evals: int = 0, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.max_no_improvement_evals, self.min_evals = max_no_improvement_evals, min_evals
        self.last_best_mean_reward = -np.inf
        self.no_improvement_evals = 0

    def _on_step(self) -> bool:
        best, continues = _evaluation(self).best_mean_reward, True
        if self.n_calls > self.min_evals:
            self.no_improvement_evals = 0 if best > self.last_best_mean_reward else self.no_improvement_evals + 1
            continues = self.no_improvement_evals <= self.max_no_improvement_evals
        self.last_best_mean_reward = best
        if self.verbose >= 1 and not continues:
            print(f"Stopping: no new best model in the last {self.no_improvement_evals} evaluations")
        return continues


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with atomic.replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _evaluation(callback: BaseCallback) -> EvalCallback:
    if not isinstance(callback.parent, EvalCallback):
        raise TypeError(f"{type(callback).__name__} needs evaluations; give it to EvalCallback")
    return callback.parent


passes_on(__name__)
