"""Callbacks with Stable-Baselines3's interface.

A subclass of :class:`BaseCallback` implements ``_on_step``, which returns whether to continue, and any of
``_on_training_start``, ``_on_rollout_start``, ``_on_rollout_end`` and ``_on_training_end``. A *call* is one step of all
environments, so frequencies in calls (``eval_freq``, ``save_freq``) correspond to ``n_envs`` times as many environment steps.
The callbacks of :mod:`rejeu.callbacks` are simpler, and their frequencies are in environment steps.

A rollout is the experience between two updates: ``n_steps`` calls with PPO and A2C, ``train_freq`` calls with the others.
Unlike in Stable-Baselines3, the update after a rollout has already started when ``_on_step`` and ``_on_rollout_end`` of its
last step are called.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from rejeu.agents import Agent
from rejeu.agents.off_policy import OffPolicyAgent
from rejeu.callbacks.base import TrainingCallback
from rejeu.callbacks.progress_bar import ProgressBar
from rejeu.envs.masks import make_masked
from rejeu.io import atomic
from rejeu.io.checkpoint import SUFFIX
from rejeu.loops.run import Progress
from rejeu.reporting.logging import Logger
from rejeu.sb3.common.evaluation import evaluate_policy
from rejeu.sb3.common.vec_env.adapters import dummy_vec_env, identities
from rejeu.sb3.common.vec_env.base_vec_env import TERMINAL_OBSERVATION, TIME_LIMIT_TRUNCATED, VecEnv
from rejeu.sb3.common.vec_env.vec_normalize import sync_envs_normalization
from rejeu.validation import whole

__all__ = [
    "BaseCallback",
    "CallbackList",
    "CheckpointCallback",
    "ConvertCallback",
    "EvalCallback",
    "EventCallback",
    "EveryNTimesteps",
    "ProgressBarCallback",
    "StopTrainingOnMaxEpisodes",
    "StopTrainingOnNoModelImprovement",
    "StopTrainingOnRewardThreshold",
]


class BaseCallback(TrainingCallback):
    """Base class of the callbacks of ``learn``. Abstract: subclasses implement ``_on_step``.

    Args:
        verbose: 0 prints nothing, 1 prints messages, 2 prints more.

    >>> import rejeu
    >>> class Count(BaseCallback):
    ...     def _on_step(self):
    ...         return self.num_timesteps < 60
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", seed=0).learn(100, Count())
    >>> agent.num_timesteps
    60
    """

    model: Agent
    """The agent."""

    every_step: ClassVar[bool] = True

    carried: ClassVar[tuple[str, ...]] = ("n_calls",)
    """Names of the attributes that a checkpoint contains: numbers, strings, lists, dicts and arrays. Subclasses with further
    state extend them."""

    def __init__(self, verbose: int = 0) -> None:
        self.verbose = verbose
        self.n_calls = 0
        """Number of calls of ``on_step`` since construction."""
        self.num_timesteps = 0
        """Number of environment steps, as ``model.num_timesteps``."""
        self.locals: dict[str, Any] = {}
        """Variables of the loop: ``actions``, ``new_obs``, ``rewards``, ``dones``, ``infos``, ``self`` and ``env``."""
        self.globals: dict[str, Any] = {}
        self.parent: BaseCallback | None = None
        """The callback that calls this one, if there is one."""

    def before_training(self, agent: Agent) -> None:
        """Calls ``init_callback``, ``on_training_start`` and ``on_rollout_start``."""
        call = agent.training_call
        assert call is not None
        self.init_callback(agent)
        known = {
            "self": agent,
            "env": agent.get_env(),
            "callback": self,
            "total_timesteps": None if call.last_step is None else call.last_step - agent.run.step,
            "log_interval": call.log_interval,
            "reset_num_timesteps": call.steps_before == 0,
        }
        self.on_training_start(known, globals())
        self.on_rollout_start()

    def __call__(self, agent: Agent, progress: Progress) -> bool:
        """Calls ``update_locals``, ``on_step`` and, around an update, ``on_rollout_end`` and ``on_rollout_start``."""
        call, result = agent.training_call, progress.result
        assert call is not None
        assert result is not None
        self.update_locals(
            {
                "progress": progress,
                "actions": progress.action,
                "new_obs": agent.run.obs,
                "rewards": result.reward,
                "dones": result.terminated | result.truncated,
                "infos": env_infos(agent, progress),
            }
        )
        if not self.on_step():
            return False
        is_last = call.last_step is not None and progress.step >= call.last_step
        if progress.rollout_ended or is_last:
            self.on_rollout_end()
            if not is_last:
                self.on_rollout_start()
        return True

    def after_training(self, agent: Agent, error: BaseException | None) -> None:
        """Calls ``on_training_end``, unless an exception ended training."""
        if error is None:
            self.on_training_end()

    @property
    def training_env(self) -> VecEnv:
        """The environments that the agent trains in; they must not be stepped."""
        env = self.model.get_env()
        assert env is not None, "training needs environments"
        return env

    @property
    def logger(self) -> Logger:
        """Records values for the next row of statistics: ``self.logger.record("group/name", value)``."""
        return self.model.logger

    def state_dict(self) -> dict[str, Any]:
        """Returns the attributes named in ``carried``, for a checkpoint."""
        return {name: getattr(self, name) for name in self.carried}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        for name in self.carried:
            setattr(self, name, state[name])

    def init_callback(self, model: Agent) -> None:
        """Sets the agent."""
        self.model = model
        self._init_callback()

    def on_training_start(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        """Called before the first step."""
        self.locals, self.globals = locals_, globals_
        self.num_timesteps = self.model.num_timesteps
        self._on_training_start()

    def on_rollout_start(self) -> None:
        """Called before the first step after an update."""
        self._on_rollout_start()

    def on_step(self) -> bool:
        """Called after each step of the environments; returns whether to continue.

        Raises:
            TypeError: if ``_on_step`` returns None.
        """
        self.n_calls += 1
        self.num_timesteps = self.model.num_timesteps
        continues = self._on_step()
        if continues is None:
            raise TypeError(f"{type(self).__name__}._on_step returned None; return True to continue, False to stop")
        return bool(continues)

    def on_rollout_end(self) -> None:
        """Called after the last step before an update."""
        self._on_rollout_end()

    def on_training_end(self) -> None:
        """Called after the last step."""
        self._on_training_end()

    def update_locals(self, locals_: dict[str, Any]) -> None:
        """Updates ``locals``, also of the child callbacks."""
        self.locals.update(locals_)
        self.update_child_locals(locals_)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Updates ``locals`` of the child callbacks."""

    def _init_callback(self) -> None:
        """Override it to act once the agent is known."""

    def _on_training_start(self) -> None:
        """Override it to act before the first step."""

    def _on_rollout_start(self) -> None:
        """Override it to act before the first step after an update."""

    @abstractmethod
    def _on_step(self) -> bool:
        """Implement it to act after each step of the environments; returns whether to continue."""

    def _on_rollout_end(self) -> None:
        """Override it to act after the last step before an update."""

    def _on_training_end(self) -> None:
        """Override it to act after the last step."""


class EventCallback(BaseCallback):
    """Calls another callback on an event. Abstract: subclasses call ``_on_event`` in ``_on_step``.

    Args:
        callback: the callback, or a function of ``(locals, globals)``; None for none.
        verbose: see :class:`BaseCallback`.
    """

    def __init__(self, callback: BaseCallback | Callable[..., Any] | None = None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.callback = None if callback is None else to_callback(callback)
        if self.callback is not None:
            self.callback.parent = self

    def init_callback(self, model: Agent) -> None:
        """Sets the agent, also of the child callbacks."""
        super().init_callback(model)
        if self.callback is not None:
            self.callback.init_callback(model)

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of the callback and of its children."""
        return {"self": super().state_dict(), "inside": [child.state_dict() for child in self._children()]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        super().load_state_dict(state["self"])
        for child, part in zip(self._children(), state["inside"], strict=True):
            child.load_state_dict(part)

    def _children(self) -> list[BaseCallback]:
        return [] if self.callback is None else [self.callback]

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Updates ``locals`` of the child callbacks."""
        if self.callback is not None:
            self.callback.update_locals(locals_)

    def _on_training_start(self) -> None:
        if self.callback is not None:
            self.callback.on_training_start(self.locals, self.globals)

    def _on_event(self) -> bool:
        return True if self.callback is None else self.callback.on_step()


class CallbackList(BaseCallback):
    """Several callbacks as one; training stops when one of them returns False.

    Args:
        callbacks: callbacks, or functions of ``(locals, globals)``.
    """

    def __init__(self, callbacks: Iterable[BaseCallback | Callable[..., Any]]) -> None:
        super().__init__()
        self.callbacks = [to_callback(callback) for callback in callbacks]

    def state_dict(self) -> dict[str, Any]:
        """Returns the state of each callback, with the name of its class."""
        parts = [[type(callback).__name__, callback.state_dict()] for callback in self.callbacks]
        return {"self": super().state_dict(), "inside": parts}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned.

        Raises:
            ValueError: if the callbacks differ.
        """
        super().load_state_dict(state["self"])
        own, saved = [type(callback).__name__ for callback in self.callbacks], [name for name, _ in state["inside"]]
        if own != saved:
            raise ValueError(f"the run was saved with the callbacks {', '.join(saved)}, but has {', '.join(own)}")
        for callback, (_, part) in zip(self.callbacks, state["inside"], strict=True):
            callback.load_state_dict(part)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Updates ``locals`` of each callback."""
        for callback in self.callbacks:
            callback.update_locals(locals_)

    def _init_callback(self) -> None:
        for callback in self.callbacks:
            callback.init_callback(self.model)

    def _on_training_start(self) -> None:
        for callback in self.callbacks:
            callback.on_training_start(self.locals, self.globals)

    def _on_rollout_start(self) -> None:
        for callback in self.callbacks:
            callback.on_rollout_start()

    def _on_step(self) -> bool:
        return all([callback.on_step() for callback in self.callbacks])  # noqa: C419 - every one is called

    def _on_rollout_end(self) -> None:
        for callback in self.callbacks:
            callback.on_rollout_end()

    def _on_training_end(self) -> None:
        for callback in self.callbacks:
            callback.on_training_end()


class ConvertCallback(BaseCallback):
    """A function of ``(locals, globals)`` as a callback; only ``False`` stops training.

    ``learn`` calls a plain function as ``callback(agent, progress)``; wrap one of ``(locals, globals)`` in this class.

    Args:
        callback: the function.
        verbose: see :class:`BaseCallback`.
    """

    def __init__(self, callback: Callable[[dict[str, Any], dict[str, Any]], Any] | None, verbose: int = 0) -> None:
        super().__init__(verbose)
        self.callback = callback

    def _on_step(self) -> bool:
        return self.callback is None or self.callback(self.locals, self.globals) is not False


class CheckpointCallback(BaseCallback):
    """Saves the agent every ``save_freq`` calls to ``save_path/{name_prefix}_{steps}_steps.safetensors``.

    Args:
        save_freq: calls between two checkpoints: ``n_envs`` times as many environment steps.
        save_path: folder; created if missing.
        name_prefix: prefix of the file names.
        save_replay_buffer: also save the replay buffer, as ``{name_prefix}_replay_buffer_{steps}_steps.safetensors``.
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

    def _write(self, save: Callable[[Path], Any], kind: str) -> None:
        """Saves one file, or warns. It is not written later: the next one has another name."""
        path = self._path(kind)
        if self.model.failed_writes.attempt(str(path), lambda: save(path), retry=False):
            self._report(path)

    def _path(self, kind: str) -> Path:
        return self.save_path / f"{self.name_prefix}_{kind}{self.num_timesteps}_steps{SUFFIX}"

    def _report(self, path: Path) -> None:
        if self.verbose >= 2:
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
        best_model_save_path: folder for ``best_model.safetensors``. None saves none.
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
        self._successes: list[bool] = []

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
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(model)

    def update_child_locals(self, locals_: dict[str, Any]) -> None:
        """Updates ``locals`` of the child callbacks."""
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
            self._record_success,
            return_episode_rewards=True,
        )
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
                path = Path(self.best_model_save_path) / f"best_model{SUFFIX}"
                self.model.failed_writes.attempt(f"best model {path}", self.model.snapshot(path))
            if self.callback_on_new_best is not None:
                continues = self.callback_on_new_best.on_step()
        return continues and self._on_event()

    def _record_success(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
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


class ProgressBarCallback(BaseCallback):
    """Shows a progress bar, as ``learn(progress_bar=True)`` does."""

    def __init__(self) -> None:
        super().__init__()
        self._bar: Any = None

    def _on_training_start(self) -> None:
        self._bar = ProgressBar(self.locals["total_timesteps"], None)

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


def to_callback(callback: BaseCallback | Callable[..., Any]) -> BaseCallback:
    """Returns a callback unchanged, and a function of ``(locals, globals)`` as a callback."""
    return callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)


def env_infos(agent: Agent, progress: Progress) -> list[dict[str, Any]]:
    """Returns one info for each environment, with the keys that Stable-Baselines3's ``VecEnv`` and ``Monitor`` add."""
    result, env = progress.result, agent.env
    assert result is not None
    assert env is not None
    given = result.info if isinstance(result.info, list) else [{} for _ in range(env.n_envs)]
    infos = [
        {**info, TIME_LIMIT_TRUNCATED: bool(result.truncated[i] and not result.terminated[i])}
        for i, info in enumerate(given)
    ]
    for i in np.flatnonzero(result.terminated | result.truncated).tolist():
        if progress.last_obs is not None:
            infos[i].setdefault(TERMINAL_OBSERVATION, _row(progress.last_obs, i))
        if not np.isnan(success := env.success(result, i)):
            infos[i].setdefault("is_success", bool(success))
    for episode in progress.episodes:
        entry = {"r": episode.episode_return, "l": episode.length, "t": episode.seconds}
        infos[episode.env].setdefault("episode", entry)
    return infos


def _row(batch: Any, i: int) -> Any:
    if isinstance(batch, dict):
        return {key: _row(part, i) for key, part in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_row(part, i) for part in batch)
    return batch[i]


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with atomic.replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def _evaluation(callback: BaseCallback) -> EvalCallback:
    if not isinstance(callback.parent, EvalCallback):
        raise TypeError(f"{type(callback).__name__} needs evaluations; give it to EvalCallback")
    return callback.parent
