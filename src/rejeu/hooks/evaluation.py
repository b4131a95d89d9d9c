"""Evaluation every so many calls, and stopping by its results."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from rejeu.envs.masks import make_masked
from rejeu.hooks.base import BaseCallback, EventCallback, hooked
from rejeu.io import atomic
from rejeu.io.checkpoint import SUFFIX
from rejeu.reporting.evaluation import evaluate_policy
from rejeu.sb3.common.vec_env.adapters import dummy_vec_env, identities
from rejeu.sb3.common.vec_env.base_vec_env import VecEnv
from rejeu.sb3.common.vec_env.vec_normalize import sync_envs_normalization
from rejeu.validation import whole

if TYPE_CHECKING:
    from rejeu.agents import Agent


class EvalCallback(EventCallback):
    """Evaluates every so many calls, keeps the best model and writes down every result.

    An agent that takes action masks is given those of ``eval_env``, which must be a Gymnasium environment or a
    ``DummyVecEnv``.

    If the agent trains in a ``VecNormalize``, ``eval_env`` must be wrapped alike, with ``training=False``; its statistics
    are copied before each evaluation.

    Args:
        eval_env: a Gymnasium or vector environment other than the one the agent trains on.
        callback_on_new_best: called when an evaluation was the best so far.
        callback_after_eval: called after each evaluation.
        n_eval_episodes: episodes of an evaluation.
        eval_freq: calls between two evaluations: ``n_envs`` times as many environment steps.
        log_path: folder for ``evaluations.npz`` with ``timesteps (n,)``, ``results (n, episodes)``, ``ep_lengths`` and,
            where the environment says, ``successes``; plain arrays. None writes none.
        best_model_save_path: folder for ``best_model.safetensors``. None saves none.
        deterministic: the policy's mode, or a sample.
        render: show the environment while it plays.
        verbose: 1 prints each result.
        warn: accepted and without effect; see :func:`rejeu.evaluate_policy`.

    Raises:
        TypeError: if ``eval_env`` is no environment.
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
        self.callback_on_new_best = None if callback_on_new_best is None else hooked(callback_on_new_best)
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
        self._successes: list[bool] = []

    def _inside(self) -> list[BaseCallback]:
        return super()._inside() + ([] if self.callback_on_new_best is None else [self.callback_on_new_best])

    def init_callback(self, model: Agent) -> None:
        """Tells it the agent.

        Raises:
            ValueError: if it was given the environments that the agent trains on.
            TypeError: if the agent takes action masks, and those of ``eval_env`` cannot be reached.
        """
        super().init_callback(model)
        if model.takes_masks:
            make_masked(self.eval_env)
        if identities(self.training_env) & identities(self.eval_env):
            raise ValueError("EvalCallback was given the environments that the agent trains on; give it others")
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(model)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Tells what it calls what the loop knows."""
        super().update_child_locals(locals_)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.update_locals(locals_)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.on_training_start(self.locals, self.globals)

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq:
            return True
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        self._successes = []
        returns, lengths = evaluate_policy(
            self.model,
            self.eval_env,
            self.n_eval_episodes,
            self.deterministic,
            self.render,
            self._note_success,
            return_episode_rewards=True,
        )
        assert isinstance(returns, list)
        assert isinstance(lengths, list)
        self._write(returns, lengths)
        self._report(returns, lengths)
        goes_on = True
        if self.last_mean_reward > self.best_mean_reward:
            self.best_mean_reward = self.last_mean_reward
            if self.verbose >= 1:
                print("New best mean reward!")
            if self.best_model_save_path is not None:
                path = Path(self.best_model_save_path) / f"best_model{SUFFIX}"
                self.model.failed_writes.attempt(f"best model {path}", self.model.snapshot(path))
            if self.callback_on_new_best is not None:
                goes_on = self.callback_on_new_best.on_step()
        return goes_on and self._on_event()

    def _note_success(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        if locals_["done"] and (success := locals_["info"].get("is_success")) is not None:
            self._successes.append(bool(success))

    def _write(self, returns: list[float], lengths: list[int]) -> None:
        if self.log_path is None:
            return
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(returns)
        self.evaluations_length.append(lengths)
        parts: dict[str, Any] = {}
        if self._successes:
            self.evaluations_successes.append(self._successes)
            if {len(row) for row in self.evaluations_successes} == {self.n_eval_episodes}:
                parts["successes"] = np.array(self.evaluations_successes)
        parts["timesteps"] = np.array(self.evaluations_timesteps)
        parts["results"] = np.array(self.evaluations_results)
        parts["ep_lengths"] = np.array(self.evaluations_length)
        path = Path(f"{self.log_path}.npz")
        self.model.failed_writes.attempt(f"evaluations {path}", partial(_write_npz, path, parts))

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
        if self._successes:
            self.logger.record("eval/success_rate", float(np.mean(self._successes)))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)


class StopTrainingOnRewardThreshold(BaseCallback):
    """Stops once the best evaluation reaches a mean return; give it to ``EvalCallback(callback_on_new_best=...)``.

    Args:
        reward_threshold: least mean return.
        verbose: 1 says so.
    """

    def __init__(self, reward_threshold: float, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.reward_threshold = reward_threshold

    def _on_step(self) -> bool:
        goes_on = _evaluation(self).best_mean_reward < self.reward_threshold
        if self.verbose >= 1 and not goes_on:
            print(f"Stopping: the mean return has reached {self.reward_threshold}")
        return goes_on


class StopTrainingOnNoModelImprovement(BaseCallback):
    """Stops after more than so many evaluations in a row without a new best; for ``callback_after_eval``.

    Args:
        max_no_improvement_evals: so many are borne.
        min_evals: evaluations before counting begins.
        verbose: 1 says so.
    """

    carried: ClassVar[tuple[str, ...]] = (*BaseCallback.carried, "last_best_mean_reward", "no_improvement_evals")

    def __init__(self, max_no_improvement_evals: int, min_evals: int = 0, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.max_no_improvement_evals, self.min_evals = max_no_improvement_evals, min_evals
        self.last_best_mean_reward = -np.inf
        self.no_improvement_evals = 0

    def _on_step(self) -> bool:
        best, goes_on = _evaluation(self).best_mean_reward, True
        if self.n_calls > self.min_evals:
            self.no_improvement_evals = 0 if best > self.last_best_mean_reward else self.no_improvement_evals + 1
            goes_on = self.no_improvement_evals <= self.max_no_improvement_evals
        self.last_best_mean_reward = best
        if self.verbose >= 1 and not goes_on:
            print(f"Stopping: no new best model in the last {self.no_improvement_evals} evaluations")
        return goes_on


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with atomic.replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _evaluation(callback: BaseCallback) -> EvalCallback:
    if not isinstance(callback.parent, EvalCallback):
        raise TypeError(f"{type(callback).__name__} judges evaluations; give it to EvalCallback")
    return callback.parent
